"""Values that are impossible in traffic are counted and named."""

import json
from pathlib import Path

import matplotlib.image
import pandas as pd
import pytest

from tests.tracks.files import CAR, interaction
from tint_sumo.cli import main
from tint_sumo.core.errors import InputError
from tint_sumo.tracks.inspection import inspect, overlapping, plot, report
from tint_sumo.tracks.schema import COLUMNS, Tracks, build_tracks


def made(*rows: tuple[str, float, float, float, float], heading_rad: float = 0.0) -> Tracks:
    """Make tracks of rows of vehicle, time, x, y and speed."""
    table = pd.DataFrame(rows, columns=["vehicle", "time_s", "x_m", "y_m", "speed_mps"])
    sizes = {"length_m": 4.0, "width_m": 2.0, "heading_rad": heading_rad, "vehicle_class": "car"}
    return build_tracks(Path("made"), "made", {"recording": "one", **sizes, **table})


def drive(
    vehicle: str, speeds_mps: list[float], y_m: float = 0.0, step_s: float = 0.1
) -> list[tuple[str, float, float, float, float]]:
    """Return rows of a vehicle that drives as its speeds say."""
    x_m, rows = 0.0, []
    for number, speed_mps in enumerate(speeds_mps):
        if number:
            x_m += (speed_mps + speeds_mps[number - 1]) / 2 * step_s
        rows.append((vehicle, number * step_s, x_m, y_m, speed_mps))
    return rows


def test_clean_tracks_have_no_faults() -> None:
    found = inspect(made(*drive("a", [10.0] * 20), *drive("b", [5.0] * 10, y_m=3.0)))
    assert set(vars(found.faults).values()) == {0}
    assert (found.vehicles, found.rows, found.recordings) == (2, 30, 1)
    assert found.step_s == pytest.approx(0.1)
    assert found.duration_s == pytest.approx(1.9)
    assert found.distance_ratio == pytest.approx(1.0)
    assert not found.has_mixed_units


def test_accelerations_beyond_what_cars_can_are_counted() -> None:
    found = inspect(made(*drive("a", [10.0, 10.9, 12.0, 11.1, 10.0]), *drive("b", [5.0] * 5, y_m=3.0)))
    assert (found.faults.accelerations, found.faults.accelerating_tracks) == (2, 1)  # 9, 11, -9 and -11 m/s2


def test_jumps_are_counted() -> None:
    rows = drive("a", [10.0] * 6)
    rows[3] = (*rows[3][:2], rows[3][2] + 2.5, *rows[3][3:])
    assert (inspect(made(*rows)).faults.jumps, inspect(made(*rows)).faults.jumping_tracks) == (1, 1)
    rows[3] = (*rows[3][:2], rows[3][2] - 1.6, *rows[3][3:])  # noise of less than a metre
    assert inspect(made(*rows)).faults.jumps == 0


def test_a_vehicle_that_comes_back_later_has_no_other_units() -> None:
    later = [(name, time_s + 100.0, *rest) for name, time_s, *rest in drive("a", [10.0] * 20)]
    found = inspect(made(*drive("a", [10.0] * 20), *later))
    assert found.distance_ratio == pytest.approx(1.0)
    assert found.faults.long_steps == 1


def test_missing_frames_are_counted() -> None:
    rows = drive("a", [10.0] * 8)
    del rows[3]
    found = inspect(made(*rows))
    assert (found.faults.long_steps, found.faults.broken_tracks, found.faults.jumps) == (1, 1, 0)


@pytest.mark.parametrize(
    ("x_m", "y_m", "overlap"),
    [(3.9, 0.0, True), (4.0, 0.0, False), (0.0, 1.9, True), (0.0, 2.0, False), (3.9, 1.9, True), (0.0, 0.0, True)],
)
def test_boxes_that_overlap_are_found(x_m: float, y_m: float, overlap: bool) -> None:
    pairs = overlapping(made(("a", 0.0, 0.0, 0.0, 0.0), ("b", 0.0, x_m, y_m, 0.0)).table)
    assert pairs.to_dict("records") == (
        [{"recording": "one", "time_s": 0.0, "vehicle": "a", "other": "b"}] if overlap else []
    )


