"""Every format gives the same table of the same traffic, recognised by the file's beginning."""

import gzip
import re
import subprocess
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
import sumolib

from tests.tracks.files import CAR, FILES, FRAMES, TRUCK, commonroad, csv, interaction, levelx, ngsim, tgsim
from tint_sumo.core.errors import InputError
from tint_sumo.core.files import write_text
from tint_sumo.dataset.recorder import record
from tint_sumo.tracks import FORMATS, read_tracks
from tint_sumo.tracks.inspection import inspect
from tint_sumo.tracks.schema import COLUMNS

REAL = Path(__file__).parents[3] / "shared" / "real"
needs_real_files = pytest.mark.skipif(not REAL.is_dir(), reason="the recorded traffic is not there")


@pytest.mark.parametrize("name", FILES)
def test_all_formats_have_the_same_table(tmp_path: Path, name: str) -> None:
    tracks = read_tracks(FILES[name](tmp_path))
    table = tracks.table
    assert tracks.format == name
    assert tuple(table) == COLUMNS
    assert len(table) == 2 * len(FRAMES)
    assert tracks.track_number.tolist() == [0] * len(FRAMES) + [1] * len(FRAMES)
    for rows, (_, speed_mps, y_m, length_m, width_m) in zip((table[:11], table[11:]), (CAR, TRUCK), strict=True):
        np.testing.assert_allclose(rows["time_s"], np.arange(11) / 10, atol=1e-9)
        np.testing.assert_allclose(rows["x_m"], speed_mps * np.arange(11) / 10, atol=1e-9)
        for column, value in (
            *(("y_m", y_m), ("heading_rad", 0.0), ("speed_mps", speed_mps), ("length_m", length_m)),
            ("width_m", width_m),
        ):
            np.testing.assert_allclose(rows[column], value, atol=1e-9)
    assert table["vehicle_class"].iloc[[0, 11]].nunique() == 2


def _driven_fcd(folder: Path, *options: str) -> Path:
    """Write floating-car data of a car that SUMO drives north-east, then west."""
    nodes = '<nodes><node id="a" x="0" y="0"/><node id="b" x="100" y="100"/><node id="c" x="0" y="100"/></nodes>'
    edges = '<edges><edge id="ab" from="a" to="b" speed="10"/><edge id="bc" from="b" to="c" speed="10"/></edges>'
    write_text(folder / "nodes.xml", nodes)
    write_text(folder / "edges.xml", edges)
    projection = ["--proj.utm", "true"] if options else []
    if projection:
        nodes = nodes.replace('x="0" y="0"', 'x="11.50" y="48.10"').replace('x="100" y="100"', 'x="11.502" y="48.102"')
        write_text(folder / "nodes.xml", nodes.replace('x="0" y="100"', 'x="11.50" y="48.102"'))
    net = ["--node-files", "nodes.xml", "--edge-files", "edges.xml", "--output-file", "net.xml"]
    subprocess.run([sumolib.checkBinary("netconvert"), *net, *projection], cwd=folder, check=True, capture_output=True)
    trip = '<trip id="car" depart="0" from="ab" to="bc" departSpeed="max"/>'
    write_text(folder / "trips.xml", f"<routes>{trip}</routes>")
    run = ["--net-file", "net.xml", "--route-files", "trips.xml", "--step-length", "0.5", "--fcd-output", "fcd.xml"]
    subprocess.run([sumolib.checkBinary("sumo"), *run, *options], cwd=folder, check=True, capture_output=True)
    return folder / "fcd.xml"


def test_floating_car_data_of_sumo(tmp_path: Path) -> None:
    tracks = read_tracks(_driven_fcd(tmp_path))
    first, last = tracks.table.iloc[0], tracks.table.iloc[-1]
    assert tracks.format == "fcd"
    assert first["heading_rad"] == pytest.approx(np.pi / 4, abs=0.05)
    assert abs(last["heading_rad"]) == pytest.approx(np.pi, abs=0.05)
    assert inspect(tracks).distance_ratio == pytest.approx(1.0, abs=0.03)


def test_geographic_positions_become_metres(tmp_path: Path) -> None:
    file = _driven_fcd(tmp_path, "--fcd-output.geo", "true", "--precision.geo", "8")
    with pytest.raises(InputError, match="has longitudes and latitudes"):
        read_tracks(file)
    tracks = read_tracks(file, "fcd_geo")
    assert inspect(tracks).distance_ratio == pytest.approx(1.0, abs=0.03)
    assert not inspect(tracks).has_mixed_units


