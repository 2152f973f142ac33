import csv
import json
from pathlib import Path

import pytest
from PIL import Image

from tests.study.scenes import result
from tint_sumo.files import write_json
from tint_sumo.study.report import tabulate, to_csv, to_markdown, write_report
from tint_sumo.study.results import RESULTS
from tint_sumo.study.statistics import wilson_interval

RESULTS_OF_A_STUDY = [
    result("oracle", 0.4, 1, 8, 1, 1),
    result("ttc", 0.25, 0, 5, 4, 1),
    result("oracle", 0.4, 0, 9, 1, 0),
    result("always_go", 0.4, 0, 0, 0, 10),
]


@pytest.fixture
def study(tmp_path: Path) -> Path:
    for number, one in enumerate(RESULTS_OF_A_STUDY):
        write_json(tmp_path / RESULTS / f"{number}.json", one.to_json())
    return tmp_path


def test_rows_pool_seeds_and_keep_the_order_of_the_registry() -> None:
    rows = tabulate(RESULTS_OF_A_STUDY)
    assert [(row.p_conservative, row.method, row.seeds) for row in rows] == [
        (0.25, "ttc", (0,)),
        (0.4, "always_go", (0,)),
        (0.4, "oracle", (0, 1)),
    ]
    pooled = rows[2].evaluation.rate("success")
    assert (pooled.count, pooled.total) == (17, 20)


def test_the_paper_s_numbers_stand_beside_where_there_are_any() -> None:
    published = {(row.method, row.p_conservative): row.published for row in tabulate(RESULTS_OF_A_STUDY)}
    assert published[("oracle", 0.4)] == {"success": 90, "timeout": 4, "collision": 5}
    assert published[("ttc", 0.25)] == {}


def test_csv() -> None:
    ttc, always_go, oracle = csv.DictReader(to_csv(tabulate(RESULTS_OF_A_STUDY)).splitlines())
    low, high = wilson_interval(17, 20)
    assert float(oracle["success_percent"]) == 85.0
    assert float(oracle["success_low_percent"]) == pytest.approx(100 * low, abs=0.005)
    assert float(oracle["success_high_percent"]) == pytest.approx(100 * high, abs=0.005)
    assert float(oracle["navigation_time_s"]) == pytest.approx((sum(range(9)) + sum(range(8))) / 17 + 10, abs=0.005)
    assert (oracle["episodes"], oracle["seeds"], oracle["paper_success_percent"]) == ("20", "0 1", "90")
    assert (always_go["navigation_time_s"], always_go["collision_percent"]) == ("", "100.00")
    assert (ttc["p_conservative"], ttc["paper_success_percent"]) == ("0.25", "")


def test_markdown_is_a_table() -> None:
    table, note = to_markdown(tabulate(RESULTS_OF_A_STUDY)).split("\n\n")
    lines = table.splitlines()
    assert len(lines) == 5
    assert len({len(line) for line in lines}) == 1
    assert len({line.count("|") for line in lines}) == 1
    assert "85.0 [64.0, 94.8]" in lines[4]
    assert "90 / 4 / 5" in lines[4]
    assert "Wilson" in note


def test_all_three_files_are_written(study: Path) -> None:
    report = write_report(study)
    assert report.csv_file.read_text().startswith("method,p_conservative,success_percent")
    assert report.markdown_file.read_text() == report.markdown
    with Image.open(report.figure_file) as figure:
        assert figure.format == "PNG"
        assert figure.width > 500
    assert not list(study.rglob("*.partial"))


def test_rows_are_ready_for_json(study: Path) -> None:
    row = json.loads(json.dumps(write_report(study).rows[2].to_json()))
    assert row["method"] == "oracle"
    assert row["success"] == 0.85
    assert row["published_percent"]["success"] == 90
