"""Tracks on the lanes of networks: of SUMO's vehicles, whose lanes are known, and of drawn and recorded ones."""

import subprocess
from collections.abc import Sequence
from pathlib import Path
from xml.etree import ElementTree

import numpy as np
import pandas as pd
import pytest

from tests.maps.files import commonroad
from tests.tracks.test_formats import REAL, needs_real_files
from tint_sumo.core.errors import InputError
from tint_sumo.core.files import write_text
from tint_sumo.maps import import_map
from tint_sumo.scenes import SCENES
from tint_sumo.scenes.build import write_scene
from tint_sumo.scenes.network import sumo_program
from tint_sumo.tracks import Matched, Tracks, match, read_tracks
from tint_sumo.tracks.match_report import plot, report, summary
from tint_sumo.tracks.matching import REASONS, write_table
from tint_sumo.tracks.schema import build_tracks


def simulated(folder: Path, scene: str, *options: str) -> tuple[Matched, pd.DataFrame]:
    """Tracks of a scene on its network, and what SUMO knows of them in columns that begin with ``true_``."""
    write_scene(folder, SCENES[scene](), 1)
    fcd = ["--fcd-output", "fcd.xml", "--fcd-output.max-leader-distance", "90", *options]
    run = ["--configuration-file", "tint.sumocfg", "--step-length", "0.2", "--end", "40", *fcd]
    subprocess.run([sumo_program("sumo"), *run], cwd=folder, check=True, capture_output=True)
    matched = match(read_tracks(folder / "fcd.xml"), folder / "tint.net.xml")
    true = [
        (
            *(one.get("id"), float(step.get("time", "")), one.get("lane"), float(one.get("pos", ""))),
            *(one.get("leaderID"), float(one.get("leaderGap") or "nan")),
        )
        for step in ElementTree.parse(folder / "fcd.xml").getroot()
        for one in step.findall("vehicle")
    ]
    names = ["vehicle", "time_s", "true_lane", "true_position_m", "true_leader", "true_gap_m"]
    texts = matched.table.assign(**{name: matched.table[name].astype(object) for name in ("vehicle", "lane", "leader")})
    return matched, texts.merge(pd.DataFrame(true, columns=names), on=["vehicle", "time_s"], validate="1:1")


@pytest.mark.parametrize("scene", ["t_intersection", "roundabout"])
def test_lanes_of_simulated_vehicles(tmp_path: Path, scene: str) -> None:
    matched, table = simulated(tmp_path, scene)
    is_right = table["lane"] == table["true_lane"]
    assert is_right[~table["true_lane"].str.startswith(":")].mean() >= 0.99
    assert is_right.mean() >= 0.99
    assert table["offset_m"].abs().quantile(0.95) < 0.02
    assert (table["position_m"] - table["true_position_m"])[is_right].abs().max() < 0.03
    assert matched.jumps == 0


def test_leaders_are_those_of_sumo(tmp_path: Path) -> None:
    _, table = simulated(tmp_path, "t_intersection")
    led = table[table["true_leader"] != ""]
    assert len(led) > 0.5 * len(table)
    assert (led["leader"] == led["true_leader"]).all()
    np.testing.assert_allclose(led["gap_m"], led["true_gap_m"], atol=0.02)
    assert table.loc[table["true_leader"] == "", "leader"].isna().all()
    np.testing.assert_allclose(led["time_gap_s"], led["gap_m"] / led["speed_mps"].where(led["speed_mps"] > 0.1))


