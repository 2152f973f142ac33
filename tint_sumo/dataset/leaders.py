"""Gaps to the leaders of vehicles on any SUMO network, from floating-car data."""

from dataclasses import dataclass
from pathlib import Path
from typing import Any, Self

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from tint_sumo.config import NO_LEADER_GAP_M
from tint_sumo.core.errors import InputError
from tint_sumo.scenes.sumocfg import read_net


@dataclass(frozen=True)
class Lanes:
    """The L lanes of a SUMO network, with those inside junctions."""

    names: pd.Index  # SUMO ids
    length_m: NDArray[np.float64]  # (L,)
    successor: NDArray[np.int64]  # (L,): the lane that follows where there is but one way on, -1 otherwise

    @classmethod
    def read(cls, net_file: Path) -> Self:
        """Raises InputError if there is no such file or it is not a SUMO network."""
        net = read_net(net_file)
        lanes = [lane for edge in net.getEdges() for lane in edge.getLanes()]
        if not lanes:
            raise InputError(f"{net_file} has no lanes; give the scenario's .net.xml")
        names = pd.Index([lane.getID() for lane in lanes])
        length_m = np.array([lane.getLength() for lane in lanes])
        return cls(names, length_m, names.get_indexer(pd.Index([_successor(lane) for lane in lanes])))

    def numbers(self, names: pd.Index) -> NDArray[np.int64]:
        """Of lanes by their ids.

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


def gaps_m(rows: pd.DataFrame, vehicle_length_m: float, lanes: Lanes | None = None) -> NDArray[np.float64]:
    """Gap (M,) from each vehicle's front to the back of the next one ahead at that time; NaN if none is seen.

    A leader is seen on the vehicle's own lane and, if ``lanes`` are given, on those that follow it without a choice and
    begin so near that the gap can be less than ``NO_LEADER_GAP_M``.

    Args:
        rows: columns time_s, lane and pos_m as ``tint_sumo.dataset.fcd_reading.read_fcd`` gives them.
        vehicle_length_m: of all vehicles; floating-car data do not tell it.
        lanes: of the network.

    Raises:
        InputError: the network lacks a lane of the rows.
    """
    names = rows["lane"].cat.categories if lanes is None else lanes.names
    number = np.arange(len(names)) if lanes is None else lanes.numbers(rows["lane"].cat.categories)
    lane, pos_m = number[rows["lane"].cat.codes], rows["pos_m"].to_numpy()
    when = np.unique(rows["time_s"], return_inverse=True)[1] * len(names)
    place = when + lane
    order = np.lexsort((pos_m, place))
    queue, queue_m = place[order], pos_m[order]  # each lane at each time, from the rearmost vehicle to the first

    distance_m = np.full(len(rows), np.nan)
    distance_m[order[:-1]] = np.where(queue[1:] == queue[:-1], np.diff(queue_m), np.nan)
    if lanes is None:
        return distance_m - vehicle_length_m
    row = np.flatnonzero(np.isnan(distance_m))
    to_end_m, ahead = lanes.length_m[lane[row]] - pos_m[row], lanes.successor[lane[row]]
    while len(row):
        seen = (ahead >= 0) & (to_end_m < NO_LEADER_GAP_M + vehicle_length_m)
        row, to_end_m, ahead = row[seen], to_end_m[seen], ahead[seen]
        rearmost = np.searchsorted(queue, when[row] + ahead).clip(max=len(queue) - 1)
        found = queue[rearmost] == when[row] + ahead
        distance_m[row[found]] = (to_end_m + queue_m[rearmost])[found]
        row, to_end_m, ahead = row[~found], to_end_m[~found], ahead[~found]
        to_end_m, ahead = to_end_m + lanes.length_m[ahead], lanes.successor[ahead]
    return distance_m - vehicle_length_m
