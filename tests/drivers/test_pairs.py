"""Leaders and followers are found in tracks of any format."""

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest

from tests.drivers.recordings import HEADER, population, simulated_pair, write_pair, write_pairs
from tint_sumo.core.errors import InputError
from tint_sumo.core.files import write_text
from tint_sumo.drivers.models import Floats
from tint_sumo.drivers.pairs import Recorded, find_pairs, left_out_text, read_pairs
from tint_sumo.tracks.schema import build_tracks

RADIUS_M, LANE_M = 100.0, 3.5


def on_a_ring(
    *vehicles: tuple[str, float, float, float], rows: int = 100, step_s: float = 0.1, **columns: Any
) -> Recorded:
    """Pairs of vehicles on a ring: id, lane, metres ahead of the origin along its lane, and speed."""
    time_s = step_s * np.arange(rows)
    parts: dict[str, list[Any]] = {name: [] for name in ("vehicle", "time_s", "x_m", "y_m", "heading_rad", "speed_mps")}
    for name, lane, start_m, speed_mps in vehicles:
        radius_m = RADIUS_M + LANE_M * lane
        angle = (start_m + speed_mps * time_s) / radius_m
        for key, values in (
            ("vehicle", [name] * rows),
            ("time_s", time_s),
            ("x_m", radius_m * np.cos(angle)),
            ("y_m", radius_m * np.sin(angle)),
            ("heading_rad", angle + np.pi / 2),
            ("speed_mps", np.full(rows, speed_mps)),
        ):
            parts[key].extend(values)
    table = {"recording": "ring", "length_m": 4.0, "width_m": 1.8, "vehicle_class": "car", **parts, **columns}
    return find_pairs(build_tracks(Path("ring.csv"), "levelx", table))


def test_the_pair_of_a_leader_follower_file_is_as_recorded(tmp_path: Path) -> None:
    pair = simulated_pair(population(1, 0)[0])
    (found,) = read_pairs(write_pair(tmp_path / "pair.csv", pair)).pairs
    assert (found.driver, found.leader, found.rows) == (pair.driver, pair.leader, pair.rows)
    np.testing.assert_allclose(found.gap_m, pair.gap_m, atol=1e-4)
    np.testing.assert_allclose(found.speed_mps, pair.speed_mps, atol=1e-4)
    np.testing.assert_allclose(found.leader_speed_mps, pair.leader_speed_mps, atol=1e-4)
    np.testing.assert_allclose(np.diff(found.front_m), np.diff(pair.front_m), atol=1e-4)


def test_leaders_are_found_along_a_bend_on_the_same_lane() -> None:
    found = on_a_ring(("a", 0, 0.0, 10.0), ("b", 0, 40.0, 12.0), ("c", 0, 100.0, 10.0), ("d", 1, 20.0, 10.0))
    gaps = {(pair.follower, pair.leader): pair for pair in found.pairs}
    assert set(gaps) == {("a", "b"), ("b", "c")}
    time_s = 0.1 * np.arange(100)
    # Chords are shorter than arcs.
    np.testing.assert_allclose(gaps["a", "b"].gap_m, 40.0 + 2.0 * time_s - 4.0, atol=0.3)
    np.testing.assert_allclose(gaps["a", "b"].speed_mps, 10.0)
    np.testing.assert_allclose(gaps["a", "b"].leader_speed_mps, 12.0)


def on_a_street(
    vehicles: Mapping[str, tuple[Floats, Floats]], time_s: Floats, noise_m: float = 0.0, **columns: Any
) -> Recorded:
    """Pairs of vehicles on a straight street: id, metres along it, and speed; positions err by ``noise_m``."""
    rng = np.random.default_rng(0)
    rows = len(time_s) * len(vehicles)
    table = {
        "vehicle": np.repeat(list(vehicles), len(time_s)),
        "time_s": np.tile(time_s, len(vehicles)),
        "x_m": np.concatenate([x_m for x_m, _ in vehicles.values()]) + rng.normal(0.0, noise_m, rows),
        "y_m": rng.normal(0.0, noise_m, rows),
        "speed_mps": np.concatenate([speed_mps for _, speed_mps in vehicles.values()]),
    }
    sizes = {"recording": "street", "heading_rad": 0.0, "length_m": 4.0, "width_m": 1.8, "vehicle_class": "car"}
    return find_pairs(build_tracks(Path("street.csv"), "levelx", {**sizes, **table, **columns}))


