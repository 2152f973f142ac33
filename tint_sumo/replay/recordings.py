"""Recordings from tables of tracks: one row for each vehicle and step of a scene, with its place on the network."""

import re
from collections.abc import Iterator, Mapping
from dataclasses import dataclass

import numpy as np
import pandas as pd

from tint_sumo.core.errors import InputError
from tint_sumo.replay.matching import Lanes, Matched
from tint_sumo.scenes.geometry import BOX, Boxes, Floats, Numbers
from tint_sumo.scenes.replay import Recording
from tint_sumo.tracks.schema import Tracks

_LONGEST_GAP_S = 1.0  # without a position; a vehicle is not there in a longer one
_LEAST_S = 1.0  # of a recording
_EPS = 1e-6  # of a step
_ON_FOOT = re.compile("pedestrian|bicycle|cyclist|person|animal|wheelchair")  # classes that never drive on


@dataclass(frozen=True, eq=False)
class _Track:
    """A vehicle without a gap, at each step."""

    vehicle: str
    label: str
    first_step: int
    box: Boxes
    speed_mps: Floats
    driven_m: Floats


def label_of(vehicle_class: str) -> str:
    """Return the id of the vType of a class: SUMO allows few characters in ids."""
    return re.sub(r"[^\w.-]", "_", vehicle_class) or "_"


def is_on_foot(label: str) -> bool:
    return bool(_ON_FOOT.search(label.lower()))


def vehicle_classes(tracks: Tracks) -> tuple[str, ...]:
    """Return the labels of all vehicles, sorted."""
    return tuple(sorted({label_of(name) for name in tracks.table["vehicle_class"].unique()}))


def read_recordings(
    tracks: Tracks, lanes: Lanes, step_s: float, labels: tuple[str, ...], yields: Mapping[str, bool]
) -> tuple[Recording, ...]:
    """Return the recordings of a table, whose vehicles are on the lanes of a network.

    Raises:
        InputError: a recording is too short, or no vehicle is on any lane.
    """
    found = tuple(
        _recording(str(name), rows, tracks, lanes, step_s, labels, yields)
        for name, rows in tracks.table.groupby("recording", observed=True, sort=True)
    )
    if not any(any(recording.routes) for recording in found):
        raise InputError(
            f"no vehicle of {tracks.file} is on a lane of the network: the tracks have x {_span(tracks.table['x_m'])} "
            f"and y {_span(tracks.table['y_m'])}, the network has {_extent(lanes)}; give the network of this recording"
        )
    return found


def _span(values: pd.Series) -> str:
    return f"{values.min():.0f} to {values.max():.0f} m"


def _extent(lanes: Lanes) -> str:
    left, low, right, high = (bound(axis) for bound, axis in zip((min, min, max, max), _bounds(lanes), strict=True))
    return f"{left:.0f} to {right:.0f} m and {low:.0f} to {high:.0f} m"


def _bounds(lanes: Lanes) -> Iterator[list[float]]:
    for side in range(4):
        yield [line.bounds[side] for line in lanes.lines]


def _recording(
    name: str,
    rows: pd.DataFrame,
    tracks: Tracks,
    lanes: Lanes,
    step_s: float,
    labels: tuple[str, ...],
    yields: Mapping[str, bool],
) -> Recording:
    begin_s, end_s = rows["time_s"].min(), rows["time_s"].max()
    if end_s - begin_s < _LEAST_S:
        raise InputError(
            f"recording {name} of {tracks.file} lasts {end_s - begin_s:g} s; give one of at least {_LEAST_S:g} s"
        )
    found = [
        track
        for vehicle, own in rows.groupby("vehicle", observed=True, sort=False)
        for track in _tracks(str(vehicle), own, begin_s, step_s)
    ]
    matched = [_matched(lanes, track) for track in found]
    counts = np.array([len(track.box) for track in found], np.int64)
    return Recording(
        name=name,
        steps=int(np.floor((end_s - begin_s) / step_s + _EPS)),
        vehicles=tuple(track.vehicle for track in found),
        labels=tuple(labels.index(track.label) for track in found),
        routes=tuple(match.route for match in matched),
        attributes=({},) * len(found),
        drives_on=np.array([not is_on_foot(track.label) for track in found], bool),
        yields=tuple(yields.get(track.vehicle, True) for track in found),
        first_row=np.concatenate([[0], np.cumsum(counts)[:-1]]).astype(np.int64),
        first_step=np.array([track.first_step for track in found], np.int64),
        rows=counts,
        box=np.concatenate([track.box for track in found]),
        speed_mps=np.concatenate([track.speed_mps for track in found]),
        driven_m=np.concatenate([track.driven_m for track in found]),
        on_road=np.concatenate([match.on_road for match in matched]),
        keeps_route=np.array([match.keeps_route for match in matched], bool),
    )


def _matched(lanes: Lanes, track: _Track) -> Matched:
    return lanes.match_walker(track.box) if is_on_foot(track.label) else lanes.match(track.box, track.driven_m)


def _tracks(vehicle: str, rows: pd.DataFrame, begin_s: float, step_s: float) -> Iterator[_Track]:
    """Yield the parts of a track between gaps, with positions interpolated to the steps."""
    time_s = rows["time_s"].to_numpy() - begin_s
    cuts = np.flatnonzero(np.diff(time_s) > _LONGEST_GAP_S) + 1
    for part in np.split(np.arange(len(rows)), cuts):
        own, own_s = rows.iloc[part], time_s[part]
        first, last = int(np.ceil(own_s[0] / step_s - _EPS)), int(np.floor(own_s[-1] / step_s + _EPS))
        if first <= last:
            yield _track(vehicle, own, own_s, np.arange(first, last + 1), step_s)


def _track(vehicle: str, rows: pd.DataFrame, time_s: Floats, steps: Numbers, step_s: float) -> _Track:
    at_s = steps * step_s
    x_m, y_m, speed_mps = (np.interp(at_s, time_s, rows[name]) for name in ("x_m", "y_m", "speed_mps"))
    heading_rad = np.interp(at_s, time_s, np.unwrap(rows["heading_rad"]))
    box = np.zeros(len(steps), BOX)
    box["x_m"], box["y_m"] = x_m, y_m
    box["heading_x"], box["heading_y"] = np.cos(heading_rad), np.sin(heading_rad)
    box["length_m"], box["width_m"] = rows["length_m"].iloc[0], rows["width_m"].iloc[0]
    steps_m = np.diff(x_m) * box["heading_x"][1:] + np.diff(y_m) * box["heading_y"][1:]
    driven_m = np.concatenate([[0.0], np.cumsum(np.maximum(steps_m, 0.0))])
    return _Track(vehicle, label_of(str(rows["vehicle_class"].iloc[0])), int(steps[0]), box, speed_mps, driven_m)
