"""SUMO's floating-car data: recorded trajectories are written as such, and any run's are read.

``write_fcd`` writes what ``sumo --fcd-output FILE --fcd-output.acceleration`` writes of the same traffic in the network
that ``tint-sumo net`` builds, apart from three things. Episodes are runs that follow each other at full minutes, so
that time increases along a file and from file to file. Vehicle ids are ``EPISODE.VEHICLE``, unique in the dataset. And
the type is SUMO's default one for all: the drivers' vTypes would give the trait away; they are in ``drivers/`` with the
labels.

``read_fcd`` reads XML, CSV and Parquet, which ``sumo --fcd-output FILE`` writes by the suffix of FILE, the first two
gzipped if it ends in .gz.

Format: https://sumo.dlr.de/docs/Simulation/Output/FCDOutput.html
"""

import gzip
import zlib
from array import array
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import IO, Any
from xml.parsers import expat

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from tint_sumo.core.errors import InputError
from tint_sumo.core.files import whole_file
from tint_sumo.core.reading import TABLE_BYTES, require_file, unpacked
from tint_sumo.dataset.schema import require_table
from tint_sumo.scenes.geometry import new_boxes, place
from tint_sumo.scenes.layout import Layout

EPISODE_PERIOD_S = 60.0
VEHICLE_TYPE = "DEFAULT_VEHTYPE"
_AGAIN = "write it again with sumo --fcd-output"
_DECIMALS = 2  # SUMO's own precision
_GZIP_LEVEL = 6
_HEADER = """<?xml version="1.0" encoding="UTF-8"?>

<!-- Episode e of the dataset starts at e minutes; vehicles are EPISODE.VEHICLE; drivers/ holds their types. -->

<fcd-export xmlns:xsi="http://www.w3.org/2001/XMLSchema-instance" \
xsi:noNamespaceSchemaLocation="http://sumo.dlr.de/xsd/fcd_file.xsd">
"""


@dataclass(frozen=True)
class FcdColumns:
    """Columns to read, with SUMO's names of the vehicles' attributes in the order of the answer."""

    numbers: Mapping[str, str]  # attribute: name of the column
    ids: Mapping[str, str]

    @property
    def names(self) -> Mapping[str, str]:
        """Names of the columns by those in SUMO's tables."""
        attributes = {f"vehicle_{attribute}": name for attribute, name in {**self.ids, **self.numbers}.items()}
        return {"timestep_time": "time_s", **attributes}


ON_LANES = FcdColumns({"pos": "pos_m", "speed": "speed_mps"}, {"id": "vehicle", "lane": "lane"})
POSES = FcdColumns(
    {"x": "x", "y": "y", "angle": "angle_deg", "speed": "speed_mps"}, {"id": "vehicle", "type": "vehicle_class"}
)


def write_fcd(rows: pd.DataFrame, file: Path, layout: Layout) -> None:
    """Write rows of trajectories to a gzipped XML file; the same rows always give the same bytes."""
    with (
        whole_file(file) as partial,
        partial.open("wb") as raw,
        gzip.GzipFile("", "wb", _GZIP_LEVEL, raw, mtime=0) as xml,
    ):
        xml.write(_HEADER.encode())
        xml.writelines(timestep.encode() for timestep in _timesteps(rows, layout))
        xml.write(b"</fcd-export>\n")


def _timesteps(rows: pd.DataFrame, layout: Layout) -> Iterator[str]:
    rows = rows.sort_values(["episode", "time_s", "vehicle"], ignore_index=True)
    time_s = rows["episode"].to_numpy() * EPISODE_PERIOD_S + rows["time_s"].to_numpy(np.float64)
    time, vehicles = _decimals(time_s), _vehicles(rows, layout)
    starts = np.flatnonzero(np.r_[True, time[1:] != time[:-1]])
    for start, end in zip(starts, [*starts[1:], len(rows)], strict=True):
        yield f'    <timestep time="{time[start]}">\n{"".join(vehicles[start:end])}    </timestep>\n'


def _vehicles(rows: pd.DataFrame, layout: Layout) -> list[str]:
    """Return the element of each row."""
    names = [route.name for route in layout.scene.routes]
    route = rows["route"].cat.set_categories(names).cat.codes.to_numpy(np.int64)
    front_m = rows["position_m"].to_numpy(np.float64)
    starts_m = layout.lane_start_m
    stage = (front_m[:, None] > starts_m[route, 1:]).sum(axis=1)
    lanes = np.full(starts_m.shape, "", object)
    for number, path in enumerate(layout.routes):
        lanes[number, : len(path.lanes)] = [lane.format(replica=0) for lane in path.lanes]
    x_m, y_m, angle_deg = _fronts(front_m, route, layout)
    columns = (
        rows["episode"],
        rows["vehicle"],
        _decimals(x_m),
        _decimals(y_m),
        _decimals(angle_deg),
        _decimals(rows["speed_mps"].to_numpy(np.float64)),
        _decimals(front_m - starts_m[route, stage]),
        lanes[route, stage],
        _decimals(rows["acceleration_mps2"].fillna(0.0).to_numpy(np.float64)),  # SUMO writes 0 when a vehicle appears
    )
    return [
        f'        <vehicle id="{episode}.{number}" x="{x}" y="{y}" angle="{angle}" type="{VEHICLE_TYPE}" '
        f'speed="{speed}" pos="{pos}" lane="{sumo_lane}" slope="0.00" acceleration="{acceleration}"/>\n'
        for episode, number, x, y, angle, speed, pos, sumo_lane, acceleration in zip(*columns, strict=True)
    ]


