"""Floating-car data as tracks: hand-built scenes, damaged files, and what SUMO itself writes."""

import gzip
import random
import tracemalloc
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
import pandas as pd
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from tint_sumo.core.errors import InputError
from tint_sumo.core.files import shipped
from tint_sumo.dataset.fcd_reader import read_fcd
from tint_sumo.dataset.schema import TRAJECTORIES
from tint_sumo.dataset.tracks import read_tracks

NET = shipped("sumo_net") / "tint.net.xml"
Seen = tuple[str, str, float, float]  # vehicle, lane, pos, speed

POOL = pa.proxy_memory_pool(pa.default_memory_pool())  # lives as long as what is allocated in it


def fcd(steps: Mapping[float, Sequence[Seen]]) -> str:
    timesteps = (
        f'<timestep time="{time:.2f}">'
        + "".join(
            f'<vehicle id="{vehicle}" lane="{lane}" pos="{pos:.2f}" speed="{speed:.2f}"/>'
            for vehicle, lane, pos, speed in seen
        )
        + "</timestep>"
        for time, seen in steps.items()
    )
    return f"<fcd-export>{''.join(timesteps)}</fcd-export>"


def tracks(tmp_path: Path, steps: Mapping[float, Sequence[Seen]], **options) -> pd.DataFrame:
    file = tmp_path / "fcd.xml"
    file.write_text(fcd(steps))
    return read_tracks(file, **options)


def offsets_m(rows: pd.DataFrame) -> list[float]:
    return list((rows["position_m"] - rows["position_m"].iloc[0]).round(6))


def gaps(rows: pd.DataFrame, vehicle: str) -> list[float]:
    return list(rows.loc[rows["vehicle"] == vehicle, "gap_m"].round(6))


# Leaders


def test_the_leader_is_the_next_vehicle_on_the_lane(tmp_path: Path) -> None:
    seen = [("b", "e_0", 10.0, 0.0), ("a", "e_0", 2.0, 0.0), ("c", "e_0", 30.0, 0.0), ("d", "e_1", 4.0, 0.0)]
    rows = tracks(tmp_path, {0.0: seen, 0.1: [("a", "e_0", 2.0, 0.0)]}, vehicle_length_m=4.0)
    np.testing.assert_equal(gaps(rows, "a"), [4.0, np.nan])
    assert gaps(rows, "b") == [16.0]
    assert np.isnan([*gaps(rows, "c"), *gaps(rows, "d")]).all()


@pytest.mark.parametrize(
    ("leader", "gap_m"),
    [
        ((":L.0_1_0", 2.0), 16.5 - 15.0 + 2.0 - 5.0),  # just past the lane's end
        (("lower_out.0_0", 3.0), 16.5 - 15.0 + 12.0 + 3.0 - 5.0),  # two lanes on
        (("lower_out.0_0", 16.0), 16.5 - 15.0 + 12.0 + 16.0 - 5.0),  # farther than matters, on a lane that is near
        (("upper_out.0_0", 1.0), np.nan),  # not on the way
    ],
)
def test_with_the_network_leaders_are_seen_across_lanes(
    tmp_path: Path, leader: tuple[str, float], gap_m: float
) -> None:
    seen = [("a", "lower_in.0_0", 15.0, 0.0), ("b", *leader, 0.0)]
    rows = tracks(tmp_path, {0.0: seen, 0.1: seen}, net_file=NET)
    np.testing.assert_allclose(gaps(rows, "a"), [gap_m] * 2)
    assert np.isnan(gaps(tracks(tmp_path, {0.0: seen, 0.1: seen}), "a")).all()


