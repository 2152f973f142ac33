"""The jobs that are being done: a live table on a terminal, a line a minute in a log file."""

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

from tint_sumo.core.progress import LOG_INTERVAL_S, Progress, Report
from tint_sumo.jobs.status import Overview, Standing, Title, duration

TABLE_INTERVAL_S = 0.25
_BAR_WIDTH, _ENDLESS = 10, 1000  # characters
_HEADERS = ("job", "method", "mix", "seed", "", "done", "speed", "left", "so far")
_NARROW_HEADERS = ("job", "done", "so far")


class Screen(Protocol):
    """Where the jobs are shown."""

    def begin(self, title: Title) -> None:
        """A job begins."""

    def end(self, line: str) -> None:
        """A job has ended; the line says what came out."""

    def show(self, overview: Overview, now_s: float) -> None:
        """Show where all jobs stand; called often, and too early calls do nothing."""


class JobTable:
    """Is told of some jobs, and shows where they stand; ``job_table`` makes one."""

    def __init__(self, overview: Overview, screen: Screen, clock: Callable[[], float] = time.monotonic) -> None:
        self._overview = overview
        self._screen = screen
        self._clock = clock

    def begin(self, title: Title) -> None:
        """One of the waiting jobs begins."""
        now_s = self._clock()
        self._overview.waiting.remove(title)
        self._overview.standings[title] = Standing(title, now_s)
        self._screen.begin(title)
        self._screen.show(self._overview, now_s)

    def report(self, title: Title, progress: Progress) -> None:
        """A job tells where it stands."""
        standings = self._overview.standings
        standings[title] = standings[title].after(progress, self._clock())
        self.refresh()

    def end(self, title: Title, outcome: str = "") -> None:
        """A job has ended; ``outcome`` says what came out if its last report does not."""
        now_s = self._clock()
        standing = self._overview.standings.pop(title)
        took_s = now_s - standing.began_s
        self._overview.took_s[title.task].append(took_s)
        found = outcome or standing.words(now_s).outcomes or "done"
        self._screen.end(f"{title}: {found} ({duration(took_s)})")
        self._screen.show(self._overview, now_s)

    def fail(self, title: Title, reason: str, *, again: bool) -> None:
        """A job has failed, whether it had begun or not; it waits ``again``, or is given up."""
        overview = self._overview
        overview.standings.pop(title, None)
        if title in overview.waiting:
            overview.waiting.remove(title)
        if again:
            overview.waiting.append(title)
        else:
            overview.given_up += 1
        self._screen.end(f"{title}: {reason}")
        self._screen.show(overview, self._clock())

    def refresh(self) -> None:
        """Keep the clocks going."""
        self._screen.show(self._overview, self._clock())


@contextmanager
def job_table(waiting: Sequence[Title], done: int = 0, *, progress: bool = True) -> Iterator[JobTable]:
    """A table on stderr of jobs that wait, beside ``done`` others that need not be done again.

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
def one_job(title: Title) -> Iterator[Report]:
    """The table of a single job, which is done in this process; nothing is shown before the first report."""
    with job_table([title]) as table:
        begun = False

        def report(progress: Progress) -> None:
            nonlocal begun
            if not begun:
                table.begin(title)
                begun = True
            table.report(title, progress)

        yield report
        if begun:
            table.end(title)


class _Nowhere:
    def begin(self, title: Title) -> None: ...

    def end(self, line: str) -> None: ...

    def show(self, overview: Overview, now_s: float) -> None: ...


class _Terminal:
    """A table that is redrawn in place, with a line above it for each job that has ended."""

    def __init__(self, live: Live) -> None:
        self._live = live
        self._drawn_s = -math.inf

    def begin(self, title: Title) -> None: ...

    def end(self, line: str) -> None:
        self._live.console.print(line, markup=False, highlight=False)

    def show(self, overview: Overview, now_s: float) -> None:
        if now_s - self._drawn_s >= TABLE_INTERVAL_S:
            self._drawn_s = now_s
            self._live.update(render(overview, now_s, self._live.console), refresh=True)


class Log:
    """A line when a job begins or ends, and one a minute about all of them."""

    def __init__(self, file: TextIO, now_s: float) -> None:
        self._file = file
        self._told_s = now_s

    def begin(self, title: Title) -> None:
        self._tell(f"{title}: begins")

    def end(self, line: str) -> None:
        self._tell(line)

    def show(self, overview: Overview, now_s: float) -> None:
        if now_s - self._told_s >= LOG_INTERVAL_S:
            self._told_s = now_s
            self._tell(report_line(overview, now_s))

    def _tell(self, line: str) -> None:
        print(line, file=self._file, flush=True)


def render(overview: Overview, now_s: float, console: Console) -> RenderableType:
    """The table: a line for each job or, where the console is too narrow for that, two."""
    standings = overview.standings.values()
    table = _table(_HEADERS, [_cells(standing, now_s) for standing in standings])
    endless = console.options.update(max_width=_ENDLESS)
    if Measurement.get(console, endless, table).maximum > console.width:
        table = _table(_NARROW_HEADERS, [_stacked_cells(standing, now_s) for standing in standings])
    return table if overview.total == 1 else Group(table, Text(_whole(overview, now_s), style="bold"))


def _table(headers: Sequence[str], rows: Sequence[Sequence[str | ProgressBar]]) -> Table:
    """Without the columns that are empty throughout."""
    table = Table(box=None, pad_edge=False, header_style="dim")
    kept = [number for number in range(len(headers)) if any(row[number] for row in rows)]
    for number in kept:
        table.add_column(headers[number], no_wrap=True)
    for row in rows:
        table.add_row(*(row[number] for number in kept))
    return table


def _cells(standing: Standing, now_s: float) -> list[str | ProgressBar]:
    title, last = standing.title, standing.last
    bar = ProgressBar(last.total if last else 1, last.done if last else 0, width=_BAR_WIDTH)
    seed = "" if title.seed is None else str(title.seed)
    told = standing.words(now_s)
    return [title.task, title.method, title.mix, seed, bar, told.percent, told.speed, told.left, told.outcomes]


def _stacked_cells(standing: Standing, now_s: float) -> list[str | ProgressBar]:
    title, told = standing.title, standing.words(now_s)
    left = f"{told.left} left" if told.left else ""
    return [
        f"{title.work}\n{title.circumstances}".strip(),
        f"{told.percent}  {left}\n{told.speed}".strip(),
        told.outcomes.replace(", ", "\n"),
    ]


def _whole(overview: Overview, now_s: float) -> str:
    left_s = overview.left_s(now_s)
    left = "" if left_s is None else f", about {duration(left_s)} left"
    given_up = f", {overview.given_up} given up" if overview.given_up else ""
    return f"{overview.done} of {overview.total} jobs are done{given_up}{left}"


def report_line(overview: Overview, now_s: float) -> str:
    """What the table says, in a line."""
    jobs = [_sentence(standing, now_s) for standing in overview.standings.values()]
    return "; ".join(jobs if overview.total == 1 else [_whole(overview, now_s), *jobs])


def _sentence(standing: Standing, now_s: float) -> str:
    told = standing.words(now_s)
    left = f"{told.left} left" if told.left else ""
    return f"{standing.title}: " + ", ".join(part for part in (told.percent, told.speed, left, told.outcomes) if part)
