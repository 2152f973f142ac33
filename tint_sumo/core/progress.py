"""How long-running work tells where it stands, and a bar that shows it: lively on a terminal, calm in a log file."""

import sys
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from typing import Any, NoReturn

from tqdm import tqdm

from tint_sumo.core.percentages import percent

TERMINAL_INTERVAL_S = 0.1
LOG_INTERVAL_S = 60.0  # every refresh of what cannot be redrawn in place is one more line
_SHARES = ("success", "timeout", "collision", "accuracy")  # measures that people read in percent


@dataclass(frozen=True)
class Progress:
    """Where a piece of work stands."""

    done: int
    total: int
    unit: str  # what is counted, in the singular
    measures: Mapping[str, float] = field(default_factory=dict)  # what has come out so far, by name

    @property
    def outcomes(self) -> str:
        """The measures for people to read."""
        shown = (
            f"{percent(value, 0)}%" if name in _SHARES else f"{value:.3g}" for name, value in self.measures.items()
        )
        return ", ".join(f"{name} {value}" for name, value in zip(self.measures, shown, strict=True))


Report = Callable[[Progress], None]


def silent(progress: Progress) -> None:
    """Report to nobody."""


def part_of(report: Report, before: int, total: int) -> Report:
    """A report for a part of some work, of which ``before`` of ``total`` was done when the part began."""
    return lambda progress: report(replace(progress, done=before + progress.done, total=total))


def make_bar(**options: Any) -> "tqdm[NoReturn]":
    """A bar on stderr; ``options`` are tqdm's (https://tqdm.github.io/docs/tqdm)."""
    interval_s = TERMINAL_INTERVAL_S if sys.stderr.isatty() else LOG_INTERVAL_S
    return tqdm(mininterval=interval_s, maxinterval=max(interval_s, 10.0), **options)


@contextmanager
def progress_bar(description: str) -> Iterator[Report]:
    """Report to a progress bar on stderr, which appears with the first report."""
    bars: list[tqdm[NoReturn]] = []

    def report(progress: Progress) -> None:
        if not bars:
            bars.append(make_bar(desc=description, unit=progress.unit, total=progress.total))
        bars[0].set_postfix_str(progress.outcomes, refresh=False)
        bars[0].update(progress.done - bars[0].n)

    try:
        yield report
    finally:
        for bar in bars:
            bar.close()