def test_each_leader_has_the_length_of_its_vtype(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    """A bus without a length has that of its vClass, which SUMO knows; a type of one vehicle is that of all."""
    (tmp_path / "vtypes.add.xml").write_text(
        '<additional><vTypeDistribution id="mix"><vType id="short.1" length="3.5" probability="1"/>'
        '</vTypeDistribution><vType id="bus" vClass="bus"/></additional>'
    )
    kinds = {"a": "DEFAULT_VEHTYPE", "b": "bus", "c": "short.1", "d": "bus@d"}
    seen = [(vehicle, "e_0", 20.0 * number, 0.0) for number, vehicle in enumerate(kinds)]
    text = fcd({0.0: seen, 0.1: seen})
    for vehicle, kind in kinds.items():
        text = text.replace(f'id="{vehicle}"', f'id="{vehicle}" type="{kind}"')
    (tmp_path / "fcd.xml").write_text(text)
    rows = read_tracks(tmp_path / "fcd.xml", vtypes_file=tmp_path / "vtypes.add.xml")
    assert [gaps(rows, vehicle)[0] for vehicle in "abc"] == [8.0, 16.5, 8.0]
    (tmp_path / "vtypes.add.xml").write_text('<additional><vType id="bus" length="-1"/></additional>')
    with pytest.raises(InputError, match=r"SUMO refuses a vType of .*vtypes\.add\.xml \(length must be greater than 0"):
        read_tracks(tmp_path / "fcd.xml", vtypes_file=tmp_path / "vtypes.add.xml")
    assert capfd.readouterr().err == ""  # SUMO prints nothing beside it
    (tmp_path / "vtypes.add.xml").write_text('<additional><vType id="bus"/></additional>')
    with pytest.raises(InputError, match=r"vtypes\.add\.xml has no vType 'short.1'"):
        read_tracks(tmp_path / "fcd.xml", vtypes_file=tmp_path / "vtypes.add.xml")
    (tmp_path / "vtypes.add.xml").write_text("<additional><vType")
    with pytest.raises(InputError, match=r"vtypes\.add\.xml is damaged"):
        read_tracks(tmp_path / "fcd.xml", vtypes_file=tmp_path / "vtypes.add.xml")
    (tmp_path / "fcd.xml").write_text(fcd({0.0: seen, 0.1: seen}))
    with pytest.raises(InputError, match="lacks the vehicles' types"):
        read_tracks(tmp_path / "fcd.xml", vtypes_file=tmp_path / "vtypes.add.xml")


def test_a_long_leader_can_reach_back_from_the_lane_ahead(tmp_path: Path) -> None:
    seen = [("a", "lower_in.0_0", 1.0, 0.0), ("b", "lower_out.0_0", 3.0, 0.0)]
    text = fcd({0.0: seen, 0.1: seen})
    (tmp_path / "fcd.xml").write_text(text.replace("<vehicle", '<vehicle type="rail"'))
    (tmp_path / "v.rou.xml").write_text('<routes><vType id="rail" length="25"/></routes>')
    rows = read_tracks(tmp_path / "fcd.xml", net_file=NET, vtypes_file=tmp_path / "v.rou.xml")
    assert gaps(rows, "a") == [16.5 - 1.0 + 12.0 + 3.0 - 25.0] * 2


# Offsets


def test_offsets_go_on_across_lanes(tmp_path: Path) -> None:
    lanes = [("e_0", 10.0), ("e_1", 10.3), ("f_0", 0.4), ("f_0", 0.7)]
    rows = tracks(tmp_path, {0.1 * step: [("a", *at, 3.0)] for step, at in enumerate(lanes)})
    assert offsets_m(rows) == [0.0, 0.3, 0.6, 0.9]
    assert rows["track"].tolist() == [0] * 4


def test_speeds_give_displacements_to_the_millimetre_unless_positions_contradict(tmp_path: Path) -> None:
    rounded = {0.1 * step: [("a", "e_0", round(0.234 * step, 2), 2.34)] for step in range(6)}
    assert offsets_m(tracks(tmp_path, rounded)) == pytest.approx([0.234 * step for step in range(6)])
    wrong = {0.1 * step: [("a", "e_0", 0.5 * step, 0.0)] for step in range(3)}
    assert offsets_m(tracks(tmp_path, wrong)) == pytest.approx([0.0, 0.49, 0.98])


# Steps


def test_long_steps_are_interpolated(tmp_path: Path) -> None:
    steps = {
        float(second): [("a", "e_0", 2.0 * second, 2.0), ("b", "e_0", 9.0 + 3.0 * second, 3.0)] for second in range(3)
    }
    rows = tracks(tmp_path, steps)
    first = rows[rows["vehicle"] == "a"]
    np.testing.assert_allclose(first["time_s"], 0.1 * np.arange(21))
    np.testing.assert_allclose(offsets_m(first), 0.2 * np.arange(21), atol=1e-6)
    np.testing.assert_allclose(first["gap_m"], 4.0 + 0.1 * np.arange(21))


@pytest.mark.parametrize("step_s", [0.01, 0.04, 0.05, 0.25])
def test_a_steady_drive_is_the_same_in_any_steps(tmp_path: Path, step_s: float) -> None:
    times = 5.0 + step_s * np.arange(round(2.0 / step_s) + 1)
    rows = tracks(tmp_path, {time: [("a", "e_0", 2.0 * time, 2.0)] for time in times})
    np.testing.assert_allclose(rows["time_s"], 5.0 + 0.1 * np.arange(21))
    np.testing.assert_allclose(offsets_m(rows), 0.2 * np.arange(21), atol=1e-6)


def test_who_vanishes_comes_back_on_a_new_track(tmp_path: Path) -> None:
    present = [0, 1, 2, 5, 6]
    steps = {0.1 * step: [("a", "e_0", 0.3 * step, 3.0)] if step in present else [] for step in range(8)}
    rows = tracks(tmp_path, steps)
    assert rows["track"].tolist() == [0, 0, 0, 1, 1]
    np.testing.assert_allclose(rows["time_s"], [0.0, 0.1, 0.2, 0.5, 0.6])


# Bad input


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "not whole XML"),
        ("time,pos\n", "not whole XML"),
        (fcd({0.0: [("a", "e_0", 1.0, 1.0)]})[:-5], "not whole XML"),
        ("<routes><vehicle id='a'/></routes>", "holds <routes>, not <fcd-export>"),
        ("<fcd-export/>", "has no vehicles"),
        (fcd({0.0: [], 0.1: []}), "has no vehicles"),
        (fcd({0.0: [("a", "e_0", 1.0, 1.0)]}), "no vehicle for two timesteps"),
        (fcd({0.0: [("a", "e_0", 1.0, 1.0)] * 2}), "twice at one time"),
        (fcd({0.0: [("a", "e_0", 1.0, 1.0)], 2.0: [("a", "e_0", 1.0, 1.0)]}), "steps of 2 s"),
        ("<fcd-export>\n<timestep/></fcd-export>", "line 2 lacks 'time'"),
        (
            "<fcd-export><timestep time='0'>\n<vehicle id='a' pos='1' speed='1'/></timestep></fcd-export>",
            "lacks 'lane'",
        ),
        ("<fcd-export><timestep time='zero'/></fcd-export>", "line 1 is damaged"),
        (fcd({0.0: [("a", "e_0", float("nan"), 1.0)]}), "without one of time, id, lane, pos, speed"),
    ],
)
def test_what_is_no_floating_car_data_is_refused(tmp_path: Path, text: str, message: str) -> None:
    file = tmp_path / "fcd.xml"
    file.write_text(text)
    with pytest.raises(InputError, match=message):
        read_tracks(file)


