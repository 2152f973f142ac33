import pytest

from tint_sumo.study.progress import progress_bar


def test_nothing_is_shown_before_the_first_report(capsys: pytest.CaptureFixture[str]) -> None:
    with progress_bar("work", "step"):
        pass
    assert capsys.readouterr().err == ""


def test_the_bar_ends_where_the_work_does(capsys: pytest.CaptureFixture[str]) -> None:
    with progress_bar("work", "step") as report:
        for done in (20, 50, 100):
            report(done, 100, f"reached {done}")
    shown = capsys.readouterr().err
    assert "work:  20%" in shown
    assert "100/100" in shown
    assert "reached 100" in shown
