"""The one progress bar: lively on a terminal, calm in a log file."""

import sys
from typing import Any, NoReturn

from tqdm import tqdm

TERMINAL_INTERVAL_S = 0.1
LOG_INTERVAL_S = 30.0  # every refresh of a bar that cannot be redrawn in place is one more line


def make_bar(**options: Any) -> "tqdm[NoReturn]":
    """A bar on stderr; ``options`` are tqdm's (https://tqdm.github.io/docs/tqdm)."""
    interval_s = TERMINAL_INTERVAL_S if sys.stderr.isatty() else LOG_INTERVAL_S
    return tqdm(mininterval=interval_s, maxinterval=max(interval_s, 10.0), **options)
