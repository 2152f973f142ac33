"""Files that are whole or absent, folders that belong to one run, outputs that may be written, and shipped files."""

import json
import os
import shutil
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path, PurePath
from tempfile import TemporaryFile
from typing import TYPE_CHECKING, Any, TypeVar

from filelock import FileLock, Timeout

from tint_sumo.core.errors import InputError
from tint_sumo.core.provenance import CONFIG_FILE, PROVENANCE_FILE, made_by, present_origin
from tint_sumo.core.reading import JSON_BYTES, read_file
from tint_sumo.core.structures import FieldError, build_json, dotted

if TYPE_CHECKING:
    from pandas import DataFrame

T = TypeVar("T")

RUN_FILE = "run.json"
LOCK_FILE = ".lock"
LOCK_TIMEOUT_S = 2.0  # workers of a killed process end a moment after it
PICTURE_SUFFIXES = (".png", ".jpg", ".jpeg", ".webp", ".svg", ".pdf")
MIN_ROOM_BYTES = 10_000_000  # less is a full disk: a study writes more
_PACKAGE = Path(__file__).resolve().parents[1]


def shipped(name: str) -> Path:
    """Return the path of a shipped folder, ``"sumo_net"`` or ``"models"``, in an installed wheel or in a checkout."""
    installed = _PACKAGE / "shipped" / name
    if installed.is_dir():
        return installed
    return _PACKAGE.parent / ("data/models" if name == "models" else name)


def at_home(path: str) -> str:
    """Return a path with the user's home folder for a leading ``~/``, as where no shell has put it in."""
    if not path.startswith("~/"):
        return path
    return os.path.expanduser(path)  # noqa: PTH111 - Path.expanduser fails where there is no home


