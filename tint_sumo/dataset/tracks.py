"""Tracks of vehicles at steps of 0.1 s, from floating-car data of any SUMO scenario or from a recorded dataset."""

from dataclasses import dataclass
from pathlib import Path
from typing import Any, Self

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from tint_sumo.config import NO_LEADER_GAP_M, STEP_S, VehicleShape
from tint_sumo.core.errors import InputError
from tint_sumo.dataset.fcd import EPISODE_PERIOD_S
from tint_sumo.dataset.fcd_reader import are_parked, read_fcd
from tint_sumo.dataset.schema import TRAJECTORIES, read_shard, read_shard_metadata
from tint_sumo.scenes.sumocfg import read_net
from tint_sumo.simulation.vtypes import find_vtype, read_vtype_table

MAX_STEP_S = 1.0  # a straight line between farther points would be no driving any more
_POS_DIGIT_M = 0.01  # SUMO's default precision
_RECORDED_COLUMNS = ("episode", "vehicle", "time_s", "position_m", "gap_m")


@dataclass(frozen=True)
class Lanes:
    """The L lanes of a SUMO network, with those inside junctions."""

    names: pd.Index  # SUMO ids
    length_m: NDArray[np.float64]  # (L,)
    successor: NDArray[np.int64]  # (L,): the lane that follows where there is but one way on, -1 otherwise

    @classmethod
    def read(cls, net_file: Path) -> Self:
        """Read a SUMO network.

        Raises:
            InputError: there is no such file, or it is not a SUMO network.
        """
        net = read_net(net_file)
        lanes = [lane for edge in net.getEdges() for lane in edge.getLanes()]
        if not lanes:
            raise InputError(f"{net_file} has no lanes; give the scenario's .net.xml")
        names = pd.Index([lane.getID() for lane in lanes])
        length_m = np.array([lane.getLength() for lane in lanes])
        return cls(names, length_m, names.get_indexer(pd.Index([_successor(lane) for lane in lanes])))

    def numbers(self, names: pd.Index) -> NDArray[np.int64]:
        """Return the numbers of lanes with these ids.

        Raises:
            InputError: the network has no such lane.
        """
        found = self.names.get_indexer(names)
        if (found < 0).any():
            raise InputError(f"the network has no lane {names[found < 0][0]}; give the .net.xml of the same scenario")
        return np.asarray(found, np.int64)


def _successor(lane: Any) -> str:
    ways = [connection.getViaLaneID() or connection.getToLane().getID() for connection in lane.getOutgoing()]
    return ways[0] if len(ways) == 1 else ""


def gaps_m(
    rows: pd.DataFrame,
    length_m: NDArray[np.float64],
    lanes: Lanes | None = None,
    reach_m: float = NO_LEADER_GAP_M,
) -> NDArray[np.float64]:
    """Return the gap (M,) from each vehicle's front to the back of the next vehicle at that time; NaN if none is seen.

    A leader is seen on the vehicle's lane and, if ``lanes`` are given, on those that follow it without a choice and
    begin so near that the gap can be less than ``reach_m``.

    Args:
        rows: columns time_s, lane and pos_m as ``tint_sumo.dataset.fcd_reader.read_fcd`` gives them.
        length_m: of each row's vehicle, (M,).
        lanes: of the network.
        reach_m: gap from which on a leader counts as none.

    Raises:
        InputError: the network lacks a lane of the rows.
    """
    names = rows["lane"].cat.categories if lanes is None else lanes.names
    number = np.arange(len(names)) if lanes is None else lanes.numbers(rows["lane"].cat.categories)
    lane, pos_m = number[rows["lane"].cat.codes], rows["pos_m"].to_numpy()
    back_m = pos_m - length_m
    when = np.unique(rows["time_s"], return_inverse=True)[1] * len(names)
    lane_then = when + lane
    order = np.lexsort((pos_m, lane_then))
    queue, queue_back_m = (
        lane_then[order],
        back_m[order],
    )  # each lane at each time, from the rearmost vehicle to the first

    gap_m = np.full(len(rows), np.nan)
    gap_m[order[:-1]] = np.where(queue[1:] == queue[:-1], queue_back_m[1:] - pos_m[order[:-1]], np.nan)
    if lanes is None:
        return gap_m
    row = np.flatnonzero(np.isnan(gap_m))
    to_end_m, ahead = lanes.length_m[lane[row]] - pos_m[row], lanes.successor[lane[row]]
    while len(row):
        seen = (ahead >= 0) & (to_end_m < reach_m + length_m.max())
        row, to_end_m, ahead = row[seen], to_end_m[seen], ahead[seen]
        rearmost = np.searchsorted(queue, when[row] + ahead).clip(max=len(queue) - 1)
        found = queue[rearmost] == when[row] + ahead
        gap_m[row[found]] = (to_end_m + queue_back_m[rearmost])[found]
        row, to_end_m, ahead = row[~found], to_end_m[~found], ahead[~found]
        to_end_m, ahead = to_end_m + lanes.length_m[ahead], lanes.successor[ahead]
    return gap_m


