"""SUMO's floating-car data as rows, whatever wrote them: one per vehicle and timestep.

``sumo --fcd-output FILE`` writes XML, CSV or Parquet by the suffix of FILE, the first two gzipped if it ends in .gz.
Format: https://sumo.dlr.de/docs/Simulation/Output/FCDOutput.html
"""

import gzip
import zlib
from array import array
from collections.abc import Mapping
from pathlib import Path
from typing import IO, Literal, cast
from xml.parsers import expat

import numpy as np
import pandas as pd

from tint_sumo.core.errors import InputError
from tint_sumo.core.reading import TABLE_BYTES, is_gzipped, require_file

_NAMES = {  # names of the columns in SUMO's tables
    "timestep_time": "time_s",
    "vehicle_id": "vehicle",
    "vehicle_lane": "lane",
    "vehicle_pos": "pos_m",
    "vehicle_speed": "speed_mps",
}
_NUMBERS = ["time_s", "pos_m", "speed_mps"]
_IDS = ["vehicle", "lane"]
_AGAIN = "write it again with sumo --fcd-output"


def read_fcd(file: Path) -> pd.DataFrame:
    """Columns time_s, vehicle and lane (categories), pos_m (of the front, along the lane) and speed_mps.

    XML is read in a stream: memory grows by 40 bytes for each vehicle and timestep. Persons are left out.

    Raises:
        InputError: no such file, a damaged one or none with floating-car data, a vehicle lacks an attribute, or there
            is no vehicle.
    """
    require_file(file, "floating-car data", TABLE_BYTES)
    try:
        rows = _read_table(file) if {".csv", ".parquet"} & set(file.suffixes) else _read_xml(file)
    except InputError:
        raise
    except expat.ExpatError as error:
        raise InputError(f"{file} is not whole XML ({error}); {_AGAIN}") from None
    except (EOFError, gzip.BadGzipFile, zlib.error, ValueError, KeyError) as error:  # pyarrow's are ValueErrors
        raise InputError(f"{file} is damaged ({str(error).splitlines()[0]}); {_AGAIN}") from None
    if rows.empty:
        raise InputError(f"{file} has no vehicles; write it again with traffic in it")
    if rows.isna().any(axis=None) or np.isinf(rows[_NUMBERS]).any(axis=None):
        raise InputError(f"{file} has a vehicle without time, lane, pos or speed; {_AGAIN}")
    return rows


def _read_table(file: Path) -> pd.DataFrame:
    if file.suffix == ".parquet":
        rows = pd.read_parquet(file, columns=list(_NAMES))
    else:
        with file.open("rb") as raw:
            packing: Literal["gzip"] | None = "gzip" if is_gzipped(raw) else None  # pandas knows others, too
            ids = {"vehicle_id": str, "vehicle_lane": str}
            rows = pd.read_csv(raw, sep=";", usecols=list(_NAMES), dtype=ids, compression=packing)
    rows = rows.rename(columns=_NAMES)[list(_NAMES.values())]
    rows = rows[rows["vehicle"].notna()]  # an empty timestep is a row of its own
    kinds = {**dict.fromkeys(_NUMBERS, "float64"), **dict.fromkeys(_IDS, "category")}
    return rows.astype(kinds).reset_index(drop=True)


def _read_xml(file: Path) -> pd.DataFrame:
    reader = _XmlReader(file)
    with file.open("rb") as raw:
        reader.read(cast("IO[bytes]", gzip.GzipFile(fileobj=raw)) if is_gzipped(raw) else raw)
    return reader.rows()


class _XmlReader:
    """Keeps numbers only; ids of vehicles and lanes once each."""

    def __init__(self, file: Path) -> None:
        self._file = file
        self._parser = expat.ParserCreate()
        self._parser.StartElementHandler = self._check_root
        self._time_s = np.nan
        self._numbers = {name: array("d") for name in _NUMBERS}
        self._codes = {name: array("l") for name in _IDS}
        self._ids: dict[str, dict[str, int]] = {name: {} for name in _IDS}

    def read(self, stream: IO[bytes]) -> None:
        self._parser.ParseFile(stream)

    def rows(self) -> pd.DataFrame:
        categories = {
            name: pd.Categorical.from_codes(np.asarray(codes), pd.Index(list(self._ids[name]), dtype=object))
            for name, codes in self._codes.items()
        }
        numbers = {name: np.asarray(values) for name, values in self._numbers.items()}
        return pd.DataFrame({**numbers, **categories})[list(_NAMES.values())]

    def _check_root(self, name: str, _: Mapping[str, str]) -> None:
        if name != "fcd-export":
            raise InputError(f"{self._file} holds <{name}>, not <fcd-export>; give what sumo --fcd-output wrote")
        self._parser.StartElementHandler = self._start

    def _start(self, name: str, attributes: Mapping[str, str]) -> None:
        try:
            if name == "timestep":
                self._time_s = float(attributes["time"])
            elif name == "vehicle":
                self._append(attributes)
        except KeyError as missing:
            raise InputError(
                f"{self._here()} lacks {missing}; write the file without --fcd-output.attributes"
            ) from None
        except ValueError as error:
            raise InputError(f"{self._here()} is damaged ({error}); {_AGAIN}") from None

    def _append(self, attributes: Mapping[str, str]) -> None:
        numbers = (self._time_s, float(attributes["pos"]), float(attributes["speed"]))
        for name, number in zip(_NUMBERS, numbers, strict=True):
            self._numbers[name].append(number)
        for name, text in zip(_IDS, (attributes["id"], attributes["lane"]), strict=True):
            ids = self._ids[name]
            self._codes[name].append(ids.setdefault(text, len(ids)))

    def _here(self) -> str:
        return f"{self._file}, line {self._parser.CurrentLineNumber}"
