"""Places recorded tracks on the lanes of a SUMO network.

A position is that of the middle of a vehicle's front, as SUMO counts it. The lanes of a track are its most likely
sequence of lanes (Viterbi): near the positions, along the headings, and connected over the distances driven.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pandas as pd
import shapely
from numpy.typing import NDArray

from tint_sumo.core.compiling import compiled
from tint_sumo.core.errors import InputError
from tint_sumo.core.files import write_frame
from tint_sumo.tracks.lanes import Lanes, Reach, reach, read_lanes
from tint_sumo.tracks.leaders import find_leaders, named
from tint_sumo.tracks.schema import Tracks

MARGIN_M = 1.5  # a front may be so far beside a lane
MOST_TURN_RAD = np.pi / 3  # between a vehicle and its lane
REASONS = ("far from all lanes", "across or against the lanes")
_FAR, _AGAINST = 1, 2
_OFFSET_M, _BEYOND_M, _TURN_RAD = 1.0, 0.1, 0.3  # scales of the errors across lanes, at their ends, and of headings
_STEP_M, _STEP_SHARE = 1.0, 0.2  # of the error of the distance between two rows
_CHANGE_COST, _JUMP_COST = 4.0, 60.0  # of a change of lanes, and of lanes without a way between them
_REACH_M = (50.0, 200.0)  # how far ways between lanes are looked for: at least, at most
_TANGENT_M = 0.25


@dataclass(frozen=True)
class Matched:
    """Tracks on the lanes of a network.

    ``table`` has the rows of the tracks and more columns: lane and edge (missing if a row is not placed), position_m
    and offset_m of the front along the lane and to the left of its middle, turn_rad from the lane's direction to the
    heading, leader, gap_m and time_gap_s from bumper to bumper (missing without a leader; the time gap also of vehicles
    that stand), and reason, which is empty where a row is placed.
    """

    tracks: Tracks
    lanes: Lanes
    table: pd.DataFrame
    fronts_m: NDArray[np.float64]  # (M, 2) in the network's coordinates
    jumps: int  # changes between lanes without a way between them


@dataclass(frozen=True)
class _Candidates:
    """Lanes that rows may be on; those of row k from ``first[k]`` to ``first[k + 1]``."""

    first: NDArray[np.int64]  # (M + 1,)
    lane: NDArray[np.int64]  # (C,)
    position_m: NDArray[np.float64]  # (C,)
    offset_m: NDArray[np.float64]  # (C,) to the left
    beyond_m: NDArray[np.float64]  # (C,) how far before the beginning of the lane, or behind its end
    turn_rad: NDArray[np.float64]  # (C,)
    reason: NDArray[np.int64]  # (M,) why a row has none


def match(tracks: Tracks, net_file: Path, shift_m: Sequence[float] = (0.0, 0.0)) -> Matched:
    """Place tracks on the lanes of a network, and find their leaders.

    Args:
        tracks: to place; geographic ones are projected as the network is.
        net_file: network of SUMO.
        shift_m: added to the positions of the tracks.

    Raises:
        InputError: the network cannot be read, or does not belong to the tracks.
    """
    lanes = read_lanes(net_file)
    fronts = _fronts(tracks, lanes) + np.asarray(shift_m, np.float64)
    candidates = _candidates(tracks, lanes, fronts)
    if not len(candidates.lane):
        raise InputError(_strangers(tracks, lanes, fronts))
    moved_m = np.r_[0.0, np.linalg.norm(np.diff(fronts, axis=0), axis=1)]
    track = tracks.track_number
    longest_m = moved_m[1:][np.diff(track) == 0].max(initial=0.0)
    ways = reach(lanes, float(np.clip(2.0 * longest_m, *_REACH_M)))
    chosen, jumps = _most_likely(track, moved_m, candidates, ways)
    table = _table(tracks, lanes, candidates, chosen)
    return Matched(tracks, lanes, find_leaders(table, lanes, _chosen_lanes(candidates, chosen)), fronts, jumps)


def _chosen_lanes(candidates: _Candidates, chosen: NDArray[np.int64]) -> NDArray[np.int64]:
    """Return the number of each row's lane, -1 if it has none; (M,)."""
    return np.where(chosen >= 0, candidates.lane[chosen], -1)


