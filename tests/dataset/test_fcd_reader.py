"""Floating-car data as SUMO itself writes it with all of its options, and the vehicles in it."""

import gzip
import subprocess
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
import sumo

from tint_sumo.core.errors import InputError
from tint_sumo.dataset.fcd_reader import ON_LANES, POSES, are_parked, read_fcd
from tint_sumo.dataset.tracks import read_tracks

BIN = Path(sumo.SUMO_HOME) / "bin"
DAY_S = 86_400
VEHICLES = ["NA", "nan", "1", "True", "x.1_2"]  # in order of departure
ROUTES = f"""<routes>
    <vType id="NA"/><vType id="a.b:c" vClass="bus"/><route id="r" edges="in out"/>
    <person id="early" depart="{DAY_S}"><walk edges="in out"/></person>
    <person id="rider" depart="{DAY_S}"><ride from="in" to="out" lines="NA"/></person>
    <container id="box" depart="{DAY_S}"><transport from="in" to="out" lines="NA"/></container>
    <vehicle id="NA" type="NA" route="r" depart="{DAY_S + 1}"/>
    <vehicle id="nan" type="a.b:c" route="r" depart="{DAY_S + 4}"/>
    <vehicle id="1" type="NA" route="r" depart="{DAY_S + 7}"/>
    <vehicle id="True" route="r" depart="{DAY_S + 10}"/>
    <vehicle id="x.1_2" route="r" depart="{DAY_S + 13}"/>
</routes>"""
PLAIN_XML = {
    "t.nod.xml": '<nodes><node id="a" x="9" y="0"/><node id="b" x="9.0008" y="0"/><node id="c" x="9.0013" y="0.0005"/>'
    "</nodes>",
    "t.edg.xml": '<edges><edge id="in" from="a" to="b" sidewalkWidth="2"/><edge id="out" from="b" to="c" '
    'sidewalkWidth="2"/></edges>',
}


def run(program: str, *options: str, folder: Path) -> None:
    subprocess.run([BIN / program, *options], check=True, capture_output=True, cwd=folder)


def build(folder: Path, *options: str) -> None:
    """Build the network of a folder."""
    run("netconvert", "-n", "t.nod.xml", "-e", "t.edg.xml", "-o", "t.net.xml", "--proj.utm", *options, folder=folder)


