"""levelX drone recordings (inD, rounD, exiD, highD): ``NN_tracks.csv`` with the two files of meta data beside it.

lxd-io reads them, too, but brings polars, and asks for the whole dataset; these are three CSV files.

Formats: https://levelxdata.com/ind-dataset and https://levelxdata.com/highd-dataset, pages "Format".
"""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from tint_sumo.core.errors import InputError
from tint_sumo.tracks.reading import Head, TrackFormat, read_csv, recording_name, register

_TRACKS = "_tracks"


def _beside(file: Path, part: str) -> Path:
    """Return the file of meta data that goes with a file of tracks."""
    name = recording_name(file)
    if not name.endswith(_TRACKS):
        raise InputError(f"{file} must be called NN_tracks.csv, as levelX names it, to find its meta data")
    found = file.with_name(name.removesuffix(_TRACKS) + f"_{part}.csv")
    if not found.is_file():
        raise InputError(f"{file} needs {found.name} in its folder, and it is not there; copy it from the dataset")
    return found


def _frame_rate_hz(file: Path) -> float:
    meta = _beside(file, "recordingMeta")
    rates_hz = read_csv(meta, ["frameRate"])["frameRate"]
    if len(rates_hz) != 1 or rates_hz[0] <= 0.0:
        raise InputError(f"{meta} must have one row, with a frameRate above 0; copy it from the dataset")
    return float(rates_hz[0])


def _classes(file: Path, ids: pd.Series, id_name: str) -> pd.Series:
    """Return the class of each row's vehicle."""
    meta = read_csv(_beside(file, "tracksMeta"), [], [id_name, "class"])
    found = ids.map(meta.drop_duplicates(id_name).set_index(id_name)["class"])
    if found.isna().any():
        unknown = ids[found.isna()].iloc[0]
        raise InputError(f"{file}: vehicle {unknown} is not in the meta data; give files of one recording")
    return found


def _read_boxes(file: Path) -> Mapping[str, Any]:
    """Read inD, rounD and exiD. Boxes of pedestrians and bicycles have no size there: half a metre stands for it."""
    numbers = ["frame", "xCenter", "yCenter", "heading", "width", "length", "xVelocity", "yVelocity"]
    rows = read_csv(file, numbers, ["trackId"])
    return {
        "recording": recording_name(file).removesuffix(_TRACKS),
        "vehicle": rows["trackId"],
        "time_s": rows["frame"] / _frame_rate_hz(file),
        "x_m": rows["xCenter"],
        "y_m": rows["yCenter"],
        "heading_rad": np.radians(rows["heading"]),
        "speed_mps": np.hypot(rows["xVelocity"], rows["yVelocity"]),
        "length_m": rows["length"].where(rows["length"] != 0.0, 0.5),
        "width_m": rows["width"].where(rows["width"] != 0.0, 0.5),
        "vehicle_class": _classes(file, rows["trackId"], "trackId"),
    }


def _read_highd(file: Path) -> Mapping[str, Any]:
    """Read highD: x and y are the upper left corner of a box in an image, so y is turned; width is along x."""
    rows = read_csv(file, ["frame", "x", "y", "width", "height", "xVelocity", "yVelocity"], ["id"])
    return {
        "recording": recording_name(file).removesuffix(_TRACKS),
        "vehicle": rows["id"],
        "time_s": rows["frame"] / _frame_rate_hz(file),
        "x_m": rows["x"] + rows["width"] / 2.0,
        "y_m": -(rows["y"] + rows["height"] / 2.0),
        "heading_rad": np.where(rows["xVelocity"] < 0.0, np.pi, 0.0),
        "speed_mps": np.hypot(rows["xVelocity"], rows["yVelocity"]),
        "length_m": rows["width"],
        "width_m": rows["height"],
        "vehicle_class": _classes(file, rows["id"], "id"),
    }


def _has_boxes(head: Head) -> bool:
    return {"trackid", "frame", "xcenter", "ycenter", "heading"} <= head.columns


def _is_highd(head: Head) -> bool:
    return {"frame", "id", "x", "y", "width", "height", "xvelocity"} <= head.columns


register(TrackFormat("levelx", "levelX CSV (inD, rounD, exiD)", _has_boxes, _read_boxes))
register(TrackFormat("highd", "levelX CSV (highD)", _is_highd, _read_highd))