def _fronts(tracks: Tracks, lanes: Lanes) -> NDArray[np.float64]:
    """Return the middles of the vehicles' fronts in the network's coordinates; (M, 2)."""
    table = tracks.table
    centres = table[["x_m", "y_m"]].to_numpy()
    if tracks.crs is not None and lanes.projection is not None:
        from pyproj import Transformer  # noqa: PLC0415 - an extra, which has read the tracks already

        projected = Transformer.from_crs(tracks.crs, lanes.projection, always_xy=True).transform(*centres.T)
        centres = np.stack(projected, axis=1) + lanes.offset_m
    heading_rad = table["heading_rad"].to_numpy()
    along = np.stack([np.cos(heading_rad), np.sin(heading_rad)], axis=1)
    return np.asarray(centres + along * table["length_m"].to_numpy()[:, None] / 2.0)


def _candidates(tracks: Tracks, lanes: Lanes, fronts: NDArray[np.float64]) -> _Candidates:
    points = shapely.points(fronts)
    tree = shapely.STRtree(lanes.lines)
    row, lane = tree.query(points, predicate="dwithin", distance=lanes.width_m.max() / 2.0 + MARGIN_M)
    line = lanes.lines[lane]
    at_m = shapely.line_locate_point(line, points[row])
    nearest = shapely.get_coordinates(shapely.line_interpolate_point(line, at_m))
    line_m = shapely.length(line)
    ends = [
        shapely.get_coordinates(shapely.line_interpolate_point(line, np.clip(at_m + step_m, 0.0, line_m)))
        for step_m in (-_TANGENT_M, _TANGENT_M)
    ]
    along = (ends[1] - ends[0]) / np.linalg.norm(ends[1] - ends[0], axis=1, keepdims=True)
    beside = fronts[row] - nearest
    offset_m = along[:, 0] * beside[:, 1] - along[:, 1] * beside[:, 0]
    turn_rad = tracks.table["heading_rad"].to_numpy()[row] - np.arctan2(along[:, 1], along[:, 0])
    turn_rad = (turn_rad + np.pi) % (2.0 * np.pi) - np.pi
    beyond_m = np.abs((along * beside).sum(axis=1))
    near = (np.abs(offset_m) <= lanes.width_m[lane] / 2.0 + MARGIN_M) & (beyond_m <= MARGIN_M)
    fits = near & (np.abs(turn_rad) <= MOST_TURN_RAD)
    reason = np.full(len(fronts), _FAR)
    reason[row[near]] = _AGAINST
    reason[row[fits]] = 0
    row, lane = row[fits], lane[fits]
    order = np.argsort(row, kind="stable")
    return _Candidates(
        np.searchsorted(row[order], np.arange(len(fronts) + 1)),
        lane[order],
        (at_m[fits] * lanes.length_m[lane] / line_m[fits])[order],
        offset_m[fits][order],
        beyond_m[fits][order],
        turn_rad[fits][order],
        reason,
    )


def _strangers(tracks: Tracks, lanes: Lanes, fronts: NDArray[np.float64]) -> str:
    """Return a message about tracks that do not belong to a network."""
    left, bottom, right, top = lanes.extent_m
    (low_x, low_y), (high_x, high_y) = fronts.min(axis=0), fronts.max(axis=0)
    apart_m = float(np.hypot(max(left - high_x, low_x - right, 0.0), max(bottom - high_y, low_y - top, 0.0)))
    how_far = f"their bounding boxes are {apart_m:,.0f} m apart" if apart_m else "no position lies on a lane"
    return (
        f"{lanes.file} does not belong to {tracks.file}: {how_far}; offsets or projections may differ: give `shift_m`, "
        "or another network"
    )


def _most_likely(
    track: NDArray[np.int64], moved_m: NDArray[np.float64], candidates: _Candidates, ways: Reach
) -> tuple[NDArray[np.int64], int]:
    """Return the number of the candidate of each row in the most likely sequence, -1 if it has none, and the jumps."""
    costs = (candidates.offset_m / _OFFSET_M) ** 2 + (candidates.turn_rad / _TURN_RAD) ** 2
    costs += (candidates.beyond_m / _BEYOND_M) ** 2
    chosen = np.full(len(track), -1, np.int64)
    jumps = _viterbi(
        track,
        moved_m,
        candidates.first,
        candidates.lane,
        candidates.position_m,
        costs,
        ways.first,
        ways.lane,
        ways.distance_m,
        ways.changes,
        chosen,
    )
    return chosen, int(jumps)


