"""Reads SUMO's floating-car data of any run: XML, CSV and Parquet, the first two gzipped or not.

SUMO chooses the format by the file's name or by ``--output.format``; here the content says which it is. SUMO's other
options do not matter either: the separator and the header of CSV, times for humans, precision, and attributes beside
those that are needed. The rows are the same, in the same order, whatever the format is, but for decimals: Parquet has
more of them than XML and CSV.

Format: https://sumo.dlr.de/docs/Simulation/Output/FCDOutput.html, https://sumo.dlr.de/docs/TabularOutputs.html
"""

import gzip
import re
import zlib
from array import array
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import IO, Any
from xml.parsers import expat

import numpy as np
import pandas as pd
import pyarrow as pa
import pyarrow.csv
import pyarrow.parquet as pq
from numpy.typing import NDArray
from sumolib.miscutils import parseTime

from tint_sumo.core.errors import InputError
from tint_sumo.core.reading import TABLE_BYTES, open_file, require_file, unpacked
from tint_sumo.dataset.schema import require_table

_ROLE = "floating-car data"
_AGAIN = "write it again with sumo --fcd-output"
_HEAD_BYTES = 4096  # of a file, from which its format is recognised
_PARQUET_MAGIC = b"PAR1"
_TIME = "time"
_ELEMENTS = ("vehicle_", "", "person_", "container_")  # headers have the name of the first row's element, or none
_PERSON_TYPES = ("DEFAULT_PEDTYPE", "DEFAULT_CONTAINERTYPE")
# SUMO's usual attributes in its order, and those in networks with heights: names of the columns where they have none.
_USUAL = ("time", "id", "x", "y", "angle", "type", "speed", "pos", "lane", "edge", "slope")
_WITH_HEIGHT = (*_USUAL[:4], "z", *_USUAL[4:])
_FIRST_NAME = re.compile(r'"?\w+"?([^\w"])')  # and the separator behind it
_SLOW = 1e-3  # positions that change so much less than speeds say are degrees
_DEGREE_M = 111_320.0  # a degree of latitude
_NEAR_M = 5.0  # two positions along a lane between which it is straight enough
_BESIDE_M = 2.0  # to the side of a lane's middle: more than half of a wide lane, less than to a parking place beside it


@dataclass(frozen=True)
class FcdColumns:
    """Columns to read, with SUMO's names of the vehicles' attributes."""

    numbers: Mapping[str, str]  # attribute: name of the column
    ids: Mapping[str, str]
    optional: frozenset[str] = frozenset()  # attributes that a file may lack

    @property
    def names(self) -> Mapping[str, str]:
        """Names of the columns by their attributes, in the order of the answer."""
        return {_TIME: "time_s", **self.ids, **self.numbers}

    def found_in(self, attributes: Iterable[str], where: str) -> "FcdColumns":
        """Return these columns without the optional ones that a file with these attributes lacks.

        Raises:
            InputError: it lacks others.
        """
        given = {_TIME, *attributes}
        missing = [attribute for attribute in self.names if attribute not in given | self.optional]
        if missing:
            raise InputError(
                f"{where} lacks {', '.join(map(repr, missing))}; run SUMO without --fcd-output.attributes and --mesosim"
            )
        numbers, ids = (
            {attribute: name for attribute, name in group.items() if attribute in given}
            for group in (self.numbers, self.ids)
        )
        return FcdColumns(numbers, ids)


ON_LANES = FcdColumns(
    {"pos": "pos_m", "speed": "speed_mps", "x": "x", "y": "y"},
    {"id": "vehicle", "lane": "lane", "type": "vehicle_class"},
    optional=frozenset({"x", "y", "type"}),
)
POSES = FcdColumns(
    {"x": "x", "y": "y", "angle": "angle_deg", "speed": "speed_mps"}, {"id": "vehicle", "type": "vehicle_class"}
)


