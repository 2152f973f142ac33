"""The shards of a dataset while it is recorded: in any number of processes, interruptible and exactly resumable.

A shard is a fixed number of episodes whose seeds follow from the dataset's seed and the shard's number, so that the
dataset does not depend on the number of workers, and an interrupted recording resumes to the very same dataset. No more
than a shard per process is in memory at a time.
"""

import signal
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import Future, ProcessPoolExecutor
from contextlib import contextmanager
from itertools import count
from pathlib import Path
from typing import Any

import pandas as pd
import pyarrow as pa
import pyarrow.parquet as pq

from tint_sumo.config import MIN_WINDOW_STEPS, NO_LEADER_GAP_M, WINDOW_STEPS
from tint_sumo.dataset.schema import (
    DRIVER_SCHEMA,
    DRIVERS,
    FCD,
    MANIFEST,
    TABLES,
    TRAJECTORIES,
    TRAJECTORY_SCHEMA,
    read_shard_metadata,
    shard_file,
    shard_number,
)
from tint_sumo.errors import InputError
from tint_sumo.files import claim_folder, read_json, whole_file, write_json
from tint_sumo.processes import SPAWN, end_with_parent
from tint_sumo.progress import make_bar
from tint_sumo.provenance import versions

EPISODE_STEPS = 500
_WINDOWS_KEY = b"tint_sumo.windows"
# Measured on real shards, size and write time relative to pyarrow's defaults (snappy, dictionaries): splitting the
# floats into byte streams halves the file (0.42) and takes a third of the time, as dictionaries of floats that hardly
# repeat are not built in vain. zstd 3 then beats snappy (0.52), lz4 (0.46) and gzip in size; zstd 9 saves 4 % for
# twice the time; delta encodings save nothing. All of them read in about the same time.
_FLOATS = [field.name for field in (*TRAJECTORY_SCHEMA, *DRIVER_SCHEMA) if pa.types.is_floating(field.type)]


def require_sizes(windows: int, seed: int) -> None:
    """Raise InputError unless a dataset can have so many windows, and this seed."""
    if windows < 1:
        raise InputError(f"windows must be at least 1, not {windows}")
    if seed < 0:
        raise InputError(f"seed must not be negative: {seed}")


def record_dataset(
    out: Path,
    settings: Mapping[str, Any],
    record_shard: Callable[[int], int],
    *,
    episodes_per_shard: int,
    episode_s: float,
    parts: Sequence[str] = TABLES,
    workers: int = 1,
    progress: bool = True,
) -> dict[str, Any]:
    """Record shards into ``out`` until they hold enough windows, or go on with that; the dataset's manifest.

    Args:
        out: a new folder, or the one of this very recording.
        settings: what the dataset follows from; ``windows`` tells how many windows are enough.
        record_shard: records a shard by its number, as far as it is not there already, and returns its windows.
        episodes_per_shard, episode_s: what a shard consists of.
        parts: what each shard has in ``out``.
        workers: processes that simulate.
        progress: show a progress bar on stderr.

    Raises:
        InputError: ``out`` holds another run, or the number of workers makes no sense.
    """
    if workers < 1:
        raise InputError(f"workers must be at least 1, not {workers}")
    with claim_folder(out, settings, with_versions=False):  # the manifest has them
        finished = _finished(out, parts)
        if finished is not None:
            return finished
        counts = _record(out, settings["windows"], record_shard, workers, progress)
        manifest = {
            **settings,
            **_contents(out, counts),
            "windows_asked_for": settings["windows"],
            "episodes": len(counts) * episodes_per_shard,
            "episode_s": episode_s,
        }
        write_json(out / MANIFEST, manifest)
        return manifest


def _finished(out: Path, parts: Sequence[str]) -> dict[str, Any] | None:
    """The manifest of a complete dataset."""
    if not (out / MANIFEST).exists():
        return None
    manifest = read_json(out / MANIFEST, "dataset manifest")
    shards = range(int(manifest.get("shards", 0)))
    return manifest if all(shard_file(out, part, shard).exists() for part in parts for shard in shards) else None


def _record(out: Path, windows: int, record_shard: Callable[[int], int], workers: int, progress: bool) -> list[int]:
    """The number of windows in each shard."""
    counts: list[int] = []
    with (
        make_bar(total=windows, desc="record", unit=" windows", disable=not progress) as bar,
        _shards(record_shard, workers) as shards,
    ):
        for found in shards:
            counts.append(found)
            bar.update(min(found, windows - bar.n))
            if sum(counts) >= windows:
                break
    _remove_shards_from(out, len(counts))
    return counts


@contextmanager
def _shards(record_shard: Callable[[int], int], workers: int) -> Iterator[Iterator[int]]:
    """Window counts of shards 0, 1, ..., recorded here or, ahead of their use, in worker processes."""
    if workers == 1:
        yield map(record_shard, count())
        return
    with ProcessPoolExecutor(workers, SPAWN, initializer=_start_worker) as pool:
        try:
            yield _ahead(pool, record_shard, workers)
        finally:
            pool.shutdown(cancel_futures=True)


def _ahead(pool: ProcessPoolExecutor, record_shard: Callable[[int], int], workers: int) -> Iterator[int]:
    pending: list[Future[int]] = []
    for shard in count():
        pending.append(pool.submit(record_shard, shard))
        if len(pending) > workers:
            yield pending.pop(0).result()


def _start_worker() -> None:
    """Leave Ctrl-C to the main process, and go with it."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    end_with_parent()


def _remove_shards_from(out: Path, first: int) -> None:
    """Workers run ahead: drop what they recorded beyond the last shard needed."""
    for part in (*TABLES, FCD):
        for file in (out / part).glob("shard-*"):
            if shard_number(file) >= first:
                file.unlink()


def _contents(out: Path, counts: Sequence[int]) -> dict[str, Any]:
    """What a manifest tells of the shards."""
    rows = {
        part: sum(read_shard_metadata(shard_file(out, part, shard)).num_rows for shard in range(len(counts)))
        for part in TABLES
    }
    return {
        "windows": sum(counts),
        "window_steps": WINDOW_STEPS,
        "no_leader_gap_m": NO_LEADER_GAP_M,
        "rows": rows[TRAJECTORIES],
        "drivers": rows[DRIVERS],
        "shards": len(counts),
        "versions": versions(("tint_sumo", "libsumo", "numpy", "pandas", "pyarrow")),
    }


def has_tables(out: Path, shard: int) -> bool:
    return all(shard_file(out, part, shard).exists() for part in TABLES)


def recorded_windows(out: Path, shard: int) -> int:
    """How many windows a shard has, as its file tells."""
    return int(read_shard_metadata(shard_file(out, TRAJECTORIES, shard)).metadata[_WINDOWS_KEY])


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


def count_windows(trajectories: pd.DataFrame) -> int:
    """Number of windows in whole tracks: pieces of 20 steps, and remainders of at least 2."""
    steps = trajectories.groupby(["episode", "vehicle"]).size().to_numpy()
    return int((steps // WINDOW_STEPS + (steps % WINDOW_STEPS >= MIN_WINDOW_STEPS)).sum())
