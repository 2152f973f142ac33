"""Recordings on the street of the T-intersection, of vehicles that drive straight on at a constant speed."""

from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pandas as pd

from tint_sumo.scenes import find_scene
from tint_sumo.scenes.build import NET_FILE, scene_files
from tint_sumo.tracks import Tracks
from tint_sumo.tracks.schema import build_tracks

STEP_S = 0.1
LOWER_Y_M, UPPER_Y_M = 2.0, 6.0  # the lower lane leads to the west, the upper one to the east
STEM = ("stem.0", "mid.0", "upper_out.0")  # the way of an ego that comes from the south and turns to the east


@dataclass(frozen=True)
class Driven:
    """A vehicle that drives along x."""

    name: str
    x_m: float  # of its centre when it appears
    y_m: float
    speed_mps: float  # to the east, or to the west if it is negative
    first_s: float = 0.0
    last_s: float = 15.0
    size_m: tuple[float, float] = (5.0, 2.0)
    vehicle_class: str = "car"
    step_s: float = STEP_S

    def rows(self) -> pd.DataFrame:
        time_s = np.arange(round((self.last_s - self.first_s) / self.step_s) + 1) * self.step_s
        return pd.DataFrame(
            {
                "vehicle": self.name,
                "time_s": self.first_s + time_s,
                "x_m": self.x_m + self.speed_mps * time_s,
                "y_m": self.y_m,
                "heading_rad": 0.0 if self.speed_mps >= 0.0 else np.pi,
                "speed_mps": abs(self.speed_mps),
                "length_m": self.size_m[0],
                "width_m": self.size_m[1],
                "vehicle_class": self.vehicle_class,
            }
        )


def recording(vehicles: Iterable[Driven]) -> Tracks:
    return built(one.rows() for one in vehicles)


def built(parts: Iterable[pd.DataFrame]) -> Tracks:
    """Return tracks of these rows."""
    return build_tracks(Path("street.csv"), "made", {"recording": "street", **pd.concat(parts)})


def write_street(folder: Path) -> Path:
    """Write the street's network; return its file."""
    file = folder / "street.net.xml"
    file.write_text(scene_files(find_scene("t_intersection_street"), 1)[NET_FILE], encoding="utf-8")
    return file
