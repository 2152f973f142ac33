"""Recording, with real simulations."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest

from tests.simulation.scenes import T
from tint_sumo.config import AGGRESSIVE, CONSERVATIVE, POPULATIONS, Mix
from tint_sumo.core.errors import InputError
from tint_sumo.dataset.recorder import (
    EPISODE_STEPS,
    EPISODES_PER_SHARD,
    Recording,
    _simulations,
    record,
    simulate_episodes,
)
from tint_sumo.dataset.schema import DRIVERS, TRAJECTORIES, read_manifest
from tint_sumo.simulation import SceneSimulation
from tint_sumo.simulation.sumo import SumoLink

WINDOWS = 3000  # one shard
TWO_SHARDS = 5000


@pytest.fixture(scope="session")
def dataset(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("dataset")
    record(folder, WINDOWS, seed=1, progress=False)
    return folder


@pytest.fixture(scope="session")
def two_shards(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two shards with floating-car data, recorded without interruption."""
    folder = tmp_path_factory.mktemp("two_shards")
    record(folder, TWO_SHARDS, fcd=True, progress=False)
    return folder


def contents(folder: Path) -> dict[str, bytes]:
    """Every shard's files."""
    return {str(file.relative_to(folder)): file.read_bytes() for file in sorted(folder.glob("*/*"))}


def test_a_shard_is_the_same_after_one_that_was_interrupted(monkeypatch: pytest.MonkeyPatch) -> None:
    """Clusters interrupt the shards that nobody needs any more, and their processes go on with other ones."""
    recording = Recording(WINDOWS, Mix(0.5), None, 0, T)
    expected = recording.simulate(0)
    forget = SumoLink._forget
    calls = 0

    def interrupted_once(link: SumoLink, replica: int, slot: int) -> None:
        nonlocal calls
        calls += 1
        if calls == 5:
            raise KeyboardInterrupt
        forget(link, replica, slot)

    monkeypatch.setattr(SumoLink, "_forget", interrupted_once)
    with pytest.raises(KeyboardInterrupt):
        recording.simulate(1)
    again = recording.simulate(0)
    _simulations.clear()
    for found, wanted in zip(again, expected, strict=True):
        pd.testing.assert_frame_equal(found, wanted)


def test_rows_are_what_sumo_reports() -> None:
    simulation = SceneSimulation(2, T, with_ego=False)
    try:
        for replica in range(2):
            simulation.reset(replica, [0, replica])
        reported = []
        vehicle = simulation.link.connection.vehicle
        for step in range(1, 81):
            simulation.step()
            for replica, slot in np.argwhere(simulation.slots.present):
                vehicle_id = simulation.link.ids[replica][slot]
                leader = vehicle.getLeader(vehicle_id, 100.0)
                min_gap_m = simulation.population[simulation.slots.member[replica, slot]].min_gap_m
                reported.append(
                    {
                        "episode": replica,
                        "vehicle": simulation.slots.vehicle_number[replica, slot],
                        "time_s": round(step * 0.1, 1),
                        "speed": vehicle.getSpeed(vehicle_id),
                        "acceleration": vehicle.getAcceleration(vehicle_id),
                        "leader_id": None if not leader or not leader[0] else int(leader[0].split(".")[-1]),
                        "gap": np.nan if not leader or not leader[0] else leader[1] + min_gap_m,
                    }
                )
        rows, _ = simulate_episodes(simulation, seed=0, first_episode=0, steps=80)
    finally:
        simulation.close()
    rows["time_s"] = rows["time_s"].round(1)
    both = pd.DataFrame(reported).merge(rows, on=["episode", "vehicle", "time_s"])
    assert len(both) == len(reported) > 500
    np.testing.assert_allclose(both["speed_mps"], both["speed"], atol=1e-9)
    seen = both["acceleration_mps2"].notna()
    np.testing.assert_allclose(both["acceleration_mps2"][seen], both["acceleration"][seen], atol=1e-6)
    # SUMO looks for leaders on the route ahead, where a vehicle about to leave the street may still be.
    led = both["leader"].notna()
    assert (both["leader"][led].astype(float) == both["leader_id"][led]).all()
    np.testing.assert_allclose(both["gap_m"][led], both["gap"][led], atol=1e-6)
    assert both["leader_id"][~led].isna().mean() > 0.95


