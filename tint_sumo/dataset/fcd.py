"""Recorded trajectories as SUMO's floating-car data; ``tint_sumo.dataset.fcd_reader`` reads those of any run.

``write_fcd`` writes what ``sumo --fcd-output FILE --fcd-output.acceleration`` writes of the same traffic in the network
that ``tint-sumo net`` builds, apart from three things. Episodes are runs that follow each other at full minutes, so
that time increases along a file and from file to file. Vehicle ids are ``EPISODE.VEHICLE``, unique in the dataset. And
the type is SUMO's default one for all: the drivers' vTypes would give the trait away; they are in ``drivers/`` with the
labels.

Format: https://sumo.dlr.de/docs/Simulation/Output/FCDOutput.html
"""

import gzip
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from tint_sumo.core.files import whole_file
from tint_sumo.scenes.geometry import new_boxes, place
from tint_sumo.scenes.layout import Layout

EPISODE_PERIOD_S = 60.0
VEHICLE_TYPE = "DEFAULT_VEHTYPE"
_DECIMALS = 2  # SUMO's own precision
_GZIP_LEVEL = 6
_HEADER = """<?xml version="1.0" encoding="UTF-8"?>

<!-- Episode e of the dataset starts at e minutes; vehicles are EPISODE.VEHICLE; drivers/ holds their types. -->

<fcd-export xmlns:xsi="http://www.w3.org/2001/XMLSchema-instance" \
xsi:noNamespaceSchemaLocation="http://sumo.dlr.de/xsd/fcd_file.xsd">
"""


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
