"""Bars on a terminal and in a log file."""

import os
import time

import pytest

from tests.terminal import look, open_terminal
from tint_sumo.core.progress import Progress, make_bar, part_of, progress_bar


def work() -> None:
    with make_bar(total=6, desc="work") as bar:
        for _ in range(6):
            time.sleep(0.12)
            bar.update()


def test_in_a_log_file_a_bar_shows_its_start_and_its_end(capsys: pytest.CaptureFixture[str]) -> None:
    work()
    shown = [line for line in capsys.readouterr().err.split("\r") if line.strip()]
    assert len(shown) == 2
    assert "0/6" in shown[0]
    assert "6/6" in shown[1]


def test_on_a_terminal_it_moves(monkeypatch: pytest.MonkeyPatch) -> None:
    ours, theirs = open_terminal()
    with os.fdopen(theirs, "w") as terminal:
        monkeypatch.setattr("sys.stderr", terminal)
        work()
        terminal.flush()
        shown = look(ours, 10.0)
    os.close(ours)
    assert sum(f"{done}/6" in shown for done in range(7)) > 2  # a busy machine may skip some


def test_nothing_is_shown_before_the_first_report(capsys: pytest.CaptureFixture[str]) -> None:
    with progress_bar("work"):
        pass
    assert capsys.readouterr().err == ""


def test_the_bar_ends_where_the_work_does(capsys: pytest.CaptureFixture[str]) -> None:
    with progress_bar("work") as report:
        for done in (20, 50, 100):
            report(Progress(done, 100, "step", {"success": done / 100, "loss": 1 / 3}))
    shown = capsys.readouterr().err
    assert "100/100" in shown
    assert "success 100%, loss 0.333" in shown


def test_a_part_of_some_work_counts_from_where_it_begins() -> None:
    told: list[Progress] = []
    part_of(told.append, 30, 200)(Progress(5, 10, "case", {"success": 1.0}))
    assert told == [Progress(35, 200, "case", {"success": 1.0})]