def read_fcd(file: Path, columns: FcdColumns = ON_LANES) -> pd.DataFrame:
    """Return the columns time_s and those asked for, by time and vehicle; persons and containers are left out.

    Ids are categories, vehicles in order of appearance; pos_m is that of the front along the lane; x and y are metres,
    or degrees with ``--fcd-output.geo``. XML is read in a stream: memory grows by some 50 bytes for each vehicle and
    timestep.

    Raises:
        InputError: no such file, a damaged one or none with floating-car data, a vehicle lacks an attribute, or there
            is no vehicle.
    """
    require_file(file, _ROLE, TABLE_BYTES)
    try:
        rows = _READERS[_format(file)](file, columns)
    except InputError:
        raise
    except expat.ExpatError as error:
        raise InputError(f"{file} is not whole XML ({error}); {_AGAIN}") from None
    except (EOFError, gzip.BadGzipFile, zlib.error, ValueError, KeyError) as error:  # pyarrow's are ValueErrors
        raise InputError(f"{file} is damaged ({str(error).splitlines()[0]}); {_AGAIN}") from None
    if rows.empty:
        raise InputError(f"{file} has no vehicles; write it again with traffic in it")
    if rows.isna().any(axis=None) or np.isinf(rows.select_dtypes("number")).any(axis=None):
        attributes = ", ".join(attribute for attribute, name in columns.names.items() if name in rows)
        raise InputError(f"{file} has a vehicle without one of {attributes}; {_AGAIN}")
    return _ordered(rows, [name for name in columns.ids.values() if name in rows])


def is_fcd_table(first_line: str) -> bool:
    """Return whether the first line of a table names the attributes of floating-car data."""
    named = _named(first_line)
    return named is not None and {_TIME, "id", "speed"} <= _positions(named[1]).keys()


def is_geographic(rows: pd.DataFrame) -> bool:
    """Return whether x and y are degrees: they change by far less than the speeds say."""
    steps = rows.sort_values(["vehicle", "time_s"]).groupby("vehicle", observed=True)
    moved = np.hypot(steps["x"].diff(), steps["y"].diff()).sum()
    driven_m = (steps["speed_mps"].shift() * steps["time_s"].diff()).sum()
    return bool(moved < _SLOW * driven_m)


def are_parked(rows: pd.DataFrame) -> NDArray[np.bool_]:
    """Return which vehicles are parked beside their lane, (M,); none if the rows have no x and y.

    SUMO gives such a vehicle the lane and the position at which it left the road. It stands, and it is farther to the
    side of the nearest point of the lane that some vehicle drives over than half a lane is wide.

    Args:
        rows: columns time_s, vehicle, lane, pos_m, speed_mps, x and y as ``read_fcd`` gives them.
    """
    parked = np.zeros(len(rows), bool)
    stands = _stand(rows)
    if "x" not in rows or stands.all() or not stands.any():
        return parked
    x_m, y_m = rows["x"].to_numpy(), rows["y"].to_numpy()
    if is_geographic(rows):
        x_m, y_m = x_m * _DEGREE_M * np.cos(np.radians(y_m.mean())), y_m * _DEGREE_M
    lane, pos_m = rows["lane"].cat.codes.to_numpy(np.int64), rows["pos_m"].to_numpy()
    along = lane * (2.0 * pos_m.max() + 1.0) + pos_m  # lanes one behind the other
    driven = np.flatnonzero(~stands)[np.argsort(along[~stands], kind="stable")]
    standing = np.flatnonzero(stands)
    after = np.searchsorted(along[driven], along[standing])
    before, after = driven[(after - 1).clip(min=0)], driven[after.clip(max=len(driven) - 1)]
    is_before = np.abs(along[before] - along[standing]) < np.abs(along[after] - along[standing])
    nearest = np.where(is_before, before, after)
    ahead_m = np.abs(pos_m[nearest] - pos_m[standing])
    apart_m = np.hypot(x_m[nearest] - x_m[standing], y_m[nearest] - y_m[standing])
    beside_m = np.sqrt((apart_m**2 - ahead_m**2).clip(min=0.0))
    known = (lane[nearest] == lane[standing]) & (ahead_m < _NEAR_M)
    parked[standing] = known & (beside_m > _BESIDE_M)
    return parked


def _stand(rows: pd.DataFrame) -> NDArray[np.bool_]:
    """Return which vehicles stand, (M,), with the row before: there SUMO has the speed at which a vehicle arrived."""
    vehicle = rows["vehicle"].cat.codes.to_numpy()
    order = np.lexsort((rows["time_s"], vehicle))
    stands = (rows["speed_mps"].to_numpy() == 0.0)[order]
    stands[:-1] |= stands[1:] & (np.diff(vehicle[order]) == 0)
    found = np.zeros(len(rows), bool)
    found[order] = stands
    return found


def _format(file: Path) -> str:
    """Return the format of a file's content; that of its name where the content is of none."""
    try:
        with open_file(file, _ROLE, TABLE_BYTES) as raw:
            head = unpacked(raw).read(_HEAD_BYTES)
    except (EOFError, OSError, zlib.error):
        head = b""
    if head.startswith(_PARQUET_MAGIC) or file.suffix == ".parquet":
        return "parquet"
    text = head.decode("utf-8-sig", "replace").lstrip()
    if text.startswith("<"):
        return "xml"
    return "csv" if ".csv" in file.suffixes or is_fcd_table(text.partition("\n")[0]) else "xml"


