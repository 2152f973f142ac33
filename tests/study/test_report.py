import csv
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

from tests.study.scenes import given, trained, write_results
from tint_sumo.config import ALL_MIXES, Mix
from tint_sumo.core.errors import InputError
from tint_sumo.core.files import RUN_FILE, write_json, write_text
from tint_sumo.core.statistics import Rate, difference_interval, interquartile_mean, rate_interval
from tint_sumo.methods.training import CURVE_FILE
from tint_sumo.scenes import described, find_scene
from tint_sumo.study.budgets import Conditions
from tint_sumo.study.ceiling_job import CEILINGS_FILE
from tint_sumo.study.page.findings import what_came_out
from tint_sumo.study.report import StudyReport, result_tables, to_markdown, write_report
from tint_sumo.study.results import Result
from tint_sumo.study.results_csv import read_csv, to_csv
from tint_sumo.study.summary import Row, scores, tabulate

AS_TRAINED, NOISY, HALF = Conditions(ALL_MIXES), Conditions(ALL_MIXES, 0.1), Conditions(ALL_MIXES, percent=50)
CURVE = "decisions,success,timeout,collision\n64,0.1,0.4,0.5\n128,0.6,0.1,0.3\n"
IN_WORLDS = [Conditions(ALL_MIXES, world=world) for world in ("old", "headway_1.5")]
CEILINGS = {"0.25": 0.875, "0.4": 1.0}
OUTCOMES = ("success", "timeout", "collision")


def policy(method: str, seed: int, success: int) -> Result:
    """A policy with so many successes of 20 cases among P 0.4, and fewer elsewhere."""
    timeout, collision = 1, 19 - success
    tested = {
        Conditions(Mix(0.25)): (success - 2, timeout, collision + 2),
        Conditions(Mix(0.4)): (success, timeout, collision),
        AS_TRAINED: (success - 1, timeout, collision + 1),
        NOISY: (success - 3, timeout, collision + 3),
        HALF: (success - 4, timeout, collision + 4),
        **{world: (success - 5 * number, 5 * number + 1, 19 - success) for number, world in enumerate(IN_WORLDS)},
    }
    return trained(method, seed, tested)


SEVERAL_SEEDS = [
    *(policy("oracle", seed, success) for seed, success in enumerate((19, 18, 19))),
    *(policy("no_labels", seed, success) for seed, success in enumerate((8, 7, 6))),
    *(policy("vae", seed, success) for seed, success in enumerate((15, 12, 14))),
    given("always_go", {Conditions(Mix(0.4)): (0, 0, 20), AS_TRAINED: (0, 0, 20)}),
]
ONE_SEED = [policy("oracle", 0, 18), given("ttc", {Conditions(Mix(0.25)): (5, 4, 1), Conditions(Mix(0.6)): (9, 1, 0)})]


