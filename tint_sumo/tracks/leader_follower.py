"""Pairs of a leader and its follower on one lane: a CSV file with the positions and speeds of both along the road.

Format: https://github.com/usdot-fhwa-stol, calibration data of To-21-426.
"""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from tint_sumo.config import VehicleShape
from tint_sumo.core.errors import InputError
from tint_sumo.tracks.reading import Head, TrackFormat, read_csv, register
from tint_sumo.tracks.schema import UNKNOWN

_NUMBERS = ["timestamp", "xLeaderReal", "vLeaderReal", "xFollowerReal", "vFollowerReal"]


def _read(file: Path) -> Mapping[str, Any]:
    """Read a pair. Positions are taken for those of the centres; vehicles have the standard size, as none is given."""
    rows = read_csv(file, _NUMBERS, ["run_no", "leader_id", "follower_id"])
    behind = np.flatnonzero(rows["xLeaderReal"].to_numpy() <= rows["xFollowerReal"].to_numpy())
    if len(behind):
        raise InputError(
            f"{file}, row {behind[0] + 1}: the leader is not ahead of its follower; give positions that grow along "
            "the way"
        )
    shape = VehicleShape()
    return {
        "recording": pd.concat([rows["run_no"]] * 2, ignore_index=True),
        "vehicle": pd.concat([rows["leader_id"], rows["follower_id"]], ignore_index=True),
        "time_s": pd.concat([rows["timestamp"]] * 2, ignore_index=True),
        "x_m": pd.concat([rows["xLeaderReal"], rows["xFollowerReal"]], ignore_index=True),
        "y_m": 0.0,
        "heading_rad": 0.0,
        "speed_mps": pd.concat([rows["vLeaderReal"], rows["vFollowerReal"]], ignore_index=True),
        "length_m": shape.length_m,
        "width_m": shape.width_m,
        "vehicle_class": UNKNOWN,
    }


def _is_pair(head: Head) -> bool:
    return {"leader_id", "follower_id", "xleaderreal", "xfollowerreal"} <= head.columns


register(TrackFormat("leader_follower", "leader-follower CSV (To-21-426)", _is_pair, _read))
