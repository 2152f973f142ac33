import json
import math
import os
import random
import re
import shutil
import signal
import subprocess
import sys
from collections.abc import Callable, Iterator
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest
import safetensors.torch
import torch

from tests.bombs import BOMBS, bomb
from tests.methods import runs
from tests.replay.recordings import LOWER_Y_M, Driven, recording, write_street
from tests.scenes.networks import UserNetwork
from tests.simulation.scenes import T
from tests.waiting import wait_until
from tint_sumo import traits
from tint_sumo.config import PERFECT, SENSORS, TRAINING_SENSORS, Mix, PolicySettings, PpoSettings, TraitSettings
from tint_sumo.core.checkpoints import CHECKPOINT_FILE, PICKLES
from tint_sumo.core.determinism import preserved_random_state
from tint_sumo.core.errors import DivergedError, InputError
from tint_sumo.core.progress import Progress, Report
from tint_sumo.core.structures import plain
from tint_sumo.envs import TaskSettings
from tint_sumo.films.training_films import film_policy
from tint_sumo.methods import training
from tint_sumo.methods.evaluation import CASE_SEED, evaluate
from tint_sumo.methods.loading import load_policy
from tint_sumo.methods.training import CURVE_FILE, ZIP_FILE, share_training, train_policy
from tint_sumo.policy import ClassifierTraits, EncoderTraits, OracleTraits, RecurrentPPO, StreamingTraits
from tint_sumo.policy.loss import PpoLoss, ppo_loss
from tint_sumo.policy.network import GruPolicy
from tint_sumo.policy.storage import load_policy_network, read_policy_card
from tint_sumo.replay import from_tracks
from tint_sumo.scenes import read_scene
from tint_sumo.traits.storage import save

SNAPSHOTS = ["policy-25.json", "policy-25.safetensors", "policy-50.json", "policy-50.safetensors"]
SMALL_VAE = TraitSettings(embedding_sizes=(4, 4), hidden_size=4, encoder_output_size=4, decoder_output_size=4)


@pytest.fixture
def trait_model(encoders: Path, tmp_path: Path) -> Path:
    """A trait model that may be changed."""
    for suffix in (".json", ".safetensors"):
        (tmp_path / "some").mkdir(exist_ok=True)
        shutil.copyfile(encoders / f"vae{suffix}", tmp_path / "some" / f"encoder{suffix}")
    return tmp_path / "some" / "encoder.safetensors"


def interrupt_at(steps: int) -> Report:
    def report(progress: Progress) -> None:
        if progress.done >= steps:
            raise KeyboardInterrupt

    return report


def files(out: Path) -> list[str]:
    """Return the files of a folder, apart from the log."""
    return sorted(path.name for path in out.glob("[!.]*") if path.name != "tensorboard")


def weights(policy: Path) -> dict[str, torch.Tensor]:
    return dict(load_policy_network(policy.with_suffix("")).state_dict())


def same(one: dict[str, torch.Tensor], other: dict[str, torch.Tensor]) -> bool:
    return all(torch.equal(one[key], other[key]) for key in one.keys() | other.keys())


def observed(source_of: Path, num_envs: int = 16) -> Any:
    """Return observations of a trained policy at the beginning of some episodes."""
    venv = load_policy(source_of).make_venv(num_envs, TaskSettings(p_conservative=0.4))
    venv.seed(7)
    observation = venv.reset()
    venv.close()
    return observation


# Files of a run


def test_a_run_leaves_a_policy_its_card_its_snapshots_and_its_curve(tmp_path: Path, brief: PpoSettings) -> None:
    out = tmp_path / "run"
    reports: list[Progress] = []
    policy = train_policy("no_labels", Mix(0.25, 0.5), 250, 3, out, settings=brief, report=reports.append)
    assert policy == out / "policy.safetensors"
    assert [one.done for one in reports] == [0, 64, 128, 192, 250], "rollouts have 64 steps"
    assert all((one.total, one.unit) == (250, "step") for one in reports)
    card = json.loads((out / "policy.json").read_text())
    assert (card["method"], card["p_conservative"], card["steps"], card["seed"]) == ("no_labels", [0.25, 0.5], 250, 3)
    assert card["settings"]["n_steps"] == 16
    assert (card["scene"], card["scene_digest"]) == ("t_intersection", T.digest)
    assert (card["traits"], card["traits_sha256"]) == (None, None)
    assert {"libsumo", "torch", "python"} < set(card["versions"])
    assert files(out) == [CURVE_FILE, *SNAPSHOTS, "policy.json", "policy.safetensors", "run.json"]
    assert not list(out.rglob("*.partial"))


def test_the_log_and_the_curve_tell_the_outcomes_of_recent_episodes(tmp_path: Path, brief: PpoSettings) -> None:
    reports: list[Progress] = []
    train_policy("oracle", Mix(0.4), 256, 0, tmp_path, settings=brief, report=reports.append)
    curve = pd.read_csv(tmp_path / CURVE_FILE)
    assert list(curve) == ["decisions", "success", "timeout", "collision"]
    assert curve["decisions"].tolist() == [64, 128, 192, 256]
    assert (curve[["success", "timeout", "collision"]].sum(axis=1) == 1.0).all()
    assert (curve["timeout"] == 1.0).all(), "episodes of 0.8 s end by their time limit"
    assert [one.measures for one in reports] == [{}, *[{"success": 0.0, "collision": 0.0}] * 4]
    assert list((tmp_path / "tensorboard").iterdir())


