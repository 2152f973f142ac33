"""Reading of files that others may have written: only regular files up to a size that suits their kind are opened.

Pipes and devices would keep a command waiting, or never end.
"""

import gzip
import os
import stat
import zipfile
import zlib
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import IO, cast

from tint_sumo.core.errors import InputError

SETTINGS_BYTES = 2**17  # of configuration files: one with all settings of a command has some 2**13
JSON_BYTES = 2**24  # of cards, manifests and settings of runs
RESULT_BYTES = 2**28  # of results, and of episodes that were recorded for a report
WEIGHTS_BYTES = 2**30  # of the weights of one network
TABLE_BYTES = 2**36  # of trajectories, networks and demand
MOST_RATIO = 200  # of a packed file's content to its size; gzip can reach 1032, SUMO's files do not come near it
_SMALL_BYTES = 2**25  # content that may have any ratio
_CHUNK_BYTES = 2**20


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
    """Check a file, gzipped or not, for libraries that open it by its path.

    Raises:
        InputError: as in ``open_file``; or the file is gzipped, and unpacks to too much.
    """
    with open_file(path, what, most_bytes) as file:
        if is_gzipped(file) and not _unpacks_within(file, most_bytes):
            raise _unpacks_to_too_much(path, what, most_bytes)


def require_zip(path: Path, what: str, most_bytes: int) -> None:
    """Check a zip file for libraries that open it by its path.

    Raises:
        InputError: as in ``open_file``; or the file unpacks to too much.
        zipfile.BadZipFile: it is not a zip file.
    """
    with open_file(path, what, most_bytes) as file, zipfile.ZipFile(file) as packed:
        require_unpacked_bytes(path, what, most_bytes, sum(entry.file_size for entry in packed.infolist()))


def require_unpacked_bytes(path: Path, what: str, most_bytes: int, unpacked_bytes: int) -> None:
    """Raise InputError if a file with so much content, as the file itself has it, unpacks to too much."""
    if unpacked_bytes > _most_unpacked(most_bytes, path.stat().st_size):
        raise _unpacks_to_too_much(path, what, most_bytes)


def _most_unpacked(most_bytes: int, packed_bytes: int) -> int:
    return min(most_bytes, max(_SMALL_BYTES, MOST_RATIO * packed_bytes))


def _unpacks_to_too_much(path: Path, what: str, most_bytes: int) -> InputError:
    return InputError(
        f"{what}: {path} unpacks to more than {most_bytes:,} bytes or {MOST_RATIO} times its size, "
        "as no such file does; check the path"
    )


def is_gzipped(file: IO[bytes]) -> bool:
    """Return whether a file that was just opened is gzipped; it is read from its beginning again."""
    magic = file.read(2)
    file.seek(0)
    return magic == b"\x1f\x8b"


def unpacked(file: IO[bytes]) -> IO[bytes]:
    """Return the content of a file that was just opened, whether gzipped or not."""
    return cast("IO[bytes]", gzip.GzipFile(fileobj=file)) if is_gzipped(file) else file


@contextmanager
def opened(path: Path, what: str, most_bytes: int) -> Iterator[IO[bytes]]:
    """Open a file, gzipped or not, for reading its content in the block.

    Raises:
        InputError: as in ``open_file``; or the file is damaged.
    """
    try:
        with open_file(path, what, most_bytes) as raw:
            yield unpacked(raw)
    except (EOFError, OSError, zlib.error) as error:
        raise InputError(f"{path} is not whole ({error}); get it again") from None


def _unpacks_within(file: IO[bytes], most_bytes: int) -> bool:
    """Return whether a gzipped file has no more bytes than allowed; a damaged file is left to its reader."""
    read_bytes = 0
    with gzip.GzipFile(fileobj=file) as stream:
        try:
            while chunk := stream.read(_CHUNK_BYTES):
                read_bytes += len(chunk)
                if read_bytes > _most_unpacked(most_bytes, file.tell()):
                    return False
        except (EOFError, OSError, zlib.error):
            pass
    return True


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