@contextmanager
def whole_file(path: Path) -> Iterator[Path]:
    """Yield a temporary path beside ``path``; rename it to ``path`` only if the block succeeds.

    It is absolute: Arrow takes a relative one such as ``run:1/table.parquet`` for a URL.

    Raises:
        OSError: the system refuses to write the file; it names ``path``.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    partial = path.absolute().with_name(f".{path.name}.{os.getpid()}.partial")
    try:
        yield partial
        partial.replace(path)
    except OSError as error:
        if error.errno is None or error.filename not in (None, str(partial)):
            raise
        raise OSError(error.errno, os.strerror(error.errno), str(path)) from error
    finally:
        partial.unlink(missing_ok=True)


@contextmanager
def whole_folder(folder: Path) -> Iterator[Path]:
    """Yield a temporary folder beside ``folder``; rename it to ``folder`` only if the block succeeds.

    Raises:
        InputError: ``folder`` has files already, cannot be a folder, or lies in the folder of a run.
        OSError: the system refuses to write there.
    """
    folder = folder.resolve()
    require_output_folder(folder)
    if folder.is_dir() and any(folder.iterdir()):
        raise InputError(f"{folder} already holds other files; choose another `out` or an empty folder")
    partial = folder.with_name(f".{folder.name}.{os.getpid()}.partial")
    try:
        partial.mkdir(parents=True)
        yield partial
        partial.replace(folder)
    finally:
        shutil.rmtree(partial, ignore_errors=True)


def is_temporary(path: PurePath) -> bool:
    """Return whether a file is unfinished or a lock, which no run leaves."""
    return path.suffix == ".partial" or path.name == LOCK_FILE


def write_bytes(path: Path, content: bytes) -> None:
    with whole_file(path) as partial:
        partial.write_bytes(content)


def write_text(path: Path, text: str) -> None:
    write_bytes(path, text.encode("utf-8"))


def write_frame(table: "DataFrame", path: Path, float_format: str | None = None) -> None:
    """Write a table without its index as .csv, or else as Parquet, whole or not at all.

    Args:
        table: to write.
        path: of the file.
        float_format: of numbers in CSV, such as ``"%.6f"``; as short as they can be if not given.
    """
    with whole_file(path) as partial:
        if path.suffix.lower() == ".csv":
            table.to_csv(partial, index=False, float_format=float_format)
        else:
            table.to_parquet(partial, index=False)


def write_json(path: Path, value: Mapping[str, Any]) -> None:
    write_text(path, json.dumps(value, indent=2) + "\n")


def read_json(path: Path, what: str, most_bytes: int = JSON_BYTES) -> dict[str, Any]:
    """Read a JSON object.

    Raises:
        InputError: the file is missing, too large or damaged; ``what`` is its role in the message.
    """
    from pydantic_core import from_json  # noqa: PLC0415 - where files are read, and nowhere else

    text = read_file(path, what, most_bytes)
    try:
        value = from_json(text)
    except ValueError as error:  # also if it is nested too deeply
        raise InputError(f"{what}: {path} is damaged ({error}); make it anew") from None
    if not isinstance(value, dict):
        raise InputError(f"{what}: {path} is damaged (not a JSON object); make it anew")
    return value


def read_record(path: Path, what: str, kind: type[T], most_bytes: int = JSON_BYTES) -> T:
    """Read a file in JSON as a value of a type: mostly a dataclass.

    Raises:
        InputError: the file is missing, too large or damaged, or a value in it does not fit.
    """
    text = read_file(path, what, most_bytes)
    try:
        found: T = build_json(kind, text)
    except FieldError as error:
        raise damaged(path, what, error) from None
    return found


def damaged(path: Path, what: str, error: object) -> InputError:
    """Return the error for a file of a run whose content does not fit."""
    return InputError(f"{what}: {path} is damaged ({error}); restore it, or remove it and repeat the command")


def require_output_file(
    file: Path, suffixes: Sequence[str], argument: str = "out", inputs: Sequence[Path] = ()
) -> None:
    """Check, before the work begins, that a command can write a file, and may.

    Args:
        file: to write.
        suffixes: that it may have.
        argument: what users call it.
        inputs: files that the command reads, which need not be there.

    Raises:
        InputError: the file is one of the inputs, the suffix is none of these, no file can be there, or it lies in the
            folder of a run.
        OSError: the folder cannot be written to, or has no room.
    """
    if any(file.exists() and read.exists() and file.samefile(read) for read in inputs):
        raise InputError(f"{file} holds the data that are read; choose another `{argument}`")
    if file.suffix.lower() not in suffixes:
        allowed = " or ".join(part for part in (", ".join(suffixes[:-1]), suffixes[-1]) if part)
        raise InputError(f"{file} must end in {allowed}; choose another `{argument}`")
    if file.is_dir() or not _nearest_entry(file.parent).is_dir():
        raise InputError(f"{file} cannot be a file there; choose another `{argument}`")
    _require_no_run(file, argument)
    _require_writable(file.parent, argument)


def require_output_folder(folder: Path, argument: str = "out") -> None:
    """Check, before the work begins, that a command can write files into a folder that belongs to no run.

    Raises:
        InputError: it cannot be a folder, or lies in the folder of a run.
        OSError: it cannot be written to, or has no room.
    """
    if not _nearest_entry(folder).is_dir():
        raise InputError(f"{folder} is a file, not a folder, or lies below one; choose another `{argument}`")
    _require_no_run(folder, argument)
    _require_writable(folder, argument)


def require_own_files(files: Sequence[Path], mark: str) -> None:
    """Check that files which a command writes are not there yet, or are from it.

    Raises:
        InputError: the text of one lacks the mark that the command puts into it.
    """
    for file in files:
        if file.exists() and mark not in file.read_text(encoding="utf-8", errors="replace"):
            raise InputError(f"{file.parent} holds a {file.name} that tint-sumo did not write; choose another `out`")


def _require_no_run(path: Path, argument: str) -> None:
    """Raise InputError if ``path`` is the folder of a run or lies in one, where no other files may be."""
    resolved = path.resolve()
    for folder in (resolved, *resolved.parents):
        if (folder / RUN_FILE).exists():
            where = "is" if folder == resolved else f"lies in {folder}, which is"
            raise InputError(f"{path} {where} the folder of a run; choose another `{argument}`")


def _require_writable(folder: Path, argument: str) -> None:
    """Check that files of some size can be written into ``folder``, which need not be there yet.

    Raises:
        InputError: its name is no text, which not all libraries can open.
        OSError: the system does not allow it, or has no room.
    """
    try:
        str(folder.resolve()).encode()
    except UnicodeEncodeError:
        name = ascii(str(folder.resolve()))
        raise InputError(f"the name {name} is no text in UTF-8; choose another `{argument}`") from None
    try:
        with TemporaryFile(dir=_nearest_entry(folder)) as file:
            os.posix_fallocate(file.fileno(), 0, MIN_ROOM_BYTES)
    except OSError as error:
        raise OSError(error.errno, error.strerror, str(folder)) from None


def _nearest_entry(path: Path) -> Path:
    """Return ``path`` if it exists, else the nearest folder above it that does."""
    return next(entry for entry in (path, *path.absolute().parents) if entry.exists())


@contextmanager
def claim_folder(folder: Path, settings: Mapping[str, Any], *, with_versions: bool = True) -> Iterator[None]:
    """Reserve ``folder`` in the block for the run described by ``settings``, a new run or that very run resumed.

    One process at a time may work there; temporary files and folders that killed processes left are removed. A new
    run that a command begins gets provenance.json and config.yaml, which describe the command; the runs that are parts
    of it do not. They are no part of what the run is: another command line may resume it.

    Args:
        folder: of the run.
        settings: all that the run's results depend on.
        with_versions: note the versions of packages, too; leave them out if the run writes them elsewhere.

    Raises:
        InputError: the folder holds another run or files of unknown origin, another process is working there, or a
            command begins a run in the folder of another one.
        OSError: the folder cannot be written to, or has no room.
    """
    wanted = json.loads(json.dumps(settings))
    if present_origin() is not None:  # the parts of a run lie in its folder
        _require_no_run(folder.resolve().parent, "out")
    _require_home(folder, wanted)
    _require_writable(folder, "out")
    folder.mkdir(parents=True, exist_ok=True)
    with locked(folder, f"another process is working in {folder}; wait for it or choose another `out`"):
        _require_home(folder, wanted)
        for partial in list(folder.rglob(".*.partial")):
            _remove(partial)
        if not (folder / RUN_FILE).exists():
            _write_provenance(folder, with_versions)
            write_json(folder / RUN_FILE, wanted)
        with made_by(None):
            yield


@contextmanager
def locked(folder: Path, refusal: str) -> Iterator[None]:
    """Let one process at a time work in a folder, in the block.

    Raises:
        InputError: another process works there; ``refusal`` says so.
    """
    lock = FileLock(folder / LOCK_FILE, timeout=LOCK_TIMEOUT_S)
    try:
        lock.acquire()
    except Timeout:
        raise InputError(refusal) from None
    try:
        yield
    finally:
        lock.release()


def _remove(entry: Path) -> None:
    """Remove a file, or a folder with all that is in it; neither need be there."""
    if entry.is_dir() and not entry.is_symlink():
        shutil.rmtree(entry)
    else:
        entry.unlink(missing_ok=True)


def _require_home(folder: Path, wanted: Mapping[str, Any]) -> None:
    """Raise InputError unless ``folder`` is absent, empty, or the home of the run ``wanted``."""
    run_file = folder / RUN_FILE
    if folder.exists() and not folder.is_dir():
        raise InputError(f"{folder} is a file, not a folder; choose another `out`")
    if run_file.exists():
        held = read_json(run_file, "run settings")
        if held != wanted:
            changed = sorted(dotted((key,)) for key in held.keys() | wanted.keys() if held.get(key) != wanted.get(key))
            raise InputError(
                f"{folder} already holds another run (different: {', '.join(changed)}); "
                "choose another `out` or remove the folder"
            )
    elif folder.exists() and any(_is_strange(entry) for entry in folder.iterdir()):
        raise InputError(f"{folder} already holds other files; choose another `out` or an empty folder")


def _is_strange(entry: Path) -> bool:
    """Return whether an entry of a folder is not from a run that was killed at its very beginning."""
    if entry.name == CONFIG_FILE:  # the user's file is not overwritten
        return not entry.with_name(PROVENANCE_FILE).exists()
    return not is_temporary(entry) and entry.name != PROVENANCE_FILE


def _write_provenance(folder: Path, with_versions: bool) -> None:
    origin = present_origin()
    if origin is not None:
        write_json(folder / PROVENANCE_FILE, origin.provenance(with_versions=with_versions))
        write_text(folder / CONFIG_FILE, origin.config())
