"""Recorded episodes of policies, as Minari reads them."""

import json
from collections.abc import Callable
from contextlib import closing
from dataclasses import replace
from pathlib import Path
from typing import Any

import minari
import numpy as np
import pytest
from filelock import FileLock
from minari.dataset.minari_dataset import EpisodeData

from tests.scenes.networks import UserNetwork
from tint_sumo.core import files
from tint_sumo.core.errors import InputError
from tint_sumo.core.files import LOCK_FILE
from tint_sumo.core.progress import Progress
from tint_sumo.envs import TaskSettings
from tint_sumo.methods import minari_dataset
from tint_sumo.methods.evaluation import CASE_SEED
from tint_sumo.methods.minari_dataset import EPISODES_PER_SEED, Credits, PolicyEpisodes, record_minari

NAME = "tint_sumo/tests/always_go-v3"
GO = 2
TASK = TaskSettings("four_way", p_conservative=(0.3, 0.7), sensor="noisy_0.1", time_limit_s=20.0)
EPISODES = PolicyEpisodes("always_go", TASK, 5, seed=7, random_actions=0.2)
CREDITS = Credits("Ada", "ada@example.org", "https://example.org/code")


@pytest.fixture(scope="module")
def root(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Minari's folder with one dataset."""
    folder = tmp_path_factory.mktemp("minari")
    record_minari(NAME, EPISODES, root=folder, credits=CREDITS)
    return folder


def leaves(values: Any) -> list[Any]:
    return [leaf for value in values.values() for leaf in leaves(value)] if isinstance(values, dict) else [values]


def read(root: Path, name: str = NAME) -> list[EpisodeData]:
    return list(minari.MinariDataset(root / name / "data"))


def assert_same(one: list[EpisodeData], other: list[EpisodeData]) -> None:
    for first, second in zip(one, other, strict=True):
        np.testing.assert_equal(vars(first), vars(second))


def test_minari_finds_and_loads_it(root: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(root))
    assert list(minari.list_local_datasets()) == [NAME]
    dataset = minari.load_dataset(NAME)
    assert dataset.total_episodes == 5 and dataset.total_steps == sum(map(len, dataset))
    found = dataset.storage.metadata
    assert (found["author"], found["author_email"], found["code_permalink"]) == (
        {"Ada"}, {"ada@example.org"}, "https://example.org/code"
    )  # fmt: skip
    assert found["algorithm_name"] == "always go, 20.0% random actions"
    assert found["description"].startswith(
        "5 episodes of the policy always go, 20.0% random actions in the scene four_way"
    )
    assert found["tint_sumo"]["seed"] == 7 and sum(found["tint_sumo"]["outcomes"].values()) == 5


def test_the_recovered_environment_lives_through_the_same_episodes(root: Path) -> None:
    dataset = minari.MinariDataset(root / NAME / "data")
    seeds = [facts["seed"] for facts in dataset.storage.get_episode_metadata(range(5))]
    assert seeds == list(range(7 * EPISODES_PER_SEED, 7 * EPISODES_PER_SEED + 5))
    with closing(dataset.recover_environment()) as env:
        assert env.observation_space == dataset.observation_space and env.action_space == dataset.action_space
        for seed, episode in zip(seeds, dataset, strict=True):
            observation, info = env.reset(seed=seed)
            for step, action in enumerate(episode.actions):
                assert episode.infos["outcome"][step].decode() == info["outcome"] == ""
                np.testing.assert_array_equal(episode.infos["traits"][step], info["traits"])
                observation, reward, terminated, truncated, info = env.step(action)
                for key, values in episode.observations.items():
                    np.testing.assert_array_equal(values[step + 1], observation[key])
                    assert values.dtype == observation[key].dtype
                assert episode.rewards[step] == reward
                assert (episode.terminations[step], episode.truncations[step]) == (terminated, truncated)
            assert terminated or truncated
            assert episode.infos["outcome"][-1].decode() == info["outcome"] != ""
            assert episode.infos["is_success"][-1] == info["is_success"]


def test_infos_have_the_same_keys_in_every_step(root: Path) -> None:
    episodes = read(root)
    for episode in episodes:
        assert {"traits", "outcome", "time_s", "reward_terms", "is_success", "collision"} <= set(episode.infos)
        assert {len(leaf) for leaf in leaves(episode.infos)} == {len(episode) + 1}
    hits = [one for one in episodes if one.infos["outcome"][-1] == b"collision"]
    assert hits, "the next lines need a collision"
    collision = hits[0].infos["collision"]
    assert collision["trait"][-1] in (b"conservative", b"aggressive") and set(collision["trait"][:-1]) == {b""}
    assert np.isnan(collision["ego_m"][:-1]).all() and np.isfinite(collision["ego_m"][-1]).all()


def test_the_same_call_writes_the_same_files_whatever_the_batch(
    root: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    again = record_minari(NAME, EPISODES, root=tmp_path / "again", credits=CREDITS).folder
    for file in ("main_data.hdf5", "metadata.json"):
        assert (again / "data" / file).read_bytes() == (root / NAME / "data" / file).read_bytes()
    monkeypatch.setattr(minari_dataset, "_BATCH", 2)
    record_minari(NAME, EPISODES, root=tmp_path / "parts")
    assert_same(read(tmp_path / "parts"), read(root))


def test_sets_of_episodes_differ_and_hold_no_test_case(
    root: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    assert (999 + 1) * EPISODES_PER_SEED <= CASE_SEED
    with pytest.raises(InputError, match="seed must lie in 0 to 999, not 1000"):
        replace(EPISODES, seed=1000)
    monkeypatch.chdir(tmp_path)
    record_minari("other-v0", replace(EPISODES, seed=8, episodes=1), root=Path())
    (other,) = read(tmp_path, "other-v0")
    assert not np.array_equal(other.observations["vehicles"][0], read(root)[0].observations["vehicles"][0])


def test_a_learned_policy_is_recorded_by_its_decisions(tmp_path: Path) -> None:
    """It sees inferred traits and looks at each step of the simulation; the dataset has neither."""
    task = TaskSettings(p_conservative=0.6)
    record_minari("streaming-v0", PolicyEpisodes("streaming", task, 1), root=tmp_path)
    dataset = minari.MinariDataset(tmp_path / "streaming-v0" / "data")
    assert set(dataset.observation_space.spaces) == {"ego", "vehicles", "mask"}  # type: ignore[attr-defined]
    assert dataset.env_spec is not None and dataset.env_spec.kwargs["decision_s"] == 0.4
    for episode in dataset:
        np.testing.assert_allclose(np.diff(episode.infos["time_s"])[:-1], 0.4)
        assert episode.infos["outcome"][-1] == b"success"


@pytest.mark.slow
def test_sumos_driver_is_recorded_in_a_network(user_network: Callable[[str], UserNetwork], tmp_path: Path) -> None:
    network = user_network("grid")
    scene = replace(network.scene(warm_up_s=5.0), ego_control="sumo")
    record_minari("sumo-v0", PolicyEpisodes("sumo", TaskSettings(scene), 1), root=tmp_path)
    dataset = minari.MinariDataset(tmp_path / "sumo-v0" / "data")
    assert dataset.env_spec is not None and dataset.env_spec.kwargs["scene"]["ego_control"] == "sumo"


@pytest.mark.parametrize("name", ["always_go", "Always go-v0", "../up-v0", "/up-v0", "a//b-v0", "a-v0/", "", "a\n-v0"])
def test_names_that_minari_does_not_have_are_refused(name: str, tmp_path: Path) -> None:
    with pytest.raises(InputError, match="is no name of a Minari dataset") as refused:
        record_minari(name, EPISODES, root=tmp_path / "root")
    assert "\n" not in str(refused.value)
    assert not (tmp_path / "root").exists()


@pytest.mark.parametrize("name", [NAME, f"{NAME}/inner-v0", "tint_sumo/tests-v0"])
def test_nothing_is_written_over(name: str, root: Path) -> None:
    taken = root / "tint_sumo" / "tests-v0"
    taken.touch()
    before = {path: path.read_bytes() for path in root.rglob("*") if path.is_file()}
    with pytest.raises(InputError, match="is there already; give another name or version as `minari`"):
        record_minari(name, EPISODES, root=root)
    assert {path: path.read_bytes() for path in root.rglob("*") if path.is_file()} == before
    taken.unlink()


def test_an_interrupted_recording_leaves_nothing(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(minari_dataset, "_BATCH", 1)

    def interrupt(progress: Progress) -> None:
        if progress.done == 2:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        record_minari(NAME, EPISODES, root=tmp_path, report=interrupt)
    assert list(tmp_path.iterdir()) == []


def test_what_a_killed_process_has_left_is_removed_but_not_what_a_running_one_writes(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    left = tmp_path / ".mine.a-v0.partial" / "data"
    left.mkdir(parents=True)
    (left / "main_data.hdf5").write_text("half")
    one, lock = replace(EPISODES, episodes=1), FileLock(left.parent / LOCK_FILE)
    monkeypatch.setattr(files, "LOCK_TIMEOUT_S", 0.1)
    with lock, pytest.raises(InputError, match="wait for it, or give another name as `minari`"):
        record_minari("mine/a-v0", one, root=tmp_path)
    assert (left / "main_data.hdf5").read_text() == "half"
    record_minari("mine/a-v0", one, root=tmp_path)
    assert [path.name for path in tmp_path.iterdir()] == ["mine"]


def test_a_dataset_that_is_not_what_was_driven_does_not_appear(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    right = minari_dataset.env_spec
    monkeypatch.setattr(minari_dataset, "env_spec", lambda task: right(replace(task, p_conservative=0.99)))
    with pytest.raises(RuntimeError, match="another one in the environment that Minari recovers"):
        record_minari(NAME, replace(EPISODES, episodes=1), root=tmp_path)
    assert list(tmp_path.iterdir()) == []


def test_the_specification_is_plain_json(root: Path) -> None:
    spec = json.loads(json.loads((root / NAME / "data" / "metadata.json").read_text())["env_spec"])
    assert spec["id"] == "tint_sumo/FourWay-v0"
    assert spec["kwargs"] == {
        "scene": "four_way", "p_conservative": [0.3, 0.7], "sensor": "noisy_0.1", "time_limit_s": 20.0
    }  # fmt: skip