def _fronts(
    front_m: NDArray[np.float64], route: NDArray[np.integer], layout: Layout
) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
    """Return x and y of front bumpers, and the angles, clockwise from north in degrees, of vehicles; all (M,)."""
    length_m, width_m = layout.scene.vehicle.length_m, layout.scene.vehicle.width_m
    boxes = new_boxes(len(front_m), length_m, width_m)
    for number, way in enumerate(layout.ways):
        here = route == number
        placed = boxes[here]
        place(front_m[here], way, placed)
        boxes[here] = placed
    x_m = boxes["x_m"] + length_m / 2 * boxes["heading_x"]
    y_m = boxes["y_m"] + length_m / 2 * boxes["heading_y"]
    return x_m, y_m, np.degrees(np.arctan2(boxes["heading_x"], boxes["heading_y"])) % 360.0


def _decimals(values: NDArray[np.float64]) -> NDArray[np.object_]:
    """Return numbers as texts; each different one is formatted once."""
    scale = 10**_DECIMALS
    different, index = np.unique(np.rint(values * scale).astype(np.int64), return_inverse=True)
    texts: NDArray[np.object_] = np.array([f"{value / scale:.{_DECIMALS}f}" for value in different], object)[index]
    return texts


def read_fcd(file: Path, columns: FcdColumns = ON_LANES) -> pd.DataFrame:
    """Return the columns time_s and those asked for; ids are categories, pos_m is that of the front along the lane.

    XML is read in a stream: memory grows by 40 bytes for each vehicle and timestep. Persons are left out.

    Raises:
        InputError: no such file, a damaged one or none with floating-car data, a vehicle lacks an attribute, or there
            is no vehicle.
    """
    require_file(file, "floating-car data", TABLE_BYTES)
    try:
        rows = _read_table(file, columns) if {".csv", ".parquet"} & set(file.suffixes) else _read_xml(file, columns)
    except InputError:
        raise
    except expat.ExpatError as error:
        raise InputError(f"{file} is not whole XML ({error}); {_AGAIN}") from None
    except (EOFError, gzip.BadGzipFile, zlib.error, ValueError, KeyError) as error:  # pyarrow's are ValueErrors
        raise InputError(f"{file} is damaged ({str(error).splitlines()[0]}); {_AGAIN}") from None
    if rows.empty:
        raise InputError(f"{file} has no vehicles; write it again with traffic in it")
    if rows.isna().any(axis=None) or np.isinf(rows.select_dtypes("number")).any(axis=None):
        attributes = ", ".join([*columns.ids, *columns.numbers])
        raise InputError(f"{file} has a vehicle without one of time, {attributes}; {_AGAIN}")
    return rows


def _read_table(file: Path, columns: FcdColumns) -> pd.DataFrame:
    names = columns.names
    ids = {name: column for name, column in names.items() if column in columns.ids.values()}
    if file.suffix == ".parquet":
        require_table(file, "floating-car data")
        rows = pd.read_parquet(file, columns=list(names), read_dictionary=list(ids))  # ids once each
    else:
        with file.open("rb") as raw:
            rows = pd.read_csv(unpacked(raw), sep=";", usecols=names.__contains__, dtype=dict.fromkeys(ids, str))
        if missing := [name for name in names if name not in rows]:
            raise InputError(f"{file} lacks the columns {', '.join(missing)}, between semicolons; {_AGAIN}")
    rows = rows.rename(columns=names)[list(names.values())]
    rows = rows[rows["vehicle"].notna()]  # an empty timestep has a row, too
    kinds = {name: "category" if name in ids.values() else "float64" for name in names.values()}
    rows = rows.astype(kinds).reset_index(drop=True)
    for name in ids.values():
        column = rows[name].cat.remove_unused_categories()
        rows[name] = column.cat.reorder_categories(sorted(column.cat.categories))
    return rows


def _read_xml(file: Path, columns: FcdColumns) -> pd.DataFrame:
    reader = _XmlReader(file, columns)
    with file.open("rb") as raw:
        reader.read(unpacked(raw))
    return reader.rows()


class _XmlReader:
    """Reader of XML that keeps numbers, and each id of a vehicle or lane once."""

    def __init__(self, file: Path, columns: FcdColumns) -> None:
        self._file = file
        self._columns = columns
        self._parser = expat.ParserCreate()
        self._parser.StartElementHandler = self._check_root
        self._time_s = np.nan
        self._times_s = array("d")
        self._numbers = {attribute: array("d") for attribute in columns.numbers}
        self._codes = {attribute: array("l") for attribute in columns.ids}
        self._ids: dict[str, dict[str, int]] = {attribute: {} for attribute in columns.ids}

    def read(self, stream: IO[bytes]) -> None:
        self._parser.ParseFile(stream)

    def rows(self) -> pd.DataFrame:
        columns: dict[str, Any] = {"time_s": np.asarray(self._times_s)}
        for attribute, name in self._columns.ids.items():
            known = pd.Index(list(self._ids[attribute]), dtype=object)
            columns[name] = pd.Categorical.from_codes(np.asarray(self._codes[attribute]), known)
        for attribute, name in self._columns.numbers.items():
            columns[name] = np.asarray(self._numbers[attribute])
        return pd.DataFrame(columns)

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
        values = {attribute: float(attributes[attribute]) for attribute in self._numbers}
        texts = {attribute: attributes[attribute] for attribute in self._codes}
        self._times_s.append(self._time_s)
        for attribute, value in values.items():
            self._numbers[attribute].append(value)
        for attribute, text in texts.items():
            ids = self._ids[attribute]
            self._codes[attribute].append(ids.setdefault(text, len(ids)))

    def _here(self) -> str:
        return f"{self._file}, line {self._parser.CurrentLineNumber}"
