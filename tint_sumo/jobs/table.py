"""The jobs that run: a live table on a terminal, a line a minute in a log file."""

import math
import os
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from typing import Protocol, TextIO

from rich.console import Console, Group, RenderableType
from rich.live import Live
from rich.measure import Measurement
from rich.progress_bar import ProgressBar
from rich.table import Table
from rich.text import Text

from tint_sumo.core.progress import Progress, Report
from tint_sumo.jobs.status import Overview, Status, duration, task_of

TABLE_INTERVAL_S = 0.25
LOG_INTERVAL_S = 60.0
_BAR_WIDTH, _ENDLESS = 10, 1000  # characters
_HEADERS = ("job", "", "done", "speed", "left", "so far")
_NARROW_HEADERS = ("job", "done", "so far")


class Screen(Protocol):
    """The terminal or the log file that shows the jobs."""

    def begin(self, name: str) -> None:
        """Show that a job begins."""

    def end(self, line: str) -> None:
        """Show that a job has ended, with a line about its result."""

    def show(self, overview: Overview, now_s: float) -> None:
        """Show the status of all jobs; called often, and too early calls do nothing."""


class JobTable:
    """Shows the status of some jobs; ``job_table`` makes one."""

    def __init__(self, overview: Overview, screen: Screen, clock: Callable[[], float] = time.monotonic) -> None:
        self._overview = overview
        self._screen = screen
        self._clock = clock

    def begin(self, name: str) -> None:
        """Note that one of the waiting jobs begins."""
        now_s = self._clock()
        self._overview.waiting.remove(name)
        self._overview.running[name] = Status(now_s)
        self._screen.begin(name)
        self._screen.show(self._overview, now_s)

    def report(self, name: str, progress: Progress) -> None:
        """Note how far a job is."""
        running = self._overview.running
        running[name] = running[name].after(progress, self._clock())
        self.refresh()

    def end(self, name: str, outcome: str = "") -> None:
        """Note that a job has ended; ``outcome`` is its result if its last report does not have it."""
        now_s = self._clock()
        status = self._overview.running.pop(name)
        took_s = now_s - status.began_s
        self._overview.took_s[task_of(name)].append(took_s)
        found = outcome or status.text(now_s).outcomes or "done"
        self._screen.end(f"{name}: {found} ({duration(took_s)})")
        self._screen.show(self._overview, now_s)

    def fail(self, name: str, reason: str, *, again: bool) -> None:
        """Note that a job has failed, whether it had begun or not; it waits ``again``, or is given up."""
        overview = self._overview
        overview.running.pop(name, None)
        if name in overview.waiting:
            overview.waiting.remove(name)
        if again:
            overview.waiting.append(name)
        else:
            overview.given_up += 1
        self._screen.end(f"{name}: {reason}")
        self._screen.show(overview, self._clock())

    def refresh(self) -> None:
        """Keep the clocks going."""
        self._screen.show(self._overview, self._clock())


@contextmanager
def job_table(waiting: Sequence[str], done: int = 0, *, progress: bool = True) -> Iterator[JobTable]:
    """Show a table on stderr of jobs that wait, beside ``done`` others that need not be done again.

    On a terminal it is redrawn in place, and gone at the end; a line for each job that has ended stays.
    """
    overview = Overview(done + len(waiting), list(waiting))
    if not progress:
        yield JobTable(overview, _Nowhere())
    elif sys.stderr.isatty() and os.environ.get("TERM") != "dumb":
        console = Console(file=sys.stderr, force_terminal=True)
        with Live(console=console, auto_refresh=False, transient=True) as live:
            yield JobTable(overview, _Terminal(live))
    else:
        yield JobTable(overview, Log(sys.stderr, time.monotonic()))


@contextmanager
def one_job(name: str, *, progress: bool = True) -> Iterator[Report]:
    """Show the table of a single job, which this process does; nothing is shown before the first report."""
    with job_table([name], progress=progress) as table:
        begun = False

        def report(progress: Progress) -> None:
            nonlocal begun
            if not begun:
                table.begin(name)
                begun = True
            table.report(name, progress)

        yield report
        if begun:
            table.end(name)


