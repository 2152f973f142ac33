"""How long-running work tells where it stands: on a bar that is lively on a terminal and calm in a log file."""

import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any, NoReturn

from tqdm import tqdm

TERMINAL_INTERVAL_S = 0.1
LOG_INTERVAL_S = 30.0  # every refresh of a bar that cannot be redrawn in place is one more line


def make_bar(**options: Any) -> "tqdm[NoReturn]":
    """A bar on stderr; ``options`` are tqdm's (https://tqdm.github.io/docs/tqdm)."""
    interval_s = TERMINAL_INTERVAL_S if sys.stderr.isatty() else LOG_INTERVAL_S
    return tqdm(mininterval=interval_s, maxinterval=max(interval_s, 10.0), **options)


Report = Callable[[int, int, str], None]  # takes what is done, of how much, and a short note


def silent(done: int, total: int, note: str) -> None:
    """Report to nobody."""


@contextmanager
def progress_bar(description: str, unit: str) -> Iterator[Report]:
    """Report to a progress bar on stderr, which appears with the first report."""
    bars: list[tqdm[NoReturn]] = []

    def report(done: int, total: int, note: str) -> None:
        if not bars:  # what an earlier run did says nothing about this one's speed
            bars.append(make_bar(desc=description, unit=unit, total=total, initial=done))
        bars[0].set_postfix_str(note, refresh=False)
        bars[0].update(done - bars[0].n)

    try:
        yield report
    finally:
        for bar in bars:
            bar.close()