@pytest.fixture(scope="module")
def net(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("net")
    return import_map(commonroad(folder / "map.xml"), folder).net


def drawn(*tracks: Sequence[tuple[float, float, float]], speed_mps: float = 10.0) -> Tracks:
    """Tracks of cars from x, y and heading of their fronts, every 0.1 s."""
    rows = []
    for number, points in enumerate(tracks):
        for step, (x_m, y_m, heading_rad) in enumerate(points):
            centre = (x_m - 2.5 * np.cos(heading_rad), y_m - 2.5 * np.sin(heading_rad))
            rows.append((str(number), step / 10, *centre, heading_rad, speed_mps))
    columns = pd.DataFrame(rows, columns=["vehicle", "time_s", "x_m", "y_m", "heading_rad", "speed_mps"])
    size = {"length_m": 5.0, "width_m": 2.0, "vehicle_class": "car", "recording": "drawn"}
    return build_tracks(Path("drawn.csv"), "drawn", {**columns, **size})


def straight(x: float, y: float, heading_rad: float, steps: int = 100) -> list[tuple[float, float, float]]:
    along = np.array([np.cos(heading_rad), np.sin(heading_rad)])
    return [(*((x, y) + along * step), heading_rad) for step in range(steps)]


def test_tracks_do_not_jump_to_lanes_that_they_cross(net: Path) -> None:
    noise = np.random.default_rng(3).normal(0.0, [0.3, 0.3, 0.15], (100, 3))
    east, north = straight(-50, 1.75, 0.0), straight(0, -50, np.pi / 2)
    matched = match(drawn(east + noise, north + noise), net)
    edges = [
        rows["edge"].astype(str).loc[lambda edge: edge != edge.shift()].tolist()
        for _, rows in matched.table.groupby("vehicle", observed=True)
    ]
    assert [len(found) for found in edges] == [3, 3]
    assert [(found[0], found[2]) for found in edges] == [("1", "21"), ("3", "23")]
    assert matched.jumps == 0
    assert (matched.table["lane"].str.endswith("_1") == (matched.table["vehicle"] == "0")).sum() > 190


def test_the_way_over_a_fork_is_the_one_that_is_taken_later(net: Path) -> None:
    turn = straight(0, -40, np.pi / 2, 31)
    turn += [(9 * (1 - np.cos(a)), -10 + 8.25 * np.sin(a), np.pi / 2 - a) for a in np.linspace(0.1, 1.5, 12)]
    turn += straight(10, -1.75, 0.0, 30)
    ahead = straight(0, -30, np.pi / 2, 73)
    matched = match(drawn(turn, ahead), net)
    found = matched.table[matched.table["vehicle"] == "0"]
    assert found["edge"].astype(str).iloc[[0, -1]].tolist() == ["3", "21"]
    assert found.loc[found["lane"].str.startswith(":"), "lane"].nunique() == 1
    leads = found["leader"].astype(object) == "1"
    assert leads.iloc[:10].all()  # still on the way of the one that turns
    np.testing.assert_allclose(found["gap_m"].iloc[:10], 5.0, atol=0.1)
    assert not leads.iloc[22:].any()  # the other is on the junction, on its way ahead
    behind = straight(0, -50, np.pi / 2, 73)
    straight_on = match(drawn(behind, turn), net).table.loc[lambda rows: rows["vehicle"] == "0", "leader"]
    assert (straight_on.astype(object) == "1").iloc[:10].all()
    assert straight_on.iloc[34:].isna().all()


def test_what_is_not_placed_has_a_reason(net: Path) -> None:
    matched = match(drawn(straight(-50, 1.75, np.pi, 3), straight(-50, 30, 0.0, 3), straight(-50, -1.75, 0.0, 3)), net)
    assert matched.table["reason"].tolist() == [REASONS[1]] * 3 + [REASONS[0]] * 3 + [""] * 3
    found = summary(matched)
    assert (found["placed_rows"], found["vehicles_placed_nowhere"], found["vehicles_placed_in_part"]) == (3, 2, 0)
    assert "3 far from all lanes, 3 across or against the lanes" in report(matched)
    assert "is this the network of these tracks?" in report(matched)
    assert "is this the network" not in report(match(drawn(straight(-50, -1.75, 0.0, 3)), net))
    assert matched.table["lane"].isna().tolist() == [True] * 6 + [False] * 3


def test_lanes_without_a_way_between_them_are_a_jump(net: Path) -> None:
    assert match(drawn(straight(-40, 1.75, 0.0, 5) + straight(0, 40, np.pi / 2, 5)), net).jumps == 1


@pytest.mark.parametrize(
    ("x", "y", "message"), [(5000, 0, "are 4,9.. m apart"), (-40, 40, "no position lies on a lane")]
)
def test_a_network_that_does_not_belong_to_the_tracks(net: Path, x: float, y: float, message: str) -> None:
    tracks = drawn(straight(x, y, 0.0, 9))
    with pytest.raises(InputError, match=rf"does not belong to drawn.csv: .*{message}; offsets or projections"):
        match(tracks, net)
    assert match(tracks, net, shift_m=(-30.0 - x, -1.75 - y)).table["lane"].notna().all()


@pytest.mark.parametrize("text", ["", "<net>", "<nodes></nodes>", "a,b\n1,2\n", "<net></net>"])
def test_what_is_no_network_is_refused(tmp_path: Path, text: str) -> None:
    write_text(tmp_path / "x.net.xml", text)
    with pytest.raises(InputError, match=r"x.net.xml (is no network|has no lanes)") as refused:
        match(drawn(straight(0, 0, 0.0, 3)), tmp_path / "x.net.xml")
    assert "\n" not in str(refused.value)


def test_geographic_tracks_lie_on_a_network_with_a_projection(tmp_path: Path) -> None:
    write_text(
        tmp_path / "n.xml", '<nodes><node id="a" x="11.5" y="48.1"/><node id="b" x="11.502" y="48.102"/></nodes>'
    )
    write_text(tmp_path / "e.xml", '<edges><edge id="ab" from="a" to="b"/></edges>')
    write_text(tmp_path / "t.xml", '<routes><trip id="car" depart="0" from="ab" to="ab" departSpeed="max"/></routes>')
    build = ["--node-files", "n.xml", "--edge-files", "e.xml", "--proj.utm", "--output-file", "x.net.xml"]
    drive = ["--net-file", "x.net.xml", "--route-files", "t.xml", "--fcd-output", "fcd.xml", "--fcd-output.geo"]
    for program, options in (("netconvert", build), ("sumo", [*drive, "--precision.geo", "8"])):
        subprocess.run([sumo_program(program), *options], cwd=tmp_path, check=True, capture_output=True)
    matched = match(read_tracks(tmp_path / "fcd.xml", "fcd_geo"), tmp_path / "x.net.xml")
    assert (matched.table["lane"] == "ab_0").all()
    assert matched.table["offset_m"].abs().max() < 0.1  # the angle of the vehicle has a few digits


def test_tables_and_pictures_are_written(net: Path, tmp_path: Path) -> None:
    matched = match(drawn(straight(-50, 1.75, 0.0), straight(-50, 30, 0.0)), net)
    write_table(matched, tmp_path / "table.csv")
    write_table(matched, tmp_path / "table.parquet")
    plot(matched, tmp_path / "lanes.png")
    for table in (pd.read_csv(tmp_path / "table.csv"), pd.read_parquet(tmp_path / "table.parquet")):
        assert table.columns.tolist() == matched.table.columns.tolist()
        np.testing.assert_allclose(table["position_m"], matched.table["position_m"], atol=1e-6)
    assert (tmp_path / "lanes.png").stat().st_size > 1000


@needs_real_files
@pytest.mark.parametrize(
    ("name", "placed", "median_m", "most_m"),
    [("USA_Lanker-1_1_T-1", 1.0, 0.25, 0.8), ("USA_Peach-4_8_T-1", 0.97, 0.5, 1.2)],
)
def test_recorded_tracks(tmp_path: Path, name: str, placed: float, median_m: float, most_m: float) -> None:
    file = REAL / "commonroad" / f"{name}.xml"
    found = summary(match(read_tracks(file), import_map(file, tmp_path).net))
    assert found["placed_rows"] >= placed * found["rows"]
    assert found["offset_median_m"] < median_m
    assert found["offset_95_m"] < most_m
    assert found["jumps"] == 0
