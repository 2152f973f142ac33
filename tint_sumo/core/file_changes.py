"""Files that are copied from a folder elsewhere, and the changes among them."""

import math
import os
import stat
from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path

from tint_sumo.core.files import is_temporary, write_bytes

SETTLED_S = 1.0

FileState = tuple[int, int]  # time of the last change in ns, size


class Changes:
    """Changes among some files of a folder, from now on.

    Args:
        folder: it need not be there yet.
        paths: files and folders in it, relative to it; the whole folder if none are given. Temporary files and locks in
            them do not count.
    """

    def __init__(self, folder: Path, paths: tuple[str, ...] = ("",)) -> None:
        self._folder = folder
        self._paths = paths
        self._known = dict(file_states(folder, paths))

    def take(self, before_s: float | None = None) -> dict[str, bytes | None]:
        """Return the contents of files that have changed since they were taken last, older files first; None: gone.

        While others write there, ``before_s`` is the present time (since the epoch), and only files are taken that
        have not changed for a moment before it: where a file is taken, so are those that were written before it.
        Without it everything is taken.
        """
        return dict(self.take_each(before_s))

    def take_each(self, before_s: float | None = None) -> Iterator[tuple[str, bytes | None]]:
        """Yield what :meth:`take` returns, with one content in memory at a time.

        A file counts as taken when the next one is asked for: one that could not be sent is taken again.
        """
        latest_ns = math.inf if before_s is None else (before_s - SETTLED_S) * 1e9
        gone = [path for path in self._known if not (self._folder / path).is_file()]
        found = dict(file_states(self._folder, self._paths))
        changed = sorted((state, path) for path, state in found.items() if state != self._known.get(path))
        all_settled = True
        for _, path in changed:
            try:
                with (self._folder / path).open("rb") as file:
                    state = _state(os.fstat(file.fileno()))  # of this content: it may be newer than what was found
                    settled = state[0] < latest_ns
                    content = file.read() if settled else b""
            except FileNotFoundError:  # removed a moment ago
                continue
            if settled:
                yield path, content
                self._known[path] = state
            all_settled &= settled
        if all_settled:  # a file may have been removed because a new one replaces it, which has to be there first
            for path in gone:
                if path not in found:
                    yield path, None
                    del self._known[path]


def read_files(folder: Path, paths: Iterable[str]) -> dict[str, bytes]:
    """Return the contents, by path in the folder, of the files among ``paths`` and in folders among them."""
    return {path: (folder / path).read_bytes() for path, _ in file_states(folder, paths)}


def write_files(folder: Path, files: Mapping[str, bytes | None]) -> None:
    """Write each file whole, in their order, or remove it where its content is None."""
    for path, content in files.items():
        if content is None:
            (folder / path).unlink(missing_ok=True)
        else:
            write_bytes(folder / path, content)


def file_states(folder: Path, paths: Iterable[str]) -> Iterator[tuple[str, FileState]]:
    """Yield relative path and state of each file; a folder's files come in the order of their paths."""
    for path in paths:
        inside = (Path(parent) / name for parent, _, names in os.walk(folder / path) for name in names)
        for file in [folder / path, *sorted(inside)]:
            try:
                status = file.stat()
            except (FileNotFoundError, NotADirectoryError):  # not there, or removed a moment ago
                continue
            if stat.S_ISREG(status.st_mode) and not is_temporary(file):
                yield file.relative_to(folder).as_posix(), _state(status)


def _state(status: os.stat_result) -> FileState:
    return status.st_mtime_ns, status.st_size
