from pathlib import Path

import pytest

from tests.study.scenes import result
from tint_sumo.errors import InputError
from tint_sumo.files import write_json
from tint_sumo.study.report import write_report
from tint_sumo.study.results import RESULTS, read_results

SOME_RESULTS = [result("oracle", 0.4, 1, 8, 1, 1), result("ttc", 0.25, 0, 0, 0, 3)]


@pytest.fixture
def study(tmp_path: Path) -> Path:
    for number, one in enumerate(SOME_RESULTS):
        write_json(tmp_path / RESULTS / f"{number}.json", one.to_json())
    return tmp_path


def test_files_give_back_the_results(study: Path) -> None:
    assert read_results(study) == SOME_RESULTS


def test_no_results(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"no results in .*; run the study first: tint-sumo study run --out"):
        write_report(tmp_path)
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(
    "damage",
    [
        "{",
        "[]",
        "{}",
        '{"method": "ttc", "p_conservative": 0.4, "seed": 0, "cases": []}',
        '{"method": "ttc", "p_conservative": 0.4, "seed": 0, "cases": [["flew", 1.0]]}',
        '{"method": "ttc", "p_conservative": 0.4, "seed": 0, "cases": [1]}',
    ],
)
def test_damaged_results_are_named(study: Path, damage: str) -> None:
    (study / RESULTS / "1.json").write_text(damage)
    with pytest.raises(InputError, match=r"1\.json is damaged"):
        write_report(study)
    assert not (study / "results.csv").exists()
