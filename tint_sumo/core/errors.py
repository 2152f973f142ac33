"""Exceptions: mistakes that a user can mend, jobs that fail, and what the system refuses."""

import errno
import reprlib
from collections.abc import Mapping
from typing import TypeVar

T = TypeVar("T")

_SHOWN = reprlib.Repr()
_SHOWN.maxstring = _SHOWN.maxother = 80


class InputError(ValueError):
    """Bad input: one line that says what is wrong and how to mend it. The command line exits with code 2 on it.

    An argument that is to be changed stands between backticks, as in "choose another `out`"; the command line shows its
    flag there.
    """


class NotFiniteError(InputError):
    """Outputs of a policy are not finite, because its weights or observations are too large or NaN."""


def find_named(kind: str, name: str, known: Mapping[str, T]) -> T:
    """Return the known thing of this name.

    Args:
        kind: of the things, for the message.
        name: to look for.
        known: all of them by name.

    Raises:
        InputError: there is none of this name.
    """
    if name not in known:
        raise InputError(f"unknown {kind} {shown(name)}; choose one of: {', '.join(known)}")
    return known[name]


def shown(value: object) -> str:
    """Return a value as Python writes it, in one line and cut to what fits into a message."""
    return " ".join(_SHOWN.repr(value).split())


class JobError(RuntimeError):
    """Jobs were given up: one line that names them and says why. The command line exits with code 1 on it."""


class DivergedError(JobError):
    """A training has met a number that is not finite: one line with the step, where it ends again if repeated."""


BAD_PATHS = (FileNotFoundError, FileExistsError, NotADirectoryError, IsADirectoryError)  # another path mends these
_NO_ROOM, _NO_RIGHT = "free some space, or choose another folder", "choose a folder that you may write to"
_REMEDIES = {
    errno.ENOSPC: _NO_ROOM,
    errno.EDQUOT: _NO_ROOM,
    errno.EFBIG: "raise the limit of file sizes (ulimit -f)",
    errno.EMFILE: "raise the limit of open files (ulimit -n)",
    errno.ENFILE: "close other programs",
    errno.EACCES: _NO_RIGHT,
    errno.EPERM: _NO_RIGHT,
    errno.EROFS: _NO_RIGHT,
    errno.ENAMETOOLONG: "choose a shorter name",
    errno.ENOMEM: "close other programs",
}


def system_problem(error: OSError) -> str:
    """Return one line that says what the system refused, and how to mend it."""
    problem = error.strerror or " ".join(str(error).split())
    parts = (str(error.filename), problem) if error.filename is not None else (problem,)
    remedy = _REMEDIES.get(error.errno or 0, "check the path" if error.filename is not None else "")
    return "; ".join(part for part in (": ".join(parts), remedy) if part)
