"""The table of jobs on a terminal and in a log file."""

import io
import os
import re
import signal
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import pytest
from rich.console import Console

from tests.terminal import look, open_terminal
from tests.waiting import PATIENCE_S
from tint_sumo.core.progress import Progress
from tint_sumo.jobs.status import Overview, Status, duration
from tint_sumo.jobs.table import JobTable, Log, one_job, render, report_line

TRAIN, OTHER, TRAITS = "train no_labels-P0.1to0.9-seed0", "train ma-P0.4-seed3", "traits vae"
HIDE, SHOW = "\x1b[?25l", "\x1b[?25h"  # the cursor


class Clock:
    """Stands still until it is set."""

    now_s = 0.0

    def __call__(self) -> float:
        return self.now_s


def half_done(measures: dict[str, float]) -> Status:
    """Ten steps a second, and ten seconds left."""
    return Status(0.0).after(Progress(0, 200, "step"), 0.0).after(Progress(100, 200, "step", measures), 10.0)


def overview(*waiting: str) -> Overview:
    """One training and one trait model at work, one job done before."""
    running = {TRAIN: half_done({"success": 0.424, "collision": 0.12}), TRAITS: half_done({"loss": 0.01234})}
    return Overview(3 + len(waiting), list(waiting), running)


def rendered(width: int) -> list[str]:
    console = Console(width=width, file=io.StringIO())
    with console.capture() as shown:
        console.print(render(overview(OTHER), 10.0, console))
    return [line.rstrip() for line in shown.get().splitlines()]


# Lines and table


def test_a_wide_table_has_a_line_for_each_job_and_one_for_all() -> None:
    header, train, traits, whole = rendered(120)
    assert header.split() == ["job", "done", "speed", "left", "so", "far"]
    assert re.fullmatch(rf"{TRAIN} +━+\S* +50% +10 steps/s +10 s +success 42%, collision 12%", train)
    assert re.fullmatch(r"traits vae +━+\S* +50% +10 steps/s +10 s +loss 0.0123", traits)
    assert whole == "1 of 4 jobs are done, about 20 s left"


def test_a_narrow_table_has_two_lines_for_each_job_and_cuts_nothing_off() -> None:
    lines = rendered(60)
    assert max(map(len, lines)) <= 60
    assert [re.split(r"  +", line) for line in lines] == [
        ["job", "done", "so far"],
        ["train", "50%", "10 s left", "success 42%"],
        ["no_labels-P0.1to0.9-seed0", "10 steps/s", "collision 12%"],
        ["traits", "50%", "10 s left", "loss 0.0123"],
        ["vae", "10 steps/s"],
        ["1 of 4 jobs are done, about 20 s left"],
    ]


def test_speed_is_that_of_this_run_and_time_left_runs_down_between_reports() -> None:
    resumed = Status(0.0).after(Progress(900, 1000, "step"), 5.0)
    assert (resumed.speed, resumed.left_s(5.0)) == (0.0, None)
    resumed = resumed.after(Progress(920, 1000, "step"), 15.0)
    assert resumed.speed == pytest.approx(2.0)
    assert [resumed.left_s(now_s) for now_s in (15.0, 25.0, 99.0)] == pytest.approx([40.0, 30.0, 0.0])


def test_a_waiting_job_is_expected_to_take_as_long_as_others_of_its_task() -> None:
    found = overview(OTHER)
    assert found.left_s(10.0) == pytest.approx((10.0 + 10.0 + 20.0) / 2)
    found.took_s["train"] = [120.0]
    assert found.left_s(10.0) == pytest.approx((10.0 + 10.0 + 70.0) / 2), "120 s and 20 s, of which 10 s are over"
    assert Overview(2, [OTHER], {TRAIN: Status(0.0)}).left_s(10.0) is None


@pytest.mark.parametrize(
    ("seconds", "text"), [(0.2, "0 s"), (99.0, "99 s"), (100.0, "2 min"), (5940.0, "99 min"), (12_000.0, "3 h 20 min")]
)
def test_durations(seconds: float, text: str) -> None:
    assert duration(seconds) == text


# A log file