def test_a_table_without_a_column_or_a_value_is_refused(tmp_path: Path) -> None:
    file, names = tmp_path / "fcd.csv", "timestep_time;vehicle_id;vehicle_pos;vehicle_speed"
    file.write_text(f"{names}\n0.00;a;1.00;1.00\n")
    with pytest.raises(InputError, match="lacks 'lane'; run SUMO without"):
        read_tracks(file)
    file.write_text(f"{names};vehicle_lane\n0.00;;;;\n0.10;a;;1.00;e_0\n")
    with pytest.raises(InputError, match="without one of time, id, lane, pos, speed"):
        read_tracks(file)


@pytest.mark.parametrize("name", ["fcd.xml.gz", "fcd.csv", "fcd.csv.gz", "fcd.parquet"])
@pytest.mark.parametrize("content", [b"nonsense", gzip.compress(b"<fcd-export>" * 99, mtime=0)[:40]])
def test_damaged_files_of_all_formats_are_refused(tmp_path: Path, name: str, content: bytes) -> None:
    (tmp_path / name).write_bytes(content)
    with pytest.raises(InputError, match=name):
        read_tracks(tmp_path / name)


def fcd_table(rows: int, vehicle: str) -> pa.Table:
    ids = pa.DictionaryArray.from_arrays(pa.array(np.zeros(rows, np.int8)), [vehicle])
    numbers = dict.fromkeys(("timestep_time", "vehicle_pos", "vehicle_speed"), np.zeros(rows))
    return pa.table({**numbers, "vehicle_id": ids, "vehicle_lane": ids})