def test_the_tables_are_complete_and_sensible(dataset: Path) -> None:
    rows = pd.read_parquet(dataset / TRAJECTORIES)
    drivers = pd.read_parquet(dataset / DRIVERS)
    assert rows["episode"].nunique() == EPISODES_PER_SHARD
    assert rows["time_s"].max() == pytest.approx(EPISODE_STEPS * 0.1)
    assert set(rows["route"]) == {"lower", "upper"}
    assert rows["position_m"].between(5.0, 45.0).all()
    assert rows["speed_mps"].between(0.0, 3.0 + 1e-6).all()
    assert (rows["gap_m"].dropna() > 0.3).all()
    assert rows["leader"].isna().equals(rows["gap_m"].isna())
    keys = ["episode", "vehicle"]
    assert not drivers.duplicated(keys).any()
    assert set(map(tuple, drivers[keys].to_numpy())) == set(map(tuple, rows[keys].drop_duplicates().to_numpy()))
    for profile in (CONSERVATIVE, AGGRESSIVE):
        mine = drivers[drivers["trait"] == profile.name]
        assert len(mine) > 200
        assert mine["desired_speed_mps"].unique() == pytest.approx([profile.desired_speed_mps[0]])
        assert mine["min_gap_m"].between(profile.min_gap_m[0] - 1e-6, profile.min_gap_m[1] + 1e-6).all()


def test_time_runs_evenly_along_each_track(dataset: Path) -> None:
    rows = pd.read_parquet(dataset / TRAJECTORIES)
    steps = rows.groupby(["episode", "vehicle"])["time_s"].diff().dropna()
    np.testing.assert_allclose(steps, 0.1, atol=1e-4)


def test_pandas_reads_a_folder_as_one_table(two_shards: Path) -> None:
    manifest = read_manifest(two_shards)
    rows = pd.read_parquet(two_shards / TRAJECTORIES)
    assert len(rows) == manifest.rows
    assert rows["episode"].unique().tolist() == list(range(manifest.episodes))
    assert rows.set_index(["episode", "vehicle", "time_s"]).index.is_monotonic_increasing
    assert rows.dtypes.astype(str).to_dict() == {
        "episode": "int32",
        "vehicle": "int16",
        "time_s": "float32",
        "route": "category",
        "position_m": "float32",
        "speed_mps": "float32",
        "acceleration_mps2": "float32",
        "leader": "Int16",
        "gap_m": "float32",
    }
    one = pd.read_parquet(two_shards / TRAJECTORIES, columns=["gap_m"], filters=[("episode", "==", 17)])
    assert len(one) == (rows["episode"] == 17).sum()
    assert len(pd.read_parquet(two_shards / DRIVERS)) == manifest.drivers


def test_columns_carry_their_units(dataset: Path) -> None:
    import pyarrow.parquet as pq

    schema = pq.read_schema(next((dataset / TRAJECTORIES).iterdir()))
    assert schema.field("gap_m").metadata[b"unit"] == b"m"
    assert schema.field("speed_mps").metadata[b"unit"] == b"m/s"


def test_the_share_of_conservative_drivers_is_the_one_asked_for(tmp_path: Path) -> None:
    record(tmp_path / "d", WINDOWS, p_conservative=0.25, seed=2, progress=False)
    drivers = pd.read_parquet(tmp_path / "d" / DRIVERS)
    spread = 4 * (0.25 * 0.75 / len(drivers)) ** 0.5
    assert (drivers["trait"] == "conservative").mean() == pytest.approx(0.25, abs=spread)


