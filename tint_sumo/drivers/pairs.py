"""Pairs of a follower and its leader in recorded tracks, along the way that they drive.

The leader of a vehicle is the nearest one ahead on the way that the vehicle itself drives from there on, or, where its
track ends before, the nearest one that has come along here: their boxes would touch if it drove on. So no map is
needed, and roads may bend. A leader-follower file names the leader, and its road is straight.
"""

import math
from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import pairwise
from pathlib import Path

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from tint_sumo.config import STEP_S
from tint_sumo.core.compiling import compiled
from tint_sumo.core.errors import InputError
from tint_sumo.tracks.motion import SAME_UNITS, Steps, steps_of
from tint_sumo.tracks.reading import formats_of, read_tracks
from tint_sumo.tracks.schema import Tracks, is_on_foot

Floats = NDArray[np.float64]

MIN_DURATION_S = 1.0
REACH_M = 150.0  # a leader farther away is none, except in files that name the leader
_STRAIGHT_M = 20.0  # a way goes on so far in a straight line where its track ends
_SAME_DIRECTION_RAD = math.radians(60.0)
_MOVED_M = 20.0  # units are compared where a vehicle has moved so far
_FEW_JUMPS = 0.05  # share of a track's rows
_MOST_WRONG = 0.1  # share of tracks whose units may disagree: mistakes of a tracker
_SUFFIXES = (".csv", ".xml", ".parquet", ".txt", ".gz")


@dataclass(frozen=True, eq=False)
class Pair:
    """A follower behind one leader without a break, with rows every ``step_s``.

    Positions are those along the follower's way from where its track begins. A stretch without a leader, which only
    those get who ask for it, has the leader ``""`` and an infinite ``leader_rear_m``.
    """

    recording: str
    follower: str
    leader: str
    start_s: float
    step_s: float
    leader_rear_m: Floats  # (T,) rear bumper
    leader_speed_mps: Floats  # (T,)
    front_m: Floats  # (T,) front bumper of the follower
    speed_mps: Floats  # (T,)

    @property
    def driver(self) -> str:
        """Name of the follower; a driver may follow several leaders."""
        return f"{self.recording}/{self.follower}"

    @property
    def name(self) -> str:
        return f"{self.driver} behind {self.leader} from {self.start_s:.10g} s"

    @property
    def rows(self) -> int:
        return len(self.front_m)

    @property
    def duration_s(self) -> float:
        return (self.rows - 1) * self.step_s

    @cached_property
    def gap_m(self) -> Floats:
        """Distance from bumper to bumper; (T,)."""
        return self.leader_rear_m - self.front_m


@dataclass(frozen=True)
class Recorded:
    """Pairs that were found in a file or in the files of a folder, and what was left out."""

    pairs: tuple[Pair, ...]
    files: tuple[Path, ...]
    unread: tuple[Path, ...] = ()  # files of a folder that are no tracks
    short: int = 0  # pairs that are too short
    inconsistent: int = 0  # tracks whose positions and speeds disagree
    jumps: int = 0  # moments at which a vehicle jumps; pairs end there

    @property
    def drivers(self) -> tuple[str, ...]:
        """Names of the drivers, each once."""
        return tuple(dict.fromkeys(pair.driver for pair in self.pairs))


def left_out_text(found: Recorded) -> list[str]:
    """Return lines for people about what was left out."""
    parts = [
        (found.short, "pairs that are too short"),
        (found.inconsistent, "tracks whose positions and speeds disagree"),
        (found.jumps, "moments at which a vehicle jumps, where pairs were cut"),
        (len(found.unread), "files that are no tracks, such as " + "".join(file.name for file in found.unread[:1])),
    ]
    return [f"left out: {count:,} {what}" for count, what in parts if count]