def write(folder: Path, file: str, *options: str, routes: str = "t.rou.xml", begin_s: int = DAY_S) -> Path:
    """Run SUMO in a folder with a network, let it write ``file``, and return that."""
    times = ("--begin", str(begin_s), "--end", str(begin_s + 25), "--step-length", "0.5")
    run("sumo", "-n", "t.net.xml", "-r", routes, *times, "--fcd-output", file, *options, folder=folder)
    return folder / file


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with a network and traffic in it."""
    path = tmp_path_factory.mktemp("runs")
    for name, text in {**PLAIN_XML, "t.rou.xml": ROUTES}.items():
        (path / name).write_text(text)
    build(path)
    return path


@pytest.fixture(scope="module")
def expected(folder: Path) -> pd.DataFrame:
    return read_fcd(write(folder, "expected.xml"))


def test_xml_has_the_vehicles_alone_in_order_of_appearance(expected: pd.DataFrame) -> None:
    assert expected["vehicle"].cat.categories.tolist() == VEHICLES
    assert expected["time_s"].is_monotonic_increasing
    assert expected["time_s"].iloc[0] == DAY_S + 1
    assert set(expected["vehicle_class"]) == {"NA", "a.b:c", "DEFAULT_VEHTYPE"}
    assert len(expected) > 100


@pytest.mark.parametrize(
    ("name", "options"),
    [
        ("fcd.xml.gz", ()),
        ("fcd.csv", ()),
        ("fcd.csv.gz", ()),
        ("fcd.csv", ("--output.column-separator", ",")),
        ("fcd.csv", ("--output.column-separator", " ")),
        ("fcd.csv", ("--output.column-separator", "\t", "--output.column-header", "plain")),
        ("fcd.csv", ("--output.column-separator", "|", "--output.column-header", "auto")),
        ("fcd.csv", ("--output.column-header", "plain", "--human-readable-time")),
        ("fcd.xml", ("--human-readable-time",)),
        ("fcd.txt", ("--output.format", "csv")),
        ("fcd.csv", ("--fcd-output.acceleration", "--fcd-output.signals")),
        ("fcd.csv", ("--fcd-output.attributes", "all")),
        ("fcd.csv", ("--fcd-output.attributes", "tag,speed,type,lane,pos,x,y")),
        ("fcd.csv", ("--fcd-output.max-leader-distance", "30")),
    ],
)
def test_text_is_the_same_to_the_last_bit_whatever_the_options(
    folder: Path, expected: pd.DataFrame, name: str, options: Sequence[str]
) -> None:
    pd.testing.assert_frame_equal(read_fcd(write(folder, name, *options)), expected, check_exact=True)


@pytest.mark.parametrize(
    "options",
    [
        (),
        ("--human-readable-time",),
        ("--output.column-header", "none"),
        ("--output.column-header", "plain", "--output.compression", "zstd"),
        ("--fcd-output.acceleration",),
    ],
)
def test_parquet_is_the_same_but_for_decimals(folder: Path, expected: pd.DataFrame, options: Sequence[str]) -> None:
    found = read_fcd(write(folder, "fcd.parquet", *options))
    pd.testing.assert_frame_equal(found, expected, rtol=0.0, atol=0.0051)


def test_parquet_may_be_in_a_folder_with_a_colon_in_its_name(
    folder: Path, expected: pd.DataFrame, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "run:1").mkdir()
    write(folder, "fcd.parquet").rename(tmp_path / "run:1" / "fcd.parquet")
    monkeypatch.chdir(tmp_path)
    assert len(read_fcd(Path("run:1/fcd.parquet"))) == len(expected)


def test_tracks_follow_in_the_same_order(folder: Path) -> None:
    whole, *others = (read_tracks(write(folder, f"fcd.{suffix}")) for suffix in ("xml", "csv", "parquet"))
    assert whole["vehicle"].drop_duplicates().tolist() == VEHICLES
    pd.testing.assert_frame_equal(others[0], whole, check_exact=True)
    pd.testing.assert_frame_equal(others[1], whole, rtol=0.0, atol=0.1)


def test_rows_may_be_in_any_order_and_ids_in_quotes(folder: Path, expected: pd.DataFrame) -> None:
    lines = write(folder, "fcd.csv").read_text().splitlines()
    header, rows = lines[0], [line.replace(";x.1_2;", ';"x;1,2";') for line in lines[1:]]
    np.random.default_rng(0).shuffle(rows)
    (folder / "shuffled.csv").write_text("\ufeff" + "\r\n".join([header, *rows]))
    found = read_fcd(folder / "shuffled.csv")
    assert found["vehicle"].cat.categories.tolist() == [*VEHICLES[:-1], "x;1,2"]
    pd.testing.assert_frame_equal(found.drop(columns="vehicle"), expected.drop(columns="vehicle"), check_exact=True)


def test_precision_and_longitudes_are_kept(folder: Path, expected: pd.DataFrame) -> None:
    fine = read_fcd(write(folder, "fcd.csv", "--precision", "6"))
    assert 0.0 < (fine["pos_m"] - expected["pos_m"]).abs().max() <= 0.005
    degrees = read_fcd(write(folder, "fcd.xml", "--fcd-output.geo"))
    pd.testing.assert_frame_equal(degrees.drop(columns=["x", "y"]), expected.drop(columns=["x", "y"]))
    assert degrees["x"].between(9.0, 9.002).all()


def test_poses_of_vehicles_alone_are_read_without_lanes(folder: Path) -> None:
    attributes = ("--fcd-output.attributes", "x,y,angle,speed,type")
    expected = read_fcd(write(folder, "fcd.xml", *attributes), POSES)
    assert expected["vehicle"].cat.categories.tolist() == VEHICLES
    pd.testing.assert_frame_equal(read_fcd(write(folder, "fcd.csv", *attributes), POSES), expected)
    with pytest.raises(InputError, match=r"fcd\.csv lacks 'lane', 'pos'; run SUMO without --fcd-output\.attributes"):
        read_fcd(folder / "fcd.csv", ON_LANES)


# Parked vehicles


@pytest.mark.parametrize("lefthand", [False, True])
@pytest.mark.parametrize("suffix", ["xml", "csv"])
@pytest.mark.parametrize("geo", [False, True])
def test_vehicles_beside_the_lane_are_no_leaders(tmp_path: Path, lefthand: bool, suffix: str, geo: bool) -> None:
    """In a parking area, at a parking stop, parked from the beginning; and one that stops on the lane is a leader."""
    for name, text in PLAIN_XML.items():
        (tmp_path / name).write_text(text.replace(' sidewalkWidth="2"', ""))
    build(tmp_path, *(("--lefthand", "true") if lefthand else ()))
    (tmp_path / "a.add.xml").write_text(
        '<additional><parkingArea id="pa" lane="in_0" startPos="40" endPos="60" roadsideCapacity="3"/></additional>'
    )
    (tmp_path / "p.rou.xml").write_text("""<routes><route id="r" edges="in out"/>
        <vehicle id="area" route="r" depart="0" departPos="20"><stop parkingArea="pa" duration="99"/></vehicle>
        <vehicle id="stop" route="r" depart="0" departPos="30">
            <stop lane="out_0" startPos="10" endPos="20" parking="true" duration="99"/>
        </vehicle>
        <vehicle id="there" route="r" depart="0" departPos="stop"><stop parkingArea="pa" duration="99"/></vehicle>
        <vehicle id="waits" route="r" depart="9"><stop lane="out_0" endPos="60" duration="99"/></vehicle>
        <vehicle id="passes" route="r" depart="12"/></routes>""")
    options = ("-a", "a.add.xml", *(("--fcd-output.geo",) if geo else ()))
    file = write(tmp_path, f"fcd.{suffix}", *options, routes="p.rou.xml", begin_s=0)
    rows = read_fcd(file)
    parked = rows[are_parked(rows)]
    stands = rows[rows["speed_mps"] == 0.0]
    beside = stands[stands["vehicle"].isin(["area", "stop", "there"])]
    assert sorted(set(parked["vehicle"])) == ["area", "stop", "there"]
    assert set(beside.index) <= set(parked.index)
    tracks = read_tracks(file, net_file=tmp_path / "t.net.xml")
    last = tracks[tracks["vehicle"] == "passes"].iloc[-1]
    assert tracks["gap_m"].min() > 2.0
    assert last["gap_m"] < 20.0, "the vehicle that waits on the lane is its leader"


# Bad input


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("\n\n\n", "names no time in its first line; give what sumo --fcd-output wrote"),
        ("timestep_time;vehicle_id;vehicle_lane;vehicle_pos;vehicle_speed\n0;a;e_0;1;2;3\n", "is damaged .*Expected 5"),
        ("timestep_time;vehicle_id;vehicle_lane;vehicle_pos;vehicle_speed\n0;a;e_0;1", "is damaged .*Expected 5"),
        ("timestep_time;vehicle_id;vehicle_lane;vehicle_pos;vehicle_speed\nx;a;e_0;1;2\n", "is damaged"),
        ("timestep_time;vehicle_id;vehicle_lane;vehicle_pos;vehicle_speed\n0;a;;1;2\n", "has no vehicle on a lane"),
        ("timestep_time;vehicle_id;vehicle_lane;vehicle_pos;vehicle_speed\n0;a;e_0;nan;2\n", "without one of time, id"),
        ("timestep_time:vehicle_id:vehicle_lane:vehicle_pos:vehicle_speed\n0::e:e_0:1:2\n", "is damaged .*Expected 5"),
        (
            "timestep_timexvehicle_idxvehicle_lanexvehicle_posxvehicle_speed\n0xaxe_0x1x2\n",
            "names no time in its first line",
        ),
    ],
)
def test_tables_that_cannot_be_read_are_refused(tmp_path: Path, text: str, message: str) -> None:
    (tmp_path / "fcd.csv.gz").write_bytes(gzip.compress(text.encode()))
    with pytest.raises(InputError, match=message) as refused:
        read_fcd(tmp_path / "fcd.csv.gz")
    assert "\n" not in str(refused.value)


@pytest.mark.parametrize("name", ["fcd.xml", "fcd.csv", "fcd.parquet"])
def test_a_mesoscopic_run_is_refused(folder: Path, name: str) -> None:
    with pytest.raises(InputError, match=r"--mesosim"):
        read_fcd(write(folder, name, "--mesosim"))


def test_a_separator_that_numbers_have_is_refused(folder: Path) -> None:
    with pytest.raises(InputError, match=r"fcd\.csv is damaged"):
        read_fcd(write(folder, "fcd.csv", "--output.column-separator", "."))
