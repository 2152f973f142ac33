import json
import shutil
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import safetensors.torch

from tests.bombs import BOMBS, bomb
from tests.scenes.networks import lights
from tint_sumo import traits
from tint_sumo.config import ALL_MIXES, SENSORS, EgoController, Mix, PpoSettings
from tint_sumo.core.errors import InputError
from tint_sumo.core.weights import write_weights
from tint_sumo.envs import TaskSettings
from tint_sumo.methods import loading
from tint_sumo.methods.evaluation import evaluate
from tint_sumo.methods.loading import find_policy, load_policy, shipped_policies, shipped_policy
from tint_sumo.methods.registry import METHODS, Learned, built_in_methods
from tint_sumo.methods.rules import AlwaysGo, TimeToCollision
from tint_sumo.methods.training import train_policy
from tint_sumo.policy import EncoderTraits, NoTraits
from tint_sumo.scenes import ALL_SCENES, T_INTERSECTION, digest_of, find_scenes
from tint_sumo.traits.storage import save


@pytest.fixture(scope="module")
def runs(tmp_path_factory: pytest.TempPathFactory, tiny: PpoSettings, encoders: Path) -> Path:
    """Folders of two finished trainings."""
    out = tmp_path_factory.mktemp("runs")
    train_policy("no_labels", Mix(0.1, 0.9), 64, 0, out / "no_labels", settings=tiny, with_zip=True)
    train_policy("vae", Mix(0.6), 64, 0, out / "vae", settings=tiny, traits=encoders / "vae.safetensors")
    return out


@pytest.fixture
def run(runs: Path, tmp_path: Path) -> Path:
    """The folder of a training without inferred traits, and with a zip file."""
    return Path(shutil.copytree(runs / "no_labels", tmp_path / "run"))


@pytest.fixture
def run_with_traits(runs: Path, tmp_path: Path) -> Path:
    """The folder of a training with a trait model."""
    return Path(shutil.copytree(runs / "vae", tmp_path / "run"))


