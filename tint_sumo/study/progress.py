"""How long-running work tells where it stands."""

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import NoReturn

from tqdm import tqdm

from tint_sumo.progress import make_bar

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
