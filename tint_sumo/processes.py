"""Worker processes that never outlive the main process."""

import os
import signal
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from multiprocessing import connection, get_context, parent_process

SPAWN = get_context("spawn")  # a forked child would share a running libsumo


@contextmanager
def interrupts_blocked() -> Iterator[None]:
    """Processes started in this block never see Ctrl-C; the main process tells them to end."""
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


def end_with_parent() -> None:
    """Call in a worker: end it as soon as its parent is gone.

    A killed main process cannot tell anyone, and two runs must never write the same files.
    """
    threading.Thread(target=_watch_parent, daemon=True).start()


def _watch_parent() -> None:
    parent = parent_process()
    assert parent is not None
    connection.wait([parent.sentinel])
    os._exit(1)
