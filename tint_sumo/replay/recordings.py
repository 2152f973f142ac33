"""Recordings from tables of tracks: one row for each vehicle and step of a scene, with its place on the network."""

import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from tint_sumo.core.errors import InputError
from tint_sumo.replay.routes import NO_LANE, Routes
from tint_sumo.scenes.geometry import BOX, Boxes, Floats, Numbers
from tint_sumo.scenes.replay import Recording
from tint_sumo.tracks.matching import REASONS, Matched, match
from tint_sumo.tracks.schema import KEYS, Tracks, is_on_foot

_LONGEST_GAP_S = 1.0  # without a position; a vehicle is not there in a longer one
_LEAST_S = 1.0  # of a recording
_SAME = ("recording", "vehicle", "length_m", "width_m", "vehicle_class")  # in all rows of a track
_EPS = 1e-6  # of a step
_FAR = REASONS[0]  # why a row is on no lane, whatever its heading


@dataclass(frozen=True, eq=False)
class Placed:
    """A recording, and the lanes of its rows."""

    recording: Recording
    lane: NDArray[np.object_]  # (R,) ids, ``NO_LANE`` where a vehicle is on none
    lane_m: Floats  # (R,) of its front along the lane


def label_of(vehicle_class: str) -> str:
    """Return the id of the vType of a class: SUMO allows few characters in ids."""
    return re.sub(r"[^\w.-]", "_", vehicle_class) or "_"


def vehicle_classes(tracks: Tracks) -> tuple[str, ...]:
    """Return the labels of all vehicles, sorted."""
    return tuple(sorted({label_of(name) for name in tracks.table["vehicle_class"].unique()}))


def read_recordings(
    tracks: Tracks,
    net_file: Path,
    shift_m: Sequence[float],
    routes: Routes,
    step_s: float,
    labels: tuple[str, ...],
    yields: Mapping[str, bool],
) -> tuple[Placed, ...]:
    """Return the recordings of a table, whose vehicles are on the lanes of a network.

    Raises:
        InputError: a recording is too short, or no vehicle is on any lane.
    """
    begin_s = _begins_s(tracks)
    parts = [
        part
        for (name, _), rows in tracks.table.groupby(["recording", "vehicle"], observed=True, sort=True)
        for part in _parts(rows, begin_s[str(name)], step_s)
    ]
    table = pd.concat(parts, ignore_index=True)
    # Parts of a track between gaps are tracks of their own.
    table["vehicle"] = [f"{vehicle}\0{part}" for vehicle, part in zip(table["vehicle"], table["part"], strict=True)]
    table = table.astype({"recording": "category", "vehicle": "category"}).sort_values(KEYS, ignore_index=True)
    matched = match(Tracks(tracks.file, tracks.format, table, tracks.crs), net_file, shift_m)
    lanes = matched.table["lane"].astype(object).fillna(NO_LANE).to_numpy()
    return tuple(
        _placed(str(name), rows.index.to_numpy(), matched, lanes, routes, labels, yields)
        for name, rows in table.groupby("recording", observed=True, sort=True)
    )


def _begins_s(tracks: Tracks) -> dict[str, float]:
    """Return when each recording begins; InputError if one is too short."""
    found = {}
    for name, times_s in tracks.table.groupby("recording", observed=True)["time_s"]:
        found[str(name)], end_s = float(times_s.min()), float(times_s.max())
        if end_s - found[str(name)] < _LEAST_S:
            raise InputError(
                f"recording {name} of {tracks.file} lasts {end_s - found[str(name)]:g} s; give one of at least "
                f"{_LEAST_S:g} s"
            )
    return found


def _parts(rows: pd.DataFrame, begin_s: float, step_s: float) -> Iterator[pd.DataFrame]:
    """Yield the parts of a track between gaps, with positions interpolated to the steps, and their numbers."""
    time_s = rows["time_s"].to_numpy() - begin_s
    cuts = np.flatnonzero(np.diff(time_s) > _LONGEST_GAP_S) + 1
    for number, part in enumerate(np.split(np.arange(len(rows)), cuts)):
        own, own_s = rows.iloc[part], time_s[part]
        first, last = int(np.ceil(own_s[0] / step_s - _EPS)), int(np.floor(own_s[-1] / step_s + _EPS))
        if first <= last:
            step = np.arange(first, last + 1)
            at_s = step * step_s
            numbers = {name: np.interp(at_s, own_s, own[name]) for name in ("x_m", "y_m", "speed_mps")}
            heading_rad = np.interp(at_s, own_s, np.unwrap(own["heading_rad"]))
            same = {name: own[name].iloc[0] for name in _SAME}
            more = {"heading_rad": heading_rad, "time_s": at_s, "step": step, "part": number}
            yield pd.DataFrame({**same, **numbers, **more})