@pytest.fixture(scope="module")
def study(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """All that a study leaves for its report."""
    out = write_results(SEVERAL_SEEDS, tmp_path_factory.mktemp("study"))
    write_json(out / CEILINGS_FILE, CEILINGS)
    for name in ("oracle-P0.1to0.9-seed0", "oracle-P0.1to0.9-seed1", "no_labels-P0.1to0.9-seed0"):
        write_text(out / "policies" / name / CURVE_FILE, CURVE)
    return out


@pytest.fixture(scope="module")
def report(study: Path) -> StudyReport:
    return write_report(study)


def row_at(report: StudyReport, method: str, p_conservative: float) -> Row:
    return next(row for row in report.rows if (row.method, row.conditions) == (method, Conditions(Mix(p_conservative))))


def tables(markdown: str) -> dict[str, list[list[str]]]:
    """Cells of each table by its heading; every table must be rectangular, in plain text, too."""
    found = {}
    for part in markdown.split("## ")[1:]:
        heading, table, note = part.strip().split("\n\n")
        lines = table.splitlines()
        assert len({len(line) for line in lines}) == 1
        assert len({line.count("|") for line in lines}) == 1
        assert set(lines[1]) == set("| -")
        assert note.endswith(".")
        found[heading] = [[cell.strip() for cell in line.strip("|").split("|")] for line in (lines[0], *lines[2:])]
    return found


def test_every_file_is_written_and_nothing_else(study: Path, report: StudyReport) -> None:
    assert report.markdown_file.read_text() == report.markdown
    assert [file.name for file in report.figure_files] == [
        "results.png",
        "conditions.png",
        "worlds.png",
        "profiles.png",
        "curves.png",
    ]
    for file in report.figure_files:
        with Image.open(file) as figure:
            assert figure.format == "PNG" and figure.width > 500
    written = {report.csv_file, report.markdown_file, *report.figure_files}
    assert {path for path in study.rglob("*") if path.is_file() and path.suffix != ".json"} == {
        *written,
        *study.glob(f"policies/*/{CURVE_FILE}"),
    }
    assert report.rows == tuple(tabulate(SEVERAL_SEEDS))


def test_the_csv_file_has_a_line_for_every_row_and_the_documented_columns(report: StudyReport) -> None:
    with report.csv_file.open(newline="") as file:
        lines = list(csv.DictReader(file))
    conditions = ["p_conservative", "position_noise_m", "tau_s", "scene_tau_s", "training_percent", "world"]
    closing = ["navigation_time_s", "episodes", "seeds", "ceiling_percent"]
    measured = [f"{outcome}{part}_percent" for outcome in OUTCOMES for part in ("", "_low", "_high", "_sd")]
    paper = [f"paper_{outcome}_percent" for outcome in OUTCOMES]
    assert list(lines[0]) == ["method", "origin", "trained_p_conservative", *conditions, *measured, *closing, *paper]
    assert [line["method"] for line in lines] == [row.method for row in report.rows]
    assert not any(None in line or None in line.values() for line in lines)


def test_what_figures_need_can_be_read_back(report: StudyReport) -> None:
    rows, ceilings = read_csv(report.csv_file)
    assert ceilings == {0.25: 0.875, 0.4: 1.0}
    assert to_csv(rows, ceilings) == report.csv_file.read_text()
    for stored, row in zip(rows, report.rows, strict=True):
        same = ("method", "origin", "mix", "conditions", "seeds", "episodes", "title", "published")
        assert [getattr(stored, name) for name in same] == [getattr(row, name) for name in same]
        for outcome in OUTCOMES:
            assert stored.rate(outcome) == pytest.approx(row.rate(outcome), abs=5e-5)
            assert stored.intervals[outcome] == pytest.approx(row.intervals[outcome], abs=5e-5)


@pytest.mark.parametrize("text", ["", "method,origin\nttc,given\n", "\0"])
def test_other_tables_are_refused_in_one_line(text: str, tmp_path: Path) -> None:
    (tmp_path / "other.csv").write_text(text)
    with pytest.raises(InputError, match=r"other\.csv is no results\.csv of a study"):
        read_csv(tmp_path / "other.csv")
    with pytest.raises(InputError, match=r"results: no file .*nowhere\.csv"):
        read_csv(tmp_path / "nowhere.csv")


def test_csv_values_of_several_seeds(report: StudyReport) -> None:
    row = row_at(report, "oracle", 0.4)
    line = list(csv.DictReader(to_csv(report.rows, {0.4: 1.0}).splitlines()))[report.rows.index(row)]
    low, high = rate_interval(row.hits("success"))
    assert float(line["success_percent"]) == pytest.approx(100 * 56 / 60, abs=0.005)
    assert float(line["success_low_percent"]) == pytest.approx(100 * low, abs=0.005)
    assert float(line["success_high_percent"]) == pytest.approx(100 * high, abs=0.005)
    assert float(line["success_sd_percent"]) == pytest.approx(5 / 3**0.5, abs=0.005)
    assert float(line["timeout_percent"]) == 5.0
    assert float(line["navigation_time_s"]) == pytest.approx(10 + (2 * sum(range(19)) + sum(range(18))) / 56, abs=0.005)
    assert (line["origin"], line["p_conservative"]) == ("trained", "0.4")
    assert (line["episodes"], line["seeds"], line["ceiling_percent"]) == ("20", "0 1 2", "100.00")
    assert [line[f"paper_{outcome}_percent"] for outcome in OUTCOMES] == ["90", "4", "5"]


def test_csv_values_of_one_seed() -> None:
    lines = list(csv.DictReader(to_csv(tabulate(ONE_SEED), {}).splitlines()))
    by_place = {(line["method"], line["p_conservative"], line["training_percent"]): line for line in lines}
    ttc, half = by_place["ttc", "0.25", "100"], by_place["oracle", "0.1 to 0.9", "50"]
    low, high = Rate(5, 10).interval
    assert (float(ttc["success_low_percent"]), float(ttc["success_high_percent"])) == pytest.approx(
        (100 * low, 100 * high), abs=0.005
    )
    assert (ttc["success_sd_percent"], ttc["ceiling_percent"], ttc["paper_success_percent"]) == ("", "", "")
    assert (half["position_noise_m"], half["tau_s"], half["success_percent"]) == ("0", "1", "70.00")


def test_the_ceiling_stands_beside_the_traffic_that_it_was_computed_for() -> None:
    other = (Conditions(Mix(0.4), tau_s=1.5), Conditions(Mix(0.4), 0.1), Conditions(Mix(0.4), world="towns"))
    rows = tabulate([given("ttc", dict.fromkeys((Conditions(Mix(0.4)), *other), (1, 0, 0)))])
    lines = csv.DictReader(to_csv(rows, {0.4: 0.995}).splitlines())
    assert [line["ceiling_percent"] for line in lines] == ["99.50", "", "", ""]


@pytest.mark.parametrize(
    ("settings", "paper"),
    [
        ({"kind": "study"}, "90"),
        ({"kind": "study", "world": "old"}, "90"),
        ({"kind": "study", "world": "range_15"}, ""),
        ({"kind": "study", **described([find_scene("roundabout")])}, ""),
    ],
)
def test_the_paper_s_rates_stand_beside_studies_of_its_scene_and_sensor(
    settings: dict[str, Any], paper: str, tmp_path: Path
) -> None:
    write_json(tmp_path / RUN_FILE, settings)
    report = write_report(write_results([trained("oracle", 0, {Conditions(Mix(0.4)): (1, 0, 0)})], tmp_path))
    (line,) = csv.DictReader(report.csv_file.read_text().splitlines())
    assert line["paper_success_percent"] == paper
    assert read_csv(report.csv_file)[0][0].published == report.rows[0].published


def test_every_table_of_several_seeds_is_there(report: StudyReport) -> None:
    assert list(tables(report.markdown)) == [
        "Success by mix of drivers",
        "All outcomes",
        "Collisions by trait and route",
        "Differences in success",
        "Over seeds and conditions",
        "Other conditions and shorter trainings",
        "Worlds",
    ]


def test_seeds_that_fail_are_shown_beside_the_interquartile_mean(report: StudyReport) -> None:
    head, *lines = tables(report.markdown)["Over seeds and conditions"]
    assert head == ["method", "seeds", "interquartile mean", "worst seed", "best seed", "beats no labels %"]
    assert [line[0] for line in lines] == ["no labels", "paper's method", "oracle"], "the rule has no seeds"
    by_title = scores(report.rows)
    assert {title: found.shape for title, found in by_title.items()} == dict.fromkeys(by_title, (3, 6))
    # Successes at P 0.25 and 0.4, as trained, with noise, and in two worlds.
    successes = np.array([[s - 2, s, s - 1, s - 3, s, s - 5] for s in (19, 18, 19)]) / 20
    np.testing.assert_allclose(np.sort(by_title["oracle"], axis=1), np.sort(successes, axis=1))
    oracle = lines[2]
    assert oracle[1] == "3" and oracle[3:5] == ["80.8", "85.8"]
    assert oracle[2].startswith(f"{100 * interquartile_mean(successes):.1f} [")
    assert oracle[5] == "100.0 [100.0, 100.0]" and lines[0][5] == "-"


def test_worlds_are_rows_with_all_outcomes_of_each_method(report: StudyReport) -> None:
    assert tables(report.markdown)["Worlds"] == [
        ["world", "no labels", "paper's method", "oracle"],
        ["the old world", "35/5/60", "68/5/27", "93/5/2"],
        ["headway 1.5 s", "10/30/60", "43/30/27", "68/30/2"],
    ]


def test_no_share_of_a_world_below_all_reads_100() -> None:
    rows = tabulate([given("ttc", {IN_WORLDS[0]: (299, 0, 1)})])
    assert tables(to_markdown(result_tables(rows, {})))["Worlds"][1] == ["the old world", ">99/0/<1"]


def test_a_table_of_earlier_versions_knows_no_worlds(report: StudyReport, tmp_path: Path) -> None:
    lines = [line for line in csv.DictReader(report.csv_file.read_text().splitlines()) if not line["world"]]
    with (tmp_path / "old.csv").open("w", newline="") as file:
        writer = csv.DictWriter(file, [name for name in lines[0] if name != "world"], extrasaction="ignore")
        writer.writeheader()
        writer.writerows(lines)
    assert [row.conditions for row in read_csv(tmp_path / "old.csv")[0]] == [
        row.conditions for row in report.rows if row.conditions.world is None
    ]


def test_the_success_table_has_the_spread_the_ceiling_and_the_paper(report: StudyReport) -> None:
    assert tables(report.markdown)["Success by mix of drivers"] == [
        ["method", "seeds", "P 0.25", "P 0.4"],
        ["always go", "1", "-", "0.0"],
        ["no labels", "3", "25.0 ± 5.0", "35.0 ± 5.0"],
        ["paper's method", "3", "58.3 ± 7.6", "68.3 ± 7.6"],
        ["oracle", "3", "83.3 ± 2.9", "93.3 ± 2.9"],
        ["ceiling", "", "87.5", "100.0"],
        ["paper", "", "81", "91"],
    ]


def test_the_outcome_table_has_intervals_and_the_paper_s_outcomes(report: StudyReport) -> None:
    header, *lines = tables(report.markdown)["All outcomes"]
    assert header == ["P", "method", "success %", "timeout %", "collision %", "time s", "cases", "seeds", "paper %"]
    assert len(lines) == 7
    oracle = next(line for line in lines if line[:2] == ["0.4", "oracle"])
    low, high = row_at(report, "oracle", 0.4).intervals["success"]
    assert oracle[2] == f"93.3 [{100 * low:.1f}, {100 * high:.1f}]"
    assert oracle[6:] == ["20", "0, 1, 2", "90 / 4 / 5"]
    always_go = next(line for line in lines if line[1] == "always go")
    assert (always_go[5], always_go[8]) == ("-", "-")
    assert always_go[2].startswith("0.0 [0.0, ")


def test_collisions_are_counted_in_a_thousand_cases(report: StudyReport) -> None:
    table = tables(report.markdown)["Collisions by trait and route"]
    assert table[0] == ["method", "aggressive, lower"]
    assert table[1] == ["always go", "1000.0"]
    assert table[-1] == ["oracle", f"{1000 * (1 + 1 + 6) / 120:.1f}"]


def test_differences_are_to_the_oracle_and_to_no_labels_with_intervals(report: StudyReport) -> None:
    header, *lines = tables(report.markdown)["Differences in success"]
    assert header == ["method", "less", "P 0.25", "P 0.4"]
    assert [line[:2] for line in lines] == [
        ["no labels", "oracle"],
        ["paper's method", "oracle"],
        ["paper's method", "no labels"],
        ["oracle", "no labels"],
    ]
    vae, oracle = (row_at(report, name, 0.4) for name in ("vae", "oracle"))
    low, high = difference_interval(vae.hits("success"), oracle.hits("success"))
    assert lines[1][3] == f"-25.0 [{100 * low:+.1f}, {100 * high:+.1f}]"
    assert lines[3][3].startswith("+58.3 [+")


def test_methods_that_did_not_meet_the_same_cases_are_not_compared() -> None:
    fewer = [trained("vae", seed, {Conditions(Mix(0.4)): (4, 0, 1)}) for seed in range(2)]
    rows = tabulate([*SEVERAL_SEEDS[:3], *fewer])
    (line,) = tables(to_markdown(result_tables(rows, {})))["Differences in success"][1:]
    assert line == ["paper's method", "oracle", "-", "-"]


def test_policies_that_were_trained_at_several_mixes_are_told_apart(tmp_path: Path) -> None:
    at, noisy, world = Conditions(Mix(0.4)), Conditions(ALL_MIXES, 0.1), Conditions(ALL_MIXES, world="towns")
    successes = {("oracle", ALL_MIXES): 8, ("oracle", Mix(0.4)): 2, ("no_labels", ALL_MIXES): 5}
    results = [
        trained(method, seed, dict.fromkeys((at, noisy, world), (n, 10 - n, 0)), mix)
        for (method, mix), n in successes.items()
        for seed in range(2)
    ]
    rows = tabulate(results)
    found = tables(to_markdown(result_tables(rows, {})))
    no_labels = "no labels (trained at P 0.1 to 0.9)"
    oracle, oracle_at = "oracle (trained at P 0.1 to 0.9)", "oracle (trained at P 0.4)"
    assert [[line[0], line[2]] for line in found["Success by mix of drivers"][1:]] == [
        [no_labels, "50.0 ± 0.0"],
        [oracle, "80.0 ± 0.0"],
        [oracle_at, "20.0 ± 0.0"],
    ]
    assert [[*line[:2], line[2].split()[0]] for line in found["Differences in success"][1:]] == [
        [no_labels, oracle, "-30.0"],
        [oracle, no_labels, "+30.0"],
    ]
    assert [line[0] for line in found["Other conditions and shorter trainings"]][1:] == [no_labels, oracle, oracle_at]
    assert found["Worlds"] == [["world", no_labels, oracle, oracle_at], ["128 towns", "50/50/0", "80/20/0", "20/80/0"]]
    write_text(tmp_path / "results.csv", to_csv(rows, {}))
    assert [row.title for row in read_csv(tmp_path / "results.csv")[0]] == [row.title for row in rows]
    assert [row.to_json()["trained_p_conservative"] for row in rows[:3]] == [[0.1, 0.9], [0.1, 0.9], 0.4]
    assert what_came_out(rows).startswith("At P 0.4 all 2 methods succeeded in 50.0 % of the cases")


def test_other_conditions_stand_beside_those_of_the_training(report: StudyReport) -> None:
    assert tables(report.markdown)["Other conditions and shorter trainings"] == [
        ["method", "as trained", "noise 0.1 m", "50 % of training"],
        ["always go", "0.0 (100.0)", "-", "-"],
        ["no labels", "30.0 (65.0)", "20.0 (75.0)", "15.0 (80.0)"],
        ["paper's method", "63.3 (31.7)", "53.3 (41.7)", "48.3 (46.7)"],
        ["oracle", "88.3 (6.7)", "78.3 (16.7)", "73.3 (21.7)"],
    ]


def test_conditions_at_several_mixes_are_columns_and_rows_of_their_own() -> None:
    slow = [Conditions(Mix(p), tau_s=1.5) for p in (0.4, 0.6)]
    worlds = [Conditions(Mix(0.4), world="towns"), Conditions(ALL_MIXES, percent=50, world="towns")]
    rows = tabulate([trained("oracle", 0, {conditions: (n, 0, 4 - n) for n, conditions in enumerate(slow + worlds)})])
    markdown = to_markdown(result_tables(rows, {}))
    assert tables(markdown) == {
        "Other conditions and shorter trainings": [
            ["method", "headway 1.5 s, P 0.4", "headway 1.5 s, P 0.6"],
            ["oracle", "0.0 (100.0)", "25.0 (75.0)"],
        ],
        "Worlds": [
            ["world", "oracle"],
            ["128 towns, P 0.4", "50/0/50"],
            ["128 towns, 50 % of training, P 0.1 to 0.9", "75/0/25"],
        ],
    }
    assert markdown.count("P is P(conservative) of the cases") == 2
    alone = to_markdown(result_tables(rows[:1], {}))
    assert "Success (collision) in percent; P(conservative) is 0.4." in alone


def test_a_study_in_other_conditions_at_one_mix_has_figures(tmp_path: Path) -> None:
    tested = dict.fromkeys((Conditions(Mix(0.4), tau_s=1.5), Conditions(Mix(0.4), world="towns")), (2, 1, 1))
    report = write_report(write_results([trained("oracle", 0, tested)], tmp_path))
    assert [file.name for file in report.figure_files] == ["conditions.png", "worlds.png"]


def test_a_study_with_one_seed_and_no_curves_has_no_differences(tmp_path: Path) -> None:
    report = write_report(write_results(ONE_SEED, tmp_path))
    assert [file.name for file in report.figure_files] == ["results.png", "conditions.png", "worlds.png"]
    found = tables(report.markdown)
    assert "Differences in success" not in found
    assert found["Success by mix of drivers"] == [
        ["method", "seeds", "P 0.25", "P 0.4", "P 0.6"],
        ["time to collision", "1", "50.0", "-", "90.0"],
        ["oracle", "1", "80.0", "90.0", "-"],
    ]


def test_a_study_in_one_set_of_conditions_has_one_figure(tmp_path: Path) -> None:
    report = write_report(write_results([given("ttc", {AS_TRAINED: (2, 1, 1)})], tmp_path))
    assert [file.name for file in report.figure_files] == ["conditions.png"]
    assert list(tables(report.markdown)) == ["Other conditions and shorter trainings"]


def test_a_training_without_an_episode_yet_has_no_curve(tmp_path: Path) -> None:
    write_results(ONE_SEED, tmp_path)
    write_text(tmp_path / "policies" / "oracle-P0.1to0.9-seed0" / CURVE_FILE, CURVE.splitlines()[0] + "\n")
    assert [file.name for file in write_report(tmp_path).figure_files] == [
        "results.png",
        "conditions.png",
        "worlds.png",
    ]


@pytest.mark.parametrize("file", [CEILINGS_FILE, f"policies/oracle-P0.1to0.9-seed0/{CURVE_FILE}"])
@pytest.mark.parametrize("text", ["", "[1, 2]", '{"P": 1}', '{"0.4": "high"}', "decisions\n64"])
def test_damaged_files_are_named_in_one_line(tmp_path: Path, file: str, text: str) -> None:
    write_results(ONE_SEED, tmp_path)
    write_text(tmp_path / file, text)
    with pytest.raises(InputError, match=rf"{Path(file).name} is damaged") as refusal:
        write_report(tmp_path)
    assert "\n" not in str(refusal.value)
    assert not (tmp_path / "results.csv").exists()