def test_a_log_has_a_line_for_each_begin_and_end_and_one_a_minute_for_all() -> None:
    file, clock = io.StringIO(), Clock()
    table = JobTable(Overview(3, [TRAIN, TRAITS]), Log(file, 0.0), clock)
    table.begin(TRAIN)
    table.begin(TRAITS)
    for second in range(181):
        clock.now_s = second / 1.0
        for name in (TRAIN, TRAITS):
            table.report(name, Progress(second, 200, "step", {"success": 0.5}))
        table.refresh()
    table.end(TRAIN)
    table.end(TRAITS, "98% of windows right")
    lines = file.getvalue().splitlines()
    assert lines[:2] == [f"{TRAIN}: begins", "traits vae: begins"]
    assert len(lines) == 2 + 3 + 2
    assert lines[2] == (
        "1 of 3 jobs are done, about 2 min left; "
        f"{TRAIN}: 30%, 1 steps/s, 2 min left, success 50%; "
        "traits vae: 30%, 1 steps/s, 2 min left, success 50%"
    )
    assert report_line(Overview(1, [], {TRAIN: Status(0.0)}), 1.0) == TRAIN, "which has not reported yet"
    assert lines[-2:] == [
        f"{TRAIN}: success 50% (3 min)",
        "traits vae: 98% of windows right (3 min)",
    ]


def test_a_pipe_gets_plain_lines(capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("FORCE_COLOR", "1")
    with one_job(TRAIN) as report:
        for done in range(500):
            report(Progress(done, 500, "step", {"success": 0.25}))
    begin, end = capsys.readouterr().err.splitlines()
    assert begin == f"{TRAIN}: begins"
    assert end == f"{TRAIN}: success 25% (0 s)"


def test_a_single_job_shows_nothing_before_its_first_report(capsys: pytest.CaptureFixture[str]) -> None:
    with one_job(TRAIN):
        pass
    assert capsys.readouterr().err == ""


# A terminal


def see(process: "subprocess.Popen[bytes]", terminal: int, until: str = "") -> str:
    """Return the output of a process until it matches, or until its end."""
    seen = ""
    while not (until and re.search(until, seen)):
        piece = look(terminal, PATIENCE_S)
        if not piece:
            break
        seen += piece
    return seen


@pytest.fixture
def start(tmp_path: Path) -> Callable[..., tuple["subprocess.Popen[bytes]", int]]:
    """Starts the program of jobs with a terminal as its stderr."""

    def started(*argv: str) -> tuple["subprocess.Popen[bytes]", int]:
        ours, theirs = open_terminal()
        command = [sys.executable, "-m", "tests.jobs.jobs", str(tmp_path), *argv]
        process = subprocess.Popen(command, stderr=theirs, env={**os.environ, "TERM": "xterm"})
        os.close(theirs)
        return process, ours

    return started


def test_on_a_terminal_the_table_moves_and_leaves_a_line_for_each_job(
    start: Callable[..., tuple["subprocess.Popen[bytes]", int]],
) -> None:
    process, terminal = start("short")
    seen = see(process, terminal)
    assert process.wait(PATIENCE_S) == 0
    os.close(terminal)
    # On a busy machine not every step of every job is drawn.
    drawn = re.sub(r"\x1b\[[\d;?]*\w", "", seen)
    assert re.search(r"(?:first|second) +\S* *\S+ +(?:33|67)%", drawn), "a job's row moves"
    assert "0 of 2 jobs are done" in seen and "1 of 2 jobs are done" in seen
    assert len(re.findall(r"(?:first|second): written \(\d+ s\)", seen)) == 2
    assert seen.rindex(SHOW) > seen.rindex(HIDE)


def test_an_interruption_leaves_the_terminal_clean(
    start: Callable[..., tuple["subprocess.Popen[bytes]", int]],
) -> None:
    process, terminal = start()
    seen = see(process, terminal, until="(?s)second.*0 of 2 jobs are done")
    process.send_signal(signal.SIGINT)
    seen += see(process, terminal)
    assert process.wait(PATIENCE_S) == 130
    os.close(terminal)
    assert seen.rindex(SHOW) > seen.rindex(HIDE)
    assert "Traceback" not in seen
    assert "jobs are done" not in seen[seen.rindex(SHOW) :], "nothing of the table is drawn any more"
