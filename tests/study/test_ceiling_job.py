from pathlib import Path

import pytest

from tint_sumo.config import ALL_MIXES, Mix
from tint_sumo.core.errors import InputError
from tint_sumo.core.progress import Progress
from tint_sumo.methods.evaluation import REPORTED_SET
from tint_sumo.study import budgets
from tint_sumo.study.budgets import Conditions
from tint_sumo.study.ceiling import ceiling
from tint_sumo.study.ceiling_job import CEILINGS_FILE, CeilingJob, read_ceilings


def test_there_is_a_ceiling_for_each_mix_of_the_training_s_conditions(tmp_path: Path) -> None:
    elsewhere = (
        Conditions(Mix(0.9), 0.1),
        Conditions(Mix(0.9), percent=25),
        Conditions(ALL_MIXES),
        Conditions(Mix(0.9), tau_s=2.0),
    )
    tests = (budgets.Trials((Conditions(Mix(0.1)), *elsewhere), 10), budgets.Trials((Conditions(Mix(0.0)),), 5))
    job = CeilingJob(tests, tmp_path)
    assert not job.is_done()
    reports: list[Progress] = []
    line = job.run(reports.append)
    assert job.is_done()
    assert reports == [Progress(0, 15, "case"), Progress(10, 15, "case")]
    expected = ceiling(Mix(0.1), 10, REPORTED_SET)
    assert read_ceilings(tmp_path) == {0.1: expected, 0.0: 0.0}
    assert line == f"P 0.1: {expected:.1%}, P 0: 0.0%"


def test_a_study_without_ceilings_has_none(tmp_path: Path) -> None:
    assert read_ceilings(tmp_path) == {}


@pytest.mark.parametrize("text", ["", "[]", '{"P 0.4": 1.0}', '{"0.4": "high"}', '{"0.4": null}'])
def test_damaged_ceilings_are_named(tmp_path: Path, text: str) -> None:
    (tmp_path / CEILINGS_FILE).write_text(text)
    with pytest.raises(InputError, match=r"ceilings\.json is damaged") as refusal:
        read_ceilings(tmp_path)
    assert "\n" not in str(refusal.value)
