"""Finds the format of a file and reads its tracks. Each format is one module, imported in ``tint_sumo.tracks``."""

import codecs
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import IO, Any

import numpy as np
import pandas as pd

from tint_sumo.core import reading
from tint_sumo.core.errors import InputError, find_named
from tint_sumo.core.reading import TABLE_BYTES, require_file
from tint_sumo.tracks.schema import Tracks, build_tracks

_HEAD_BYTES = 4096  # of a file, from which its format is recognised
_ROLE = "tracks"
_SEPARATORS = (",", ";", "\t")
_THOUSANDS = r"-?[1-9]\d{0,2}(,\d{3})+(\.\d*)?"  # a comma before other digits may be a decimal one


@dataclass(frozen=True)
class Head:
    """Beginning of a file, from which formats recognise it."""

    file: Path
    text: str

    @property
    def first_line(self) -> str:
        return next(iter(self.text.lstrip("\ufeff").splitlines()), "")

    @property
    def separator(self) -> str:
        """The separator of a CSV file: comma, semicolon or tab, whichever its first line has most of."""
        return max(_SEPARATORS, key=self.first_line.count)

    @property
    def columns(self) -> frozenset[str]:
        """Names in the first line of a CSV file, in lower case."""
        return frozenset(name.strip().strip('"').lower() for name in self.first_line.split(self.separator))


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
        InputError: there is no such file, its format is not known or not the only one that fits, it is damaged, or
            values are missing, not finite or given twice.
    """
    if format_name is None:
        fitting = formats_of(file)
        if not fitting:
            known = "; ".join(track_format.title for track_format in FORMATS.values())
            raise InputError(
                f"{file} has the columns or elements of no known format of tracks; give a file of one of these: {known}"
            )
        if len(fitting) > 1:
            names = ", ".join(track_format.name for track_format in fitting)
            raise InputError(f"{file} fits more than one format of tracks; choose the `format`: {names}")
        found = fitting[0]
    else:
        found = find_named("format", format_name, FORMATS)
    require_file(file, _ROLE, TABLE_BYTES)
    return build_tracks(file, found.name, found.read(file))


def formats_of(file: Path) -> list[TrackFormat]:
    """Return the formats that the beginning of a file fits.

    Raises:
        InputError: there is no such file, or it cannot be read.
    """
    head = _head(file)
    return [track_format for track_format in FORMATS.values() if track_format.recognises(head)]


@contextmanager
def opened(file: Path) -> Iterator[IO[bytes]]:
    """Open a file of tracks, gzipped or not.

    Raises:
        InputError: there is no such file, or it is damaged.
    """
    with reading.opened(file, _ROLE, TABLE_BYTES) as content:
        yield content


def recording_name(file: Path) -> str:
    """Return the name of a file without its suffix, and without .gz behind that."""
    return Path(file.name.removesuffix(".gz")).stem


def part_of(file: Path, part: pd.Series) -> pd.Series:
    """Return names of a file's parts, such as cases or runs, which other files number anew."""
    return f"{recording_name(file)}/" + part


def _head(file: Path) -> Head:
    with opened(file) as content:
        head = content.read(_HEAD_BYTES)
    if not head.strip(b"\xef\xbb\xbf \t\r\n"):
        raise InputError(f"{file} is empty; give a recording of traffic")
    if head.startswith((codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE)):
        raise InputError(f"{file} is text in UTF-16; save it in UTF-8")
    return Head(file, head.decode("utf-8", "replace"))


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
        texts: names of columns with texts or ids, kept as they are written but for spaces around them.

    Returns:
        these columns, called as they were asked for.

    Raises:
        InputError: the file is damaged, has no rows, lacks columns, or holds something else where a number belongs.
    """
    separator = _head(file).separator
    try:
        with opened(file) as content:
            rows = pd.read_csv(
                content, sep=separator, dtype=str, encoding="utf-8-sig", skipinitialspace=True, na_filter=False
            )
    except (pd.errors.ParserError, pd.errors.EmptyDataError, UnicodeDecodeError) as error:
        raise InputError(f"{file} is not a whole CSV file ({' '.join(str(error).split())}); get it again") from None
    if not isinstance(rows.index, pd.RangeIndex):  # pandas takes the first values for names of rows
        raise InputError(f"{file} has more values in its rows than names in its first line; add the missing names")
    names = {str(name).strip().lower(): name for name in reversed(rows.columns)}  # the first of those that are twice
    wanted = [*numbers, *texts]
    missing = [name for name in wanted if name.lower() not in names]
    if missing:
        raise InputError(f"{file} lacks the column {', '.join(missing)}; give the file as it was published")
    table = pd.DataFrame({name: rows[names[name.lower()]].str.strip() for name in wanted})
    for name in numbers:
        table[name] = _numbers(file, table[name], separator)
    return table


def _numbers(file: Path, texts: pd.Series, separator: str) -> pd.Series:
    """Return the numbers of a column, whose thousands may stand between commas where values do.

    Where values stand between semicolons or tabs, commas are likelier decimal ones.
    """
    values = pd.to_numeric(texts, errors="coerce")
    unread = values.isna()
    if unread.any() and separator == ",":
        grouped = texts[unread].where(texts[unread].str.fullmatch(_THOUSANDS), "")
        values[unread] = pd.to_numeric(grouped.str.replace(",", ""), errors="coerce")
    bad = np.flatnonzero(values.isna().to_numpy())
    if len(bad):
        found = texts.iloc[bad[0]]
        mend = "write decimals with points, not commas" if "," in found else "correct it"
        raise InputError(f"{file}, row {bad[0] + 1}: {texts.name} is {found!r}, not a number; {mend}")
    return values
