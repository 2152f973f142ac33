"""The shards of a dataset while it is recorded: by any number of workers, interruptible and exactly resumable.

A shard is a fixed number of episodes whose seeds follow from the dataset's seed and the shard's number, so that the
dataset does not depend on the number of workers, and an interrupted recording resumes to the very same dataset. No more
than a shard per process is in memory at a time.
"""

import hashlib
import tempfile
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import count
from pathlib import Path, PurePosixPath
from typing import Any, NamedTuple, Protocol

import pandas as pd
import pyarrow as pa
import pyarrow.parquet as pq

from tint_sumo.config import NO_LEADER_GAP_M, WINDOW_STEPS
from tint_sumo.core.errors import InputError
from tint_sumo.core.file_changes import write_files
from tint_sumo.core.files import claim_folder, whole_file, write_json
from tint_sumo.core.progress import Progress
from tint_sumo.core.provenance import versions
from tint_sumo.core.stores import Store, is_url, working_folder
from tint_sumo.dataset.fcd import write_fcd
from tint_sumo.dataset.schema import (
    DRIVER_SCHEMA,
    DRIVERS,
    FCD,
    MANIFEST,
    TABLES,
    TRAJECTORIES,
    TRAJECTORY_SCHEMA,
    Manifest,
    read_manifest,
    read_shard,
    read_shard_metadata,
    shard_file,
    shard_number,
    shard_path,
)
from tint_sumo.dataset.windows import count_windows
from tint_sumo.jobs import Executor, Work, Workers, executor_of
from tint_sumo.jobs.table import one_job
from tint_sumo.scenes import Scene
from tint_sumo.scenes.layout import layout

EPISODE_STEPS = 500
_WINDOWS_KEY = b"tint_sumo.windows"
# Compared on real shards with pyarrow's defaults (snappy, dictionaries): splitting the floats into byte streams makes
# files half as large and quicker to write, as dictionaries of floats that hardly repeat are not built in vain. zstd 3
# then beats snappy, lz4 and gzip in size, zstd 9 saves little for twice the time, and delta encodings save nothing.
_FLOATS = [field.name for field in (*TRAJECTORY_SCHEMA, *DRIVER_SCHEMA) if pa.types.is_floating(field.type)]


class ShardContents(NamedTuple):
    """Counts of what a shard contains."""

    windows: int
    rows: int
    drivers: int


def require_sizes(windows: int, seed: int) -> None:
    """Raise InputError unless a dataset can have so many windows, and this seed."""
    if windows < 1:
        raise InputError(f"windows must be at least 1, not {windows}")
    if seed < 0:
        raise InputError(f"seed must not be negative: {seed}")


class Recording(Protocol):
    """A dataset to record: at least ``windows`` windows of traffic."""

    @property
    def windows(self) -> int: ...

    @property
    def episodes_per_shard(self) -> int: ...

    @property
    def episode_s(self) -> float: ...

    def settings(self) -> dict[str, Any]:
        """Return all that the dataset follows from."""

    def simulate(self, shard: int) -> tuple[pd.DataFrame, pd.DataFrame]:
        """Return the rows of a shard: trajectories, by vehicle and time, and drivers."""


@dataclass(frozen=True)
class Shards:
    """The shards of a recording, which are written as far as they are not in ``out`` already."""

    recording: Recording
    out: Path
    fcd: Scene | None = None  # scene whose trajectories are written as floating-car data, too

    def paths(self, number: int) -> tuple[str, ...]:
        return tuple(shard_path(part, number) for part in (*TABLES, *([FCD] if self.fcd else [])))

    def __call__(self, number: int) -> ShardContents:
        if not all(shard_file(self.out, part, number).exists() for part in TABLES):
            write_tables(self.out, number, *self.recording.simulate(number))
        if self.fcd and not shard_file(self.out, FCD, number).exists():
            rows = read_shard(shard_file(self.out, TRAJECTORIES, number))
            write_fcd(rows, shard_file(self.out, FCD, number), layout(self.fcd))
        return _shard_contents(self.out, number)


def record_dataset(
    out: str | Path, recording: Recording, *, fcd: Scene | None = None, workers: Workers = 1, progress: bool = True
) -> Manifest:
    """Record shards into ``out`` until they hold enough windows, or go on with that; return the dataset's manifest.

    Args:
        out: a new folder, or the one of this very recording, or its URL: shards then go there from where they are
            recorded.
        recording: what is recorded.
        fcd: scene whose trajectories are written as floating-car data, too.
        workers: processes that simulate, or an executor.
        progress: show the progress on stderr.

    Raises:
        InputError: ``out`` holds another run, or the number of workers makes no sense.
    """
    shards, settings = Shards(recording, Path(out), fcd), recording.settings()
    executor = executor_of(workers)
    store = Store.at(out)
    with (
        working_folder(out, without=(*TABLES, FCD)) as folder,
        claim_folder(folder, settings, with_versions=False),  # the manifest has them
    ):
        finished = _finished(folder, store, shards)
        if finished is not None:
            return finished
        work = _Stored(shards, store) if is_url(out) else shards
        found = _record(recording.windows, work, executor, progress)
        _remove_shards_from(store, len(found))
        content = {
            **settings,
            **_contents(found),
            "sha256": _checksums(store, len(found)),
            "windows_asked_for": recording.windows,
            "episodes": len(found) * recording.episodes_per_shard,
            "episode_s": recording.episode_s,
        }
        write_json(folder / MANIFEST, content)
        return read_manifest(folder)


