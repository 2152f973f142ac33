"""Counts what is in recorded tracks, and what cannot be: vehicles that jump, or that are in each other's place."""

from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import shapely
from matplotlib.collections import LineCollection
from matplotlib.figure import Figure
from numpy.typing import NDArray

from tint_sumo.core.files import whole_file
from tint_sumo.tracks.motion import MOST_ACCELERATION_MPS2, SAME_UNITS, Steps, steps_of
from tint_sumo.tracks.schema import Tracks

_TOUCH_M = 0.02  # boxes that overlap by less touch
_QUANTILES = (0.05, 0.5, 0.95)
_FLAT_M = 1.0  # tracks with less sideways extent are drawn over the time


@dataclass(frozen=True)
class Faults:
    """Numbers of rows that are physical nonsense, and of the tracks they are in."""

    accelerations: int  # beyond MOST_ACCELERATION_MPS2 either way
    accelerating_tracks: int
    jumps: int  # positions farther from those before than speed and acceleration allow
    jumping_tracks: int
    overlaps: int  # pairs of boxes that overlap at one time
    overlapping_pairs: int  # pairs of vehicles
    long_steps: int  # frames are missing before the row
    broken_tracks: int


@dataclass(frozen=True)
class Inspection:
    """Counts and distributions of recorded tracks."""

    tracks: Tracks
    recordings: int
    vehicles: int
    rows: int
    duration_s: float  # of all recordings together
    step_s: float  # the usual one
    track_s: tuple[float, ...]  # 5, 50 and 95 % of the tracks' durations
    speed_mps: tuple[float, ...]  # 5, 50 and 95 %
    classes: dict[str, int]  # vehicles of each class
    extent_m: tuple[float, float, float, float]  # left, bottom, right, top
    distance_ratio: float | None  # distance driven to speed times time; None if nobody moves
    faults: Faults

    @property
    def has_mixed_units(self) -> bool:
        """Whether positions and speeds cannot have the units that the format says."""
        low, high = SAME_UNITS
        return self.distance_ratio is not None and not low <= self.distance_ratio <= high

    def summary(self) -> dict[str, Any]:
        """Return all numbers, for JSON."""
        values = {name: value for name, value in vars(self).items() if name not in ("tracks", "faults")}
        return {"format": self.tracks.format, **values, "faults": asdict(self.faults)}


def inspect(tracks: Tracks) -> Inspection:
    """Count what is in some tracks."""
    table, track, steps = tracks.table, tracks.track_number, steps_of(tracks)
    by_track = table.groupby(track)
    durations_s = (by_track["time_s"].max() - by_track["time_s"].min()).to_numpy()
    by_recording = table.groupby("recording", observed=True)["time_s"]
    classes = table["vehicle_class"].iloc[np.r_[0, np.flatnonzero(np.diff(track)) + 1]].value_counts()
    whole = ~steps.is_long  # where a vehicle was meanwhile is not known
    driven_m, expected_m = steps.driven_m[whole].sum(), (steps.speed_mps * steps.time_s)[whole].sum()
    return Inspection(
        tracks=tracks,
        recordings=by_recording.ngroups,
        vehicles=len(durations_s),
        rows=len(table),
        duration_s=float((by_recording.max() - by_recording.min()).sum()),
        step_s=steps.usual_s,
        track_s=_quantiles(durations_s),
        speed_mps=_quantiles(table["speed_mps"].to_numpy()),
        classes={str(name): int(count) for name, count in classes.items() if count},
        extent_m=(table["x_m"].min(), table["y_m"].min(), table["x_m"].max(), table["y_m"].max()),
        distance_ratio=float(driven_m / expected_m) if expected_m > 0.0 else None,
        faults=_faults(tracks, steps),
    )


def _quantiles(values: NDArray[np.float64]) -> tuple[float, ...]:
    return tuple(float(value) for value in np.quantile(values, _QUANTILES))


def _faults(tracks: Tracks, steps: Steps) -> Faults:
    track = tracks.track_number[steps.row]
    too_fast = np.abs(steps.acceleration_mps2) > MOST_ACCELERATION_MPS2
    pairs = overlapping(tracks.table)
    return Faults(
        int(too_fast.sum()),
        len(np.unique(track[too_fast])),
        int(steps.is_jump.sum()),
        len(np.unique(track[steps.is_jump])),
        len(pairs),
        len(pairs.drop_duplicates(["recording", "vehicle", "other"])),
        int(steps.is_long.sum()),
        len(np.unique(track[steps.is_long])),
    )


def overlapping(table: pd.DataFrame) -> pd.DataFrame:
    """Find vehicles whose boxes overlap.

    Args:
        table: rows of ``TRACK_SCHEMA``.

    Returns:
        columns recording, time_s, vehicle and other, one row for each pair and time.
    """
    boxes = _boxes(table)
    found = []
    for _, rows in table.groupby(["recording", "time_s"], observed=True).indices.items():
        tree = shapely.STRtree(boxes[rows])
        first, second = tree.query(boxes[rows], predicate="intersects")
        found.append(np.stack([rows[first], rows[second]])[:, first < second])
    pairs = np.concatenate(found, axis=1) if found else np.zeros((2, 0), np.int64)
    found_at = {name: table[name].to_numpy()[pairs[0]] for name in ("recording", "time_s", "vehicle")}
    return pd.DataFrame({**found_at, "other": table["vehicle"].to_numpy()[pairs[1]]})