def test_our_own_recordings_are_read(tmp_path: Path) -> None:
    record(tmp_path / "data", 200, fcd=True)
    (file,) = (tmp_path / "data" / "fcd").iterdir()
    with gzip.open(file) as opened:
        vehicles = {line.split(b'"')[1] for line in opened if b"<vehicle" in line}
    found = inspect(read_tracks(file))
    assert found.vehicles == len(vehicles)
    assert found.faults.jumps == found.faults.overlaps == 0


@needs_real_files
def test_real_recordings_are_read() -> None:
    for name, vehicles in (("USA_Lanker-1_1_T-1", 24), ("USA_Peach-4_8_T-1", 9)):
        found = inspect(read_tracks(REAL / "commonroad" / f"{name}.xml"))
        assert (found.tracks.format, found.vehicles, found.faults.jumps) == ("commonroad", vehicles, 0)
    pairs = [read_tracks(file) for file in sorted((REAL / "car_following").glob("*.csv"))]
    assert len(pairs) == 93
    assert {pair.format for pair in pairs} == {"leader_follower"}
    for pair in pairs:
        gap_m = pair.table.groupby("time_s")["x_m"].agg(lambda x_m: x_m.max() - x_m.min())
        raw = pd.read_csv(pair.file)
        np.testing.assert_allclose(gap_m, raw["spacing"] + 5.0, atol=0.01)


def test_headings_follow_from_motion_and_stay_where_a_vehicle_stands(tmp_path: Path) -> None:
    header = "id,time,xloc-kf,yloc-kf,speed-kf,length-smoothed,width-smoothed,type-most-common"
    places = [(0, 0), (0, -1), (0, -2), (0, -2), (0, -2.01), (1, -2.01), (2, -2.01)]  # images have y downwards
    lines = [["v", number, x, y, 1.0, 4.0, 2.0, 1] for number, (x, y) in enumerate(places)]
    still = [["w", number, 9.0, 9.0, 0.0, 4.0, 2.0, 1] for number in range(3)]
    table = read_tracks(csv(tmp_path / "t.csv", header, [*lines, *still])).table
    expected = [np.pi / 2, np.pi / 2, 0.01, 0.01, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0]
    np.testing.assert_allclose(table["heading_rad"], expected, atol=0.011)


def test_pedestrians_of_levelx_have_a_size(tmp_path: Path) -> None:
    file = levelx(tmp_path)
    write_text(file, file.read_text().replace("1.8,4.0", "0.0,0.0"))
    assert read_tracks(file).table["length_m"].min() == 0.5


def test_vehicle_ids_that_ngsim_uses_again_are_others(tmp_path: Path) -> None:
    file = ngsim(tmp_path)
    header, *lines = file.read_text().splitlines()
    again = [line.replace("2,", "1,", 1).replace(",11,", ",12,", 1) for line in lines if line.startswith("2,")]
    write_text(file, "\n".join([header, *(line for line in lines if line.startswith("1,")), *again]))
    assert inspect(read_tracks(file)).vehicles == 2


def test_cases_of_interaction_are_recordings(tmp_path: Path) -> None:
    header, *lines = interaction(tmp_path).read_text().splitlines()
    both = [f"{case},{line}" for case in ("7.0", "8.0") for line in lines]
    write_text(tmp_path / "cases.csv", "\n".join([f"case_id,{header}", *both]))
    found = inspect(read_tracks(tmp_path / "cases.csv"))
    assert (found.recordings, found.vehicles) == (2, 4)


def test_files_that_number_their_parts_anew_are_other_recordings(tmp_path: Path) -> None:
    header, *lines = interaction(tmp_path).read_text().splitlines()
    runs = tgsim(tmp_path).read_text()
    for place in ("merging", "roundabout"):
        write_text(tmp_path / f"{place}.csv", "\n".join([f"case_id,{header}", *(f"1.0,{line}" for line in lines)]))
        write_text(tmp_path / f"{place}_runs.csv", runs)
        for name in (f"{place}", f"{place}_runs"):
            recordings = read_tracks(tmp_path / f"{name}.csv").table["recording"].unique()
            assert [recording.partition("/")[0] for recording in recordings] == [name]


# Bad input


