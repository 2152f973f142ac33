"""Table of recorded tracks: the same columns, units and frame for every file format.

Positions are those of the centres of the vehicles' boxes, in a plane with x to the right and y to the left of it, so
that headings grow counter-clockwise.
"""

import math
import re
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pyarrow as pa
from numpy.typing import NDArray

from tint_sumo.core.compiling import compiled
from tint_sumo.core.errors import InputError


def _field(name: str, dtype: pa.DataType, unit: str, meaning: str) -> pa.Field:
    return pa.field(name, dtype, nullable=False, metadata={"unit": unit, "meaning": meaning})


TRACK_SCHEMA = pa.schema(
    [
        _field(
            "recording", pa.dictionary(pa.int32(), pa.string()), "1", "name of the recording, with times of its own"
        ),
        _field("vehicle", pa.dictionary(pa.int32(), pa.string()), "1", "id of the vehicle, unique in its recording"),
        _field("time_s", pa.float64(), "s", "time in the recording, rising along each track"),
        _field("x_m", pa.float64(), "m", "centre of the vehicle's box"),
        _field("y_m", pa.float64(), "m", "centre of the vehicle's box"),
        _field("heading_rad", pa.float64(), "rad", "direction, counter-clockwise from the x axis, -pi to pi"),
        _field("speed_mps", pa.float64(), "m/s", "speed, never negative"),
        _field("length_m", pa.float64(), "m", "length of the box"),
        _field("width_m", pa.float64(), "m", "width of the box"),
        _field("vehicle_class", pa.dictionary(pa.int32(), pa.string()), "1", "class as the file names it"),
    ]
)
COLUMNS: tuple[str, ...] = tuple(TRACK_SCHEMA.names)
KEYS = ["recording", "vehicle", "time_s"]
_TEXTS = [field.name for field in TRACK_SCHEMA if pa.types.is_dictionary(field.type)]
_NUMBERS = [name for name in COLUMNS if name not in _TEXTS]
_ON_FOOT = re.compile("pedestrian|bicycle|cyclist|person|animal|wheelchair")
UNKNOWN = "unknown"  # class of vehicles where a file names none
_MOST = 1e12  # of any number: beyond all times since 1970 in seconds, and all positions on Earth in metres
MOVED_M = 0.5  # a heading is derived from positions that lie so far apart, or it would follow the noise


@dataclass(frozen=True)
class Tracks:
    """Recorded tracks and the file they come from.

    ``table`` has the columns of ``TRACK_SCHEMA``, sorted by recording, vehicle and time, each of these once.
    """

    file: Path
    format: str  # name of the file format
    table: pd.DataFrame
    crs: str | None = None  # coordinate reference system of the positions, if they lie on Earth

    @property
    def track_number(self) -> NDArray[np.int64]:
        """Return the number of each row's track, rising from 0 along the table; (rows,)."""
        groups = self.table.groupby(["recording", "vehicle"], observed=True, sort=False)
        return np.asarray(groups.ngroup(), np.int64)


def build_tracks(file: Path, format_name: str, columns: Mapping[str, Any]) -> Tracks:
    """Check and sort what a reader found in a file.

    Args:
        file: for messages.
        format_name: name of the file's format.
        columns: values by the names of ``TRACK_SCHEMA``; single ones stand for all rows. ``crs`` may be among them.

    Raises:
        InputError: there is no vehicle, a value is missing, not finite or absurdly large, a box has no size, or a
            vehicle is twice at one time.
    """
    table = pd.DataFrame({name: columns[name] for name in COLUMNS})
    if table.empty:
        raise InputError(f"{file} has no vehicles; give a recording of traffic")
    table[_NUMBERS] = table[_NUMBERS].astype("float64")
    table[_TEXTS] = table[_TEXTS].astype(str).astype("category")
    for name in ("recording", "vehicle"):
        if "" in table[name].cat.categories:
            raise InputError(f"{file} has {sum(table[name] == ''):,} rows without a {name}; remove them, or fill them")
    for name in _NUMBERS:
        values = table[name].to_numpy()
        bad = ~(np.abs(values) <= _MOST)  # NaN, too
        if name in ("length_m", "width_m"):
            bad |= values <= 0.0
        if bad.any():
            problem = f"{name} is {values[bad][0]:g} for {_first(table, bad)}"
            raise InputError(f"{file}: {problem}; remove such rows, or correct them")
    table["speed_mps"] = table["speed_mps"].abs()
    table["heading_rad"] = (table["heading_rad"] + np.pi) % (2.0 * np.pi) - np.pi
    table = table.sort_values(KEYS, kind="stable", ignore_index=True)
    twice = table.duplicated(KEYS).to_numpy()
    if twice.any():
        raise InputError(
            f"{file} has {_first(table, twice)} more than once, {twice.sum():,} rows in all; keep one row for each "
            "vehicle and time"
        )
    return Tracks(file, format_name, table, columns.get("crs"))


def _first(table: pd.DataFrame, rows: NDArray[np.bool_]) -> str:
    """Return vehicle and time of the first of some rows, for messages."""
    row = table.iloc[int(np.flatnonzero(rows)[0])]
    return f"vehicle {row['vehicle']} at {row['time_s']:.10g} s"


def is_on_foot(vehicle_class: str) -> bool:
    """Return whether a class, as a file names it, is one that does not drive as cars do."""
    return bool(_ON_FOOT.search(vehicle_class.lower()))


def headings_of_motion(
    track: NDArray[np.int64], x_m: NDArray[np.float64], y_m: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Derive headings from positions, for formats without them.

    The heading of a row is the direction to the next position of its track that is at least half a metre away. Where
    there is none, as at the end of a track, the heading before is kept; a vehicle that never moves has heading 0.

    Args:
        track: (M,) numbers of the tracks, whose rows lie together and are sorted by time.
        x_m, y_m: (M,) positions.

    Returns:
        (M,) headings in radians.
    """
    heading_rad = np.zeros(len(track))
    _write_headings(track, x_m, y_m, heading_rad)
    return heading_rad


@compiled
def _write_headings(
    track: NDArray[np.int64], x_m: NDArray[np.float64], y_m: NDArray[np.float64], heading_rad: NDArray[np.float64]
) -> None:
    ahead = 0
    for row in range(len(track)):
        ahead = max(ahead, row)
        while (
            ahead < len(track)
            and track[ahead] == track[row]
            and math.hypot(x_m[ahead] - x_m[row], y_m[ahead] - y_m[row]) < MOVED_M
        ):
            ahead += 1
        if ahead < len(track) and track[ahead] == track[row]:
            heading_rad[row] = math.atan2(y_m[ahead] - y_m[row], x_m[ahead] - x_m[row])
        elif row > 0 and track[row - 1] == track[row]:
            heading_rad[row] = heading_rad[row - 1]