def _ordered(rows: pd.DataFrame, ids: Sequence[str]) -> pd.DataFrame:
    """Return rows by time and vehicle; categories are sorted, those of vehicles in order of appearance."""
    for name in ids:
        used = rows[name].cat.remove_unused_categories()
        rows[name] = used.cat.set_categories(pd.Index(sorted(used.cat.categories), dtype=object))
    rows = rows.iloc[np.lexsort((rows["vehicle"].cat.codes, rows["time_s"]))].reset_index(drop=True)
    vehicles = rows["vehicle"].cat
    rows["vehicle"] = vehicles.reorder_categories(vehicles.categories[vehicles.codes.unique()])
    return rows


def _times_s(texts: Iterable[str]) -> NDArray[np.float64]:
    """Return times that SUMO writes, in seconds or as [days:]hours:minutes:seconds; ValueError if one is neither."""
    return np.array([np.nan if (time_s := parseTime(text)) is None else time_s for text in texts], np.float64)


# Tables


def _read_csv(file: Path, columns: FcdColumns) -> pd.DataFrame:
    with file.open("rb") as raw:
        named = _named(unpacked(raw).readline(_HEAD_BYTES).decode("utf-8-sig", "replace"))
    if named is None:  # of --output.column-header none SUMO 1.28 makes a file of empty lines
        raise InputError(
            f"{file} names no time in its first line; give what sumo --fcd-output wrote, with SUMO's usual "
            "--output.column-header and --output.column-separator"
        )
    separator, names = named
    position = _positions(names)
    found = columns.found_in(position, str(file))
    wanted = _wanted(found, position)
    text = pa.dictionary(pa.int32(), pa.string())
    types = {str(position[attribute]): pa.float64() if attribute in found.numbers else text for attribute in wanted}
    with file.open("rb") as raw:
        table = pyarrow.csv.read_csv(
            unpacked(raw),
            pyarrow.csv.ReadOptions(column_names=[str(number) for number in range(len(names))], skip_rows=1),
            pyarrow.csv.ParseOptions(delimiter=separator),
            pyarrow.csv.ConvertOptions(
                column_types=types, include_columns=list(types), null_values=[""], strings_can_be_null=True
            ),
        )
    return _vehicles_of(table.rename_columns(wanted), found, file)


def _named(line: str) -> tuple[str, Sequence[str]] | None:
    """Return the separator and the names of a header; None if this line is none."""
    first = _FIRST_NAME.match(line.strip())
    if first is None:
        return None
    names = [name.strip().strip('"') for name in line.strip().split(first[1])]
    return (first[1], names) if {"timestep_time", _TIME} & set(names) else None


def _read_parquet(file: Path, columns: FcdColumns) -> pd.DataFrame:
    require_table(file, _ROLE)
    schema = pq.read_schema(file.absolute())
    is_nameless = not any(schema.names)  # --output.column-header none
    usual = (names for names in (_USUAL, _WITH_HEIGHT) if len(names) == len(schema.names))
    position = _positions(next(usual, ()) if is_nameless else schema.names)
    found = columns.found_in(position, str(file))
    wanted = _wanted(found, position)
    numbers = [position[attribute] for attribute in wanted]
    texts = [schema.names[number] for number in numbers if pa.types.is_string(schema.field(number).type)]
    with pq.ParquetFile(file.absolute(), read_dictionary=texts) as content:  # each id is in memory once
        if is_nameless:
            table = content.read().select(numbers)
        else:
            names = [schema.names[number] for number in numbers]
            table = content.read(names).select(names)
    return _vehicles_of(table.rename_columns(wanted), found, file)


def _positions(names: Sequence[str]) -> dict[str, int]:
    """Return the number of the column of each attribute."""
    found: dict[str, int] = {}
    for element in reversed(_ELEMENTS):
        for number, name in enumerate(names):
            if name.startswith(element):
                found[name.removeprefix(element)] = number
    if "timestep_time" in names:
        found[_TIME] = names.index("timestep_time")
    return found


def _wanted(columns: FcdColumns, position: Mapping[str, int]) -> list[str]:
    """Return the attributes to read: those asked for, and those that tell vehicles from persons."""
    return list(dict.fromkeys([*columns.names, *(name for name in ("tag", "lane", "type") if name in position)]))