class _Nowhere:
    def begin(self, name: str) -> None: ...

    def end(self, line: str) -> None: ...

    def show(self, overview: Overview, now_s: float) -> None: ...


class _Terminal:
    """A table that is redrawn in place, with a line above it for each job that has ended."""

    def __init__(self, live: Live) -> None:
        self._live = live
        self._drawn_s = -math.inf

    def begin(self, name: str) -> None: ...

    def end(self, line: str) -> None:
        self._live.console.print(line, markup=False, highlight=False)

    def show(self, overview: Overview, now_s: float) -> None:
        if now_s - self._drawn_s >= TABLE_INTERVAL_S:
            self._drawn_s = now_s
            self._live.update(render(overview, now_s, self._live.console), refresh=True)


class Log:
    """A line when a job begins or ends, and a line a minute about all of them."""

    def __init__(self, file: TextIO, now_s: float) -> None:
        self._file = file
        self._written_s = now_s

    def begin(self, name: str) -> None:
        self._write(f"{name}: begins")

    def end(self, line: str) -> None:
        self._write(line)

    def show(self, overview: Overview, now_s: float) -> None:
        if now_s - self._written_s >= LOG_INTERVAL_S:
            self._written_s = now_s
            self._write(report_line(overview, now_s))

    def _write(self, line: str) -> None:
        print(line, file=self._file, flush=True)


def render(overview: Overview, now_s: float, console: Console) -> RenderableType:
    """Return the table: a line for each job or, where the console is too narrow for that, two."""
    running = overview.running.items()
    table = _table(_HEADERS, [_cells(name, status, now_s) for name, status in running])
    endless = console.options.update(max_width=_ENDLESS)
    if Measurement.get(console, endless, table).maximum > console.width:
        table = _table(_NARROW_HEADERS, [_stacked_cells(name, status, now_s) for name, status in running])
    return table if overview.total == 1 else Group(table, Text(_summary(overview, now_s), style="bold"))


def _table(headers: Sequence[str], rows: Sequence[Sequence[str | ProgressBar]]) -> Table:
    """Return a table without the columns that are empty throughout."""
    table = Table(box=None, pad_edge=False, header_style="dim")
    kept = [number for number in range(len(headers)) if any(row[number] for row in rows)]
    for number in kept:
        table.add_column(headers[number], no_wrap=True)
    for row in rows:
        table.add_row(*(row[number] for number in kept))
    return table


def _cells(name: str, status: Status, now_s: float) -> list[str | ProgressBar]:
    text, last = status.text(now_s), status.last
    bar = ProgressBar(last.total if last else 1, last.done if last else 0, width=_BAR_WIDTH)
    return [name, bar, text.percent, text.speed, text.left, text.outcomes]


def _stacked_cells(name: str, status: Status, now_s: float) -> list[str | ProgressBar]:
    text = status.text(now_s)
    left = f"{text.left} left" if text.left else ""
    return [
        name.replace(" ", "\n", 1),
        f"{text.percent}  {left}\n{text.speed}".strip(),
        text.outcomes.replace(", ", "\n"),
    ]


def _summary(overview: Overview, now_s: float) -> str:
    left_s = overview.left_s(now_s)
    left = "" if left_s is None else f", about {duration(left_s)} left"
    given_up = f", {overview.given_up} given up" if overview.given_up else ""
    return f"{overview.done} of {overview.total} jobs are done{given_up}{left}"


def report_line(overview: Overview, now_s: float) -> str:
    """Return the content of the table in a line."""
    jobs = [_sentence(name, status, now_s) for name, status in overview.running.items()]
    return "; ".join(jobs if overview.total == 1 else [_summary(overview, now_s), *jobs])


def _sentence(name: str, status: Status, now_s: float) -> str:
    text = status.text(now_s)
    left = f"{text.left} left" if text.left else ""
    known = ", ".join(part for part in (text.percent, text.speed, left, text.outcomes) if part)
    return f"{name}: {known}" if known else name