def test_the_dataset_does_not_depend_on_the_number_of_workers(two_shards: Path, tmp_path: Path) -> None:
    manifest = record(tmp_path, TWO_SHARDS, workers=2, fcd=True, progress=False)
    assert manifest == read_manifest(two_shards)
    assert manifest.shards == 2
    assert contents(tmp_path) == contents(two_shards)


def test_recording_again_leaves_a_finished_dataset_alone(dataset: Path) -> None:
    before = {file: file.stat().st_mtime_ns for file in dataset.rglob("*")}
    record(dataset, WINDOWS, seed=1, progress=False)
    assert {file: file.stat().st_mtime_ns for file in dataset.rglob("*")} == before


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"windows": 0}, "windows must be at least 1"),
        ({"windows": 10, "p_conservative": 2.0}, r"must be a probability in \[0, 1\]"),
        ({"windows": 10, "workers": 0}, "workers must lie in 1 to 1,024"),
        ({"windows": 10, "seed": -1}, "seed must not be negative"),
        ({"windows": 10, "scene": "moon"}, "unknown scene 'moon'"),
        (
            {"windows": 10, "scene": replace(T, step_s=0.5)},
            r"scene t_intersection has steps of 0\.5 s, and traits are inferred in steps of 0\.1 s",
        ),
    ],
)
def test_bad_arguments_write_nothing(tmp_path: Path, arguments: dict[str, Any], message: str) -> None:
    with pytest.raises(InputError, match=message):
        record(tmp_path / "d", **arguments)
    assert not (tmp_path / "d").exists()


def test_libsumo_is_free_again_after_recording(tmp_path: Path) -> None:
    record(tmp_path / "d", 10, progress=False)
    simulation = SceneSimulation(1, T, backend="libsumo")
    simulation.close()


def test_a_folder_of_another_run_is_left_alone(dataset: Path, tmp_path: Path) -> None:
    before = contents(dataset)
    with pytest.raises(InputError, match=r"already holds another run \(different: seed\)"):
        record(dataset, WINDOWS, seed=2)
    assert contents(dataset) == before
    (tmp_path / "letters.txt").write_text("dear")
    with pytest.raises(InputError, match="already holds other files"):
        record(tmp_path, WINDOWS)
    assert [file.name for file in tmp_path.iterdir()] == ["letters.txt"]


def test_traits_of_drivers_whose_willingness_changes_are_their_profiles() -> None:
    population = replace(POPULATIONS["inattentive"], members=2)
    simulation = SceneSimulation(2, replace(T, population=population), with_ego=False)
    try:
        _, drivers = simulate_episodes(simulation, 0, 0, steps=100)
    finally:
        simulation.close()
    assert (drivers["trait"].astype(str) == drivers["vtype"].str.split(".").str[0]).all()
    assert set(drivers["trait"]) == {"conservative", "aggressive"}


def test_drivers_without_classes_are_recorded_by_the_same_command(tmp_path: Path) -> None:
    manifest = record(tmp_path / "d", WINDOWS, population="continuous", progress=False)
    drivers = pd.read_parquet(tmp_path / "d" / DRIVERS)
    assert manifest.population == "continuous"
    assert set(drivers["trait"]) == {"continuous"}
    assert drivers["desired_speed_mps"].between(2.0, 3.4).all()
    assert drivers["desired_speed_mps"].nunique() > 100
    rows = pd.read_parquet(tmp_path / "d" / TRAJECTORIES)
    fastest = rows.groupby(["episode", "vehicle"])["speed_mps"].max()
    wanted = drivers.set_index(["episode", "vehicle"])["desired_speed_mps"]
    assert (fastest <= wanted.loc[fastest.index] + 1e-4).all()
    assert np.corrcoef(fastest, wanted.loc[fastest.index])[0, 1] > 0.5
    with pytest.raises(InputError, match="unknown population 'odd'"):
        record(tmp_path / "e", WINDOWS, population="odd")
