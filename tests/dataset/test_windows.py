"""Windows, and that nothing in them gives the label away."""

import json
import resource
import shutil
from collections.abc import Iterator
from dataclasses import fields
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from tests.simulation.scenes import T
from tint_sumo.config import AGGRESSIVE, CONSERVATIVE, NO_LEADER_GAP_M
from tint_sumo.core.errors import InputError
from tint_sumo.dataset import windows as module
from tint_sumo.dataset.recorder import EPISODES_PER_SHARD, record, simulate_episodes
from tint_sumo.dataset.schema import DRIVERS, MANIFEST, TRAJECTORIES, TRAJECTORY_SCHEMA
from tint_sumo.dataset.windows import (
    WindowFile,
    Windows,
    cut_windows,
    joined,
    load_labels,
    load_windows,
    read_training_windows,
    read_windows,
    split_by_episode,
    window_file,
)
from tint_sumo.simulation import SceneSimulation
from tint_sumo.simulation.demand import PlacedVehicle


def test_tracks_are_cut_into_windows_of_twenty_steps_and_remainders_of_at_least_two() -> None:
    steps = {3: 41, 5: 20, 8: 22, 9: 1}  # driver: track length
    driver = np.repeat(list(steps), list(steps.values()))
    position_m = np.concatenate([np.arange(n) * 0.3 + 5.0 for n in steps.values()])
    windows = cut_windows(driver, driver // 5, position_m, np.full(len(driver), 4.0))
    assert windows.driver.tolist() == [3, 3, 5, 8, 8]
    assert windows.length.tolist() == [20, 20, 20, 20, 2]
    assert windows.episode.tolist() == [0, 0, 1, 1, 1]
    np.testing.assert_allclose(windows.states[1, :, 0], np.arange(20) * 0.3, atol=1e-5)
    assert windows.states[4, 2:].tolist() == [[0.0, 0.0]] * 18


def test_every_driver_without_a_leader_gets_the_same_gap_and_larger_gaps_are_capped() -> None:
    gap_m = np.array([3.0, 25.0, np.inf, np.inf])
    windows = cut_windows(np.array([0, 0, 1, 1]), np.zeros(4, int), np.array([5.0, 6.0, 5.0, 6.0]), gap_m)
    assert windows.states[0, :2, 1].tolist() == [3.0, NO_LEADER_GAP_M]
    assert windows.states[1, :2, 1].tolist() == [NO_LEADER_GAP_M, NO_LEADER_GAP_M]
    assert windows.has_leader.tolist() == [True, False]


def test_loaded_windows_match_the_rows(dataset: Path) -> None:
    windows = load_windows(dataset)
    assert len(windows) == json.loads((dataset / MANIFEST).read_text())["windows"]
    assert windows.states.dtype == np.float32
    assert (windows.states[:, 0, 0] == 0.0).all()
    valid = np.arange(20) < windows.length[:, None]
    assert (np.diff(windows.states[..., 0], axis=1)[valid[:, 1:]] >= 0.0).all()
    assert (windows.states[~valid] == 0.0).all()
    rows = pd.read_parquet(dataset / TRAJECTORIES)
    first = rows[(rows["episode"] == rows["episode"].iloc[0]) & (rows["vehicle"] == rows["vehicle"].iloc[0])]
    offset_m = first["position_m"].to_numpy()[:20] - first["position_m"].iloc[0]
    np.testing.assert_array_equal(windows.states[0, : windows.length[0], 0], offset_m)


def test_split_puts_every_episode_on_one_side(dataset: Path) -> None:
    windows = load_windows(dataset)
    train, test = split_by_episode(windows, 1 / 3, seed=0)
    assert sorted([*train, *test]) == list(range(len(windows)))
    assert not set(windows.episode[train]) & set(windows.episode[test])
    assert len(test) / len(windows) == pytest.approx(1 / 3, abs=0.1)
    np.testing.assert_array_equal(split_by_episode(windows, 1 / 3, seed=0)[1], test)


def test_training_windows_come_shard_by_shard(two_shards: Path) -> None:
    windows = load_windows(two_shards)
    train, _ = split_by_episode(windows, 1 / 3, seed=4)
    parts = list(read_training_windows(two_shards, 1 / 3, seed=4))
    assert [set(part.episode // EPISODES_PER_SHARD) for part in parts] == [{0}, {1}]
    for field in fields(Windows):
        column = np.concatenate([getattr(part, field.name) for part in parts])
        np.testing.assert_array_equal(column, getattr(windows[train], field.name))


# The label leak: in the authors' code a driver without a leader got a gap that gave its trait away.


def test_changing_every_label_leaves_the_inputs_as_they_are(dataset: Path, tmp_path: Path) -> None:
    """The loader reads nothing of the drivers' file: with all labels turned round the windows are the same."""
    turned = tmp_path / "turned"
    shutil.copytree(dataset, turned)
    for file in (turned / DRIVERS).iterdir():
        drivers = pd.read_parquet(file)
        opposite = {"conservative": "aggressive", "aggressive": "conservative"}
        drivers["trait"] = drivers["trait"].astype(str).map(opposite).astype("category")
        drivers.to_parquet(file)
    before, after = load_windows(dataset), load_windows(turned)
    for field in ("states", "length", "driver", "episode", "has_leader"):
        np.testing.assert_array_equal(getattr(before, field), getattr(after, field))
    assert (load_labels(dataset, before) == 1 - load_labels(turned, after)).all()
    shutil.rmtree(turned / DRIVERS)
    np.testing.assert_array_equal(load_windows(turned).states, before.states)


def test_trajectories_have_no_column_of_the_driver() -> None:
    revealing = {"trait", "vtype", "type", "desired_speed_mps", "min_gap_m", "tau_s", "colour"}
    assert not revealing & set(TRAJECTORY_SCHEMA.names)


def test_drivers_that_move_alike_look_alike_whatever_their_trait() -> None:
    """Two vehicles held to one speed give the same inputs, gaps and their stand-in included, for either trait."""
    found = []
    for profile in (CONSERVATIVE, AGGRESSIVE):
        simulation = SceneSimulation(1, T, with_ego=False)
        member = next(i for i, one in enumerate(simulation.population) if one.profile is profile)
        simulation.reset_to(0, [PlacedVehicle(1, 20.0, member), PlacedVehicle(1, 10.0, member)])
        for vehicle_id in simulation.link.ids[0][:2]:
            simulation.link.connection.vehicle.setSpeedMode(vehicle_id, 32)
            simulation.link.connection.vehicle.setSpeed(vehicle_id, 1.5)
        front_m, gap_m = np.empty((20, 2)), np.empty((20, 2))
        for step in range(20):
            simulation.step()
            front_m[step] = simulation.slots.front_m[0, :2]
            gap_m[step] = simulation.leaders()[1][0, :2]
        simulation.close()
        assert np.isinf(gap_m[:, 0]).all()  # the vehicle ahead
        np.testing.assert_allclose(gap_m[:, 1], 5.0, atol=1e-9)  # the one behind
        driver = np.repeat([0, 1], 20)
        tracks = [values.T.ravel() for values in (front_m, gap_m)]
        found.append(cut_windows(driver, np.zeros(40, int), *tracks).states)
    np.testing.assert_array_equal(found[0], found[1])


def test_numbers_and_order_do_not_give_the_trait_away(dataset: Path) -> None:
    """Episode and vehicle numbers, and being leaderless, are no better than guessing."""
    windows = load_windows(dataset)
    label = load_labels(dataset, windows)
    _, first = np.unique(windows.driver, return_index=True)
    number = windows.driver[first] % 100_000
    for value in (number, number % 2, windows.episode[first]):
        assert abs(np.corrcoef(value, label[first])[0, 1]) < 4 / len(first) ** 0.5
    leaderless = windows.states[~windows.has_leader & (windows.length == 20)]
    gaps = leaderless[..., 1]
    assert set(np.unique(gaps[(gaps == gaps[:, :1]).all(axis=1)])) == {NO_LEADER_GAP_M}


# Bad input


def test_a_missing_shard_is_noticed_and_recorded_again(dataset: Path, tmp_path: Path) -> None:
    shutil.copytree(dataset, tmp_path / "d")
    file = next((tmp_path / "d" / TRAJECTORIES).iterdir())
    content = file.read_bytes()
    file.unlink()
    with pytest.raises(InputError, match=r"shard-00000.parquet is missing; repeat the command"):
        load_windows(tmp_path / "d")
    record(tmp_path / "d", 3000, seed=1, progress=False)
    assert file.read_bytes() == content


@pytest.mark.parametrize("more", [-1, 1])
def test_other_windows_than_in_the_manifest(dataset: Path, tmp_path: Path, more: int) -> None:
    shutil.copytree(dataset, tmp_path / "d")
    manifest = json.loads((tmp_path / "d" / MANIFEST).read_text())
    (tmp_path / "d" / MANIFEST).write_text(json.dumps(manifest | {"windows": manifest["windows"] + more}))
    with pytest.raises(InputError, match="do not agree; record the dataset anew"):
        load_windows(tmp_path / "d")


def test_missing_labels(dataset: Path, tmp_path: Path) -> None:
    shutil.copytree(dataset, tmp_path / "d")
    windows = load_windows(dataset)
    shutil.rmtree(tmp_path / "d" / DRIVERS)
    with pytest.raises(InputError, match=r"drivers.shard-00000.parquet is missing; repeat the command"):
        load_labels(tmp_path / "d", windows)


def test_labels_of_other_windows(dataset: Path) -> None:
    windows = load_windows(dataset)[:5]
    strangers = Windows(windows.states, windows.length, windows.driver + 10**9, windows.episode, windows.has_leader)
    with pytest.raises(InputError, match="lacks drivers of these windows"):
        load_labels(dataset, strangers)


def test_simulating_twice_gives_the_same_rows() -> None:
    simulation = SceneSimulation(2, T, with_ego=False)
    first, second = (simulate_episodes(simulation, seed=4, first_episode=6, steps=40) for _ in range(2))
    simulation.close()
    pd.testing.assert_frame_equal(first[0], second[0])
    pd.testing.assert_frame_equal(first[1], second[1])


def numbered(*episodes: int) -> Windows:
    """Windows of vehicle 7 in each of some episodes."""
    count, episode = len(episodes), np.array(episodes)
    driver = episode * 100_000 + 7
    return Windows(np.zeros((count, 20, 2), np.float32), np.full(count, 20), driver, episode, np.ones(count, bool))


def test_joined_windows_are_numbered_as_if_their_episodes_followed_each_other() -> None:
    whole = joined([numbered(0, 2), numbered(0, 1), numbered(3)])
    assert whole.episode.tolist() == [0, 2, 3, 4, 8]
    assert whole.driver.tolist() == [episode * 100_000 + 7 for episode in whole.episode]
    assert len(whole) == len(whole.states) == len(whole.has_leader) == 5


def test_parts_are_the_windows_in_their_order(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("tint_sumo.dataset.windows.PART", 3)
    assert [part.episode.tolist() for part in numbered(*range(8)).parts()] == [[0, 1, 2], [3, 4, 5], [6, 7]]


@pytest.fixture
def stored(two_shards: Path, tmp_path: Path) -> Iterator[WindowFile]:
    with window_file(read_windows(two_shards), tmp_path) as windows:
        yield windows


def assert_same(one: Windows, other: Windows) -> None:
    for field in fields(Windows):
        here, there = getattr(one, field.name), getattr(other, field.name)
        np.testing.assert_array_equal(here, there)
        assert here.dtype == there.dtype
        assert here.flags.writeable  # what torch asks for


def test_chosen_windows_come_in_the_order_asked_for(stored: WindowFile, two_shards: Path) -> None:
    windows = load_windows(two_shards)
    assert len(stored) == len(windows)
    for size in (1, 500):
        index = np.random.default_rng(0).integers(len(windows), size=size)
        assert_same(stored[index], windows[index])


def test_parts_hold_every_window_once(stored: WindowFile, two_shards: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(module, "PART", 1000)
    windows, parts = load_windows(two_shards), list(stored.parts())
    assert [len(part) for part in parts[:-1]] == [1000] * (len(windows) // 1000)
    for number, part in enumerate(parts):
        assert_same(part, windows[1000 * number : 1000 * (number + 1)])


def test_labels_are_those_of_the_windows_in_memory(stored: WindowFile, two_shards: Path) -> None:
    np.testing.assert_array_equal(load_labels(two_shards, stored), load_labels(two_shards, load_windows(two_shards)))


def test_the_file_leaves_no_trace_in_a_folder_that_may_not_be_there_yet(dataset: Path, tmp_path: Path) -> None:
    with window_file(read_windows(dataset), tmp_path / "runs" / "model") as windows:
        assert list(tmp_path.iterdir()) == []
        assert len(windows) > 0
    with window_file([], tmp_path) as nothing:
        assert len(nothing) == 0
        assert list(nothing.parts()) == []


def test_a_disk_without_room(dataset: Path, tmp_path: Path) -> None:
    limits = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (100_000, limits[1]))
    try:
        with (
            pytest.raises(InputError, match=r"has no room for the windows \(File too large\); free some"),
            window_file(read_windows(dataset), tmp_path),
        ):
            pass
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)
    assert list(tmp_path.iterdir()) == []
