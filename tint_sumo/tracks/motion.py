"""Compute the steps of recorded tracks: distance driven, speed, acceleration, position jumps and missing frames."""

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from tint_sumo.core.compiling import compiled
from tint_sumo.tracks.schema import Tracks

MOST_ACCELERATION_MPS2 = 10.0  # cars brake with at most 9 to 10 m/s2 on dry roads
SAME_UNITS = (0.8, 1.25)  # of the distance driven to the speed times the time, in recordings without mistakes
_LONG_STEP = 1.5  # times the usual step of a recording: frames are missing
_JUMP_M = 1.0  # noise of a position
_NOISY_M = 2.0  # the direction of a shorter step is that of the way around it: its own would be noise


@dataclass(frozen=True, eq=False)
class Steps:
    """Changes from each row to the next one of its track; arrays (S,)."""

    usual_s: float  # median time of a step; 0 if there is none
    row: NDArray[np.int64]  # the later of the two
    time_s: NDArray[np.float64]
    driven_m: NDArray[np.float64]  # along the way, below 0 where noise or the vehicle goes back
    speed_mps: NDArray[np.float64]  # mean of both rows
    acceleration_mps2: NDArray[np.float64]
    is_long: NDArray[np.bool_]  # frames are missing between the rows
    is_jump: NDArray[np.bool_]  # farther than the speeds and any acceleration allow


def steps_of(tracks: Tracks) -> Steps:
    """Return the steps of some tracks.

    The way driven is measured along the way itself. The length of the steps would grow with the noise of the
    positions, most of all while a vehicle stands.
    """
    table, track = tracks.table, tracks.track_number
    row = np.flatnonzero(track[1:] == track[:-1]) + 1
    x_m, y_m, speed_mps, time_s = (table[name].to_numpy() for name in ("x_m", "y_m", "speed_mps", "time_s"))
    step_s = time_s[row] - time_s[row - 1]
    straight_m = np.hypot(x_m[row] - x_m[row - 1], y_m[row] - y_m[row - 1])
    fastest_m = np.maximum(speed_mps[row], speed_mps[row - 1]) * step_s + MOST_ACCELERATION_MPS2 * step_s**2 / 2.0
    usual_s = float(np.median(step_s)) if len(step_s) else 0.0
    is_long, is_jump = step_s > _LONG_STEP * usual_s, straight_m > fastest_m + _JUMP_M
    begins = np.ones(len(track), np.bool_)  # of parts without a break
    begins[row] = is_long | is_jump
    driven_m = np.zeros(len(track))
    driven_m[row] = straight_m
    _write_driven(np.cumsum(begins), x_m, y_m, driven_m)
    return Steps(
        usual_s,
        row,
        step_s,
        driven_m[row],
        (speed_mps[row] + speed_mps[row - 1]) / 2.0,
        (speed_mps[row] - speed_mps[row - 1]) / step_s,
        is_long,
        is_jump,
    )


@compiled
def _write_driven(
    part: NDArray[np.int64], x_m: NDArray[np.float64], y_m: NDArray[np.float64], driven_m: NDArray[np.float64]
) -> None:
    """Replace lengths of short steps by those along the way from the points that lie ``_NOISY_M`` behind and ahead.

    Args:
        part: (M,) numbers of the parts of tracks without a break, whose rows lie together and are sorted by time.
        x_m, y_m: (M,) positions.
        driven_m: (M,) lengths of the steps to each row.
    """
    behind, ahead = 0, 0
    for row in range(1, len(part)):
        before = row - 1
        if part[row] != part[before]:
            behind = row
            continue
        while behind < before and math.hypot(x_m[before] - x_m[behind + 1], y_m[before] - y_m[behind + 1]) >= _NOISY_M:
            behind += 1
        ahead = max(ahead, row)
        while (
            ahead + 1 < len(part)
            and part[ahead + 1] == part[row]
            and math.hypot(x_m[ahead] - x_m[row], y_m[ahead] - y_m[row]) < _NOISY_M
        ):
            ahead += 1
        along_x, along_y = x_m[ahead] - x_m[behind], y_m[ahead] - y_m[behind]
        length_m = math.hypot(along_x, along_y)
        if driven_m[row] < _NOISY_M and length_m > 0.0:
            along_x, along_y = along_x / length_m, along_y / length_m
            driven_m[row] = (x_m[row] - x_m[before]) * along_x + (y_m[row] - y_m[before]) * along_y