@pytest.mark.parametrize("name", FILES)
def test_a_file_that_is_cut_or_spoilt_is_one_line(tmp_path: Path, name: str) -> None:
    file = FILES[name](tmp_path)
    text = file.read_text()
    number = "32.80" if name == "ngsim" else "10.0"
    assert number in text
    cut = text[: text.rindex(",", 0, text.rindex(","))] if "," in text else text[: len(text) // 2]
    for spoilt in (text.replace(number, "fast"), cut):
        write_text(file, spoilt)
        with pytest.raises(InputError) as caught:
            read_tracks(file)
        assert str(file) in str(caught.value)
        assert "\n" not in str(caught.value)


@pytest.mark.parametrize("name", FILES)
def test_a_file_without_vehicles_is_refused(tmp_path: Path, name: str) -> None:
    file = FILES[name](tmp_path)
    empty = '<commonRoad timeStepSize="0.1"/>' if name == "commonroad" else file.read_text().splitlines()[0] + "\n"
    write_text(file, empty)
    with pytest.raises(InputError, match="has no vehicles; give a recording of traffic"):
        read_tracks(file)


def test_missing_columns_are_named(tmp_path: Path) -> None:
    file = interaction(tmp_path)
    write_text(file, file.read_text().replace(",width", ",breadth"))
    with pytest.raises(InputError, match="lacks the column width; give the file as it was published"):
        read_tracks(file)


def test_frames_that_are_there_twice_are_refused(tmp_path: Path) -> None:
    file = interaction(tmp_path)
    with file.open("a") as opened:
        opened.write(file.read_text().splitlines()[3] + "\n")
    with pytest.raises(InputError, match=r"has vehicle 1 at 0\.2 s more than once, 1 rows in all"):
        read_tracks(file)


def test_levelx_needs_its_meta_data(tmp_path: Path) -> None:
    file = levelx(tmp_path)
    (tmp_path / "07_tracksMeta.csv").unlink()
    with pytest.raises(InputError, match=r"needs 07_tracksMeta\.csv in its folder"):
        read_tracks(file)


@pytest.mark.parametrize("text", ["", "\n \n", "\ufeff\n"])
@pytest.mark.parametrize("suffix", ["", ".gz"])
def test_empty_files_are_called_so(tmp_path: Path, text: str, suffix: str) -> None:
    (tmp_path / f"file.csv{suffix}").write_bytes(gzip.compress(text.encode()) if suffix else text.encode())
    with pytest.raises(InputError, match="is empty; give a recording of traffic"):
        read_tracks(tmp_path / f"file.csv{suffix}")


@pytest.mark.parametrize("text", ["a,b\n1,2\n", "<routes/>", "\x00\x01"])
def test_unknown_files_are_refused(tmp_path: Path, text: str) -> None:
    write_text(tmp_path / "file.csv", text)
    with pytest.raises(InputError, match="has the columns or elements of no known format"):
        read_tracks(tmp_path / "file.csv")
    with pytest.raises(InputError, match="no file"):
        read_tracks(tmp_path / "missing.csv")


def test_a_format_can_be_named(tmp_path: Path) -> None:
    file = commonroad(tmp_path)
    assert read_tracks(file, "commonroad").format == "commonroad"
    with pytest.raises(InputError, match="unknown format 'commonrod'"):
        read_tracks(file, "commonrod")
    for name in FORMATS.keys() - {"commonroad"}:
        with pytest.raises(InputError):
            read_tracks(file, name)


@pytest.mark.parametrize("name", FILES)
def test_gzipped_files_are_the_same(tmp_path: Path, name: str) -> None:
    file = FILES[name](tmp_path)
    packed = file.with_name(f"{file.name}.gz")
    packed.write_bytes(gzip.compress(file.read_bytes()))
    pd.testing.assert_frame_equal(read_tracks(packed).table, read_tracks(file).table)
    packed.write_bytes(packed.read_bytes()[:60])
    for format_name in (None, name):
        with pytest.raises(InputError, match=r"is not whole \(Compressed file ended"):
            read_tracks(packed, format_name)


@pytest.mark.parametrize("suffix", [".zip", ".bz2", ".xz", ".zst", ".tar"])
def test_names_do_not_say_how_a_file_is_packed(tmp_path: Path, suffix: str) -> None:
    file = interaction(tmp_path)
    assert len(read_tracks(file.rename(file.with_suffix(suffix))).table) == 2 * len(FRAMES)


def test_spaces_and_a_byte_order_mark_do_not_matter(tmp_path: Path) -> None:
    file = levelx(tmp_path)
    table = read_tracks(file).table
    write_text(file, "\ufeff" + file.read_text().replace(",", " , ").replace("\n", "\r\n"))
    pd.testing.assert_frame_equal(read_tracks(file).table, table)


@pytest.mark.parametrize("name", sorted(FILES.keys() - {"commonroad"}))
@pytest.mark.parametrize("separator", [";", "\t"])
def test_other_separators_are_read(tmp_path: Path, name: str, separator: str) -> None:
    file = FILES[name](tmp_path)
    table = read_tracks(file).table
    write_text(file, file.read_text().replace(",", separator))
    pd.testing.assert_frame_equal(read_tracks(file).table, table)


@pytest.mark.parametrize("encoding", ["utf-16", "utf-16-be"])
@pytest.mark.parametrize("name", FILES)
def test_another_encoding_is_named(tmp_path: Path, name: str, encoding: str) -> None:
    file = FILES[name](tmp_path)
    file.write_bytes(f"\ufeff{file.read_text()}".encode(encoding))
    with pytest.raises(InputError, match=r"is text in UTF-16; save it in UTF-8"):
        read_tracks(file)


def test_commas_stand_between_thousands_only(tmp_path: Path) -> None:
    file = ngsim(tmp_path)
    table = read_tracks(file).table
    text = file.read_text()
    write_text(file, re.sub(r"1118846(98\d)(\d00)", r'"1,118,846,\1,\2"', text))
    pd.testing.assert_frame_equal(read_tracks(file).table, table)
    write_text(file, text.replace(",1118846980200,", ',"1,5",', 1))
    with pytest.raises(InputError, match=r"row \d+: .* is '1,5', not a number; write decimals with points, not commas"):
        read_tracks(file)


@pytest.mark.parametrize("number", ["0,000", "13,500", "4,5"])
def test_decimal_commas_are_no_thousands(tmp_path: Path, number: str) -> None:
    file = ngsim(tmp_path)
    text = file.read_text().replace(",", ";")
    write_text(file, text.replace(";1118846980200;", f";{number};", 1))
    with pytest.raises(InputError, match=rf"is '{number}', not a number; write decimals with points, not commas"):
        read_tracks(file)
    write_text(file, file.read_text().replace(";", ",").replace(f",{number},", ',"0,000",', 1))
    with pytest.raises(InputError, match="is '0,000', not a number"):
        read_tracks(file)


@pytest.mark.parametrize("name", sorted(FILES.keys() - {"commonroad"}))
def test_rows_with_too_many_values_are_refused(tmp_path: Path, name: str) -> None:
    file = FILES[name](tmp_path)
    header, *lines = file.read_text().splitlines()
    write_text(file, "\n".join([header, *(f"{line},9" for line in lines)]))
    with pytest.raises(InputError, match="more values in its rows than names in its first line"):
        read_tracks(file)


def test_files_that_fit_two_formats_need_its_name(tmp_path: Path) -> None:
    file = interaction(tmp_path)
    header, *lines = file.read_text().splitlines()
    both = [f"{header},id,time,xloc-kf,yloc-kf,speed-kf", *(f"{line},1,2,3,4,5" for line in lines)]
    write_text(file, "\n".join(both))
    with pytest.raises(InputError, match="choose the `format`: interaction, tgsim"):
        read_tracks(file)
    assert read_tracks(file, "interaction").format == "interaction"


@pytest.mark.parametrize("rates", ["7,1,0", "7,1,-25", "7,1,nan", "", "7,1,10\n7,1,10"])
def test_levelx_needs_one_frame_rate(tmp_path: Path, rates: str) -> None:
    file = levelx(tmp_path)
    write_text(tmp_path / "07_recordingMeta.csv", "recordingId,locationId,frameRate\n" + rates)
    with pytest.raises(InputError, match=r"07_recordingMeta\.csv.*(one row, with a frameRate above 0|not a number)"):
        read_tracks(file)


def test_sizes_below_zero_are_refused(tmp_path: Path) -> None:
    file = levelx(tmp_path)
    write_text(file, file.read_text().replace("1.8,4.0", "1.8,-4.0", 1))
    with pytest.raises(InputError, match=r"length_m is -4 for vehicle 1 at 0 s"):
        read_tracks(file)


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ('"0.1"', '"0"', "timeStepSize is 0, not above 0"),
        ('"0.1"', '"-0.1"', "timeStepSize is -0.1, not above 0"),
        ('"1.0"?', '"1.0" encoding="klingon"?', "is not whole XML"),
        ('"1.0"?', '"1.0" encoding="utf-32"?', "is not whole XML"),
    ],
)
def test_commonroad_without_sense_is_refused(tmp_path: Path, old: str, new: str, message: str) -> None:
    file = commonroad(tmp_path)
    write_text(file, file.read_text().replace(old, new, 1))
    with pytest.raises(InputError, match=message):
        read_tracks(file)


def test_floating_car_data_without_all_columns_names_them(tmp_path: Path) -> None:
    write_text(tmp_path / "fcd.csv", "timestep_time,vehicle_id,vehicle_speed,vehicle_x\n0,a,1,1\n")
    with pytest.raises(InputError, match=r"fcd\.csv lacks 'type', 'y', 'angle'"):
        read_tracks(tmp_path / "fcd.csv")