@pytest.fixture
def shelf(runs: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The folder of shipped models with two policies: ``vae`` and ``no_labels``."""
    for name, parts in (("vae", ("policy", "traits")), ("no_labels", ("policy",))):
        for part in parts:
            for suffix in (".safetensors", ".json"):
                target = tmp_path / "models" / "policies" / (name if part == "policy" else part)
                target.parent.mkdir(parents=True, exist_ok=True)
                shutil.copyfile(runs / name / f"{part}{suffix}", target.with_suffix(suffix))
    monkeypatch.setattr(loading, "shipped", lambda _: tmp_path / "models")
    return tmp_path / "models" / "policies"


def refused(name_or_path: str | Path, **options: Any) -> str:
    """The one line that says why a policy is not loaded."""
    with pytest.raises(InputError) as refusal:
        load_policy(name_or_path, **options)
    line = str(refusal.value)
    assert "\n" not in line
    return line


def test_rules_by_name() -> None:
    assert isinstance(load_policy("always_go").policy, AlwaysGo)
    assert isinstance(load_policy("ttc").policy, TimeToCollision)
    assert load_policy("ttc").source is None
    venv = load_policy("ttc").make_venv(2, TaskSettings())
    assert set(venv.reset()) == {"ego", "vehicles", "mask"}
    venv.close()


def test_rules_drive_in_sumo_configurations_with_any_desired_speeds_and_sumo_s_driver_obeys_lights(
    tmp_path: Path,
) -> None:
    controller = EgoController((0.0, 4.0, 8.0, 11.0))
    scene = lights(tmp_path, 0.5).scene(controller=controller, red_light="end", warm_up_s=5.0, time_limit_s=120.0)
    found = {}
    for name in ("always_go", "ttc", "sumo"):
        contender = load_policy(name, scene=scene)
        make_venv = partial(contender.make_venv, task=contender.task)
        found[name] = evaluate(contender.policy, make_venv, 4, 0, batch=1)
    assert found["sumo"].rate("success").value == 1.0
    for name in ("always_go", "ttc"):
        assert found[name].rate("red_light").value > 0.0
        assert found[name].outcomes == ("success", "timeout", "collision", "red_light")
    costly = load_policy("always_go", scene=replace(scene, red_light="cost"))
    for repeat in (1, 4):  # a decision costs as much as its steps
        driver = replace(costly, action_repeat=repeat)
        evaluation = evaluate(driver.policy, partial(driver.make_venv, task=driver.task), 4, 0, batch=1)
        assert [case.outcome for case in evaluation.cases] == ["success"] * 4
        assert evaluation.cost == evaluation.summary()["cost"] == 2.0, "both lights of its way are red"
    assert found["always_go"].cost is None
    assert "cost" not in found["always_go"].summary()
    assert "give a .sumocfg as the scene" in refused("sumo")
    assert "give a .sumocfg as the scene" in refused("sumo", scene="on_ramp")


@pytest.mark.parametrize("path", [".", "policy.safetensors", "policy", "policy-25", "policy-50.safetensors"])
def test_trained_policies_by_folder_and_by_file(run: Path, path: str) -> None:
    contender = load_policy(run / path)
    assert contender.name == str(run / path)
    assert contender.p_conservative == ALL_MIXES
    assert contender.source is not None and isinstance(contender.source(), NoTraits)


def test_a_policy_drives_in_the_world_it_is_asked_to(run_with_traits: Path) -> None:
    contender = load_policy(run_with_traits)
    assert contender.source is not None and isinstance(contender.source(), EncoderTraits)
    task = TaskSettings(p_conservative=ALL_MIXES, sensor=SENSORS["noisy_0.1"], tau_s=1.5, time_limit_s=3.0)
    found = evaluate(contender.policy, lambda num_envs: contender.make_venv(num_envs, task), 3, 0)
    assert len(found.cases) == 3


def test_a_policy_drives_in_the_scene_of_its_training_unless_another_one_is_asked_for(run: Path) -> None:
    for name in (run, "ttc"):
        assert load_policy(name).scene.name == T_INTERSECTION
        contender = load_policy(name, scene="roundabout")
        venv: Any = contender.make_venv(2, contender.task)
        assert venv.unwrapped.env.batch.episodes.simulation.scene.name == contender.scene.name == "roundabout"
        contender.policy.predict(venv.reset(), deterministic=True)
        venv.close()
        assert "unknown scene 'moon'" in refused(name, scene="moon")


def test_a_folder_that_is_called_like_a_rule_is_still_reached_by_path(run: Path) -> None:
    assert load_policy(run.rename(run.with_name("ttc"))).p_conservative == ALL_MIXES


def test_shipped_policies_by_name(shelf: Path) -> None:
    assert shipped_policies() == ["no_labels", "vae"]  # in the order of the methods
    contender = load_policy("vae")
    assert (contender.name, contender.p_conservative) == ("vae", Mix(0.6))
    assert find_policy("vae") == shelf / "vae"


def test_files_of_the_user_come_before_shipped_policies_of_their_name(
    shelf: Path, run: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    Path("vae").mkdir()
    assert find_policy("vae") == shelf / "vae", "a folder without a policy"
    shutil.copytree(run, "no_labels")
    for name in ("no_labels", "./no_labels"):
        assert find_policy(name) == Path("no_labels/policy")
        assert load_policy(name).p_conservative == ALL_MIXES
    assert shipped_policy("no_labels") == shelf / "no_labels"


def test_a_shipped_policy_drives_with_the_shipped_trait_model_whatever_the_present_folder_holds(
    encoders: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    for suffix in (".safetensors", ".json"):
        shutil.copyfile(encoders / f"vae{suffix}", f"vae{suffix}")
    source = load_policy(shipped_policy("vae")).source
    assert source is not None
    used = source()
    assert isinstance(used, EncoderTraits) and isinstance(used.model, traits.TraitModel)
    assert used.model.settings == traits.storage.read_card(traits.storage.shipped_model("vae")).settings


def test_unknown_names_are_answered_with_the_known_ones(shelf: Path, tmp_path: Path) -> None:
    (shelf / "strangers").mkdir()
    (shelf / "strangers" / "mine.safetensors").touch()
    names = "always_go, ttc, sumo, no_labels, vae, strangers/mine"
    advice = f"give {names}, the folder of a training run or a .safetensors file"
    assert refused("nobody") == f"no policy nobody; {advice}"
    assert refused(tmp_path).endswith(advice)
    assert refused("oracle").endswith(advice), "a method that nobody has shipped"


@pytest.mark.parametrize("name", ["", ".", "/", "..", "a/b/c"])
def test_paths_that_name_no_policy_are_refused(name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    assert refused(name).startswith("no policy")


def test_a_damaged_policy(run: Path) -> None:
    weights = run / "policy.safetensors"
    weights.write_bytes(weights.read_bytes()[:1000])
    assert "policy.safetensors is damaged" in refused(run)


def test_a_missing_card(run: Path) -> None:
    (run / "policy.json").unlink()
    assert "card of the policy: no file" in refused(run)
    assert "card of the policy: no file" in refused(run / "policy.zip", allow_pickle=True)


def test_a_policy_whose_outputs_overflow_is_refused(run: Path) -> None:
    """Its weights are finite."""
    weights = safetensors.torch.load_file(run / "policy.safetensors")
    huge = {name: weight * 1e12 for name, weight in weights.items()}
    change_card(run, **write_weights(run / "policy", huge))
    assert refused(run).startswith(f"{run / 'policy.safetensors'}: the policy's outputs are not finite")


def test_a_damaged_card(run: Path) -> None:
    (run / "policy.json").write_text("{")
    assert "policy.json is damaged" in refused(run)


def change_card(run: Path, **changes: Any) -> None:
    card_file = run / "policy.json"
    card_file.write_text(json.dumps({**json.loads(card_file.read_text()), **changes}))


@pytest.mark.parametrize(
    "changes",
    [
        {"method": "ttc"},
        {"method": "magic"},
        {"method": ["no_labels"]},
        {"method": None},
        {"method": "vae"},  # which needs a trait model
        {"method": "vae", "traits": ""},
        {"method": "vae", "traits": "../policy"},
        {"method": "vae", "traits": "/etc/passwd"},
        {"method": "vae", "traits": 1},
        {"p_conservative": None},
        {"p_conservative": "0.4"},
        {"p_conservative": [0.9, 0.1]},
        {"settings": {}},
        {"settings": None},
        {"settings": {"action_repeat": "1"}},
        {"steps": None},
        {"seed": "0"},
        {"scene": None},
        {"scene": "moon"},
        {"scene": ["t_intersection"]},
        {"network": None},
    ],
)
def test_a_wrong_card(run: Path, changes: dict[str, Any]) -> None:
    change_card(run, **changes)
    assert "policy.json is not the card of a policy" in refused(run)


def test_a_missing_trait_model(run_with_traits: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("tint_sumo.traits.storage.shipped", lambda _: tmp_path / "none")
    (run_with_traits / "traits.safetensors").unlink()
    assert f"no trait model {run_with_traits / 'traits.safetensors'}" in refused(run_with_traits)


def test_another_trait_model_than_the_training_s_is_refused(run_with_traits: Path) -> None:
    other = traits.load(run_with_traits / "traits.safetensors")
    other.feature_mean.add_(0.1)
    save(other, run_with_traits / "traits", {})
    assert "policy.json belongs to another trait model traits; restore that model" in refused(run_with_traits)


def test_a_run_that_is_not_finished(run: Path) -> None:
    (run / "policy.safetensors").unlink()
    assert "not finished; repeat its command" in refused(run)


def test_a_zip_file_acts_as_the_policy_beside_it(run: Path, capsys: pytest.CaptureFixture[str]) -> None:
    contender, same = load_policy(run), load_policy(run / "policy.zip", allow_pickle=True)
    assert "can run any code" in capsys.readouterr().err
    assert (same.name, same.p_conservative) == (str(run / "policy.zip"), contender.p_conservative)
    venv = contender.make_venv(16, contender.task)
    venv.seed(7)
    observation: Any = venv.reset()
    venv.close()
    actions = [one.policy.predict(observation, deterministic=True)[0] for one in (contender, same)]
    np.testing.assert_array_equal(*actions)


def test_a_zip_file_is_read_with_permission_alone(run: Path, tmp_path: Path) -> None:
    for file in (run / "policy.zip", tmp_path / "absent.zip"):
        line = refused(file)
        assert str(file) in line
        assert "run any code" in line and "give the .safetensors file beside it, or `allow_pickle`" in line
    assert "no file" in refused(tmp_path / "absent.zip", allow_pickle=True)


MALICIOUS: dict[str, Callable[[Path], Path]] = {
    "policy.safetensors": lambda run: run,
    "policy.json": lambda run: run,
    "policy.zip": lambda run: run / "policy.zip",
    "policy-25.safetensors": lambda run: run / "policy-25.safetensors",
    "policy-25.json": lambda run: run / "policy-25",
    "traits.safetensors": lambda run: run,
    "traits.json": lambda run: run,
    "policy.pkl": lambda run: run / "policy.pkl",
}


@pytest.mark.parametrize("kind", BOMBS)
@pytest.mark.parametrize("place", MALICIOUS)
def test_a_malicious_file_in_place_of_any_other_never_runs_code(
    run_with_traits: Path, tmp_path: Path, place: str, kind: str
) -> None:
    marker = tmp_path / "marker"
    (run_with_traits / place).write_bytes(bomb(kind, marker))
    line = refused(MALICIOUS[place](run_with_traits))
    assert str(run_with_traits / place) in line
    assert any(advice in line for advice in ("restore", "make it anew", "give the .safetensors file", "give always_go"))
    assert not marker.exists()


@pytest.mark.parametrize("kind", BOMBS)
def test_malicious_files_beside_a_sound_policy_are_not_touched(run: Path, tmp_path: Path, kind: str) -> None:
    marker = tmp_path / "marker"
    for name in ("policy.zip", "policy.pkl", "policy.pt", "checkpoint.zip", "run.json", "traits.json"):
        (run / name).write_bytes(bomb(kind, marker))
    assert load_policy(run).p_conservative == load_policy(run / "policy.safetensors").p_conservative == ALL_MIXES
    assert not marker.exists()


@pytest.mark.parametrize("kind", BOMBS)
def test_a_folder_of_nothing_but_malicious_files_never_runs_code(tmp_path: Path, kind: str) -> None:
    marker, folder = tmp_path / "marker", tmp_path / "run"
    folder.mkdir()
    names = ["policy.zip", "policy.json", "checkpoint.zip", "traits.json", "policy.pkl"]
    for name in names:
        (folder / name).write_bytes(bomb(kind, marker))
    assert "no policy" in refused(folder)
    (folder / "run.json").write_bytes(bomb(kind, marker))
    assert "not finished" in refused(folder)
    (folder / "policy.safetensors").write_bytes(bomb(kind, marker))
    for name in ("", *names, "policy.safetensors"):
        refused(folder / name)
    assert not marker.exists()


def test_the_zip_bomb_is_live(run: Path, tmp_path: Path) -> None:
    """Show that the files of the tests above are dangerous, which is why permission is asked for."""
    (run / "policy.zip").write_bytes(bomb("stable-baselines3", tmp_path / "marker"))
    refused(run / "policy.zip")
    assert not (tmp_path / "marker").exists()
    refused(run / "policy.zip", allow_pickle=True)
    assert (tmp_path / "marker").is_dir()


@pytest.mark.parametrize("name", [name for name in built_in_methods() if isinstance(METHODS[name], Learned)])
def test_a_policy_of_every_learned_method_of_the_old_world_is_shipped(name: str) -> None:
    contender = load_policy(name)
    venv = contender.make_venv(2, TaskSettings(contender.scene, p_conservative=0.5))
    try:
        venv.seed(0)
        actions, _ = contender.policy.predict(venv.reset(), deterministic=True)
        assert actions.shape == (2,)
        assert contender.p_conservative == ALL_MIXES
    finally:
        venv.close()


def test_a_policy_of_another_version_of_its_scene_is_refused_unless_the_scene_is_named(
    run: Path, tmp_path: Path
) -> None:
    for suffix in (".json", ".safetensors"):
        shutil.copy(run / f"policy{suffix}", tmp_path / f"policy{suffix}")
    card = json.loads((tmp_path / "policy.json").read_text())
    (tmp_path / "policy.json").write_text(json.dumps(card | {"scene_digest": "of another day"}))
    with pytest.raises(InputError, match="another version of the scene t_intersection; give its name as `scene`"):
        load_policy(tmp_path)
    assert load_policy(tmp_path, scene=T_INTERSECTION).scene.name == T_INTERSECTION


def test_a_policy_of_all_scenes_needs_one_to_drive_in(run: Path, tmp_path: Path) -> None:
    for suffix in (".json", ".safetensors"):
        shutil.copy(run / f"policy{suffix}", tmp_path / f"policy{suffix}")
    card = json.loads((tmp_path / "policy.json").read_text())
    (tmp_path / "policy.json").write_text(
        json.dumps(card | {"scene": ALL_SCENES, "scene_digest": digest_of(find_scenes(ALL_SCENES))})
    )
    with pytest.raises(InputError, match="was trained in all scenes; give the `scene`"):
        load_policy(tmp_path)
    assert load_policy(tmp_path, scene="on_ramp").scene.name == "on_ramp"