@compiled
def _viterbi(
    track: NDArray[np.int64],
    moved_m: NDArray[np.float64],
    first: NDArray[np.int64],
    lane: NDArray[np.int64],
    position_m: NDArray[np.float64],
    costs: NDArray[np.float64],
    reach_first: NDArray[np.int64],
    reach_lane: NDArray[np.int64],
    reach_m: NDArray[np.float64],
    reach_changes: NDArray[np.int64],
    chosen: NDArray[np.int64],
) -> int:
    """Write the candidates of the most likely sequences into ``chosen``; return the number of jumps."""
    best = np.zeros(len(lane))  # costs of the best sequence up to each candidate
    before = np.full(len(lane), -1)
    has_jumped = np.zeros(len(lane), np.bool_)
    jumps = 0
    last = -1  # row with candidates
    driven_m = 0.0  # since that row
    for row in range(len(track) + 1):
        is_new = row == len(track) or row == 0 or track[row] != track[row - 1]
        if is_new:
            if last >= 0:
                jumps += _trace(last, first, best, before, has_jumped, chosen)
            last, driven_m = -1, 0.0
        if row == len(track):
            break
        driven_m += 0.0 if is_new else moved_m[row]
        if first[row] == first[row + 1]:
            continue
        for one in range(first[row], first[row + 1]):
            best[one] = costs[one]
            if last < 0:
                continue
            least, source, jumped = np.inf, -1, False
            for other in range(first[last], first[last + 1]):
                step, jump = _JUMP_COST, True
                for way in range(reach_first[lane[other]], reach_first[lane[other] + 1]):
                    if reach_lane[way] == lane[one]:
                        error_m = reach_m[way] + position_m[one] - position_m[other] - driven_m
                        cost = (error_m / (_STEP_M + _STEP_SHARE * driven_m)) ** 2 + _CHANGE_COST * reach_changes[way]
                        if cost < step:
                            step, jump = cost, False
                        break
                if best[other] + step < least:
                    least, source, jumped = best[other] + step, other, jump
            best[one] += least
            before[one] = source
            has_jumped[one] = jumped
        last, driven_m = row, 0.0
    return jumps


@compiled
def _trace(
    last: int,
    first: NDArray[np.int64],
    best: NDArray[np.float64],
    before: NDArray[np.int64],
    has_jumped: NDArray[np.bool_],
    chosen: NDArray[np.int64],
) -> int:
    """Write the best sequence that ends in a row, from its end to its beginning; return the number of its jumps."""
    one = first[last] + np.argmin(best[first[last] : first[last + 1]])
    row, jumps = last, 0
    while one >= 0:
        while not first[row] <= one < first[row + 1]:
            row -= 1
        chosen[row] = one
        jumps += has_jumped[one]
        one = before[one]
    return jumps


def _table(tracks: Tracks, lanes: Lanes, candidates: _Candidates, chosen: NDArray[np.int64]) -> pd.DataFrame:
    """Return the rows of the tracks with what is known of their lanes."""
    placed = chosen >= 0
    lane = _chosen_lanes(candidates, chosen)
    edge = np.where(placed, lanes.edge[lane], -1)

    def values(of_candidates: NDArray[np.float64]) -> NDArray[np.float64]:
        return np.where(placed, of_candidates[chosen], np.nan)

    return tracks.table.assign(
        edge=named(edge, lanes.edges),
        lane=named(lane, lanes.ids),
        position_m=values(candidates.position_m),
        offset_m=values(candidates.offset_m),
        turn_rad=values(candidates.turn_rad),
        reason=named(candidates.reason, ["", *REASONS]),
    )


def write_table(matched: Matched, file: Path) -> None:
    """Write the table as .parquet or .csv; numbers in CSV have six digits after the point."""
    write_frame(matched.table, file, "%.6f")
