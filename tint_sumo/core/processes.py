"""Worker processes that never outlive the main process, and the results that they send."""

import atexit
import gc
import os
import signal
import sys
import threading
import traceback
from collections.abc import Callable, Mapping
from multiprocessing import connection, forkserver, get_context, parent_process, resource_tracker
from multiprocessing.context import ForkServerContext
from types import FrameType
from typing import Any, Literal, NoReturn

from tint_sumo.core.errors import DivergedError, InputError

WorkResult = tuple[Literal["done", "refused", "diverged", "failed"], Any]

# A child forked from this process would share a running libsumo. One forked from the server, which runs no simulation,
# starts in milliseconds with all modules loaded, where a new interpreter loads them for seconds.
_CONTEXT = get_context("forkserver")
_FOR_MAIN = {signal.SIGINT, signal.SIGTERM}  # signals to a whole process group; the main process ends the others


def start_worker(
    target: Callable[..., None], *arguments: Any, daemon: bool = True
) -> tuple[connection.Connection, Any]:
    """Start ``target(pipe, *arguments)`` in a worker; return this end of the pipe, and the process.

    The worker never sees Ctrl-C: the main process ends it. A daemon cannot start workers itself.
    """
    context = worker_context()
    pipe, theirs = context.Pipe()
    process = context.Process(target=_work, args=(target, theirs, dict(os.environ), *arguments), daemon=daemon)
    process.start()
    theirs.close()
    return pipe, process


def worker_context() -> ForkServerContext:
    """Return the multiprocessing context of all workers, with its server running.

    The server loads the modules of this package that this process has loaded when the first worker starts, and
    ``tint_sumo.core.worker_server``; a worker imports what comes later by itself. The server and the workers never see
    Ctrl-C, nor SIGTERM before ``begin_work``.
    """
    loaded = [name for name in sys.modules if name.startswith("tint_sumo.")]
    _CONTEXT.set_forkserver_preload([*loaded, "tint_sumo.core.worker_server"])
    resource_tracker.ensure_running()  # else the server starts it, which would unblock the signals again
    before = signal.pthread_sigmask(signal.SIG_BLOCK, _FOR_MAIN)
    try:
        forkserver.ensure_running()
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)
    return _CONTEXT


def _work(
    target: Callable[..., None], pipe: connection.Connection, environment: dict[str, str], *arguments: Any
) -> None:
    begin_work(environment)
    target(pipe, *arguments)


def begin_work(environment: Mapping[str, str]) -> None:
    """Prepare a worker, with the main process's environment variables: those of the server may be older."""
    os.environ.clear()
    os.environ.update(environment)
    signal.pthread_sigmask(signal.SIG_UNBLOCK, {signal.SIGTERM})
    end_with_parent()
    end_quickly()


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
    # A signal to the whole process group comes a second time from the main process, while work is being saved.
    signal.signal(signal.SIGTERM, signal.SIG_IGN)
    raise KeyboardInterrupt


def result_of(work: Callable[[], Any]) -> WorkResult:
    """Do some work in a worker; return how it ended, with its value or the reason, to be sent."""
    try:
        return "done", work()
    except InputError as error:
        return "refused", str(error)
    except DivergedError as error:
        return "diverged", str(error)
    except (EOFError, ConnectionError):  # the other end is closed
        raise
    except Exception:
        return "failed", traceback.format_exc()


def value_of(result: WorkResult, worker: str) -> Any:
    """Return the value of a worker's work.

    Raises:
        InputError, DivergedError, RuntimeError: it was refused, it diverged, or it failed.
    """
    how, content = result
    if how == "refused":
        raise InputError(content)
    if how == "diverged":
        raise DivergedError(content)
    if how == "failed":
        raise RuntimeError(f"{worker} failed:\n{content}")
    return content


def end_with_parent() -> None:
    """End this worker as soon as its parent is gone.

    A killed main process cannot end its workers, and two runs must never write the same files.
    """
    threading.Thread(target=_watch_parent, daemon=True).start()


def _watch_parent() -> None:
    parent = parent_process()
    assert parent is not None
    connection.wait([parent.sentinel])
    os._exit(1)