def read_tracks(
    source: Path,
    *,
    net_file: Path | None = None,
    vehicle_length_m: float = VehicleShape().length_m,
    vtypes_file: Path | None = None,
    reach_m: float = NO_LEADER_GAP_M,
) -> pd.DataFrame:
    """Return rows of tracks, sorted by track and time, at steps of 0.1 s.

    Data in other steps, up to 1 s, are interpolated linearly. A vehicle that is missing for a step starts a new track.
    Vehicles that are parked beside their lane are missing: they follow nobody, and nobody follows them.

    Args:
        source: floating-car data, a dataset's folder, its ``trajectories/`` or one file of them.
        net_file: network of floating-car data; with it leaders are seen beyond the end of a lane.
        vehicle_length_m: of the vehicles in floating-car data, if no file of vTypes says it.
        vtypes_file: route file, additional file or .sumocfg with the vTypes of floating-car data.
        reach_m: gap up to which leaders are seen beyond the end of a lane.

    Returns:
        Columns vehicle (category; EPISODE.VEHICLE for a dataset), track (number), time_s (episode e of a dataset starts
        at e minutes, as in its floating-car data), position_m (of which differences count) and gap_m (bumper to bumper
        to the leader, NaN without one).

    Raises:
        InputError: unusable files, a length that is not positive, or steps of more than 1 s.
    """
    if not 0.0 < vehicle_length_m < np.inf:
        raise InputError(f"vehicle length must be positive, not {vehicle_length_m} m")
    recorded = _trajectories_in(source)
    if recorded is not None:
        if net_file is not None or vtypes_file is not None:
            raise InputError(f"{source} knows its leaders; leave network and vTypes out")
        return _in_steps(_recorded(recorded), source)
    lanes = None if net_file is None else Lanes.read(net_file)
    rows = read_fcd(source)
    length_m = np.full(len(rows), vehicle_length_m) if vtypes_file is None else _lengths_m(rows, vtypes_file, source)
    on_road = ~are_parked(rows)
    if not on_road.any():
        raise InputError(f"{source} has parked vehicles only; write it again with traffic in it")
    return _in_steps(_driven(rows[on_road], length_m[on_road], lanes, reach_m), source)


def _lengths_m(rows: pd.DataFrame, vtypes_file: Path, source: Path) -> NDArray[np.float64]:
    """Return the length of each row's vehicle, (M,), by its vType."""
    if "vehicle_class" not in rows:
        raise InputError(f"{source} lacks the vehicles' types; run SUMO without --fcd-output.attributes")
    known, vtypes = read_vtype_table(vtypes_file), rows["vehicle_class"].cat
    lengths_m = []
    for name in vtypes.categories:
        vtype = find_vtype(name, known)
        if vtype is None:
            raise InputError(
                f"{vtypes_file} has no vType {name!r}, which vehicles of {source} have; give the file that has"
            )
        lengths_m.append(vtype.length_m)
    return np.array(lengths_m)[vtypes.codes]


def _trajectories_in(source: Path) -> Path | None:
    """Return the Parquet file or folder with this project's trajectories; None if it must be floating-car data."""
    if source.is_dir():
        folder = source / TRAJECTORIES if (source / TRAJECTORIES).is_dir() else source
        if not any(folder.glob("shard-*.parquet")):
            raise InputError(f"{source} holds no trajectories; give a dataset's folder or a file of floating-car data")
        return folder
    if source.suffix == ".parquet" and source.is_file():
        return source if set(_RECORDED_COLUMNS) <= set(read_shard_metadata(source).schema.names) else None
    return None