def read_pairs(
    path: Path,
    format_name: str | None = None,
    step_s: float = STEP_S,
    min_duration_s: float = MIN_DURATION_S,
    *,
    with_free: bool = False,
) -> Recorded:
    """Read the pairs of a file of tracks, or of all such files in a folder.

    Args:
        path: of the file or folder.
        format_name: format of the tracks; recognised if not given.
        step_s: time between the rows of the pairs, which are interpolated between those of the recording.
        min_duration_s: shorter pairs are left out.
        with_free: return stretches without a leader, too. A leader-follower file does not know whom leaders follow.

    Raises:
        InputError: nothing can be read, a file is damaged, positions and speeds have different units, there is no pair
            that is long enough, or a pair is there twice.
    """
    files, unread = _files(path, format_name)
    parts = [find_pairs(read_tracks(file, format_name), step_s, min_duration_s, with_free=with_free) for file in files]
    pairs = tuple(pair for part in parts for pair in part.pairs)
    found = Recorded(
        pairs,
        files,
        unread,
        sum(part.short for part in parts),
        sum(part.inconsistent for part in parts),
        sum(part.jumps for part in parts),
    )
    if not pairs:
        rest = f"{found.short:,} are shorter than {min_duration_s:g} s" if found.short else "nobody follows anybody"
        raise InputError(f"{path} has no pair of a leader and a follower to fit ({rest}); give a longer recording")
    _require_each_once(pairs)
    return found


def _files(path: Path, format_name: str | None) -> tuple[tuple[Path, ...], tuple[Path, ...]]:
    """Return the files of tracks, and the other files of a folder."""
    if not path.is_dir():
        return (path,), ()
    files = sorted(file for file in path.iterdir() if file.is_file() and not file.name.startswith("."))
    if not files:
        raise InputError(f"{path} has no files; give a folder with recordings")
    known = [file for file in files if file.suffix.lower() in _SUFFIXES and (format_name or formats_of(file))]
    if not known:
        raise InputError(f"{path} has no file of a known format of tracks; give a folder with recordings")
    return tuple(known), tuple(file for file in files if file not in known)


def _require_each_once(pairs: tuple[Pair, ...]) -> None:
    """Raise InputError if two pairs of the same vehicles overlap in time."""
    ordered = sorted(pairs, key=lambda pair: (pair.driver, pair.leader, pair.start_s))
    for first, second in pairwise(ordered):
        same = (first.driver, first.leader) == (second.driver, second.leader)
        if same and second.start_s < first.start_s + first.duration_s:
            raise InputError(f"{second.name} is there more than once; give each recording once")


def find_pairs(
    tracks: Tracks, step_s: float = STEP_S, min_duration_s: float = MIN_DURATION_S, *, with_free: bool = False
) -> Recorded:
    """Find the pairs in some tracks; see ``read_pairs``."""
    table, track = tracks.table, tracks.track_number
    steps = steps_of(tracks)
    driven_m, wrong = _driven_m(track, steps), _inconsistent(tracks, track, steps)
    time_s, x_m, y_m, heading_rad, speed_mps, length_m, width_m = (
        table[name].to_numpy() for name in ("time_s", "x_m", "y_m", "heading_rad", "speed_mps", "length_m", "width_m")
    )
    drives, is_wrong = ~_on_foot(table), np.isin(track, wrong)
    rows, begins = _by_moment(table, drives)
    named = tracks.format == "leader_follower"
    reach_m, straight_m = (math.inf, math.inf) if named else (REACH_M, _STRAIGHT_M)
    leader, ahead_m = np.full(len(track), -1, np.int64), np.zeros(len(track))
    way = (track, x_m, y_m, heading_rad, driven_m)
    _find_leaders(rows, begins, *way, length_m, width_m, reach_m, straight_m, leader, ahead_m)
    pairs, short = [], 0
    names = [table[name].astype(str).to_numpy() for name in ("recording", "vehicle")]
    for first, last in _stretches(track, leader, steps):
        own, other = slice(first, last), leader[first:last]
        free = other[0] < 0
        if free and (named or not with_free or not drives[first]):
            continue
        if is_wrong[first] or (not free and is_wrong[other[0]]):  # who follows such a vehicle follows nobody else
            continue
        pair = Pair(
            recording=names[0][first],
            follower=names[1][first],
            leader="" if free else names[1][other[0]],
            start_s=float(time_s[first]),
            step_s=step_s,
            leader_rear_m=driven_m[own] + (math.inf if free else ahead_m[own] - length_m[other] / 2.0),
            leader_speed_mps=np.zeros(last - first) if free else speed_mps[other],
            front_m=driven_m[own] + length_m[own] / 2.0,
            speed_mps=speed_mps[own],
        )
        if time_s[last - 1] - time_s[first] < max(min_duration_s, step_s) - 1e-9:
            short += 1
        else:
            pairs.append(_at_step(pair, time_s[own]))
    return Recorded(tuple(pairs), (tracks.file,), (), short, len(wrong), int(steps.is_jump.sum()))