def test_snapshots_are_the_policies_after_parts_of_the_training(tmp_path: Path, tiny: PpoSettings) -> None:
    policy = train_policy("oracle", Mix(0.4), 512, 0, tmp_path, settings=tiny)
    quarter, half = (tmp_path / f"policy-{percent}.safetensors" for percent in (25, 50))
    assert [read_policy_card(one.with_suffix(""))["decisions"] for one in (quarter, half)] == [128, 256]
    for one in (quarter, half):
        assert not same(weights(one), weights(policy))
        contender = load_policy(one)
        assert contender.p_conservative == Mix(0.4)
        actions, _ = contender.policy.predict(observed(one), deterministic=True)
        assert actions.shape == (16,)
    assert not same(weights(quarter), weights(half))


def test_a_run_of_a_single_rollout_has_snapshots_too(tmp_path: Path, tiny: PpoSettings) -> None:
    policy = train_policy("oracle", Mix(0.4), 10, 0, tmp_path, settings=tiny)
    assert all(same(weights(tmp_path / f"policy-{percent}.safetensors"), weights(policy)) for percent in (25, 50))


def test_a_finished_run_is_not_repeated(tmp_path: Path, tiny: PpoSettings) -> None:
    first = train_policy("oracle", Mix(0.4), 64, 0, tmp_path / "run", settings=tiny)
    written = first.stat().st_mtime_ns
    assert train_policy("oracle", Mix(0.4), 64, 0, tmp_path / "run", settings=tiny) == first
    assert first.stat().st_mtime_ns == written


def test_the_seed_decides(tmp_path: Path, tiny: PpoSettings) -> None:
    one, again, other = (
        weights(train_policy("oracle", Mix(0.4), 64, seed, tmp_path / name, settings=tiny))
        for name, seed in (("one", 0), ("again", 0), ("other", 1))
    )
    assert same(one, again)
    assert not same(one, other)


def test_a_loaded_policy_acts_as_the_trained_one(
    tmp_path: Path, tiny: PpoSettings, monkeypatch: pytest.MonkeyPatch
) -> None:
    trained: list[GruPolicy] = []
    original = RecurrentPPO.learn

    def learn(model: RecurrentPPO, *args: Any, **kwargs: Any) -> RecurrentPPO:
        trained.append(model.policy)
        return original(model, *args, **kwargs)

    monkeypatch.setattr(RecurrentPPO, "learn", learn)
    train_policy("oracle", Mix(0.4), 64, 0, tmp_path, settings=tiny)
    observation = observed(tmp_path)
    assert set(observation) == {"ego", "vehicles", "mask", "traits"}
    actions, (states,) = load_policy(tmp_path).policy.predict(observation, deterministic=True)
    expected, (expected_states,) = trained[0].predict(observation, deterministic=True)
    np.testing.assert_array_equal(actions, expected)
    np.testing.assert_array_equal(states, expected_states)


def test_decisions_can_last_several_steps(tmp_path: Path, tiny: PpoSettings) -> None:
    train_policy("oracle", Mix(0.4), 64, 0, tmp_path, settings=replace(tiny, action_repeat=5))
    contender = load_policy(tmp_path)
    venv = contender.make_venv(2, TaskSettings(contender.scene, p_conservative=0.4))
    venv.seed(0)
    start_y_m = 20.0 * venv.reset()["ego"][:, 1]
    y_m = 20.0 * venv.step(np.array([2, 2]))[0]["ego"][:, 1]
    venv.close()
    assert y_m - start_y_m == pytest.approx(3.0 * 0.1**2 * (1 + 2 + 3 + 4 + 5), abs=1e-3)  # five steps at 3 m/s2


# Interruptions


@pytest.fixture(autouse=True, scope="module")
def _every_rollout_can_be_gone_on_from() -> Iterator[None]:
    with pytest.MonkeyPatch.context() as patched:
        patched.setattr(training, "STATE_INTERVAL_S", 0.0)
        yield


def test_an_interrupted_run_goes_on_where_it_was(tmp_path: Path, brief: PpoSettings) -> None:
    out = tmp_path / "run"
    with pytest.raises(KeyboardInterrupt):
        train_policy("oracle", Mix(0.4), 512, 0, out, settings=brief, report=interrupt_at(256))
    assert files(out) == [CHECKPOINT_FILE, CURVE_FILE, *SNAPSHOTS[:2], "run.json"]
    with pytest.raises(InputError, match="not finished"):
        load_policy(out)
    assert load_policy(out / "policy-25").p_conservative == Mix(0.4)
    kept = (out / "policy-25.safetensors").stat().st_mtime_ns
    reports: list[Progress] = []
    train_policy("oracle", Mix(0.4), 512, 0, out, settings=brief, report=reports.append)
    assert [one.done for one in reports] == [192, 256, 320, 384, 448, 512], "what nothing was learnt from is repeated"
    assert files(out) == [CURVE_FILE, *SNAPSHOTS, "policy.json", "policy.safetensors", "run.json"]
    assert (out / "policy-25.safetensors").stat().st_mtime_ns == kept
    assert pd.read_csv(out / CURVE_FILE)["decisions"].tolist() == [64 * rollout for rollout in range(1, 9)]


