"""What the ego has observed of the vehicles around it, as a trait model takes it."""

from dataclasses import dataclass
from typing import Self

import numpy as np

from tint_sumo.config import MAX_VEHICLES, POSITION_SCALE_M, WINDOW_STEPS, Street, VehicleShape
from tint_sumo.dataset.schema import NO_LEADER_GAP_M
from tint_sumo.scenario.geometry import lane_border_y_m

Observation = dict[str, np.ndarray]

LANE_BORDER_Y_M = lane_border_y_m(Street())


@dataclass
class Tracks:
    """Where vehicles were at the last 20 steps, oldest first; arrays are (N, 20, 12), of N environments."""

    x_m: np.ndarray  # of the vehicle's centre, float32
    y_m: np.ndarray  # the same
    present: np.ndarray  # whether the slot holds a vehicle, bool

    @classmethod
    def empty(cls, num_envs: int) -> Self:
        shape = (num_envs, WINDOW_STEPS, MAX_VEHICLES)
        return cls(np.zeros(shape, np.float32), np.zeros(shape, np.float32), np.zeros(shape, bool))

    def of(self, envs: np.ndarray) -> "Tracks":
        """The tracks of some environments."""
        return Tracks(self.x_m[envs], self.y_m[envs], self.present[envs])


def centres_m(observation: Observation, envs: np.ndarray | slice = slice(None)) -> tuple[np.ndarray, np.ndarray]:
    """x and y of the vehicles' centres in some environments, each (N, 12) float32."""
    centre = (observation["vehicles"][envs] + observation["ego"][envs, None, :2]) * POSITION_SCALE_M
    return centre[..., 0], centre[..., 1]


def is_upper(y_m: np.ndarray) -> np.ndarray:
    """Whether positions lie in the upper lane, which runs east; the lower runs west."""
    return y_m > LANE_BORDER_Y_M


def along_m(x_m: np.ndarray, y_m: np.ndarray) -> np.ndarray:
    """Positions along the lanes, in the direction of travel."""
    return np.where(is_upper(y_m), x_m, -x_m)


def windows(tracks: Tracks) -> tuple[np.ndarray, np.ndarray]:
    """Trait model inputs from tracks, as in ``tint_sumo.dataset.windows``.

    Returns:
        states: (N, 12, 20, 2) float32: offset along the lane from the window's first position (m) and bumper-to-bumper
            gap to the leader (m); zero after ``length``.
        length: (N, 12) int64: for how many steps up to now the slot has held its vehicle, 0..20.
    """
    length = np.minimum.accumulate(tracks.present[:, ::-1], axis=1).sum(axis=1)
    gap = leader_gaps(tracks.x_m, tracks.y_m, tracks.present)
    features = np.stack([along_m(tracks.x_m, tracks.y_m), gap], axis=-1).swapaxes(1, 2)
    steps = np.arange(WINDOW_STEPS)
    valid = steps < length[..., None]
    source = np.where(valid, steps + (WINDOW_STEPS - length)[..., None], 0)
    states = np.take_along_axis(features, source[..., None], axis=2)
    states[..., 0] -= states[:, :, :1, 0]
    return np.where(valid[..., None], states, np.float32(0.0)), length


def leader_gaps(x_m: np.ndarray, y_m: np.ndarray, present: np.ndarray) -> np.ndarray:
    """Bumper-to-bumper gaps to the leaders in the same lane, (..., 12) m, at most ``NO_LEADER_GAP_M``."""
    upper, along = is_upper(y_m), along_m(x_m, y_m)
    gap = along[..., None, :] - along[..., :, None]
    leads = (gap > 0.0) & (upper[..., None, :] == upper[..., :, None]) & present[..., None, :]
    nearest = np.where(leads, gap - VehicleShape.length_m, NO_LEADER_GAP_M).min(axis=-1)
    capped: np.ndarray = np.minimum(nearest, NO_LEADER_GAP_M).astype(np.float32)
    return capped
