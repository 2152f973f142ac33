"""Folders at URLs: in an object store such as S3, or of this machine's files (``file://``)."""

import re
import tempfile
import threading
import time
from collections.abc import Iterable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from functools import cached_property
from itertools import takewhile
from pathlib import Path, PurePosixPath
from typing import Any
from urllib.parse import parse_qsl, quote, urlencode, urlsplit, urlunsplit
from uuid import uuid4

from tint_sumo.core.errors import InputError, JobError
from tint_sumo.core.file_changes import Changes
from tint_sumo.core.files import is_temporary, write_bytes
from tint_sumo.core.redaction import redact

PUSH_INTERVAL_S = 15.0

_OBJECT_STORES = ("s3", "gcs", "abfs")  # Arrow's names of those where a file shows only when it is complete
_OPTIONS = {
    "s3": {"allow_delayed_open": "true"},  # a small file is one request; nothing is left of one that breaks off
    "gs": {"retry_limit_seconds": "10"},  # without credentials Arrow would try for a quarter of an hour
}
_NAME_LENGTH = 60  # characters; file systems take 255 bytes, and a character has up to four
_ADVICE = {
    "s3": "check the bucket, the connection (AWS_ENDPOINT_URL) and the credentials "
    "(AWS_ACCESS_KEY_ID and AWS_SECRET_ACCESS_KEY, or a profile of the AWS command line)",
    "gs": "check the bucket, the connection and the credentials (GOOGLE_APPLICATION_CREDENTIALS)",
    "file": "choose a folder that you may write to, as file:///folder",
}
_ADVICE_ON_OTHERS = "use a URL such as s3://bucket/folder, gs://bucket/folder or file:///folder"


def is_url(out: str | Path) -> bool:
    """Return whether an output folder is given as a URL; a Path would lose a slash, so URLs stay text."""
    return "://" in str(out)


def name_in(out: str | Path, path: PurePosixPath | Path | str) -> str:
    """Return a file's name as the user writes it: ``path`` in the output folder ``out``, a folder or a URL."""
    if not is_url(out):
        return str(Path(out) / path)
    folder, mark, options = redact(str(out)).partition("?")
    return f"{folder.rstrip('/')}/{PurePosixPath(path)}{mark}{options}"


@dataclass(frozen=True)
class Store:
    """The folder of files at a URL; it need not be there yet, but a bucket must. It can be sent to other processes.

    Every method raises InputError where the store does not answer or refuses.

    Attributes:
        url: as pyarrow.fs understands it, options after a ``?`` included. Special characters may be percent-encoded;
            ``?`` and ``%`` must be.
    """

    url: str

    @classmethod
    def at(cls, out: str | Path) -> "Store":
        """Return the store at a URL, or a folder of this machine as a store."""
        return cls(str(out) if is_url(out) else Path(out).resolve().as_uri())

    def files(self, under: str = "") -> dict[str, int]:
        """Return the sizes in bytes, by path in the store, of the files in its folder ``under``."""
        from pyarrow.fs import FileSelector, FileType  # noqa: PLC0415

        with self._reported("read"):
            filesystem, base = self._home
            selector = FileSelector(self._path(under), recursive=True, allow_not_found=True)
            infos = [info for info in filesystem.get_file_info(selector) if info.is_file]
            bucket = base.split("/")[0]
            no_bucket = not infos and bucket and filesystem.get_file_info(bucket).type == FileType.NotFound
        if no_bucket:
            raise InputError(redact(f"cannot read {self.url}: there is no bucket {bucket!r}; make it first"))
        sizes = {info.path.removeprefix(base).lstrip("/"): info.size for info in infos}
        return {path: sizes[path] for path in sorted(sizes) if _is_ours(PurePosixPath(path))}

    @property
    def name(self) -> str:
        """The last part of the folder's path, or of the bucket's where it is the whole bucket."""
        with self._reported("read"):
            return PurePosixPath(self._home[1]).name

    def exists(self, path: str) -> bool:
        """Return whether there is such a file."""
        with self._reported("read"):
            filesystem, _ = self._home
            return bool(filesystem.get_file_info(self._path(path)).is_file)

    def read(self, path: str) -> bytes:
        with self._reported("read"):
            filesystem, _ = self._home
            try:
                with filesystem.open_input_stream(self._path(path)) as stream:
                    return bytes(stream.read())
            except FileNotFoundError:
                raise FileNotFoundError(f"it has no file {path}") from None

    def write(self, path: str, content: bytes) -> None:
        """Write a file, whole or not at all."""
        # Ctrl-C reaches the main thread only. Between two of the calls it would leave a file that is cut short: a
        # stream that is given up completes what it has.
        with self._reported("write"), ThreadPoolExecutor(1) as thread:
            thread.submit(self._write, self._path(path), content).result()

    def delete(self, path: str) -> None:
        """Remove a file if it is there."""
        with self._reported("write"), suppress(FileNotFoundError):
            filesystem, _ = self._home
            filesystem.delete_file(self._path(path))

    def __reduce__(self) -> tuple[type["Store"], tuple[str]]:
        return Store, (self.url,)  # without its connections

    @cached_property
    def _home(self) -> tuple[Any, str]:
        """Return Arrow's file system and the folder's path in it."""
        from pyarrow.fs import FileSystem  # noqa: PLC0415

        url = urlsplit(quote(self.url, safe="%/:?&=+,;@!$'()*[]~"))
        options = _OPTIONS.get(url.scheme, {}) | dict(parse_qsl(url.query))
        filesystem, path = FileSystem.from_uri(urlunsplit(url._replace(query=urlencode(options))))
        return filesystem, path.rstrip("/")

    def _path(self, path: str) -> str:
        base = self._home[1]
        return f"{base}/{path}" if path else base

    def _write(self, path: str, content: bytes) -> None:
        filesystem, _ = self._home
        if filesystem.type_name in _OBJECT_STORES:
            _put(filesystem, path, content)
            return
        folder, _, name = path.rpartition("/")
        filesystem.create_dir(folder)
        partial = f"{folder}/.{name}.{uuid4().hex}.partial"
        try:
            _put(filesystem, partial, content)
            filesystem.move(partial, path)
        except BaseException:
            with suppress(FileNotFoundError):
                filesystem.delete_file(partial)
            raise

    @contextmanager
    def _reported(self, doing: str) -> Iterator[None]:
        """Raise InputError for the exceptions of Arrow in the block."""
        try:
            yield
        except (OSError, ValueError, NotImplementedError) as error:
            reason = " ".join(str(error).split())
            advice = _ADVICE.get(self.url.split(":")[0], _ADVICE_ON_OTHERS)
            raise InputError(redact(f"cannot {doing} {self.url}: {reason}; {advice}")) from None