def test_a_resumed_run_learns_as_often_as_one_at_a_stretch(tmp_path: Path, tiny: PpoSettings) -> None:
    with pytest.raises(KeyboardInterrupt):
        train_policy("oracle", Mix(0.4), 256, 0, tmp_path, settings=tiny, report=interrupt_at(128))
    train_policy("oracle", Mix(0.4), 256, 0, tmp_path, settings=tiny, with_zip=True)
    model = RecurrentPPO.load(tmp_path / ZIP_FILE)
    assert (model.num_timesteps, model._n_updates) == (256, 4)


def test_a_run_may_be_interrupted_again_and_again(tmp_path: Path, brief: PpoSettings) -> None:
    for steps in (64, 128, 128, 192):
        with pytest.raises(KeyboardInterrupt):
            train_policy("oracle", Mix(0.4), 256, 0, tmp_path, settings=brief, report=interrupt_at(steps))
    train_policy("oracle", Mix(0.4), 256, 0, tmp_path, settings=brief)
    assert pd.read_csv(tmp_path / CURVE_FILE)["decisions"].tolist() == [64, 128, 192, 256]


def look(policy: Path) -> None:
    """Look at a policy as films do, and draw random numbers of all kinds."""
    load_policy(policy)
    draw()


def draw(_: object = None) -> tuple[float, float, float]:
    return random.random(), float(np.random.random()), float(torch.rand(1))  # noqa: NPY002 - the global ones


@pytest.mark.parametrize("method", ["oracle", "vae", "streaming_critic"])
def test_an_interrupted_run_ends_with_the_very_same_policy(method: str, tmp_path: Path, tiny: PpoSettings) -> None:
    """Whoever looks on. Policies are kept, and looked at, after 128 and 256 decisions, and trainings go on from there.

    Episodes of 10 s are 25 decisions, and end within rollouts of 16; traits are inferred after 5 decisions.
    """
    settings = replace(tiny, time_limit_s=10.0)
    at_a_stretch, resumed = tmp_path / "at_a_stretch", tmp_path / "resumed"
    train = partial(train_policy, method, Mix(0.1, 0.9), 512, 0, settings=settings)
    train(at_a_stretch)
    for steps in (128, 256, 384):
        with pytest.raises(KeyboardInterrupt):
            train(resumed, report=interrupt_at(steps), film=look)
        torch.manual_seed(steps)  # another process has other random numbers
    train(resumed, report=draw, film=look)
    assert_same_training(resumed, at_a_stretch)