def _on_foot(table: pd.DataFrame) -> NDArray[np.bool_]:
    return table["vehicle_class"].map(is_on_foot).to_numpy(np.bool_)


def _driven_m(track: NDArray[np.int64], steps: Steps) -> Floats:
    """Return the distance that each vehicle has driven since its track began; (M,)."""
    steps_m = np.zeros(len(track))
    steps_m[steps.row] = steps.driven_m
    driven_m = np.cumsum(steps_m)
    return np.asarray(driven_m - driven_m[np.flatnonzero(np.diff(track, prepend=-1))][track])


def _inconsistent(tracks: Tracks, track: NDArray[np.int64], steps: Steps) -> NDArray[np.int64]:
    """Return the numbers of tracks on which vehicles move farther or less far than their speeds say.

    Missing frames do not count, nor do single jumps; where there are many, the units are wrong.

    Raises:
        InputError: there are so many such tracks that the units must be mixed.
    """
    rows, own = np.bincount(track), track[steps.row]
    single = steps.is_jump & (np.bincount(own[steps.is_jump], minlength=len(rows)) <= _FEW_JUMPS * rows)[own]
    counts = ~(steps.is_long | single)
    moved_m, expected_m = (
        np.bincount(own[counts], way_m[counts], len(rows)) for way_m in (steps.driven_m, steps.speed_mps * steps.time_s)
    )
    judged = np.maximum(expected_m, moved_m) > _MOVED_M
    ratio = moved_m / np.maximum(expected_m, 1e-9)
    wrong = judged & ~((ratio >= SAME_UNITS[0]) & (ratio <= SAME_UNITS[1]))
    if wrong.sum() > _MOST_WRONG * judged.sum():
        worst = np.flatnonzero(wrong)[0]
        vehicle = tracks.table["vehicle"].iloc[np.flatnonzero(track == worst)[0]]
        raise InputError(
            f"{tracks.file} has mixed units: vehicle {vehicle} moves {ratio[worst]:.3g} times as far as its speed "
            "says; give positions in m and speeds in m/s"
        )
    return np.flatnonzero(wrong)


def _by_moment(table: pd.DataFrame, drives: NDArray[np.bool_]) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Return the rows of vehicles that drive, moment by moment, and where in them each moment begins."""
    rows = np.flatnonzero(drives)
    milliseconds = np.round(table["time_s"].to_numpy()[rows] * 1000.0).astype(np.int64)
    recording = table["recording"].cat.codes.to_numpy()[rows]
    order = np.lexsort((rows, milliseconds, recording))
    changes = np.flatnonzero(np.diff(milliseconds[order]) | np.diff(recording[order])) + 1
    return rows[order], np.concatenate([[0], changes, [len(rows)]])


@compiled
def _find_leaders(
    rows: NDArray[np.int64],
    begins: NDArray[np.int64],
    track: NDArray[np.int64],
    x_m: Floats,
    y_m: Floats,
    heading_rad: Floats,
    driven_m: Floats,
    length_m: Floats,
    width_m: Floats,
    reach_m: float,
    straight_m: float,
    leader: NDArray[np.int64],
    ahead_m: Floats,
) -> None:
    """Write the row of each row's leader, -1 if there is none, and the distance to it along the way."""
    for moment in range(len(begins) - 1):
        for i in range(begins[moment], begins[moment + 1]):
            row, nearest_m = rows[i], reach_m
            along_x, along_y = math.cos(heading_rad[row]), math.sin(heading_rad[row])
            for j in range(begins[moment], begins[moment + 1]):
                other = rows[j]
                dx, dy = x_m[other] - x_m[row], y_m[other] - y_m[row]
                turned = math.cos(heading_rad[other] - heading_rad[row])
                far = dx * dx + dy * dy > nearest_m * nearest_m
                if other == row or far or dx * along_x + dy * along_y <= 0.0 or turned < math.cos(_SAME_DIRECTION_RAD):
                    continue
                beside_m = (width_m[row] + width_m[other]) / 2.0
                found_m = _along_way(
                    row, other, 1, track, x_m, y_m, heading_rad, driven_m, beside_m, nearest_m, straight_m
                )
                if found_m < 0.0:
                    found_m = _along_way(
                        other, row, -1, track, x_m, y_m, heading_rad, driven_m, beside_m, nearest_m, straight_m
                    )
                touching_m = (length_m[row] + length_m[other]) / 2.0
                if touching_m < found_m < nearest_m:
                    leader[row], nearest_m = other, found_m
                    ahead_m[row] = found_m


