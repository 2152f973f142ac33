"""Worker processes that never outlive the main process, and how they tell what became of their work."""

import atexit
import gc
import os
import signal
import threading
import traceback
from collections.abc import Callable
from multiprocessing import connection, get_context, parent_process
from types import FrameType
from typing import Any, Literal, NoReturn

from tint_sumo.errors import InputError

Told = tuple[Literal["done", "refused", "failed"], Any]

SPAWN = get_context("spawn")  # a forked child would share a running libsumo


def start_worker(
    target: Callable[..., None], *arguments: Any, daemon: bool = True
) -> tuple[connection.Connection, Any]:
    """Start ``target(pipe, *arguments)`` in a process of its own; this end of the pipe, and the process.

    It never sees Ctrl-C: the main process tells it to end. A daemon cannot start workers itself.
    """
    pipe, theirs = SPAWN.Pipe()
    process = SPAWN.Process(target=_work, args=(target, theirs, *arguments), daemon=daemon)
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        process.start()
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)
    theirs.close()
    return pipe, process


def _work(target: Callable[..., None], pipe: connection.Connection, *arguments: Any) -> None:
    end_with_parent()
    end_quickly()
    target(pipe, *arguments)


def end_quickly() -> None:
    """Spare this process the last search for garbage among all objects of torch, which takes it most of a second."""
    atexit.register(gc.freeze)


def interrupt_on_sigterm() -> None:
    """Let SIGTERM, with which schedulers end a process, do what Ctrl-C does, so that work is saved.

    Does nothing outside of the main thread, where Python does not allow it.
    """
    if threading.current_thread() is threading.main_thread():
        signal.signal(signal.SIGTERM, _raise_interrupt)


def _raise_interrupt(_signal: int, _frame: FrameType | None) -> NoReturn:
    raise KeyboardInterrupt


def told(work: Callable[[], Any]) -> Told:
    """Do some work in a worker; what to send of it."""
    try:
        return "done", work()
    except InputError as error:
        return "refused", str(error)
    except (EOFError, ConnectionError):  # the other end is closed
        raise
    except Exception:
        return "failed", traceback.format_exc()


def answer(message: Told, worker: str) -> Any:
    """What a worker's work gave.

    Raises:
        InputError, RuntimeError: it was refused, or it failed.
    """
    kind, content = message
    if kind == "refused":
        raise InputError(content)
    if kind == "failed":
        raise RuntimeError(f"{worker} failed:\n{content}")
    return content


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