def _vehicles_of(table: pa.Table, columns: FcdColumns, file: Path) -> pd.DataFrame:
    """Return the rows of vehicles, of a table whose columns are attributes."""
    for number, name in enumerate(table.column_names):
        if pa.types.is_string(table.schema.field(number).type):
            table = table.set_column(number, name, table.column(number).dictionary_encode())
    rows = table.to_pandas()
    rows = rows[rows["id"].notna()]  # an empty timestep can have a row, too
    vehicles = rows[_are_vehicles(rows)]
    if len(rows) and vehicles.empty:
        raise InputError(f"{file} has no vehicle on a lane; {_AGAIN} with traffic in it, and not with --mesosim")
    if isinstance(vehicles[_TIME].dtype, pd.CategoricalDtype):
        times = vehicles[_TIME].cat
        vehicles = vehicles.assign(**{_TIME: np.append(_times_s(times.categories), np.nan)[times.codes]})
    kinds = {name: "float64" if name in (_TIME, *columns.numbers) else "category" for name in columns.names}
    found: pd.DataFrame = vehicles.astype(kinds)[list(columns.names)]
    return found.rename(columns=dict(columns.names))


def _are_vehicles(rows: pd.DataFrame) -> pd.Series:
    """Return which rows are vehicles: tables have persons and containers in the same columns, but on no lane."""
    if "lane" in rows:
        return rows["lane"].notna()
    if "tag" in rows:
        return rows["tag"] == "vehicle"
    return ~rows["type"].isin(_PERSON_TYPES) if "type" in rows else rows["id"].notna()


# XML


def _read_xml(file: Path, columns: FcdColumns) -> pd.DataFrame:
    reader = _XmlReader(file, columns)
    with file.open("rb") as raw:
        reader.read(unpacked(raw))
    return reader.rows()


class _XmlReader:
    """Reader of XML that keeps numbers, and each id of a vehicle, type or lane once."""

    def __init__(self, file: Path, columns: FcdColumns) -> None:
        self._file = file
        self._wanted = columns
        self._columns: FcdColumns | None = None  # as the first vehicle has them
        self._parser = expat.ParserCreate()
        self._parser.StartElementHandler = self._check_root
        self._time_s = np.nan
        self._times_s = array("d")
        self._numbers = {attribute: array("d") for attribute in columns.numbers}
        self._codes = {attribute: array("i") for attribute in columns.ids}
        self._ids: dict[str, dict[str, int]] = {attribute: {} for attribute in columns.ids}

    def read(self, stream: IO[bytes]) -> None:
        self._parser.ParseFile(stream)

    def rows(self) -> pd.DataFrame:
        rows: dict[str, Any] = {"time_s": np.asarray(self._times_s)}
        columns = self._columns or self._wanted
        for attribute, name in columns.ids.items():
            known = pd.Index(list(self._ids[attribute]), dtype=object)
            rows[name] = pd.Categorical.from_codes(np.asarray(self._codes[attribute]), known)
        for attribute, name in columns.numbers.items():
            rows[name] = np.asarray(self._numbers[attribute])
        return pd.DataFrame(rows)

    def _check_root(self, name: str, _: Mapping[str, str]) -> None:
        if name != "fcd-export":
            raise InputError(f"{self._file} holds <{name}>, not <fcd-export>; give what sumo --fcd-output wrote")
        self._parser.StartElementHandler = self._start

    def _start(self, name: str, attributes: Mapping[str, str]) -> None:
        try:
            if name == "timestep":
                self._time_s = float(_times_s([attributes["time"]])[0])
            elif name == "vehicle":
                self._append(attributes)
        except KeyError as missing:
            raise InputError(f"{self._here()} lacks {missing}; {_AGAIN}") from None
        except ValueError as error:
            raise InputError(f"{self._here()} is damaged ({error}); {_AGAIN}") from None

    def _append(self, attributes: Mapping[str, str]) -> None:
        if self._columns is None:
            self._columns = self._wanted.found_in(attributes, self._here())
        values = {attribute: float(attributes[attribute]) for attribute in self._columns.numbers}
        texts = {attribute: attributes[attribute] for attribute in self._columns.ids}
        self._times_s.append(self._time_s)
        for attribute, value in values.items():
            self._numbers[attribute].append(value)
        for attribute, text in texts.items():
            ids = self._ids[attribute]
            self._codes[attribute].append(ids.setdefault(text, len(ids)))

    def _here(self) -> str:
        return f"{self._file}, line {self._parser.CurrentLineNumber}"


_READERS = {"csv": _read_csv, "parquet": _read_parquet, "xml": _read_xml}
