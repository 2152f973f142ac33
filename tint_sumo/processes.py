"""Worker processes that never outlive the main process."""

import os
import threading
from multiprocessing import connection, get_context, parent_process

SPAWN = get_context("spawn")  # a forked child would share a running libsumo


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
