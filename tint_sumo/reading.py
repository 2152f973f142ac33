"""Files that others may have written: they are opened only if they are regular ones, and no larger than their kind is.

Pipes and devices would keep a command waiting, or never end.
"""

import os
import stat
from pathlib import Path
from typing import IO

from tint_sumo.errors import InputError

SETTINGS_BYTES = 2**17  # of configuration files: one with all settings of a command has some 2**13
JSON_BYTES = 2**24  # of cards, manifests and settings of runs
RESULT_BYTES = 2**28  # of results, and of episodes that were recorded for a report
WEIGHTS_BYTES = 2**30  # of the weights of one network
TABLE_BYTES = 2**36  # of trajectories, networks and demand


def open_file(path: Path, what: str, most_bytes: int) -> IO[bytes]:
    """Open a file for reading.

    Args:
        path: of the file.
        what: its role, for messages.
        most_bytes: a larger file is refused.

    Raises:
        InputError: there is no such file, it cannot be read, is none of the regular files, or is too large.
    """
    try:
        descriptor = os.open(path, os.O_RDONLY | os.O_NONBLOCK | os.O_CLOEXEC)  # a pipe alone could keep it waiting
    except (FileNotFoundError, NotADirectoryError):
        raise InputError(f"{what}: no file {path}; check the path") from None
    except (OSError, ValueError) as error:  # no permission; a path with a null byte
        raise InputError(f"{what}: {str(path)!r} cannot be read ({error}); check the path") from None
    found = os.fstat(descriptor)
    if not stat.S_ISREG(found.st_mode):
        problem = "is a folder, a pipe or a device; give a regular file"
    elif found.st_size > most_bytes:
        problem = f"has {found.st_size:,} bytes, more than the {most_bytes:,} that are read; check the path"
    else:
        return os.fdopen(descriptor, "rb")
    os.close(descriptor)
    raise InputError(f"{what}: {path} {problem}")


def require_file(path: Path, what: str, most_bytes: int) -> None:
    """Raise InputError unless ``open_file`` can open a file; for libraries that open it by its path."""
    open_file(path, what, most_bytes).close()


def read_file(path: Path, what: str, most_bytes: int) -> bytes:
    """Return all bytes of a file.

    Raises:
        InputError: as in ``open_file``.
    """
    try:
        with open_file(path, what, most_bytes) as file:
            return file.read(most_bytes)
    except OSError as error:
        raise InputError(f"{what}: {path} cannot be read ({error}); check the path") from None