def test_noise_in_a_queue_changes_no_gap_and_no_way() -> None:
    time_s = 0.04 * np.arange(2000)
    speed_mps = np.interp(time_s, [0.0, 10.0, 15.0, 60.0, 70.0], [10.0, 10.0, 0.0, 0.0, 10.0])
    x_m = np.cumsum(speed_mps) * 0.04
    later_m = np.interp(time_s - 2.0, time_s, x_m) - 10.0
    later_mps = np.interp(time_s - 2.0, time_s, speed_mps)
    (pair,) = on_a_street({"a": (x_m, speed_mps), "b": (later_m, later_mps)}, time_s, noise_m=0.05).pairs
    at_s = pair.step_s * np.arange(pair.rows)
    np.testing.assert_allclose(pair.front_m - 2.0, np.interp(at_s, time_s, later_m - later_m[0]), atol=0.5)
    before = at_s < 70.0  # later on the follower's own way, which the gap is measured along, ends before the leader
    np.testing.assert_allclose(pair.gap_m[before], np.interp(at_s, time_s, x_m - later_m - 4.0)[before], atol=0.5)


def test_vehicles_that_come_back_have_no_other_units() -> None:
    once_s = 0.1 * np.arange(100)
    time_s = np.concatenate([once_s, 120.0 + once_s, 240.0 + once_s])
    x_m, speed_mps = np.tile(12.0 * once_s, 3), np.full(300, 12.0)
    found = on_a_street({"a": (x_m, speed_mps), "b": (x_m - 25.0, speed_mps)}, time_s)
    assert [(pair.start_s, pair.rows) for pair in found.pairs] == [(0.0, 100), (120.0, 100), (240.0, 100)]
    assert found.inconsistent == 0


def test_who_follows_a_vehicle_of_wrong_speed_follows_nobody_else() -> None:
    time_s = 0.1 * np.arange(100)
    row = {f"{at}": (12.0 * time_s - 25.0 * at, np.full(100, 24.0 if at == 5 else 12.0)) for at in range(12)}
    found = on_a_street(row, time_s)
    assert found.inconsistent == 1
    sound = [(f"{at + 1}", f"{at}") for at in range(11) if at not in (4, 5)]
    assert sorted((pair.follower, pair.leader) for pair in found.pairs) == sorted(sound)


def test_who_drives_the_other_way_or_walks_is_no_leader() -> None:
    heading = np.concatenate([np.full(100, np.pi / 2), np.full(100, -np.pi / 2)])
    with pytest.raises(InputError, match="nobody follows"):
        read_or_raise(on_a_ring(("a", 0, 0.0, 1.0), ("b", 0, 20.0, 1.0), heading_rad=heading))
    classes = ["car"] * 100 + ["Pedestrian"] * 100
    assert not on_a_ring(("a", 0, 0.0, 1.0), ("b", 0, 20.0, 1.0), vehicle_class=classes).pairs


def read_or_raise(found: Recorded) -> None:
    if not found.pairs:
        raise InputError("nobody follows anybody")


def test_another_frame_rate_is_interpolated() -> None:
    (pair,) = on_a_ring(("a", 0, 0.0, 10.0), ("b", 0, 15.0, 12.0), rows=51, step_s=0.04).pairs
    assert (pair.rows, pair.step_s) == (21, 0.1)
    np.testing.assert_allclose(pair.gap_m, 11.0 + 0.2 * np.arange(21), atol=0.3)


def test_missing_frames_and_new_leaders_begin_a_new_pair(tmp_path: Path) -> None:
    pair = simulated_pair(population(1, 0)[0], rows=100)
    file = write_pair(tmp_path / "pair.csv", pair)
    lines = file.read_text().splitlines()
    write_text(file, "\n".join(lines[:41] + lines[46:]) + "\n")
    found = read_pairs(file).pairs
    assert [round(part.duration_s, 1) for part in found] == [3.9, 5.4]
    assert [round(part.start_s, 1) for part in found] == [0.0, 4.5]
    assert read_pairs(file, min_duration_s=5.0).short == 1


