"""SUMO's floating-car data: what ``sumo --fcd-output FILE`` writes, as XML, CSV or Parquet.

SUMO writes the middle of a vehicle's front and no sizes: all vehicles have the standard one of ``VehicleShape``.

Format: https://sumo.dlr.de/docs/Simulation/Output/FCDOutput.html
"""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from tint_sumo.config import VehicleShape
from tint_sumo.core.errors import InputError
from tint_sumo.dataset.fcd_reader import POSES, is_fcd_table, is_geographic, read_fcd
from tint_sumo.tracks.reading import Head, TrackFormat, recording_name, register

_UTM_NORTH, _UTM_SOUTH = 32600, 32700  # EPSG codes of zone 0
_ZONE_DEG = 6.0


def _read(file: Path) -> Mapping[str, Any]:
    rows = read_fcd(file, POSES)
    if is_geographic(rows):
        raise InputError(f"{file} has longitudes and latitudes; give the `format` fcd_geo")
    return _columns(file, rows, rows["x"].to_numpy(), rows["y"].to_numpy())


def _read_geographic(file: Path) -> Mapping[str, Any]:
    """Read the output of ``--fcd-output.geo``: longitudes and latitudes, which pyproj projects to metres (UTM)."""
    rows = read_fcd(file, POSES)
    longitude, latitude = rows["x"].to_numpy(), rows["y"].to_numpy()
    if np.abs(longitude).max() > 180.0 or np.abs(latitude).max() > 90.0:
        raise InputError(f"{file} has positions that are no longitudes and latitudes; give the `format` fcd")
    crs, x_m, y_m = _in_metres(longitude, latitude)
    return {**_columns(file, rows, x_m, y_m), "crs": crs}


def _columns(file: Path, rows: pd.DataFrame, x_m: NDArray[np.float64], y_m: NDArray[np.float64]) -> Mapping[str, Any]:
    """Return the columns of vehicles whose fronts are at these positions."""
    shape = VehicleShape()
    heading_rad = np.radians(90.0 - rows["angle_deg"].to_numpy())  # SUMO's angle is clockwise from north
    return {
        "recording": recording_name(file),
        "vehicle": rows["vehicle"],
        "time_s": rows["time_s"],
        "x_m": x_m - shape.length_m / 2.0 * np.cos(heading_rad),
        "y_m": y_m - shape.length_m / 2.0 * np.sin(heading_rad),
        "heading_rad": heading_rad,
        "speed_mps": rows["speed_mps"],
        "length_m": shape.length_m,
        "width_m": shape.width_m,
        "vehicle_class": rows["vehicle_class"],
    }


def _in_metres(
    longitude: NDArray[np.float64], latitude: NDArray[np.float64]
) -> tuple[str, NDArray[np.float64], NDArray[np.float64]]:
    """Project to the UTM zone of the mean position; return it with x and y."""
    try:
        from pyproj import Transformer  # noqa: PLC0415 - an extra
    except ModuleNotFoundError:
        raise InputError('geographic positions need pyproj; install it: pip install "tint_sumo[geo]"') from None
    zone = int((longitude.mean() + 180.0) // _ZONE_DEG) + 1
    code = (_UTM_NORTH if latitude.mean() >= 0.0 else _UTM_SOUTH) + zone
    crs = f"EPSG:{code}"
    x_m, y_m = Transformer.from_crs("EPSG:4326", crs, always_xy=True).transform(longitude, latitude)
    return crs, np.asarray(x_m), np.asarray(y_m)


def _is_fcd(head: Head) -> bool:
    is_table = is_fcd_table(head.first_line)
    return "<fcd-export" in head.text or is_table or head.file.suffix == ".parquet"


register(TrackFormat("fcd", "SUMO floating-car data", _is_fcd, _read))
register(TrackFormat("fcd_geo", "SUMO floating-car data, geographic", lambda _: False, _read_geographic))
