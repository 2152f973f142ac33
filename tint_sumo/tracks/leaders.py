"""Leaders in recorded traffic: the next vehicle ahead on the way that a vehicle takes."""

from collections.abc import Sequence

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from tint_sumo.tracks.lanes import Lanes

LOOK_AHEAD_M = 100.0
_MOVES_MPS = 0.1  # slower vehicles have no time gap


def find_leaders(table: pd.DataFrame, lanes: Lanes, lane: NDArray[np.int64]) -> pd.DataFrame:
    """Add leader, gap_m and time_gap_s to a table of tracks on lanes.

    The way of a vehicle leads along its lane and then over the edges that it takes later in its track; behind its last
    edge it goes on as long as there is one way. Vehicles that merge into it from elsewhere lead when they are on it.

    Args:
        table: rows with recording, vehicle, time_s, position_m, length_m and speed_mps, sorted by these first three.
        lanes: of the network.
        lane: (M,) number of each row's lane, -1 if it has none.
    """
    rows = np.flatnonzero(lane >= 0)
    track = table.groupby(["recording", "vehicle"], observed=True, sort=False).ngroup().to_numpy()
    is_new = np.r_[True, (np.diff(track[rows]) != 0) | (np.diff(lane[rows]) != 0)]
    stay = np.cumsum(is_new) - 1  # number of the stay on a lane that each row belongs to
    ways = _ways(lanes, track[rows], lane[rows], np.flatnonzero(is_new))
    moment = table.groupby(["recording", "time_s"], observed=True, sort=False).ngroup().to_numpy()[rows]
    position_m = table["position_m"].to_numpy()
    here = pd.DataFrame({"row": rows, "stay": stay, "moment": moment, "from_m": position_m[rows]})
    there = pd.DataFrame({"other": rows, "lane": lane[rows], "moment": moment, "at_m": position_m[rows]})
    pairs = here.merge(ways, on="stay").merge(there, on=["moment", "lane"])
    pairs["ahead_m"] = pairs["begin_m"] + pairs["at_m"] - pairs["from_m"]
    pairs = pairs[(pairs["row"] != pairs["other"]) & (pairs["ahead_m"] >= 0.0)]
    pairs = pairs.sort_values(["row", "ahead_m", "other"], kind="stable").drop_duplicates("row")
    pairs = pairs[pairs["ahead_m"] <= LOOK_AHEAD_M]
    row, other = pairs["row"].to_numpy(), pairs["other"].to_numpy()
    gap_m = np.full(len(table), np.nan)
    gap_m[row] = pairs["ahead_m"].to_numpy() - table["length_m"].to_numpy()[other]
    speed_mps = table["speed_mps"].to_numpy()
    leader = np.full(len(table), -1)
    leader[row] = table["vehicle"].cat.codes.to_numpy()[other]
    return table.assign(
        leader=named(leader, table["vehicle"].cat.categories),
        gap_m=gap_m,
        time_gap_s=np.where(speed_mps > _MOVES_MPS, gap_m / np.maximum(speed_mps, _MOVES_MPS), np.nan),
    )


def named(numbers: NDArray[np.integer], names: Sequence[str] | pd.Index) -> pd.Categorical:
    """Return names by their numbers, missing for -1."""
    return pd.Categorical.from_codes(np.asarray(numbers, np.int64), pd.Index(names))


def _ways(
    lanes: Lanes, track: NDArray[np.integer], lane: NDArray[np.integer], first: NDArray[np.integer]
) -> pd.DataFrame:
    """Return the lanes ahead of each stay on a lane, with the distance to their beginnings from that of its lane."""
    tracks, stays = track[first].tolist(), lane[first].tolist()
    found = []
    later: set[int] = set()  # edges that the vehicle takes afterwards
    for number in reversed(range(len(stays))):
        if number + 1 < len(stays) and tracks[number + 1] == tracks[number]:
            later.add(int(lanes.edge[stays[number + 1]]))
        else:
            later = set()
        found += [(number, one, begin_m) for one, begin_m in _way(lanes, stays[number], later)]
    return pd.DataFrame(found, columns=["stay", "lane", "begin_m"])


def _way(lanes: Lanes, start: int, edges: set[int]) -> list[tuple[int, float]]:
    """Return the lanes of a way over edges, one behind the other, as far as vehicles ahead matter."""
    way = [(start, 0.0)]
    length_m = float(lanes.length_m[start])
    while length_m <= lanes.length_m[start] + LOOK_AHEAD_M:
        after = lanes.successors[way[-1][0]]
        taken = [one for one in after if lanes.edge[one] in edges]
        following = taken[0] if taken else after[0] if len(after) == 1 else None
        if following is None or any(following == one for one, _ in way):
            return way
        way.append((following, length_m))
        length_m += float(lanes.length_m[following])
    return way
