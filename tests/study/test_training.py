import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from tint_sumo import traits
from tint_sumo.config import PpoSettings, TraitSettings
from tint_sumo.errors import InputError
from tint_sumo.policy import EncoderTraits, RecurrentPPO
from tint_sumo.study.evaluation import CASE_SEED, evaluate
from tint_sumo.study.loading import load_policy
from tint_sumo.study.training import CHECKPOINT_FILE, train_policy
from tint_sumo.traits.storage import save

SMALL_VAE = TraitSettings(embedding_sizes=(4, 4), hidden_size=4, encoder_output_size=4, decoder_output_size=4)


@pytest.fixture
def trait_model(tmp_path: Path) -> Path:
    """A trait model nobody trained."""
    torch.manual_seed(0)
    save(traits.METHODS["vae"](SMALL_VAE), tmp_path / "some" / "encoder", {"seed": 0})
    return tmp_path / "some" / "encoder.safetensors"


def interrupt_at(steps: int) -> Callable[[int, int, str], None]:
    def report(done: int, total: int, note: str) -> None:
        if done >= steps:
            raise KeyboardInterrupt

    return report


def weights(file: Path) -> dict[str, torch.Tensor]:
    return dict(RecurrentPPO.load(file).policy.state_dict())


def test_a_run_leaves_a_policy_and_its_card(tmp_path: Path, tiny: PpoSettings) -> None:
    out = tmp_path / "run"
    told: list[tuple[int, int]] = []
    policy = train_policy(
        "no_labels", 0.25, 100, 3, out, settings=tiny, report=lambda done, total, _: told.append((done, total))
    )
    assert policy == out / "policy.zip"
    assert told == [(0, 100), (64, 100), (100, 100)]
    assert RecurrentPPO.load(policy).num_timesteps == 128  # whole rollouts of 4 environments and 16 steps
    card = json.loads((out / "policy.json").read_text())
    assert (card["method"], card["p_conservative"], card["steps"], card["seed"]) == ("no_labels", 0.25, 100, 3)
    assert card["settings"]["n_steps"] == 16
    assert "libsumo" in card["versions"]
    assert list((out / "tensorboard").iterdir())
    assert sorted(path.name for path in out.glob("[!.]*")) == ["policy.json", "policy.zip", "run.json", "tensorboard"]


def test_a_finished_run_is_not_repeated(tmp_path: Path, tiny: PpoSettings) -> None:
    first = train_policy("oracle", 0.4, 64, 0, tmp_path / "run", settings=tiny)
    written = first.stat().st_mtime_ns
    assert train_policy("oracle", 0.4, 64, 0, tmp_path / "run", settings=tiny) == first
    assert first.stat().st_mtime_ns == written


def test_the_seed_decides(tmp_path: Path, tiny: PpoSettings) -> None:
    one, same, other = (
        weights(train_policy("oracle", 0.4, 64, seed, tmp_path / name, settings=tiny))
        for name, seed in (("one", 0), ("same", 0), ("other", 1))
    )
    assert all(torch.equal(one[key], same[key]) for key in one)
    assert not all(torch.equal(one[key], other[key]) for key in one)


def test_an_interrupted_run_goes_on_where_it_was(tmp_path: Path, tiny: PpoSettings) -> None:
    out = tmp_path / "run"
    with pytest.raises(KeyboardInterrupt):
        train_policy("oracle", 0.4, 256, 0, out, settings=tiny, report=interrupt_at(128))
    assert sorted(path.name for path in out.glob("[!.]*")) == [CHECKPOINT_FILE, "run.json", "tensorboard"]
    with pytest.raises(InputError, match="not finished"):
        load_policy(out)
    told: list[int] = []
    train_policy("oracle", 0.4, 256, 0, out, settings=tiny, report=lambda done, *_: told.append(done))
    assert told == [64, 128, 192, 256]  # the rollout that nothing was learnt from is collected again
    assert RecurrentPPO.load(out / "policy.zip")._n_updates == 4
    assert not (out / CHECKPOINT_FILE).exists()


def test_a_resumed_run_meets_new_episodes(tmp_path: Path, tiny: PpoSettings, monkeypatch: pytest.MonkeyPatch) -> None:
    seeds: list[int] = []
    original = RecurrentPPO.learn

    def learn(model: RecurrentPPO, *args: object, **kwargs: object) -> object:
        assert model.env is not None
        seeds.extend(model.env.unwrapped._seeds)
        return original(model, *args, **kwargs)  # type: ignore[arg-type]

    monkeypatch.setattr(RecurrentPPO, "learn", learn)
    with pytest.raises(KeyboardInterrupt):
        train_policy("oracle", 0.4, 192, 0, tmp_path / "run", settings=tiny, report=interrupt_at(128))
    train_policy("oracle", 0.4, 192, 0, tmp_path / "run", settings=tiny)
    assert len(set(seeds)) == 8  # 4 environments, twice
    assert max(seeds) < CASE_SEED