@compiled
def _along_way(
    row: int,
    other: int,
    direction: int,
    track: NDArray[np.int64],
    x_m: Floats,
    y_m: Floats,
    heading_rad: Floats,
    driven_m: Floats,
    most_beside_m: float,
    reach_m: float,
    straight_m: float,
) -> float:
    """Return how far along a vehicle's way another one is, or -1 if it is farther beside or beyond.

    The way goes on straight for ``straight_m`` where the track ends.

    Args:
        row: of the vehicle.
        other: row of the other one at this time.
        direction: 1 for the way from here on, -1 for the way to here.
    """
    way_m, nearest_m, found_m = 0.0, most_beside_m, -1.0
    at = row
    while way_m <= reach_m:
        after = at + direction
        is_last = after < 0 or after >= len(track) or track[after] != track[row]
        if is_last:
            along_x, along_y = direction * math.cos(heading_rad[at]), direction * math.sin(heading_rad[at])
            length_m = straight_m
        else:
            along_x, along_y = x_m[after] - x_m[at], y_m[after] - y_m[at]
            length_m = math.hypot(along_x, along_y)
            if length_m > 0.0:
                along_x, along_y = along_x / length_m, along_y / length_m
        dx, dy = x_m[other] - x_m[at], y_m[other] - y_m[at]
        along_m = min(max(dx * along_x + dy * along_y, 0.0), length_m)
        beside_m = math.hypot(dx - along_m * along_x, dy - along_m * along_y)
        if beside_m < nearest_m:
            nearest_m, found_m = beside_m, way_m + along_m
        if is_last:
            break
        at = after
        way_m = abs(driven_m[at] - driven_m[row])
    return found_m


def _stretches(track: NDArray[np.int64], leader: NDArray[np.int64], steps: Steps) -> Iterator[tuple[int, int]]:
    """Yield first and last row (exclusive) of each stretch of a track with one leader or none and without a break."""
    jumps, goes_on = np.zeros((2, len(track)), np.bool_)
    jumps[steps.row], goes_on[steps.row] = steps.is_jump, ~(steps.is_jump | steps.is_long)
    leading = np.where(leader >= 0, track[leader], -1)
    joined = goes_on[1:] & (leading[1:] == leading[:-1]) & ~((leader >= 0) & jumps[leader])[1:]
    bounds = np.concatenate([[0], np.flatnonzero(~joined) + 1, [len(track)]])
    for first, last in pairwise(bounds):
        if last - first > 1:
            yield int(first), int(last)


def _at_step(pair: Pair, time_s: Floats) -> Pair:
    """Return a pair with rows at its step in place of those at the times of the recording."""
    count = int((time_s[-1] - time_s[0]) / pair.step_s + 1e-6) + 1
    wanted_s = time_s[0] + pair.step_s * np.arange(count)
    columns = ("leader_rear_m", "leader_speed_mps", "front_m", "speed_mps")
    found = {name: np.interp(wanted_s, time_s, getattr(pair, name)) for name in columns}
    if not pair.leader:
        found["leader_rear_m"] = np.full(count, np.inf)
    return replace(pair, **found)
