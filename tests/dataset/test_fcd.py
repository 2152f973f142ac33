"""Floating-car data, as SUMO's own tools see it."""

import gzip
import shutil
from pathlib import Path

import libsumo
import numpy as np
import pandas as pd
import pytest
import sumolib
from sumolib.geomhelper import positionAtShapeOffset

from tests.dataset.test_recorder import WINDOWS, contents
from tests.simulation.scenes import T
from tint_sumo.core.files import shipped
from tint_sumo.dataset.fcd import EPISODE_PERIOD_S, VEHICLE_TYPE, write_fcd
from tint_sumo.dataset.recorder import record, simulate_episodes
from tint_sumo.dataset.schema import FCD, TRAJECTORIES
from tint_sumo.scenes.layout import layout
from tint_sumo.simulation import SceneSimulation

EPISODES = (5, 6)
NUMBERS = ["x", "y", "angle", "speed", "pos", "slope", "acceleration"]
ROUNDING = 0.005 + 1e-5  # two decimals, of numbers in single precision


def vehicles(file: Path) -> pd.DataFrame:
    """A row per vehicle and timestep, in the file's order."""
    rows = [
        {"time": step.time, **dict(vehicle.getAttributes())}
        for step in sumolib.xml.parse(str(file), "timestep")
        for vehicle in step.vehicle or ()
    ]
    return pd.DataFrame(rows).astype(dict.fromkeys(["time", *NUMBERS], float))


@pytest.fixture(scope="module")
def rows(dataset: Path) -> pd.DataFrame:
    """Two episodes."""
    found = pd.read_parquet(next((dataset / TRAJECTORIES).iterdir()))
    return found[found["episode"].isin(EPISODES)]


@pytest.fixture(scope="module")
def file(rows: pd.DataFrame, tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("fcd") / "shard-00000.xml.gz"
    write_fcd(rows, path, layout(T))
    return path


@pytest.fixture(scope="module")
def found(file: Path) -> pd.DataFrame:
    return vehicles(file)


def test_it_contains_what_the_rows_contain(found: pd.DataFrame, rows: pd.DataFrame) -> None:
    keys = found["id"].str.split(".", expand=True).astype(int).set_axis(["episode", "vehicle"], axis=1)
    both = pd.concat([found, keys], axis=1)
    both["time_s"] = (found["time"] - EPISODE_PERIOD_S * both["episode"]).round(1)
    both = both.merge(rows.assign(time_s=rows["time_s"].astype(float).round(1)), on=["episode", "vehicle", "time_s"])
    assert len(both) == len(found) == len(rows)
    direction = both["route"].map({"lower": -1, "upper": 1}).astype(int)
    assert (direction * (both["position_m"] - 22.5) - both["x"]).abs().max() < ROUNDING
    assert (both["speed_mps"] - both["speed"]).abs().max() < ROUNDING
    assert (both["acceleration_mps2"].fillna(0.0) - both["acceleration"]).abs().max() < ROUNDING
    assert both["y"].equals(both["lane"].str.contains("lower|L").map({True: 2.0, False: 6.0}))
    assert both["angle"].equals(direction.map({-1: 270.0, 1: 90.0}))


def test_time_increases_and_episodes_start_at_full_minutes(found: pd.DataFrame) -> None:
    assert found["time"].is_monotonic_increasing
    assert not found.duplicated(["time", "id"]).any()
    episode = found["id"].str.split(".").str[0].astype(int)
    assert (found["time"] // EPISODE_PERIOD_S == episode).all()
    assert found.groupby(episode)["time"].min().tolist() == [300.0, 360.0]
    steps = found["time"].drop_duplicates().diff().round(6)
    assert sorted(set(steps.dropna())) == [0.1, 10.0]


def test_vehicles_are_where_the_network_has_their_lanes(found: pd.DataFrame) -> None:
    net = sumolib.net.readNet(str(shipped("sumo_net") / "tint.net.xml"), withInternal=True)
    assert found["lane"].nunique() == 6
    for name, part in found.groupby("lane"):
        lane = net.getLane(name)
        assert part["pos"].between(0.0, lane.getLength() + 0.005).all()
        expected = [positionAtShapeOffset(lane.getShape(), min(pos, lane.getLength())) for pos in part["pos"]]
        np.testing.assert_allclose(part[["x", "y"]], expected, atol=2 * ROUNDING)


def test_nothing_gives_the_trait_away(found: pd.DataFrame, file: Path) -> None:
    assert found["type"].unique().tolist() == [VEHICLE_TYPE]
    text = gzip.decompress(file.read_bytes()).decode()
    assert "conservative" not in text
    assert "aggressive" not in text


def test_the_same_rows_give_the_same_bytes(file: Path, rows: pd.DataFrame, tmp_path: Path) -> None:
    again = tmp_path / "other name.xml.gz"
    write_fcd(rows, again, layout(T))
    assert again.read_bytes() == file.read_bytes()


def test_sumo_writes_the_same(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """SUMO's own FCD of the same run: every vehicle it moves, with the same attributes in the same order.

    SUMO names a step by the time at its start. It does not see a vehicle before its first step on the street.
    """
    start, theirs_file = libsumo.start, tmp_path / "sumo.xml"
    options = ["--fcd-output", str(theirs_file), "--fcd-output.acceleration", "true"]
    monkeypatch.setattr(libsumo, "start", lambda command: start([*command, *options]))
    simulation = SceneSimulation(1, T, with_ego=False, backend="libsumo")
    rows, _ = simulate_episodes(simulation, seed=3, first_episode=0, steps=200)
    simulation.close()
    kept = rows.astype(dict.fromkeys(["time_s", "position_m", "speed_mps", "acceleration_mps2"], np.float32))
    write_fcd(kept, tmp_path / "ours.xml.gz", layout(T))
    ours, theirs = vehicles(tmp_path / "ours.xml.gz"), vehicles(theirs_file)
    assert list(ours) == list(theirs)
    ours = ours[ours.duplicated("id")]
    theirs["time"] += 0.1
    ours, theirs = (
        part.round({"time": 1}).sort_values(["time", "y", "x"], ignore_index=True) for part in (ours, theirs)
    )
    assert len(ours) == len(theirs) > 1000
    assert ours[["time", "lane"]].equals(theirs[["time", "lane"]])
    # Single precision may round the last digit otherwise, but hardly ever does.
    np.testing.assert_allclose(ours[NUMBERS], theirs[NUMBERS], atol=0.01 + 1e-9)
    assert np.isclose(ours[NUMBERS], theirs[NUMBERS], atol=1e-9).mean() > 0.999


def test_a_finished_dataset_gets_it_without_simulating(
    dataset: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    copy = tmp_path / "copy"
    shutil.copytree(dataset, copy)
    monkeypatch.delattr("tint_sumo.dataset.recorder.simulate_episodes")
    record(copy, WINDOWS, seed=1, fcd=True, progress=False)
    assert contents(dataset).items() < contents(copy).items()
    rows = pd.read_parquet(next((dataset / TRAJECTORIES).iterdir()))
    write_fcd(rows, tmp_path / "expected.xml.gz", layout(T))
    assert contents(copy)[f"{FCD}/shard-00000.xml.gz"] == (tmp_path / "expected.xml.gz").read_bytes()
