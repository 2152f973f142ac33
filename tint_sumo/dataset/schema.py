"""Tables and files of a recorded dataset.

A dataset folder has ``trajectories/`` (one row per vehicle and step) and, apart from it, ``drivers/`` (one row per
driver, with the trait label), each one Parquet file per shard, and ``manifest.json``, written last. ``fcd/``, if asked
for, has the trajectories as SUMO writes them.
"""

import hashlib
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, fields
from pathlib import Path, PurePath
from typing import Annotated, Any

import numpy as np
import pandas as pd
import pyarrow as pa
import pyarrow.parquet as pq

from tint_sumo.config import NO_LEADER_GAP_M, WINDOW_STEPS, DriverProfile, Mix, TrafficSeed
from tint_sumo.core.errors import InputError
from tint_sumo.core.files import read_json
from tint_sumo.core.ranges import Range
from tint_sumo.core.reading import TABLE_BYTES, require_file, require_unpacked_bytes
from tint_sumo.core.structures import FieldError, build, is_required, plain
from tint_sumo.scenes.drivers import read_population

SCHEMA_VERSION = 2
MANIFEST = "manifest.json"
TRAJECTORIES = "trajectories"
DRIVERS = "drivers"
TABLES = (TRAJECTORIES, DRIVERS)
FCD = "fcd"
_SUFFIX = {TRAJECTORIES: "parquet", DRIVERS: "parquet", FCD: "xml.gz"}
_Count = Annotated[int, Range(0, 10**12)]


def _field(name: str, dtype: pa.DataType, unit: str, meaning: str, nullable: bool = False) -> pa.Field:
    return pa.field(name, dtype, nullable=nullable, metadata={"unit": unit, "meaning": meaning})


_KEYS = [
    _field("episode", pa.int32(), "1", "number of the episode, unique in the dataset"),
    _field("vehicle", pa.int16(), "1", "number of the vehicle in its episode, in order of appearance"),
]

TRAJECTORY_SCHEMA = pa.schema(
    [
        *_KEYS,
        _field("time_s", pa.float32(), "s", "since the episode's start"),
        _field("route", pa.dictionary(pa.int8(), pa.string()), "1", "name of the route in the scene"),
        _field("position_m", pa.float32(), "m", "front bumper's distance along the route"),
        _field("speed_mps", pa.float32(), "m/s", "over the last step; at appearance the insertion speed"),
        _field("acceleration_mps2", pa.float32(), "m/s2", "over the last step; null at appearance", nullable=True),
        _field("leader", pa.int16(), "1", "vehicle ahead on the route; null if none", nullable=True),
        _field("gap_m", pa.float32(), "m", "bumper to bumper to the leader; null if none", nullable=True),
    ]
)

DRIVER_SCHEMA = pa.schema(
    [
        *_KEYS,
        _field("trait", pa.dictionary(pa.int16(), pa.string()), "1", "the label: conservative or aggressive"),
        _field("vtype", pa.string(), "1", "SUMO vType"),
        _field("desired_speed_mps", pa.float32(), "m/s", "IDM v0"),
        _field("min_gap_m", pa.float32(), "m", "IDM minGap"),
        _field("tau_s", pa.float32(), "s", "IDM desired time headway"),
    ]
)


@dataclass(frozen=True, kw_only=True)
class Manifest:
    """Contents of a dataset and the settings that it was recorded with, in ``manifest.json``."""

    kind: str = "dataset"
    schema_version: int = SCHEMA_VERSION
    scene: str
    scene_digest: str
    scene_settings: dict[str, Any] | None = None  # of a scene that differs from its base
    windows: _Count
    p_conservative: Mix | None  # None: the traffic of a SUMO configuration
    population: str | dict[str, Any] | tuple[str, ...]  # name, profiles, or the vTypes of a SUMO configuration
    seed: TrafficSeed
    window_steps: int = WINDOW_STEPS
    no_leader_gap_m: float = NO_LEADER_GAP_M
    rows: _Count
    drivers: _Count
    shards: Annotated[int, Range(0, 1_000_000)]
    versions: dict[str, str] | None = None
    sha256: dict[str, str] | None = None  # of the tables' files
    windows_asked_for: _Count | None = None
    episodes: _Count | None = None
    episode_s: float | None = None

    @property
    def profiles(self) -> tuple[DriverProfile, ...] | None:
        """The profiles of a scene's drivers; None for the vTypes of a SUMO configuration."""
        if isinstance(self.population, tuple):
            return None
        return read_population(self.population, ("population",)).profiles

    @property
    def traits(self) -> tuple[str, ...]:
        """The drivers' labels by their numbers: names of profiles or vTypes."""
        return tuple(self.population) if self.profiles is None else tuple(profile.name for profile in self.profiles)

    def content(self) -> dict[str, Any]:
        """Return what the file contains: all fields but optional ones without a value."""
        values = {field.name: plain(getattr(self, field.name)) for field in fields(self)}
        return {
            field.name: values[field.name]
            for field in fields(self)
            if values[field.name] is not None or is_required(field)
        }