@contextmanager
def working_folder(out: str | Path, without: tuple[str, ...] = ()) -> Iterator[Path]:
    """Give, in the block, a folder of this machine that stands for ``out``: ``out`` itself unless it is a URL.

    For a URL it is a temporary folder that begins with the files of the store. While the block runs, the files that
    have changed are sent there every PUSH_INTERVAL_S, older ones first: where a file is, so are those that were written
    before it. When the block ends, however it ends, the rest is sent. Temporary files and locks never are. Folders
    ``without`` are not fetched, and what is in them there stays.

    Raises:
        InputError: the store does not answer or refuses. Is that so at the end, the folder is kept; the message says
            where.
    """
    if not is_url(out):
        yield Path(out)
        return
    store = Store(str(out))
    with tempfile.TemporaryDirectory(prefix="tint_sumo_") as home:
        folder = Path(home) / _folder_name(store.name)
        folder.mkdir()
        for path in store.files():
            if path.split("/")[0] in without:
                continue
            write_bytes(folder / path, store.read(path))
        try:
            with _pushing(store, folder):
                yield folder
        except _PushError as error:
            kept = folder.rename(f"{home}_not_sent")
            raise InputError(f"{error}; everything is kept in {kept}") from None
        except InputError as error:
            raise InputError(_renamed(str(error), folder, store.url)) from None
        except JobError as error:
            raise JobError(_renamed(str(error), folder, store.url)) from None


def _folder_name(name: str) -> str:
    """Return a name that every file system takes, the same one wherever possible: reports are titled with it."""
    return re.sub(r"[^\w .+-]", "_", name).strip(" .")[:_NAME_LENGTH] or "out"


def _renamed(message: str, folder: Path, url: str) -> str:
    """Name files as the user does in a message that names those of ``folder``, whose name nothing else can have."""
    path = re.compile(rf"{re.escape(str(folder))}(?:/([^\s:;,()'\"]*))?")
    return path.sub(lambda found: name_in(url, found[1]) if found[1] else redact(url), message)


class _PushError(InputError):
    """The last files could not be sent."""


@contextmanager
def _pushing(store: Store, folder: Path) -> Iterator[None]:
    """Send the changes in a folder, regularly and when the block ends."""
    changes = Changes(folder)
    ended = threading.Event()
    regularly = threading.Thread(target=_push_regularly, args=(store, changes, ended), daemon=True)
    try:
        regularly.start()
        yield
    finally:
        ended.set()  # before the folder goes: its files would count as removed
        regularly.join()
        try:
            _push(store, changes.take_each())
        except InputError as error:
            raise _PushError(str(error)) from None


def _push_regularly(store: Store, changes: Changes, ended: threading.Event) -> None:
    def goes_on(_: object) -> bool:
        return not ended.is_set()

    while not ended.wait(PUSH_INTERVAL_S):
        with suppress(InputError):  # files that could not be sent are sent next time; the last push raises
            _push(store, takewhile(goes_on, changes.take_each(time.time())))


def _push(store: Store, changed: Iterable[tuple[str, bytes | None]]) -> None:
    for path, content in changed:
        if content is None:
            store.delete(path)
        else:
            store.write(path, content)


def _put(filesystem: Any, path: str, content: bytes) -> None:
    with filesystem.open_output_stream(path) as stream:
        stream.write(content)


def _is_ours(path: PurePosixPath) -> bool:
    return not is_temporary(path) and ".." not in path.parts  # which would lead out of a folder of this machine