def _finished(folder: Path, store: Store, shards: Shards) -> Manifest | None:
    """Return the manifest of a complete dataset."""
    if not (folder / MANIFEST).exists():
        return None
    manifest = read_manifest(folder)
    held = store.files()
    wanted = (path for shard in range(manifest.shards) for path in shards.paths(shard))
    return manifest if all(path in held for path in wanted) else None


def _record(windows: int, shards: Work[ShardContents], executor: Executor, progress: bool) -> list[ShardContents]:
    found: list[ShardContents] = []
    done = 0
    with one_job("record", progress=progress) as report, executor.map(shards, count()) as recorded:
        report(Progress(0, windows, "window"))
        for shard in recorded:
            found.append(shard)
            done = min(done + shard.windows, windows)
            report(Progress(done, windows, "window"))
            if done == windows:
                break
    return found


@dataclass(frozen=True)
class _Stored:
    """Shards that are recorded in a temporary folder, and kept in a store."""

    shards: Shards
    store: Store
    out: Path = Path()  # nothing is left here

    def paths(self, _number: int, /) -> tuple[str, ...]:
        return ()

    def __call__(self, number: int) -> ShardContents:
        with tempfile.TemporaryDirectory(prefix="tint_sumo-") as scratch:
            folder = Path(scratch)
            paths = self.shards.paths(number)
            held = {path: self.store.read(path) for path in paths if self.store.exists(path)}
            write_files(folder, held)
            found = replace(self.shards, out=folder)(number)
            for path in paths:
                if path not in held:
                    self.store.write(path, (folder / path).read_bytes())
            return found


def _remove_shards_from(store: Store, first: int) -> None:
    """Drop what workers, which run ahead, recorded beyond the last shard needed."""
    for part in (*TABLES, FCD):
        for path in store.files(part):
            if shard_number(PurePosixPath(path)) >= first:
                store.delete(path)


def _contents(shards: Sequence[ShardContents]) -> dict[str, Any]:
    """Return a manifest's entries about the shards."""
    return {
        "windows": sum(shard.windows for shard in shards),
        "window_steps": WINDOW_STEPS,
        "no_leader_gap_m": NO_LEADER_GAP_M,
        "rows": sum(shard.rows for shard in shards),
        "drivers": sum(shard.drivers for shard in shards),
        "shards": len(shards),
        "versions": versions(("tint_sumo", "libsumo", "numpy", "pandas", "pyarrow")),
    }


def _checksums(store: Store, shards: int) -> dict[str, str]:
    """Return the checksums of all tables' files, by their paths in the dataset's folder."""
    paths = [shard_path(table, shard) for table in TABLES for shard in range(shards)]
    return {path: hashlib.sha256(store.read(path)).hexdigest() for path in paths}


def _shard_contents(out: Path, shard: int) -> ShardContents:
    """Return the counts of a shard, as its files have them."""
    trajectories, drivers = (read_shard_metadata(shard_file(out, table, shard)) for table in TABLES)
    return ShardContents(int(trajectories.metadata[_WINDOWS_KEY]), trajectories.num_rows, drivers.num_rows)


def write_tables(out: Path, shard: int, trajectories: pd.DataFrame, drivers: pd.DataFrame) -> None:
    windows = str(count_windows(trajectories)).encode()
    # The trajectories come last: where they are, the shard's tables are complete.
    _write(shard_file(out, DRIVERS, shard), drivers, DRIVER_SCHEMA, {})
    _write(shard_file(out, TRAJECTORIES, shard), trajectories, TRAJECTORY_SCHEMA, {_WINDOWS_KEY: windows})


def _write(file: Path, frame: pd.DataFrame, schema: pa.Schema, metadata: Mapping[bytes, bytes]) -> None:
    table = pa.Table.from_pandas(frame, schema, preserve_index=False)
    table = table.replace_schema_metadata({**(table.schema.metadata or {}), **metadata})
    with whole_file(file) as partial:
        pq.write_table(
            table,
            partial,
            compression="zstd",
            compression_level=3,
            use_dictionary=[name for name in table.column_names if name not in _FLOATS],
            use_byte_stream_split=[name for name in table.column_names if name in _FLOATS],
        )