def test_boxes_turn_with_their_headings() -> None:
    rows = (("a", 0.0, 0.0, 0.0, 0.0), ("b", 0.0, 0.0, 3.0, 0.0))
    assert len(overlapping(made(*rows, heading_rad=0.0).table)) == 0
    assert len(overlapping(made(*rows, heading_rad=1.5708).table)) == 1


def test_boxes_at_other_times_do_not_overlap() -> None:
    assert len(overlapping(made(("a", 0.0, 0.0, 0.0, 0.0), ("b", 0.1, 0.0, 0.0, 0.0)).table)) == 0


def test_mixed_units_are_named() -> None:
    feet = [(name, time_s, x_m / 0.3048, y_m, speed) for name, time_s, x_m, y_m, speed in drive("a", [10.0] * 20)]
    found = inspect(made(*feet))
    assert found.has_mixed_units
    assert "positions and speeds have other units than the format says" in report(found)


def test_speeds_close_to_zero_are_other_units_too() -> None:
    found = inspect(made(("a", 0.0, 0.0, 0.0, 1e-30), ("a", 1.0, 10.0, 0.0, 1e-30)))
    assert "vehicles move 1e+31 times as far as their speeds say" in report(found)


@pytest.mark.filterwarnings("error")
def test_a_single_row_is_drawn(tmp_path: Path) -> None:
    found = inspect(made(("a", 0.0, 0.0, 0.0, 1.0)))
    assert (found.vehicles, found.rows, found.step_s, found.distance_ratio) == (1, 1, 0.0, None)
    plot(found, tmp_path / "picture.png")
    assert matplotlib.image.imread(tmp_path / "picture.png").shape[:2] == (720, 1440)


def test_the_command_reports_draws_and_prints_json(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    file, picture = interaction(tmp_path), tmp_path / "picture.png"
    assert main(["tracks", "inspect", str(file), "--figure", str(picture), "--json"]) == 0
    text = capsys.readouterr().out
    content = json.loads(text.splitlines()[-1])
    assert content["vehicles"] == 2
    assert content["classes"] == {"car": 1, "truck": 1}
    assert content["speed_mps"][2] == CAR[1]
    assert "vehicles          2: 1 car, 1 truck" in text
    image = matplotlib.image.imread(picture)
    assert image.shape[:2] == (720, 1440)
    assert image[..., :3].std() > 0.05


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["missing.csv"], "no file"),
        (["{file}", "--figure", "{file}"], "must end in"),
        (["{file}", "--format", "fcd_geo"], "names no time in its first line"),
        (["{file}", "--format", "unknown"], "unknown format 'unknown'"),
    ],
)
def test_bad_calls_end_with_one_line(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], words: list[str], message: str
) -> None:
    file = interaction(tmp_path)
    before = file.read_bytes()
    assert main(["tracks", "inspect", *(word.format(file=file) for word in words)]) == 2
    error = capsys.readouterr().err
    assert error.startswith("tint-sumo: error: ")
    assert error.count("\n") == 1
    assert message in error
    assert file.read_bytes() == before


def test_the_table_is_sorted_and_typed() -> None:
    rows = [*drive("b", [5.0] * 3, y_m=3.0), *drive("a", [10.0] * 3)]
    table = made(*reversed(rows)).table
    assert tuple(table) == COLUMNS
    assert table["vehicle"].tolist() == ["a"] * 3 + ["b"] * 3
    assert table["time_s"].is_monotonic_increasing is False
    assert table.groupby("vehicle", observed=True)["time_s"].is_monotonic_increasing.all()


def test_values_without_sense_are_refused() -> None:
    good = ("a", 0.0, 0.0, 0.0, 1.0)
    for value in (float("nan"), float("-inf"), 1e13):
        with pytest.raises(InputError, match=rf"x_m is {value:g} for vehicle a at 0\.1 s".replace("+", r"\+")):
            made(good, ("a", 0.1, value, 0.0, 1.0))
    with pytest.raises(InputError, match="has 2 rows without a vehicle; remove them, or fill them"):
        made(good, ("", 0.1, 0.0, 0.0, 1.0), ("", 0.2, 0.0, 0.0, 1.0))
    with pytest.raises(ValueError, match="has no vehicles"):
        made()
