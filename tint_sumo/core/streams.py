"""Output of commands: any name can be printed, and write errors show before the interpreter ends."""

import io
import os
import select
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TextIO

READER_GONE = 141  # exit code of a program that a closed pipe ends: 128 + SIGPIPE


def open_closed_streams() -> None:
    """Let output go nowhere where the program was started with a closed stdout or stderr; Python has None there."""
    sys.stdout = sys.stdout or _nowhere()
    sys.stderr = sys.stderr or _nowhere()


def show_any_name() -> None:
    """Print what the encoding of stdout does not have, such as bytes of a file's name, as escape sequences."""
    if isinstance(sys.stdout, io.TextIOWrapper):
        sys.stdout.reconfigure(errors="backslashreplace")


@contextmanager
def flushed_output() -> Iterator[None]:
    """Write out what the block prints.

    Raises:
        OSError: it cannot be written; the rest of it is dropped.
    """
    try:
        yield
    finally:
        for stream in (sys.stdout, sys.stderr):
            _flush(stream)


def _nowhere() -> TextIO:
    return Path(os.devnull).open("w", encoding="utf-8")


def _flush(stream: TextIO) -> None:
    try:
        stream.flush()
    except OSError:
        _drop(stream)
        raise


def has_lost_reader() -> bool:
    """Return whether stdout or stderr is a pipe from which nobody reads any more."""
    return any(_has_no_reader(stream) for stream in (sys.stdout, sys.stderr))


def _has_no_reader(stream: TextIO) -> bool:
    try:
        descriptor = stream.fileno()
    except (OSError, ValueError):  # no file stands behind it
        return False
    poll = select.poll()
    poll.register(descriptor, 0)
    return any(event & select.POLLERR for _, event in poll.poll(0))


def _drop(stream: TextIO) -> None:
    """Let nothing complain when the interpreter flushes the stream once more at its end."""
    nowhere = os.open(os.devnull, os.O_WRONLY)
    os.dup2(nowhere, stream.fileno())
    os.close(nowhere)
