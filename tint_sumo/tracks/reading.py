"""Finds the format of a file and reads its tracks. Each format is one module, imported in ``tint_sumo.tracks``."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from tint_sumo.core.errors import InputError, find_named
from tint_sumo.core.reading import TABLE_BYTES, open_file, require_file
from tint_sumo.tracks.schema import Tracks, build_tracks

_HEAD_BYTES = 4096  # of a file, from which its format is recognised
_ROLE = "tracks"


@dataclass(frozen=True)
class Head:
    """Beginning of a file, from which formats recognise it."""

    file: Path
    text: str

    @property
    def columns(self) -> frozenset[str]:
        """Names in the first line of a CSV file, in lower case."""
        first = self.text.lstrip("\ufeff").partition("\n")[0]
        return frozenset(name.strip().strip('"').lower() for name in first.split(","))


@dataclass(frozen=True)
class TrackFormat:
    """File format of recorded tracks."""

    name: str
    title: str  # for people
    recognises: Callable[[Head], bool]
    read: Callable[[Path], Mapping[str, Any]]  # columns of TRACK_SCHEMA; single values stand for all rows


FORMATS: dict[str, TrackFormat] = {}


def register(track_format: TrackFormat) -> None:
    """Make a format known.

    Raises:
        ValueError: the name is taken.
    """
    if track_format.name in FORMATS:
        raise ValueError(f"two formats of tracks are called {track_format.name!r}")
    FORMATS[track_format.name] = track_format


def read_tracks(file: Path, format_name: str | None = None) -> Tracks:
    """Read the tracks of a file.

    Args:
        file: of any format in ``FORMATS``.
        format_name: the format; recognised by the file's beginning if not given.

    Raises:
        InputError: there is no such file, its format is not known, it is damaged, or values are missing, not finite or
            given twice.
    """
    head = _head(file)
    if format_name is None:
        found = next((one for one in FORMATS.values() if one.recognises(head)), None)
        if found is None:
            known = "; ".join(one.title for one in FORMATS.values())
            raise InputError(f"{file} has the columns or elements of no known format of tracks: {known}")
    else:
        found = FORMATS[find_named("format", format_name, {name: name for name in FORMATS})]
    require_file(file, _ROLE, TABLE_BYTES)
    return build_tracks(file, found.name, found.read(file))


def _head(file: Path) -> Head:
    with open_file(file, _ROLE, TABLE_BYTES) as opened:
        return Head(file, opened.read(_HEAD_BYTES).decode("utf-8", "replace"))


def read_columns_of(file: Path) -> frozenset[str]:
    """Return the names of a CSV file's columns, in lower case.

    Raises:
        InputError: there is no such file.
    """
    return _head(file).columns


def read_csv(file: Path, numbers: Sequence[str], texts: Sequence[str] = ()) -> pd.DataFrame:
    """Read some columns of a CSV file, whatever the case of their names.

    Args:
        file: CSV file with a header line.
        numbers: names of columns with numbers.
        texts: names of columns with texts or ids, kept as they are written.

    Returns:
        these columns, called as they were asked for.

    Raises:
        InputError: the file is damaged, has no rows, lacks columns, or holds something else where a number belongs.
    """
    try:
        rows = pd.read_csv(file, dtype=str, encoding="utf-8-sig", skipinitialspace=True, na_filter=False)
    except (pd.errors.ParserError, pd.errors.EmptyDataError, UnicodeDecodeError, EOFError, OSError) as error:
        raise InputError(f"{file} is not a whole CSV file ({' '.join(str(error).split())}); get it again") from None
    names = {str(name).strip().lower(): name for name in rows.columns}
    wanted = [*numbers, *texts]
    missing = [name for name in wanted if name.lower() not in names]
    if missing:
        raise InputError(f"{file} lacks the column {', '.join(missing)}; give the file as it was published")
    table = pd.DataFrame({name: rows[names[name.lower()]] for name in wanted})
    for name in numbers:
        values = pd.to_numeric(table[name].str.replace(",", "", regex=False), errors="coerce")
        bad = np.flatnonzero(values.isna().to_numpy())
        if len(bad):
            found = table[name].iloc[bad[0]]
            raise InputError(f"{file}, line {bad[0] + 2}: {name} is {found!r}, not a number; mend it")
        table[name] = values
    return table