def read_manifest(folder: Path) -> Manifest:
    """Return the manifest of a dataset; entries that this version does not know are left out.

    Raises:
        InputError: there is none, it is damaged, or the dataset has another schema version.
    """
    found = read_json(folder / MANIFEST, "dataset")
    version = found.get("schema_version")
    if version != SCHEMA_VERSION:
        raise InputError(
            f"{folder} has dataset schema version {version}, this tint_sumo reads {SCHEMA_VERSION}; record it anew"
        )
    try:
        manifest: Manifest = build(
            Manifest, {field.name: found[field.name] for field in fields(Manifest) if field.name in found}
        )
    except FieldError as error:
        raise InputError(f"{folder / MANIFEST} is damaged ({error}); record the dataset anew") from None
    return manifest


def shard_path(part: str, shard: int) -> str:
    """Return a shard's file, relative to the dataset's folder."""
    return f"{part}/shard-{shard:05d}.{_SUFFIX[part]}"


def shard_file(folder: Path, part: str, shard: int) -> Path:
    return folder / shard_path(part, shard)


def shard_number(file: PurePath) -> int:
    """Return the number of the shard in a path made by ``shard_file``."""
    return int(file.name.removeprefix("shard-").split(".")[0])


def read_shards(
    folder: Path, part: str, manifest: Manifest, columns: list[str] | None = None
) -> Iterator[pd.DataFrame]:
    """Yield the rows of a dataset's table, shard after shard.

    Raises:
        InputError: a file is missing or damaged, or there are more or fewer rows than in the manifest.
    """
    found, wanted = 0, manifest.rows if part == TRAJECTORIES else manifest.drivers
    for shard in range(manifest.shards):
        rows = read_shard(shard_file(folder, part, shard), columns)
        found += len(rows)
        yield rows
    if found != wanted:
        raise InputError(f"{folder / part} has {found} of {wanted} rows; repeat the command that recorded the dataset")


def read_shard(file: Path, columns: list[str] | None = None) -> pd.DataFrame:
    """Return the rows of one Parquet file.

    Raises:
        InputError: the file is missing or damaged.
    """
    with _mendable(file):
        texts = ["route", "trait"]  # once each
        rows = pd.read_parquet(file.absolute(), columns=columns, read_dictionary=texts)
    _require_numbers(file, rows)
    return rows


def _require_numbers(file: Path, rows: pd.DataFrame) -> None:
    """Raise InputError if a column holds no numbers where it must, or a number that is not finite."""
    for field in (*TRAJECTORY_SCHEMA, *DRIVER_SCHEMA):
        if field.name not in rows.columns or not (pa.types.is_floating(field.type) or pa.types.is_integer(field.type)):
            continue
        column = rows[field.name]
        if not pd.api.types.is_numeric_dtype(column) or pd.api.types.is_bool_dtype(column):
            raise InputError(f"{file} has other values than numbers in {field.name}; record the dataset anew")
        values = column.to_numpy(np.float64, na_value=np.nan)
        if np.isinf(values).any() or (not field.nullable and np.isnan(values).any()):
            raise InputError(f"{file} has values in {field.name} that are not finite; record the dataset anew")


def verify(folder: Path, manifest: Manifest) -> int:
    """Compare the files of a dataset with the checksums in its manifest.

    Returns:
        The number of files.

    Raises:
        InputError: a file is missing or another one, or the manifest has no checksums.
    """
    checksums = manifest.sha256
    if not checksums:
        raise InputError(f"{folder / MANIFEST} has no checksums (an earlier version recorded it); record it anew")
    for shard in range(manifest.shards):
        for table in TABLES:
            file = shard_file(folder, table, shard)
            with _mendable(file), file.open("rb") as content:
                digest = hashlib.file_digest(content, "sha256").hexdigest()
            if checksums.get(shard_path(table, shard)) != digest:
                raise InputError(f"{file} is not as it was recorded; remove it and repeat the command that recorded it")
    return len(TABLES) * manifest.shards


def read_shard_metadata(file: Path) -> pq.FileMetaData:
    """Return the number of rows and the file's key-value metadata.

    Raises:
        InputError: the file is missing or damaged.
    """
    with _mendable(file):
        return pq.read_metadata(file.absolute())


def require_table(file: Path, what: str) -> None:
    """Check a Parquet file before all of it is read into memory.

    Raises:
        InputError: it is no regular file, or has absurdly more rows or bytes, as its metadata say, than its size.
        ValueError or OSError: it is damaged.
    """
    require_file(file, what, TABLE_BYTES)
    metadata = pq.read_metadata(file.absolute())  # Arrow takes a relative path such as run:1/a.parquet for a URL
    groups = (metadata.row_group(index) for index in range(metadata.num_row_groups))
    encoded_bytes = sum(group.total_byte_size for group in groups)
    numbers_bytes = metadata.num_rows * metadata.num_columns * np.dtype(np.float64).itemsize
    require_unpacked_bytes(file, what, TABLE_BYTES, encoded_bytes + numbers_bytes)


@contextmanager
def _mendable(file: Path) -> Iterator[None]:
    try:
        for shard in file.glob("shard-*.parquet") if file.is_dir() else [file] if file.exists() else []:
            require_table(shard, "shard of a dataset")
        yield
    except InputError:
        raise
    except FileNotFoundError:
        raise InputError(f"{file} is missing; repeat the command that recorded the dataset") from None
    except (OSError, ValueError, KeyError) as error:  # pyarrow's errors derive from these
        reason = str(error).splitlines()[0]
        raise InputError(
            f"{file} is damaged ({reason}); remove it and repeat the command that recorded the dataset"
        ) from None
