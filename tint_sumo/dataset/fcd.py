"""Recorded trajectories as SUMO's floating-car data, for the tools of the SUMO world.

What ``sumo --fcd-output FILE --fcd-output.acceleration`` writes of the same traffic in ``sumo_net/tint.net.xml``, apart
from three things. Episodes are runs of their own and follow each other at full minutes, so that time increases along a
file and from file to file. Vehicle ids are ``EPISODE.VEHICLE``, unique in the dataset. And the type is SUMO's default
one for all: the drivers' own vTypes would tell the trait; they are in ``drivers/`` with the labels.

Format: https://sumo.dlr.de/docs/Simulation/Output/FCDOutput.html
"""

import gzip
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from tint_sumo.config import Street, VehicleShape
from tint_sumo.files import whole_file
from tint_sumo.scenario.geometry import LANE_DIRECTION, LANE_NAMES, lane_y_m, stage_start_m
from tint_sumo.scenario.network import lane_id

EPISODE_PERIOD_S = 60.0
VEHICLE_TYPE = "DEFAULT_VEHTYPE"
_DECIMALS = 2  # SUMO's own precision
_GZIP_LEVEL = 6
_HEADER = """<?xml version="1.0" encoding="UTF-8"?>

<!-- Episode e of the dataset starts at e minutes; vehicles are EPISODE.VEHICLE; drivers/ holds their types. -->

<fcd-export xmlns:xsi="http://www.w3.org/2001/XMLSchema-instance" \
xsi:noNamespaceSchemaLocation="http://sumo.dlr.de/xsd/fcd_file.xsd">
"""


def write_fcd(rows: pd.DataFrame, file: Path) -> None:
    """Write rows of trajectories to a gzipped XML file; the same rows always give the same bytes."""
    with (
        whole_file(file) as partial,
        partial.open("wb") as raw,
        gzip.GzipFile("", "wb", _GZIP_LEVEL, raw, mtime=0) as xml,
    ):
        xml.write(_HEADER.encode())
        xml.writelines(timestep.encode() for timestep in _timesteps(rows))
        xml.write(b"</fcd-export>\n")


def _timesteps(rows: pd.DataFrame) -> Iterator[str]:
    rows = rows.sort_values(["episode", "time_s", "vehicle"], ignore_index=True)
    time_s = rows["episode"].to_numpy() * EPISODE_PERIOD_S + rows["time_s"].to_numpy(np.float64)
    time, vehicles = _decimals(time_s), _vehicles(rows)
    starts = np.flatnonzero(np.r_[True, time[1:] != time[:-1]])
    for start, end in zip(starts, [*starts[1:], len(rows)], strict=True):
        yield f'    <timestep time="{time[start]}">\n{"".join(vehicles[start:end])}    </timestep>\n'


def _vehicles(rows: pd.DataFrame) -> list[str]:
    """The element of each row."""
    street, vehicle = Street(), VehicleShape()
    lane = rows["lane"].cat.set_categories(list(LANE_NAMES)).cat.codes.to_numpy(np.int64)
    front_m = rows["position_m"].to_numpy(np.float64)
    starts_m = stage_start_m(street, vehicle)
    stage = (front_m[:, None] > starts_m[lane, 1:]).sum(axis=1)
    x_m = LANE_DIRECTION[lane] * (front_m - street.half_length_m - vehicle.length_m / 2)
    lanes = np.array([[lane_id(one, part, replica=0) for part in range(3)] for one in range(2)], object)
    columns = (
        rows["episode"],
        rows["vehicle"],
        _decimals(x_m),
        _decimals(lane_y_m(street))[lane],
        _decimals(90.0 * (2 - LANE_DIRECTION))[lane],  # clockwise from north
        _decimals(rows["speed_mps"].to_numpy(np.float64)),
        _decimals(front_m - starts_m[lane, stage]),
        lanes[lane, stage],
        _decimals(rows["acceleration_mps2"].fillna(0.0).to_numpy(np.float64)),  # as SUMO has it at appearance
    )
    return [
        f'        <vehicle id="{episode}.{number}" x="{x}" y="{y}" angle="{angle}" type="{VEHICLE_TYPE}" '
        f'speed="{speed}" pos="{pos}" lane="{sumo_lane}" slope="0.00" acceleration="{acceleration}"/>\n'
        for episode, number, x, y, angle, speed, pos, sumo_lane, acceleration in zip(*columns, strict=True)
    ]


def _decimals(values: NDArray[np.float64]) -> NDArray[np.object_]:
    """Texts of numbers, each different one formatted once."""
    scale = 10**_DECIMALS
    different, index = np.unique(np.rint(values * scale).astype(np.int64), return_inverse=True)
    texts: NDArray[np.object_] = np.array([f"{value / scale:.{_DECIMALS}f}" for value in different], object)[index]
    return texts