def test_a_table_of_absurdly_many_rows_is_refused_before_it_is_read(tmp_path: Path) -> None:
    """10,000,000 equal rows take 200 kB in the file and 400 MB in memory."""
    pq.write_table(fcd_table(10_000_000, "a"), tmp_path / "fcd.parquet", compression="zstd")
    assert (tmp_path / "fcd.parquet").stat().st_size < 300_000
    tracemalloc.start()
    with pytest.raises(InputError, match=r"fcd\.parquet unpacks to more than .* or 200 times its size"):
        read_tracks(tmp_path / "fcd.parquet")
    peak_bytes = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak_bytes < 2**20


def test_a_long_name_is_in_memory_once_however_many_rows_have_it(tmp_path: Path) -> None:
    """A name of 1 MB in each of 1,000 rows, as vehicle and as lane, would be 2 GB."""
    name = "".join(random.Random(0).choices("0123456789abcdef", k=2**20))
    file = tmp_path / "fcd.parquet"
    pq.write_table(fcd_table(1_000, name), file, store_schema=False, dictionary_pagesize_limit=2**26)
    usual = pa.default_memory_pool()
    pa.set_memory_pool(POOL)
    try:
        assert read_fcd(file)["vehicle"].cat.categories.tolist() == [name]
    finally:
        pa.set_memory_pool(usual)
    assert 2**20 < POOL.max_memory() < 2**25


def test_a_network_must_be_that_of_the_data(tmp_path: Path) -> None:
    seen = {0.1 * step: [("a", "elsewhere_0", 1.0, 1.0)] for step in range(2)}
    with pytest.raises(InputError, match="no lane elsewhere_0"):
        tracks(tmp_path, seen, net_file=NET)
    for text in ("nonsense", "<net/>"):
        (tmp_path / "net.xml").write_text(text)
        with pytest.raises(InputError, match=r"net\.xml"):
            tracks(tmp_path, seen, net_file=tmp_path / "net.xml")


def test_folders_without_trajectories_are_refused(dataset: Path, tmp_path: Path) -> None:
    with pytest.raises(InputError, match="holds no trajectories"):
        read_tracks(tmp_path)
    with pytest.raises(InputError, match="drivers"):
        read_tracks(dataset / "drivers")


# Real files


def test_a_dataset_is_read_from_its_folder_part_and_shard(dataset: Path) -> None:
    whole = read_tracks(dataset)
    recorded = pd.read_parquet(dataset / TRAJECTORIES)
    np.testing.assert_array_equal(whole["position_m"], recorded["position_m"])
    np.testing.assert_array_equal(whole["gap_m"], recorded["gap_m"])
    assert whole["vehicle"].iloc[0] == f"{recorded['episode'][0]}.{recorded['vehicle'][0]}"
    pd.testing.assert_frame_equal(read_tracks(dataset / TRAJECTORIES), whole)
    one = read_tracks(next(iter(sorted((dataset / TRAJECTORIES).iterdir()))))
    pd.testing.assert_frame_equal(one, whole[: len(one)], check_categorical=False)
