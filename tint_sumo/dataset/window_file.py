"""Windows that lie in a file instead of in memory, for datasets that may be larger than memory."""

import os
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from dataclasses import fields
from pathlib import Path
from tempfile import TemporaryFile

import numpy as np
from numpy.typing import NDArray

from tint_sumo.config import WINDOW_STEPS
from tint_sumo.core.errors import InputError
from tint_sumo.dataset.windows import PART, Windows

_RECORD = np.dtype(
    [
        ("states", np.float32, (WINDOW_STEPS, 2)),
        ("length", np.int64),
        ("driver", np.int64),
        ("episode", np.int64),
        ("has_leader", np.bool_),
    ]
)


class WindowFile:
    """N windows in an open file, one record after the other; use ``window_file`` to make one.

    Windows are read, not mapped: the kernel maps up to 2 MiB around every byte that is touched, so that a batch from
    all over the file would bring all of it into the process's memory. Reading is no slower.
    """

    def __init__(self, descriptor: int) -> None:
        self._descriptor = descriptor
        self._count = os.fstat(descriptor).st_size // _RECORD.itemsize

    def __len__(self) -> int:
        return self._count

    def __getitem__(self, index: NDArray[np.integer]) -> Windows:
        """The windows at these indices."""
        return _windows(b"".join([self._read(one, 1) for one in index.tolist()]))

    def parts(self) -> Iterator[Windows]:
        """All windows in their order, some thousands at a time."""
        for start in range(0, len(self), PART):
            yield _windows(self._read(start, PART))

    @property
    def driver(self) -> NDArray[np.int64]:
        """(N,) as in ``Windows``."""
        return np.concatenate([part.driver for part in self.parts()])

    def _read(self, first: int, count: int) -> bytes:
        return os.pread(self._descriptor, count * _RECORD.itemsize, first * _RECORD.itemsize)


@contextmanager
def window_file(parts: Iterable[Windows], folder: Path) -> Iterator[WindowFile]:
    """All windows of ``parts`` in a file without a name, which is gone after the block, and whenever the process ends.

    Args:
        parts: windows, which are written in their order.
        folder: where the file lies; if it is not there yet, in the nearest folder above it.

    Raises:
        InputError: there is not enough room.
    """
    home = next(one for one in (folder, *folder.absolute().parents) if one.is_dir())
    with TemporaryFile(dir=home, buffering=0) as file:
        for part in parts:
            left = memoryview(_content(part))
            try:
                while left:
                    left = left[file.write(left) :]
            except OSError as error:
                raise InputError(
                    f"{home} has no room for the windows ({error.strerror}); free some or choose another --out"
                ) from None
        yield WindowFile(file.fileno())


def _content(windows: Windows) -> bytes:
    records = np.empty(len(windows), _RECORD)
    for field in fields(Windows):
        records[field.name] = getattr(windows, field.name)
    return records.tobytes()


def _windows(content: bytes) -> Windows:
    records = np.frombuffer(content, _RECORD)
    return Windows(**{field.name: records[field.name].copy() for field in fields(Windows)})
