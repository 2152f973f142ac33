"""The one exception type for mistakes a user can mend, and the mistake of a name that nothing has."""

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
    """The one of the known things that has this name.

    Raises:
        InputError: none has; ``kind`` says in the message what was looked for.
    """
    if name not in known:
        raise InputError(f"unknown {kind} {name!r}; choose one of: {', '.join(known)}")
    return known[name]


def shown(value: object) -> str:
    """Return a value as Python writes it, in one line and cut to what fits into a message."""
    return " ".join(_SHOWN.repr(value).split())


class JobError(RuntimeError):
    """Jobs were given up: which, and why, in one line. The command line exits with code 1 on it."""


class DivergedError(JobError):
    """A training has met a number that is not finite: at which step, in one line. It ends there if it is repeated."""


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