def test_a_run_that_repeats_rollouts_ends_with_the_very_same_policy(
    tmp_path: Path, brief: PpoSettings, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The state of the training is not kept at each of many short rollouts."""
    monkeypatch.setattr(training, "STATE_INTERVAL_S", math.inf)
    at_a_stretch, resumed = tmp_path / "at_a_stretch", tmp_path / "resumed"
    train = partial(train_policy, "oracle", Mix(0.4), 512, 0, settings=brief)
    train(at_a_stretch)
    with pytest.raises(KeyboardInterrupt):
        train(resumed, report=interrupt_at(384))
    reports: list[Progress] = []
    train(resumed, report=reports.append)
    assert reports[0].done == 0
    assert_same_training(resumed, at_a_stretch)


def test_an_interrupted_run_goes_on_in_the_towns_where_it_was(tmp_path: Path, brief: PpoSettings) -> None:
    towns = {"base": "towns", "members": 1, "towns": {"count": 40, "episodes": 5}}
    scene = read_scene({"base": "t_intersection", "population": towns})
    train = partial(train_policy, "oracle", Mix(0.4), 256, 0, settings=brief, scene=scene)
    at_a_stretch, resumed = tmp_path / "at_a_stretch", tmp_path / "resumed"
    train(at_a_stretch)
    for steps in (64, 192):
        with pytest.raises(KeyboardInterrupt):
            train(resumed, report=interrupt_at(steps))
    train(resumed)
    assert_same_training(resumed, at_a_stretch)


def test_an_interrupted_run_in_a_sumo_configuration_ends_with_the_very_same_policy(
    tmp_path: Path, tiny: PpoSettings, user_network: Callable[[str], UserNetwork]
) -> None:
    scene = user_network("merge").scene(warm_up_s=2.0, warm_up_spread_s=9.0, warm_starts=3, perceives=("lane",))
    settings = replace(tiny, n_envs=1, n_minibatches=1, time_limit_s=4.0)  # an episode has 10 decisions
    train = partial(train_policy, "no_labels", None, 64, 0, settings=settings, scene=scene)
    at_a_stretch, resumed = tmp_path / "at_a_stretch", tmp_path / "resumed"
    train(at_a_stretch)
    with pytest.raises(KeyboardInterrupt):
        train(resumed, report=interrupt_at(32))
    train(resumed)
    assert_same_training(resumed, at_a_stretch)


def test_a_training_leaves_the_random_numbers_and_threads_of_the_process_alone(
    tmp_path: Path, tiny: PpoSettings, encoders: Path
) -> None:
    with preserved_random_state():
        expected = draw()
    torch.set_num_threads(2)
    try:
        train_policy("vae", Mix(0.4), 64, 0, tmp_path, settings=tiny, traits=encoders / "vae.safetensors", film=look)
        assert torch.get_num_threads() == 2
    finally:
        torch.set_num_threads(1)
    assert draw() == expected


def test_policies_are_loaded_without_random_numbers(tmp_path: Path, tiny: PpoSettings) -> None:
    policy = train_policy("oracle", Mix(0.4), 64, 0, tmp_path, settings=tiny, with_zip=True)
    with preserved_random_state():
        expected = draw()
    load_policy(policy)
    load_policy(tmp_path / ZIP_FILE, allow_pickle=True)
    assert draw() == expected


def test_a_run_meets_no_case_of_the_tests(tmp_path: Path, tiny: PpoSettings, monkeypatch: pytest.MonkeyPatch) -> None:
    seeds: list[int] = []
    original = RecurrentPPO.learn

    def learn(model: RecurrentPPO, *args: Any, **kwargs: Any) -> RecurrentPPO:
        assert model.env is not None
        seeds.extend(model.env.unwrapped._seeds)
        return original(model, *args, **kwargs)

    monkeypatch.setattr(RecurrentPPO, "learn", learn)
    train_policy("oracle", Mix(0.4), 64, 0, tmp_path / "run", settings=tiny)
    assert len(set(seeds)) == 4  # environments
    assert max(seeds) < CASE_SEED


def assert_same_training(out: Path, other: Path) -> None:
    """To the last bit."""
    for name in (*SNAPSHOTS, "policy.json", "policy.safetensors", CURVE_FILE):
        assert (out / name).read_bytes() == (other / name).read_bytes(), name


@pytest.mark.slow
def test_a_killed_run_leaves_whole_files_and_goes_on(tmp_path: Path) -> None:
    out = tmp_path / "run"
    process = subprocess.Popen([sys.executable, "-m", "tests.methods.runs", str(out)])
    try:
        wait_until((out / "policy-25.json").exists, process)
    finally:
        os.kill(process.pid, signal.SIGKILL)
        process.wait()
    assert not (out / "policy.json").exists()
    with safetensors.safe_open(out / CHECKPOINT_FILE, "pt") as checkpoint:
        done = json.loads(checkpoint.metadata()["state"])["decisions"]
    assert runs.STEPS / 4 <= done < runs.STEPS
    assert pd.read_csv(out / CURVE_FILE)["decisions"].is_monotonic_increasing
    reports: list[Progress] = []
    train_policy(runs.METHOD, Mix(0.4), runs.STEPS, runs.SEED, out, settings=runs.SETTINGS, report=reports.append)
    assert reports[0].done == done
    assert files(out) == [CURVE_FILE, *SNAPSHOTS, "policy.json", "policy.safetensors", "run.json"]
    assert not list(out.rglob("*.partial"))
    assert pd.read_csv(out / CURVE_FILE)["decisions"].tolist() == list(range(64, runs.STEPS + 1, 64))
    assert all(load_policy(out / name) for name in ("policy-25", "policy-50", "policy"))
    train_policy(runs.METHOD, Mix(0.4), runs.STEPS, runs.SEED, tmp_path / "at_a_stretch", settings=runs.SETTINGS)
    assert_same_training(out, tmp_path / "at_a_stretch")


@pytest.fixture(scope="module")
def interrupted(tiny: PpoSettings, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder of a training with a checkpoint after two rollouts; do not write there."""
    out = tmp_path_factory.mktemp("interrupted") / "run"
    with pytest.raises(KeyboardInterrupt):
        train_policy("vae", Mix(0.4), 512, 0, out, settings=tiny, report=interrupt_at(192))
    return out


def go_on(out: Path, tiny: PpoSettings) -> str:
    """The line that refuses to go on with a training."""
    with pytest.raises(InputError) as refused:
        train_policy("vae", Mix(0.4), 512, 0, out, settings=tiny)
    assert "\n" not in str(refused.value)
    return str(refused.value)


@pytest.mark.parametrize("kind", BOMBS)
@pytest.mark.parametrize("name", [CHECKPOINT_FILE, *PICKLES])
def test_no_checkpoint_can_run_code(interrupted: Path, tmp_path: Path, tiny: PpoSettings, kind: str, name: str) -> None:
    out = shutil.copytree(interrupted, tmp_path / "run")
    (out / name).write_bytes(bomb(kind, tmp_path / "marker"))
    assert f"{out / name} is " in go_on(out, tiny)
    assert "remove it to begin the training anew" in go_on(out, tiny)
    assert not (tmp_path / "marker").exists()


SPOILT: dict[str, tuple[Callable[[dict[str, torch.Tensor], dict[str, Any]], object], str]] = {
    "a weight is missing": (lambda tensors, _: tensors.pop("model.action_net.bias"), "no model.action_net.bias"),
    "a weight has another shape": (
        lambda tensors, _: tensors.update({"model.action_net.bias": torch.zeros(4)}),
        r"model.action_net.bias is torch.float32 of \(4,\), not torch.float32 of \(3,\)",
    ),
    "a weight is no number": (lambda tensors, _: tensors["model.action_net.bias"].fill_(np.nan), "not finite"),
    "the optimizer has no numbers": (
        lambda tensors, _: tensors["optimizer.action_net.bias.exp_avg"].fill_(np.inf),
        "exp_avg has numbers that are not finite",
    ),
    "a trait has another type": (
        lambda tensors, _: tensors.update({"memory.2.traits": torch.zeros(4, 12, 2, dtype=torch.int64)}),
        "memory.2.traits is torch.int64",
    ),
    "no random numbers": (lambda tensors, _: tensors["generator"].fill_(255), "generator|RNG|state"),
    "an action is none": (lambda tensors, _: tensors["episodes.actions"].fill_(7), "actions of its episodes"),
    "actions are missing": (
        lambda tensors, _: tensors.update({"episodes.actions": torch.zeros(1, dtype=torch.int8)}),
        "actions of its episodes",
    ),
    "an episode is shorter than nothing": (
        lambda tensors, _: tensors["episodes.counts"][:2].add_(torch.tensor([-100, 100])),
        "actions of its episodes",
    ),
    "fewer environments": (lambda _, state: state["began"].pop(), "environments"),
    "an outcome is none": (lambda _, state: state.update(recent=["triumph"]), "recent outcomes"),
    "decisions are none": (lambda _, state: state.update(decisions="many"), "decisions"),
    "a generator is none": (lambda _, state: state["began"][0].update(state=-1), "state"),
    "something else": (lambda _, state: state.update(code="import os"), "code"),
}


@pytest.mark.parametrize(("spoil", "message"), SPOILT.values(), ids=SPOILT)
def test_a_checkpoint_that_does_not_fit_is_named(
    interrupted: Path, tmp_path: Path, tiny: PpoSettings, spoil: Any, message: str
) -> None:
    out = shutil.copytree(interrupted, tmp_path / "run")
    tensors = safetensors.torch.load_file(out / CHECKPOINT_FILE)
    with safetensors.safe_open(out / CHECKPOINT_FILE, "pt") as opened:
        state = json.loads(opened.metadata()["state"])
    spoil(tensors, state)
    safetensors.torch.save_file(tensors, out / CHECKPOINT_FILE, {"state": json.dumps(state)})
    line = go_on(out, tiny)
    assert line.startswith(f"{out / CHECKPOINT_FILE} is damaged or of another version (")
    assert re.search(message, line)
    assert not (out / "policy.json").exists()


def test_a_checkpoint_cut_short_is_named(interrupted: Path, tmp_path: Path, tiny: PpoSettings) -> None:
    out = shutil.copytree(interrupted, tmp_path / "run")
    content = (out / CHECKPOINT_FILE).read_bytes()
    (out / CHECKPOINT_FILE).write_bytes(content[: len(content) // 2])
    assert CHECKPOINT_FILE in go_on(out, tiny)


def test_a_training_that_diverges_says_where_and_keeps_its_last_finite_policy(
    tmp_path: Path, tiny: PpoSettings, monkeypatch: pytest.MonkeyPatch
) -> None:
    """In the fifth update, of one rollout each; once the cause is gone, the training goes on from there."""
    train = partial(train_policy, "oracle", Mix(0.4), 512, 0, settings=tiny)
    updates: list[PpoLoss] = []

    def loss(*args: Any, **kwargs: Any) -> PpoLoss:
        updates.append(ppo_loss(*args, **kwargs))
        return replace(updates[-1], total=updates[-1].total * (np.nan if len(updates) == 5 else 1.0))

    with monkeypatch.context() as patched:
        patched.setattr("tint_sumo.policy.ppo.ppo_loss", loss)
        with pytest.raises(DivergedError, match=r"^the training diverged at step 320: .* not finite[^\n]*$") as error:
            train(tmp_path / "run")
    assert str(tmp_path / "run") in str(error.value)
    assert files(tmp_path / "run") == [CHECKPOINT_FILE, CURVE_FILE, *SNAPSHOTS, "run.json"]
    tensors = safetensors.torch.load_file(tmp_path / "run" / CHECKPOINT_FILE)
    assert all(tensor.isfinite().all() for tensor in tensors.values())
    train(tmp_path / "run")
    train(tmp_path / "at_a_stretch")
    assert_same_training(tmp_path / "run", tmp_path / "at_a_stretch")


def test_several_sensors_share_the_environments_of_a_training(tmp_path: Path, tiny: PpoSettings) -> None:
    sensors = [PERFECT, SENSORS["noisy_0.2"]]
    policy = train_policy("no_labels", Mix(0.4), 256, 0, tmp_path / "run", settings=tiny, sensors=sensors)
    assert read_policy_card(policy.with_suffix(""))["sensors"] == [plain(sensor) for sensor in sensors]
    assert load_policy(policy).sensor == PERFECT
    train_policy("no_labels", Mix(0.4), 256, 0, tmp_path / "perfect", settings=tiny)
    assert policy.read_bytes() != (tmp_path / "perfect" / "policy.safetensors").read_bytes()
    with pytest.raises(InputError, match="another run"):
        train_policy("no_labels", Mix(0.4), 256, 0, tmp_path / "run", settings=tiny, sensors=sensors[:1])
    with pytest.raises(InputError, match="n_envs must be at least 9, an environment for each scene and sensor, not 4"):
        train_policy("no_labels", Mix(0.4), 64, 0, tmp_path / "more", settings=tiny, sensors=TRAINING_SENSORS)


def test_a_film_of_a_policy_that_has_diverged_says_at_which_step(
    tmp_path: Path, tiny: PpoSettings, monkeypatch: pytest.MonkeyPatch
) -> None:
    """All its weights are finite, and what follows from them is not."""

    def overflow(policy: Path) -> bytes | None:
        with monkeypatch.context() as patched:
            patched.setattr("tint_sumo.films.training_films.load_policy", lambda *_, **__: broken(load_policy(policy)))
            return film_policy(policy)

    def broken(contender: Any) -> Any:
        with torch.no_grad():
            for parameter in contender.policy.parameters():
                parameter.fill_(3e38)
        return contender

    for _ in range(2):  # the same command comes to the same end
        with pytest.raises(DivergedError, match=r"^the training diverged at step \d+: .*outputs are not finite"):
            train_policy("oracle", Mix(0.4), 64, 0, tmp_path / "run", settings=tiny, film=overflow)
        assert not [name for name in files(tmp_path / "run") if name.startswith("policy") and name.endswith(".json")]


def test_a_policy_whose_outputs_are_not_finite_is_not_kept(
    tmp_path: Path, tiny: PpoSettings, monkeypatch: pytest.MonkeyPatch
) -> None:
    """All its weights are finite; no film is made of it."""

    def train(model: RecurrentPPO) -> None:
        with torch.no_grad():
            for parameter in model.policy.parameters():
                parameter.fill_(3e38)

    monkeypatch.setattr(RecurrentPPO, "train", train)
    with pytest.raises(DivergedError, match=r"^the training diverged at step 64: the policy's outputs are not finite"):
        train_policy("oracle", Mix(0.4), 64, 0, tmp_path, settings=tiny)
    assert not list(tmp_path.glob("policy*"))


# Folders and arguments


def test_a_training_with_another_sensor_is_another_run(tmp_path: Path, tiny: PpoSettings) -> None:
    policy = train_policy("oracle", Mix(0.4), 64, 0, tmp_path, settings=tiny, sensors=[SENSORS["range_15"]])
    assert read_policy_card(policy.with_suffix(""))["sensor"]["range_m"] == 15.0
    assert load_policy(tmp_path).task.sensor == SENSORS["range_15"]
    with pytest.raises(InputError, match=r"another run \(different: sensor\)"):
        train_policy("oracle", Mix(0.4), 64, 0, tmp_path, settings=tiny)


def test_another_run_s_folder_is_refused(tmp_path: Path, tiny: PpoSettings) -> None:
    train_policy("oracle", Mix(0.4), 64, 0, tmp_path, settings=tiny)
    before = {path: path.read_bytes() for path in tmp_path.rglob("*") if path.is_file()}
    with pytest.raises(InputError, match=r"another run \(different: method, seed\)"):
        train_policy("no_labels", Mix(0.4), 64, 1, tmp_path, settings=tiny)
    assert {path: path.read_bytes() for path in tmp_path.rglob("*") if path.is_file()} == before


@pytest.mark.parametrize(
    ("method", "steps", "seed", "message"),
    [
        ("magic", 64, 0, "unknown method"),
        ("ttc", 64, 0, "hand-written rule"),
        ("oracle", 0, 0, "steps"),
        ("oracle", 64, -1, "seed"),
    ],
)
def test_bad_values_leave_no_folder(
    tmp_path: Path, tiny: PpoSettings, method: str, steps: int, seed: int, message: str
) -> None:
    with pytest.raises(InputError, match=message):
        train_policy(method, Mix(0.4), steps, seed, tmp_path / "run", settings=tiny)
    assert not (tmp_path / "run").exists()


@pytest.mark.parametrize(
    ("method", "given", "message"),
    [
        ("oracle", {"traits": "vae"}, "method oracle infers no traits; leave `traits` and `other_scene` out"),
        ("no_labels", {"other_scene": True}, "method no_labels infers no traits"),
        (
            "vae",
            {"settings": PpoSettings(policy=PolicySettings(attention=False))},
            "leave policy.attention out",
        ),
    ],
)
def test_what_a_method_has_no_use_for_is_refused(
    tmp_path: Path, tiny: PpoSettings, method: str, given: dict[str, Any], message: str
) -> None:
    with pytest.raises(InputError, match=message):
        train_policy(method, Mix(0.4), 64, 0, tmp_path / "run", **{"settings": tiny, **given})
    assert not (tmp_path / "run").exists()


@pytest.mark.parametrize("method", ["vae", "relative", "ma", "no_labels"])
@pytest.mark.parametrize("own", [False, True])
def test_traits_are_inferred_in_no_other_steps_than_trait_models_read(
    tmp_path: Path, tiny: PpoSettings, user_network: Callable[[str], UserNetwork], method: str, own: bool
) -> None:
    slow = read_scene({"base": "t_intersection", "step_s": 0.2, "name": "slow"})
    scene, mix = (user_network("grid").scene(), None) if own else (slow, Mix(0.4))
    settings = replace(tiny, motion=method == "no_labels")
    line = r"scene (grid|slow) has steps of (1|0\.2) s, and traits are inferred in steps of 0\.1 s; set its step_s"
    with pytest.raises(InputError, match=line):
        train_policy(method, mix, 64, 0, tmp_path / "run", settings=settings, scene=scene)
    assert not (tmp_path / "run").exists()


def test_nobody_trains_in_a_recording_which_a_card_cannot_describe(tmp_path: Path, tiny: PpoSettings) -> None:
    scene = from_tracks(write_street(tmp_path), recording([Driven("west", 90.0, LOWER_Y_M, -10.0)]))
    with pytest.raises(InputError, match="scene street is a recording"):
        train_policy("no_labels", None, 64, 0, tmp_path / "run", settings=tiny, scene=scene)
    assert not (tmp_path / "run").exists()


def test_a_policy_that_infers_traits_drives_in_no_other_steps(tmp_path: Path, tiny: PpoSettings) -> None:
    policy = train_policy("no_labels", Mix(0.4), 64, 0, tmp_path, settings=replace(tiny, motion=True))
    contender = load_policy(policy, scene=read_scene({"base": "t_intersection", "step_s": 0.2}))
    with pytest.raises(InputError, match=r"traits are inferred in steps of 0\.1 s"):
        contender.make_venv(1, contender.task)


# Trait models


def test_the_trait_model_travels_with_the_policy(tmp_path: Path, tiny: PpoSettings, trait_model: Path) -> None:
    policy = train_policy("vae", Mix(0.4), 64, 0, tmp_path / "run", settings=tiny, traits=trait_model)
    trait_model.unlink()
    moved = (tmp_path / "run").rename(tmp_path / "moved")
    for path in (moved, moved / policy.name, moved / "policy-25"):
        contender = load_policy(path)
        assert contender.source is not None
        assert isinstance(contender.source(), EncoderTraits)
    found = evaluate(
        contender.policy,
        lambda num_envs: contender.make_venv(num_envs, TaskSettings(contender.scene, p_conservative=1.0)),
        2,
        0,
    )
    assert len(found.cases) == 2


def test_another_trait_model_is_another_run(tmp_path: Path, tiny: PpoSettings, trait_model: Path) -> None:
    train_policy("vae", Mix(0.4), 64, 0, tmp_path / "run", settings=tiny, traits=trait_model)
    save(traits.TRAIT_METHODS["vae"](SMALL_VAE), trait_model.with_suffix(""), {})
    with pytest.raises(InputError, match=r"another run \(different: traits\)"):
        train_policy("vae", Mix(0.4), 64, 0, tmp_path / "run", settings=tiny, traits=trait_model)


def test_a_trait_model_of_another_latent_size_is_refused(tmp_path: Path, tiny: PpoSettings) -> None:
    save(traits.TRAIT_METHODS["vae"](SMALL_VAE, latent_size=3), tmp_path / "wide", {})
    with pytest.raises(InputError, match="3 latents where 2 are needed"):
        train_policy("vae", Mix(0.4), 64, 0, tmp_path / "run", settings=tiny, traits=tmp_path / "wide.safetensors")
    assert not (tmp_path / "run").exists()


@pytest.mark.parametrize(
    ("method", "needed"), [("streaming", "cross_window"), ("ma", "classifier"), ("morton", "morton")]
)
def test_a_trait_model_of_another_method_is_refused(
    method: str, needed: str, tmp_path: Path, tiny: PpoSettings, trait_model: Path
) -> None:
    message = f"method {method} needs a trait model of the method {needed}, not of vae; give such a model as `traits`"
    with pytest.raises(InputError, match=message):
        train_policy(method, Mix(0.4), 64, 0, tmp_path / "run", settings=tiny, traits=trait_model)
    with pytest.raises(InputError, match=message):
        share_training(tmp_path / "oracle", method, tmp_path / "run", trait_model)
    assert not (tmp_path / "run").exists()


# Differences between the methods


def test_without_attention_there_are_no_scores(tmp_path: Path, tiny: PpoSettings, encoders: Path) -> None:
    policy = train_policy("no_attention", Mix(0.4), 64, 0, tmp_path, settings=tiny, traits=encoders / "vae.safetensors")
    assert not any(".score." in name for name in weights(policy))
    assert read_policy_card(tmp_path / "policy")["settings"]["policy"]["attention"] is False


def test_a_critic_that_sees_true_traits_is_trained_and_the_policy_drives_without_them(
    tmp_path: Path, tiny: PpoSettings, encoders: Path
) -> None:
    settings = replace(tiny, n_steps=32)
    train_policy(
        "streaming_critic", Mix(0.4), 128, 0, tmp_path, settings=settings, traits=encoders / "cross_window.safetensors"
    )
    assert read_policy_card(tmp_path / "policy")["network"] | {"settings": None} == {
        "settings": None,
        "trait_size": 5,
        "critic_sees_true_traits": True,
        "max_vehicles": 12,
        "actions": 3,
    }
    contender = load_policy(tmp_path)
    assert contender.source is not None and isinstance(contender.source(), StreamingTraits)
    assert set(observed(tmp_path)) == {"ego", "vehicles", "mask", "traits"}
    found = evaluate(
        contender.policy,
        lambda num_envs: contender.make_venv(num_envs, TaskSettings(contender.scene, p_conservative=0.9)),
        2,
        0,
    )
    assert len(found.cases) == 2


def test_what_the_critic_sees_is_learnt_from(tmp_path: Path, tiny: PpoSettings, encoders: Path) -> None:
    settings = replace(tiny, learning_rate=1e-2)
    train_policy(
        "streaming_critic", Mix(0.4), 256, 0, tmp_path, settings=settings, traits=encoders / "cross_window.safetensors"
    )
    before, after = (weights(tmp_path / f"{name}.safetensors") for name in ("policy-25", "policy"))
    changed = {name for name in before if not torch.equal(before[name], after[name])}
    assert any(name.startswith("critic_extractor.") for name in changed)
    assert any(name.startswith("critic_hint.") for name in changed)


def test_ma_is_trained_on_true_traits_and_drives_with_predicted_ones(
    tmp_path: Path, tiny: PpoSettings, encoders: Path
) -> None:
    oracle = train_policy("oracle", Mix(0.4), 64, 0, tmp_path / "oracle", settings=tiny)
    ma = train_policy("ma", Mix(0.4), 64, 0, tmp_path / "ma", settings=tiny, traits=encoders / "classifier.safetensors")
    assert same(weights(oracle), weights(ma))
    source = load_policy(ma).source
    assert source is not None and isinstance(source(), ClassifierTraits)


def test_a_shared_training_gives_the_same_actions_with_another_source(
    tmp_path: Path, tiny: PpoSettings, encoders: Path
) -> None:
    train_policy("oracle", Mix(0.1, 0.9), 128, 5, tmp_path / "oracle", settings=tiny)
    share_training(tmp_path / "oracle", "ma", tmp_path / "ma", encoders / "classifier.safetensors")
    card = read_policy_card(tmp_path / "ma" / "policy")
    assert (card["method"], card["trained_as"], card["seed"], card["traits"]) == ("ma", "oracle", 5, "traits")
    observation = observed(tmp_path / "oracle")
    for name in ("policy-25", "policy-50", "policy"):
        oracle, ma = (load_policy(tmp_path / method / name) for method in ("oracle", "ma"))
        actions, expected = (one.policy.predict(observation, deterministic=True)[0] for one in (ma, oracle))
        np.testing.assert_array_equal(actions, expected)
        assert ma.p_conservative == Mix(0.1, 0.9)
        assert oracle.source is not None and isinstance(oracle.source(), OracleTraits)
        assert ma.source is not None and isinstance(ma.source(), ClassifierTraits)
    written = (tmp_path / "ma" / "policy.safetensors").read_bytes()
    share_training(tmp_path / "oracle", "ma", tmp_path / "ma", encoders / "classifier.safetensors")
    assert (tmp_path / "ma" / "policy.safetensors").read_bytes() == written


def test_a_training_that_is_not_finished_is_not_shared(tmp_path: Path, tiny: PpoSettings, encoders: Path) -> None:
    with pytest.raises(KeyboardInterrupt):
        train_policy("oracle", Mix(0.4), 256, 0, tmp_path / "oracle", settings=tiny, report=interrupt_at(256))
    with pytest.raises(InputError, match=r"no file .*policy\.json"):
        share_training(tmp_path / "oracle", "ma", tmp_path / "ma", encoders / "classifier.safetensors")
    assert not (tmp_path / "ma" / "policy.json").exists()


def test_a_zip_file_is_written_on_demand_and_read_with_permission(tmp_path: Path, tiny: PpoSettings) -> None:
    policy = train_policy("oracle", Mix(0.4), 64, 0, tmp_path, settings=tiny, with_zip=True)
    assert RecurrentPPO.load(tmp_path / ZIP_FILE).num_timesteps == 64
    with pytest.raises(InputError, match="a pickle, which can run any code"):
        load_policy(tmp_path / ZIP_FILE)
    actions = [
        one.policy.predict(observed(policy), deterministic=True)[0]
        for one in (load_policy(policy), load_policy(tmp_path / ZIP_FILE, allow_pickle=True))
    ]
    np.testing.assert_array_equal(*actions)


def test_a_trait_model_of_another_scene_is_refused_unless_it_is_asked_for(tmp_path: Path, tiny: PpoSettings) -> None:
    there = partial(train_policy, "vae", Mix(0.5), 8, 0, tmp_path / "policy", settings=tiny, scene="roundabout")
    with pytest.raises(InputError, match="vae was trained in scene t_intersection, the policy is of scene roundabout"):
        there()
    assert not (tmp_path / "policy").exists()
    assert there(other_scene=True).exists()