def test_a_damaged_checkpoint_is_named(tmp_path: Path, tiny: PpoSettings) -> None:
    with pytest.raises(KeyboardInterrupt):
        train_policy("oracle", 0.4, 128, 0, tmp_path, settings=tiny, report=interrupt_at(64))
    (tmp_path / CHECKPOINT_FILE).write_bytes(b"nonsense")
    with pytest.raises(InputError, match=CHECKPOINT_FILE):
        train_policy("oracle", 0.4, 128, 0, tmp_path, settings=tiny)


def test_another_run_s_folder_is_refused(tmp_path: Path, tiny: PpoSettings) -> None:
    train_policy("oracle", 0.4, 64, 0, tmp_path, settings=tiny)
    before = {path: path.read_bytes() for path in tmp_path.rglob("*") if path.is_file()}
    with pytest.raises(InputError, match=r"another run \(different: method, seed\)"):
        train_policy("no_labels", 0.4, 64, 1, tmp_path, settings=tiny)
    assert {path: path.read_bytes() for path in tmp_path.rglob("*") if path.is_file()} == before


@pytest.mark.parametrize(
    ("method", "p_conservative", "steps", "seed", "message"),
    [
        ("magic", 0.4, 64, 0, "unknown method"),
        ("ttc", 0.4, 64, 0, "hand-written rule"),
        ("oracle", 1.5, 64, 0, "p_conservative"),
        ("oracle", 0.4, 0, 0, "steps"),
        ("oracle", 0.4, 64, -1, "seed"),
    ],
)
def test_bad_values_leave_no_folder(
    tmp_path: Path, tiny: PpoSettings, method: str, p_conservative: float, steps: int, seed: int, message: str
) -> None:
    with pytest.raises(InputError, match=message):
        train_policy(method, p_conservative, steps, seed, tmp_path / "run", settings=tiny)
    assert not (tmp_path / "run").exists()


def test_the_trait_model_travels_with_the_policy(tmp_path: Path, tiny: PpoSettings, trait_model: Path) -> None:
    policy = train_policy("vae", 0.4, 64, 0, tmp_path / "run", settings=tiny, traits=trait_model)
    trait_model.unlink()
    moved = (tmp_path / "run").rename(tmp_path / "moved")
    for path in (moved, moved / policy.name):
        contender = load_policy(path)
        assert contender.source is not None
        assert isinstance(contender.source(), EncoderTraits)
        assert contender.p_conservative == 0.4
    found = evaluate(contender.policy, lambda num_envs: contender.make_venv(num_envs, 1.0), 2, 0)
    assert len(found.cases) == 2


def test_another_trait_model_is_another_run(tmp_path: Path, tiny: PpoSettings, trait_model: Path) -> None:
    train_policy("vae", 0.4, 64, 0, tmp_path / "run", settings=tiny, traits=trait_model)
    other = traits.METHODS["vae"](SMALL_VAE)
    save(other, trait_model.with_suffix(""), {})
    with pytest.raises(InputError, match=r"another run \(different: traits\)"):
        train_policy("vae", 0.4, 64, 0, tmp_path / "run", settings=tiny, traits=trait_model)


def test_a_trait_model_of_another_latent_size_is_refused(tmp_path: Path, tiny: PpoSettings) -> None:
    save(traits.METHODS["vae"](SMALL_VAE, latent_size=3), tmp_path / "wide", {})
    with pytest.raises(InputError, match="3 latents where 2 are needed"):
        train_policy("vae", 0.4, 64, 0, tmp_path / "run", settings=tiny, traits=tmp_path / "wide.safetensors")
    assert not (tmp_path / "run").exists()


def test_a_loaded_policy_acts_as_the_trained_one(tmp_path: Path, tiny: PpoSettings) -> None:
    policy = train_policy("oracle", 0.4, 64, 0, tmp_path, settings=tiny)
    contender = load_policy(tmp_path)
    venv = contender.make_venv(3, 0.4)
    venv.seed(7)
    observation = venv.reset()
    venv.close()
    assert set(observation) == {"ego", "vehicles", "mask", "traits"}
    actions, _ = contender.policy.predict(observation, deterministic=True)
    expected, _ = RecurrentPPO.load(policy).predict(observation, deterministic=True)
    np.testing.assert_array_equal(actions, expected)


def test_decisions_can_last_several_steps(tmp_path: Path, tiny: PpoSettings) -> None:
    train_policy("oracle", 0.4, 64, 0, tmp_path, settings=replace(tiny, action_repeat=5))
    contender = load_policy(tmp_path)
    venv = contender.make_venv(2, 0.4)
    venv.seed(0)
    start_y_m = 20.0 * venv.reset()["ego"][:, 1]
    y_m = 20.0 * venv.step(np.array([2, 2]))[0]["ego"][:, 1]
    venv.close()
    assert y_m - start_y_m == pytest.approx(3.0 * 0.1**2 * (1 + 2 + 3 + 4 + 5), abs=1e-3)  # five steps at 3 m/s2
