"""A street of Intelligent Driver Model vehicles in numpy, and the windows one would record on it."""

from dataclasses import dataclass

import numpy as np
import pytest
from numpy.typing import NDArray

from tint_sumo.config import (
    AGGRESSIVE,
    CONSERVATIVE,
    NO_LEADER_GAP_M,
    STEP_S,
    WINDOW_STEPS,
    DriverProfile,
    Idm,
    TraitSettings,
)
from tint_sumo.dataset.windows import Windows

VEHICLE_LENGTH_M = 5.0
STREET_M = 40.0


@dataclass(frozen=True)
class Platoons:
    """Vehicles one behind the other in separate lanes, the first of each lane in column 0."""

    conservative: NDArray[np.bool_]  # (lanes, vehicles)
    desired_speed_mps: NDArray[np.float64]
    min_gap_m: NDArray[np.float64]
    position_m: NDArray[np.float64]  # of the centre, 0 to 40 while on the street

    @classmethod
    def draw(cls, lanes: int, vehicles: int, generator: np.random.Generator) -> "Platoons":
        conservative = generator.random((lanes, vehicles)) < 0.5
        entry_gap = _draw(conservative, generator, lambda profile: profile.entry_gap_m)
        return cls(
            conservative,
            _draw(conservative, generator, lambda profile: profile.desired_speed_mps),
            _draw(conservative, generator, lambda profile: profile.min_gap_m),
            STREET_M - np.cumsum(entry_gap + VEHICLE_LENGTH_M, axis=1) + VEHICLE_LENGTH_M,
        )


def _draw(conservative, generator, bounds_of) -> NDArray[np.float64]:
    def uniform(profile: DriverProfile) -> NDArray[np.float64]:
        return generator.uniform(*bounds_of(profile), conservative.shape)

    return np.where(conservative, uniform(CONSERVATIVE), uniform(AGGRESSIVE))


def drive(platoons: Platoons, steps: int) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.bool_]]:
    """Positions, gaps and whether the vehicle is on the street, each (lanes, vehicles, steps).

    A leader counts while it is on the street; a vehicle without one drives freely.
    """
    idm, dt = Idm(), STEP_S
    position, speed = platoons.position_m.copy(), 0.8 * platoons.desired_speed_mps
    frames = []
    for _ in range(steps):
        led = np.zeros(position.shape, dtype=bool)
        led[:, 1:] = position[:, :-1] <= STREET_M
        gap = np.full(position.shape, np.inf)
        gap[:, 1:] = np.where(led[:, 1:], position[:, :-1] - position[:, 1:] - VEHICLE_LENGTH_M, np.inf)
        closing = np.zeros(position.shape)
        closing[:, 1:] = speed[:, 1:] - speed[:, :-1]
        frames.append((position, np.minimum(gap, NO_LEADER_GAP_M), (position >= 0) & (position <= STREET_M)))
        wanted = platoons.min_gap_m + np.maximum(
            0.0, speed * idm.tau_s + speed * closing / (2 * np.sqrt(idm.accel_mps2 * idm.decel_mps2))
        )
        free = 1.0 - (speed / platoons.desired_speed_mps) ** idm.delta
        acceleration = idm.accel_mps2 * (free - (wanted / np.maximum(gap, 0.1)) ** 2)
        speed = np.maximum(0.0, speed + np.maximum(acceleration, -idm.emergency_decel_mps2) * dt)
        position = position + speed * dt
    positions, gaps, present = (np.stack(parts, axis=2) for parts in zip(*frames, strict=True))
    return positions, gaps, present


def record(lanes: int, seed: int) -> tuple[Windows, NDArray[np.bool_]]:
    """Windows of at most 20 steps on a common time grid, and whether each one's driver is conservative.

    Every lane counts as one episode.
    """
    vehicles, steps = 6, 10 * WINDOW_STEPS
    platoons = Platoons.draw(lanes, vehicles, np.random.default_rng(seed))
    position, gap, present = (part.reshape(-1, WINDOW_STEPS) for part in drive(platoons, steps))
    driver = np.repeat(np.arange(lanes * vehicles), steps // WINDOW_STEPS)
    kept = present.sum(axis=1) >= 2
    position, gap, present, driver = position[kept], gap[kept], present[kept], driver[kept]

    length = present.sum(axis=1)
    shift = np.minimum(present.argmax(axis=1)[:, None] + np.arange(WINDOW_STEPS), WINDOW_STEPS - 1)
    valid = np.arange(WINDOW_STEPS) < length[:, None]
    position, gap = np.take_along_axis(position, shift, axis=1), np.take_along_axis(gap, shift, axis=1)
    states = np.stack((position - position[:, :1], gap), axis=2) * valid[:, :, None]
    windows = Windows(
        states=states.astype(np.float32),
        length=length.astype(np.int64),
        driver=driver,
        episode=driver // vehicles,
        has_leader=((gap < NO_LEADER_GAP_M) | ~valid).all(axis=1),
    )
    return windows, platoons.conservative.reshape(-1)[driver]


@pytest.fixture(scope="session")
def street() -> tuple[Windows, NDArray[np.bool_]]:
    """A few hundred windows and their labels."""
    return record(lanes=12, seed=1)


@pytest.fixture(scope="session")
def small() -> TraitSettings:
    """A network and a schedule of a moment."""
    return TraitSettings(
        embedding_sizes=(8, 8),
        hidden_size=8,
        encoder_output_size=8,
        decoder_output_size=8,
        learning_rate=3e-3,
        batch_size=64,
        epochs=3,
    )