@pytest.mark.parametrize(("column", "jump_m"), [("xLeaderReal", 8.0), ("xFollowerReal", -8.0)])
def test_pairs_are_cut_where_a_vehicle_jumps(tmp_path: Path, column: str, jump_m: float) -> None:
    file = write_pair(tmp_path / "pair.csv", simulated_pair(population(1, 0)[0], rows=100))
    rows = pd.read_csv(file)
    rows.loc[60:, column] += jump_m
    rows.to_csv(file, index=False)
    found = read_pairs(file)
    assert [pair.rows for pair in found.pairs] == [60, 40]
    assert left_out_text(found) == ["left out: 1 moments at which a vehicle jumps, where pairs were cut"]


def test_vehicles_in_each_other_are_no_pair(tmp_path: Path) -> None:
    pair = simulated_pair(population(1, 0)[0], rows=100)
    nearer = replace(pair, leader_rear_m=pair.leader_rear_m - pair.gap_m.min() - 0.5)
    (before, *_) = read_pairs(write_pair(tmp_path / "pair.csv", nearer)).pairs
    assert before.rows < 100
    assert all((part.gap_m > 0.0).all() for part in read_pairs(tmp_path / "pair.csv").pairs)


def test_a_folder_is_read_file_by_file(tmp_path: Path) -> None:
    first, second = population(2, 0)
    pairs = [simulated_pair(first, 0), simulated_pair(first, 1), simulated_pair(second, 2, follower="2")]
    write_pairs(tmp_path, pairs)
    write_text(tmp_path / "README.txt", "no tracks")
    found = read_pairs(tmp_path)
    assert [pair.driver for pair in found.pairs] == ["1/1", "1/1", "1/2"]
    assert found.drivers == ("1/1", "1/2")
    assert [file.name for file in found.unread] == ["README.txt"]


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda text: "", "is empty"),
        (lambda text: HEADER + "\n", "no vehicles"),
        (lambda text: text.replace("vFollowerReal", "v"), "lacks the column vFollowerReal"),
        (lambda text: text + text.splitlines()[5] + "\n", "more than once"),
        (lambda text: "\n".join(text.splitlines()[:8]), "1 are shorter than 1 s"),
        (lambda text: text.replace(",leader0,", ",1,"), "more than once"),
        (lambda text: text.replace("Leader", "X").replace("Follower", "Leader").replace("X", "Follower"), "not ahead"),
    ],
    ids=("empty", "no rows", "missing column", "duplicate frame", "short", "one vehicle", "turned round"),
)
def test_bad_files_are_refused(tmp_path: Path, change: Any, message: str) -> None:
    file = write_pair(tmp_path / "pair.csv", simulated_pair(population(1, 0)[0], rows=50))
    write_text(file, change(file.read_text()))
    with pytest.raises(InputError, match=message):
        read_pairs(file)


@pytest.mark.parametrize("column", [5, 8])
def test_mixed_units_are_refused(tmp_path: Path, column: int) -> None:
    file = write_pair(tmp_path / "pair.csv", simulated_pair(population(1, 0)[0]))
    head, *lines = [line.split(",") for line in file.read_text().splitlines()]
    for line in lines:
        line[column] = str(float(line[column]) * 3.6)
    write_text(file, "\n".join(map(",".join, [head, *lines])))
    with pytest.raises(InputError, match=r"mixed units.* moves 0.278 times as far"):
        read_pairs(file)


def test_a_recording_is_not_read_twice(tmp_path: Path) -> None:
    pair = simulated_pair(population(1, 0)[0])
    write_pairs(tmp_path, [pair, pair])
    with pytest.raises(InputError, match=r"1/1 behind leader0 from 0 s is there more than once"):
        read_pairs(tmp_path)
    with pytest.raises(InputError, match="no file of a known format"):
        read_pairs(write_text(tmp_path / "other" / "notes.txt", "nothing") or tmp_path / "other")
