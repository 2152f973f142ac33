"""Waiting for what other processes do, and whether they are still there."""

import subprocess
import time
from collections.abc import Callable

import psutil

PATIENCE_S = 300.0  # slow machines need more than a minute to start nodes beside other work


def wait_until(condition: Callable[[], bool], process: "subprocess.Popen[bytes] | None" = None) -> None:
    """Wait until a condition holds, which a process brings about if one is given.

    Raises:
        AssertionError: the condition does not hold in time, or the process has ended before it did.
    """
    end_s = time.monotonic() + PATIENCE_S
    while not condition():
        assert process is None or process.poll() is None, "the process has ended"
        assert time.monotonic() < end_s, "waited in vain"
        time.sleep(0.01)


def is_alive(process_id: int) -> bool:
    """Whether a process goes on. Zombies have ended; a process may end while one looks at it."""
    try:
        return bool(psutil.Process(process_id).status() != psutil.STATUS_ZOMBIE)
    except psutil.NoSuchProcess:
        return False