def _recorded(source: Path) -> pd.DataFrame:
    """Return columns vehicle, time_s, position_m and gap_m, by vehicle and time."""
    rows = read_shard(source, list(_RECORDED_COLUMNS))
    number, vehicles = pd.MultiIndex.from_frame(rows[["episode", "vehicle"]]).factorize()
    ids = [f"{episode}.{vehicle}" for episode, vehicle in vehicles]
    return pd.DataFrame(
        {
            "vehicle": pd.Categorical.from_codes(number, pd.Index(ids)),
            "time_s": rows["episode"] * EPISODE_PERIOD_S + rows["time_s"].astype(float).round(3),
            "position_m": rows["position_m"].astype(float),
            "gap_m": rows["gap_m"].astype(float),
        }
    )


def _driven(rows: pd.DataFrame, length_m: NDArray[np.float64], lanes: Lanes | None, reach_m: float) -> pd.DataFrame:
    """Return columns vehicle, time_s, position_m and gap_m, by vehicle and time.

    Speeds are the finer measure of displacements: rounded to 0.01 m/s they give those of 0.1 s to the millimetre, and
    SUMO's displacements are speed times step. Positions on one lane correct them beyond a position's last digit.
    """
    rows = rows.assign(gap_m=gaps_m(rows, length_m, lanes, reach_m))
    rows = rows.sort_values(["vehicle", "time_s"], ignore_index=True)
    moved_m = rows["pos_m"].diff().to_numpy()
    along_lane = (rows["lane"].cat.codes.diff() == 0).to_numpy() & (moved_m > -_POS_DIGIT_M)
    moved_m = np.where(along_lane, moved_m, np.nan)
    by_speed_m = (rows["speed_mps"] * rows["time_s"].diff()).to_numpy()
    displacement_m = np.fmin(np.fmax(by_speed_m, moved_m - _POS_DIGIT_M), moved_m + _POS_DIGIT_M)
    displacement_m[0] = 0.0  # a difference to another vehicle's position means nothing
    return rows[["vehicle", "time_s", "gap_m"]].assign(position_m=np.cumsum(displacement_m))


def _in_steps(rows: pd.DataFrame, source: Path) -> pd.DataFrame:
    """Return columns vehicle, track, time_s, position_m and gap_m at steps of 0.1 s, of rows by vehicle and time."""
    interval_s = rows["time_s"].diff().to_numpy()[1:]
    same = (rows["vehicle"].cat.codes.diff() == 0).to_numpy()[1:]
    step_s = _step_s(interval_s[same], source)
    start = np.flatnonzero(np.r_[True, ~same | (np.abs(interval_s - step_s) > step_s / 2)])
    rows_each = np.diff(np.r_[start, len(rows)])
    steps_each = np.floor(np.round((rows_each - 1) * step_s / STEP_S, 6)).astype(np.int64) + 1

    track = np.repeat(np.arange(len(start)), steps_each)
    step = np.arange(len(track)) - np.repeat(np.cumsum(steps_each) - steps_each, steps_each)
    passed = np.round(step * STEP_S / step_s, 6)  # rows since the track's start
    before = start[track] + np.floor(passed).astype(np.int64)
    part = passed % 1.0

    def interpolated(column: str) -> NDArray[np.float64]:
        values = rows[column].to_numpy(np.float64)
        return np.asarray(values[before] + part * (values[before + (part > 0.0)] - values[before]))

    columns = {column: interpolated(column) for column in ("time_s", "position_m", "gap_m")}
    return pd.DataFrame({"vehicle": rows["vehicle"].iloc[before].array, "track": track, **columns})


def _step_s(interval_s: NDArray[np.float64], source: Path) -> float:
    """Return the usual time between two rows of a vehicle, from all such times."""
    if not len(interval_s):
        raise InputError(f"{source} has no vehicle for two timesteps; write a longer run")
    if (interval_s <= 0.0).any():
        raise InputError(f"{source} has a vehicle twice at one time; write it again, in steps of 0.01 s or more")
    step_s = round(float(np.median(interval_s)), 6)
    if step_s > MAX_STEP_S:
        raise InputError(f"{source} has steps of {step_s:g} s; write it with a period of {MAX_STEP_S:g} s at most")
    return step_s
