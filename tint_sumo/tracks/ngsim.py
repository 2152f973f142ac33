"""NGSIM and its successor TGSIM, recordings of the Federal Highway Administration.

NGSIM has feet, and gives the middle of a vehicle's front. Both lack headings, which follow from the motion. TGSIM's
images have y downwards.

Formats: https://doi.org/10.21949/1504477 (NGSIM), https://data.transportation.gov, "Third Generation Simulation Data".
"""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from tint_sumo.tracks.reading import Head, TrackFormat, part_of, read_columns_of, read_csv, recording_name, register
from tint_sumo.tracks.schema import headings_of_motion

_FOOT_M = 0.3048
_NGSIM_CLASSES = {"1": "motorcycle", "2": "car", "3": "truck"}
_NGSIM_NUMBERS = ["Global_Time", "Local_X", "Local_Y", "v_Length", "v_Width", "v_Vel"]
_TGSIM_NUMBERS = ["time", "xloc-kf", "yloc-kf", "speed-kf", "length-smoothed", "width-smoothed"]


def _read_ngsim(file: Path) -> Mapping[str, Any]:
    """Read NGSIM. Vehicle ids are used again later on, so a vehicle is its id and its number of frames."""
    is_joined = "location" in read_columns_of(file)
    texts = ["Vehicle_ID", "Total_Frames", "v_Class", *(["Location"] if is_joined else [])]
    rows = read_csv(file, _NGSIM_NUMBERS, texts)
    recording = rows["Location"] if is_joined else pd.Series(recording_name(file), rows.index)
    vehicle = rows["Vehicle_ID"] + "-" + rows["Total_Frames"]
    start_ms = rows["Global_Time"].groupby(recording).transform("min")
    time_s = (rows["Global_Time"] - start_ms) / 1000.0
    x_m, y_m = rows["Local_X"] * _FOOT_M, rows["Local_Y"] * _FOOT_M
    length_m = rows["v_Length"] * _FOOT_M
    heading_rad = _headings(recording, vehicle, time_s, x_m, y_m)
    return {
        "recording": recording,
        "vehicle": vehicle,
        "time_s": time_s,
        "x_m": x_m - length_m / 2.0 * np.cos(heading_rad),
        "y_m": y_m - length_m / 2.0 * np.sin(heading_rad),
        "heading_rad": heading_rad,
        "speed_mps": rows["v_Vel"] * _FOOT_M,
        "length_m": length_m,
        "width_m": rows["v_Width"] * _FOOT_M,
        "vehicle_class": rows["v_Class"].replace(_NGSIM_CLASSES),
    }


def _read_tgsim(file: Path) -> Mapping[str, Any]:
    has_runs = "run-index" in read_columns_of(file)
    rows = read_csv(file, _TGSIM_NUMBERS, ["id", "type-most-common", *(["run-index"] if has_runs else [])])
    recording = part_of(file, rows["run-index"]) if has_runs else pd.Series(recording_name(file), rows.index)
    x_m, y_m = rows["xloc-kf"], -rows["yloc-kf"]
    return {
        "recording": recording,
        "vehicle": rows["id"],
        "time_s": rows["time"],
        "x_m": x_m,
        "y_m": y_m,
        "heading_rad": _headings(recording, rows["id"], rows["time"], x_m, y_m),
        "speed_mps": rows["speed-kf"],
        "length_m": rows["length-smoothed"],
        "width_m": rows["width-smoothed"],
        "vehicle_class": "type " + rows["type-most-common"],
    }


def _headings(recording: pd.Series, vehicle: pd.Series, time_s: pd.Series, x_m: pd.Series, y_m: pd.Series) -> pd.Series:
    """Return the headings of rows in any order."""
    rows = pd.DataFrame({"recording": recording, "vehicle": vehicle, "time_s": time_s, "x_m": x_m, "y_m": y_m})
    rows = rows.sort_values(["recording", "vehicle", "time_s"], kind="stable")
    track = np.asarray(rows.groupby(["recording", "vehicle"], sort=False).ngroup(), np.int64)
    found = headings_of_motion(track, rows["x_m"].to_numpy(), rows["y_m"].to_numpy())
    return pd.Series(found, rows.index).reindex(x_m.index)


def _is_ngsim(head: Head) -> bool:
    return {"vehicle_id", "global_time", "local_x", "local_y", "v_vel"} <= head.columns


def _is_tgsim(head: Head) -> bool:
    return {"id", "time", "xloc-kf", "yloc-kf", "speed-kf"} <= head.columns


register(TrackFormat("ngsim", "NGSIM CSV", _is_ngsim, _read_ngsim))
register(TrackFormat("tgsim", "TGSIM CSV", _is_tgsim, _read_tgsim))