def _boxes(table: pd.DataFrame) -> NDArray[np.object_]:
    """Return the vehicles' boxes as polygons, a little smaller than they are."""
    along = np.stack([np.cos(table["heading_rad"]), np.sin(table["heading_rad"])], axis=1)
    across = np.stack([-along[:, 1], along[:, 0]], axis=1)
    centre = table[["x_m", "y_m"]].to_numpy()
    half_length = along * (np.maximum(table["length_m"].to_numpy() - _TOUCH_M, _TOUCH_M) / 2.0)[:, None]
    half_width = across * (np.maximum(table["width_m"].to_numpy() - _TOUCH_M, _TOUCH_M) / 2.0)[:, None]
    signs = ((1, 1), (1, -1), (-1, -1), (-1, 1))
    corners = np.stack([centre + i * half_length + j * half_width for i, j in signs], axis=1)
    return np.asarray(shapely.polygons(corners))


def report(found: Inspection) -> str:
    """Return the counts as lines for people."""
    faults = found.faults
    left, bottom, right, top = found.extent_m
    classes = ", ".join(f"{count:,} {name}" for name, count in found.classes.items())
    lines = [
        f"format            {found.tracks.format}",
        f"recordings        {found.recordings:,}, {found.duration_s:,.1f} s in all, a row every {found.step_s:g} s",
        f"vehicles          {found.vehicles:,}: {classes}",
        f"rows              {found.rows:,}",
        "tracks            {:.1f} to {:.1f} s (5 to 95 %), {:.1f} s in the median".format(*_outer(found.track_s)),
        "speed             {:.1f} to {:.1f} m/s (5 to 95 %), {:.1f} m/s in the median".format(*_outer(found.speed_mps)),
        f"extent            {right - left:,.1f} m by {top - bottom:,.1f} m",
        _count("accelerations", faults.accelerations, f"beyond {MOST_ACCELERATION_MPS2:g} m/s2", "tracks").format(
            faults.accelerating_tracks
        ),
        _count("jumps", faults.jumps, "farther than the speed allows", "tracks").format(faults.jumping_tracks),
        _count("overlaps", faults.overlaps, "pairs of boxes at one time", "pairs of vehicles").format(
            faults.overlapping_pairs
        ),
        _count("missing frames", faults.long_steps, "steps longer than usual", "tracks").format(faults.broken_tracks),
    ]
    if found.has_mixed_units and found.distance_ratio is not None:
        lines.append(
            f"units             vehicles move {found.distance_ratio:.3g} times as far as their speeds say: positions "
            "and speeds have other units than the format says"
        )
    return "\n".join(lines)


def _outer(values: tuple[float, ...]) -> tuple[float, float, float]:
    """Return 5, 95 and 50 %."""
    return values[0], values[2], values[1]


def _count(name: str, number: int, what: str, whose: str) -> str:
    return f"{name:18}{number:,} {what}" + (f", in {{:,}} {whose}" if number else "")


def plot(found: Inspection, file: Path) -> None:
    """Write a picture of the tracks, coloured by speed, and of the distributions of speed and acceleration."""
    figure = Figure(figsize=(12.0, 6.0), dpi=120, layout="constrained")
    ways, speed, acceleration = figure.subplot_mosaic(
        [["ways", "speed"], ["ways", "acceleration"]], width_ratios=[2, 1]
    ).values()
    table, steps = found.tracks.table, steps_of(found.tracks)
    _, bottom, _, top = found.extent_m
    is_flat = top - bottom < _FLAT_M
    horizontal, vertical = ("time_s", "x_m") if is_flat else ("x_m", "y_m")
    points = table[[horizontal, vertical]].to_numpy()
    lines = LineCollection(
        list(np.stack([points[steps.row - 1], points[steps.row]], axis=1)),
        array=steps.speed_mps,
        cmap="viridis",
        linewidths=0.8,
    )
    ways.add_collection(lines)
    ways.autoscale()
    if is_flat:
        ways.set(xlabel="time (s)", ylabel="position (m)")
    else:
        ways.set(xlabel="x (m)", ylabel="y (m)")
        ways.set_aspect("equal", adjustable="datalim")
    figure.colorbar(lines, ax=ways, label="speed (m/s)", shrink=0.8)
    speed.hist(table["speed_mps"], bins=60, color="#4878a8")
    speed.set(xlabel="speed (m/s)", ylabel="rows")
    bound = MOST_ACCELERATION_MPS2
    acceleration.hist(np.clip(steps.acceleration_mps2, -bound, bound), bins=80, range=(-bound, bound), color="#4878a8")
    acceleration.set(xlabel=f"acceleration (m/s², cut at {bound:g})", ylabel="rows")
    if len(steps.row):
        acceleration.set_yscale("log")
    figure.suptitle(f"{found.vehicles:,} vehicles, {found.rows:,} rows ({found.tracks.format})")
    with whole_file(file) as partial:
        figure.savefig(partial, format=file.suffix.lower().removeprefix("."))
