"""INTERACTION dataset: ``vehicle_tracks_NNN.csv``, and the files of its prediction challenge with a ``case_id``.

Format: https://interaction-dataset.com, "Details and Format".
"""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from tint_sumo.tracks.reading import Head, TrackFormat, part_of, read_columns_of, read_csv, recording_name, register

_NUMBERS = ["timestamp_ms", "x", "y", "vx", "vy", "psi_rad", "length", "width"]


def _read(file: Path) -> Mapping[str, Any]:
    has_cases = "case_id" in read_columns_of(file)
    rows = read_csv(file, _NUMBERS, ["track_id", "agent_type", *(["case_id"] if has_cases else [])])
    return {
        "recording": part_of(file, rows["case_id"]) if has_cases else recording_name(file),
        "vehicle": rows["track_id"],
        "time_s": rows["timestamp_ms"] / 1000.0,
        "x_m": rows["x"],
        "y_m": rows["y"],
        "heading_rad": rows["psi_rad"],
        "speed_mps": np.hypot(rows["vx"], rows["vy"]),
        "length_m": rows["length"],
        "width_m": rows["width"],
        "vehicle_class": rows["agent_type"],
    }


def _is_interaction(head: Head) -> bool:
    return {"track_id", "timestamp_ms", "agent_type", "psi_rad"} <= head.columns


register(TrackFormat("interaction", "INTERACTION CSV of vehicles", _is_interaction, _read))