def _placed(
    name: str,
    rows: Numbers,
    matched: Matched,
    all_lanes: NDArray[np.object_],
    routes: Routes,
    labels: tuple[str, ...],
    yields: Mapping[str, bool],
) -> Placed:
    """Return the recording that has these rows of a table."""
    table, lanes = matched.table.iloc[rows], all_lanes[rows]
    boxes, driven_m = _boxes(table, matched.fronts_m[rows])
    begins = np.flatnonzero(np.r_[True, table["vehicle"].to_numpy()[1:] != table["vehicle"].to_numpy()[:-1]])
    counts = np.diff(np.r_[begins, len(table)])
    slices = [slice(begin, begin + count) for begin, count in zip(begins.tolist(), counts.tolist(), strict=True)]
    vehicles = tuple(str(table["vehicle"].iloc[begin]).partition("\0")[0] for begin in begins)
    kinds = [label_of(str(table["vehicle_class"].iloc[begin])) for begin in begins]
    on_foot = np.array([is_on_foot(kind) for kind in kinds], bool)
    far = (table["reason"] == _FAR).to_numpy()
    on_road = np.where(np.repeat(on_foot, counts), ~far, lanes != NO_LANE)
    found = [
        _walked(routes, boxes[own], on_road[own]) if walks else routes.of(lanes[own].tolist())
        for own, walks in zip(slices, on_foot.tolist(), strict=True)
    ]
    keeps = [
        set(lanes[own][on_road[own]]) <= routes.lane_starts_m(route).keys()
        for own, route in zip(slices, found, strict=True)
    ]
    driven_m -= np.repeat(driven_m[begins], counts)
    recording = Recording(
        name=name,
        steps=int(table["step"].max()),
        vehicles=vehicles,
        labels=tuple(labels.index(kind) for kind in kinds),
        routes=tuple(found),
        attributes=({},) * len(slices),
        drives_on=~on_foot,
        yields=tuple(yields.get(vehicle, True) for vehicle in vehicles),
        first_row=begins.astype(np.int64),
        first_step=table["step"].to_numpy()[begins].astype(np.int64),
        rows=counts.astype(np.int64),
        box=boxes,
        speed_mps=table["speed_mps"].to_numpy(),
        driven_m=driven_m,
        on_road=on_road,
        keeps_route=np.array(keeps, bool) & ~on_foot,
    )
    return Placed(recording, lanes, table["position_m"].to_numpy())


def _walked(routes: Routes, boxes: Boxes, on_road: NDArray[np.bool_]) -> tuple[str, ...]:
    """Return the edge that is nearest to where somebody on foot is first on a lane; SUMO asks for a route."""
    if not on_road.any():
        return ()
    box = boxes[int(np.argmax(on_road))]
    return (routes.nearest(float(box["x_m"]), float(box["y_m"])),)


def _boxes(table: pd.DataFrame, fronts_m: Floats) -> tuple[Boxes, Floats]:
    """Return the boxes of rows whose fronts are there, and how far each vehicle has come since the first row."""
    heading_rad = table["heading_rad"].to_numpy()
    box = np.zeros(len(table), BOX)
    box["heading_x"], box["heading_y"] = np.cos(heading_rad), np.sin(heading_rad)
    box["length_m"], box["width_m"] = table["length_m"], table["width_m"]
    box["x_m"] = fronts_m[:, 0] - box["length_m"] / 2.0 * box["heading_x"]
    box["y_m"] = fronts_m[:, 1] - box["length_m"] / 2.0 * box["heading_y"]
    steps_m = np.diff(box["x_m"]) * box["heading_x"][1:] + np.diff(box["y_m"]) * box["heading_y"][1:]
    return box, np.concatenate([[0.0], np.cumsum(np.maximum(steps_m, 0.0))])
