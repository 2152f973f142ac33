"""Hand-built situations in the T-intersection."""

from collections.abc import Callable, Iterator
from contextlib import contextmanager

import numpy as np

from tint_sumo.config import DriverProfile
from tint_sumo.scenes import T_INTERSECTION, Scene, find_scene
from tint_sumo.simulation import SceneSimulation
from tint_sumo.simulation.demand import PlacedVehicle

GO, CREEP, STOP = 3.0, 0.5, 0.0
STEP_S = 0.1
STEM_M = 20.0
LOWER, UPPER = 0, 1  # routes
T = find_scene(T_INTERSECTION)


@contextmanager
def scene(*vehicles: tuple[int, DriverProfile, float], played: Scene = T) -> Iterator[SceneSimulation]:
    """One intersection with vehicles given as (route, profile, x of the centre); slots in that order."""
    simulation = SceneSimulation(1, played)
    try:
        simulation.reset_to(0, [_placed(simulation, *vehicle) for vehicle in vehicles])
        yield simulation
    finally:
        simulation.close()


def _placed(simulation: SceneSimulation, lane: int, profile: DriverProfile, x_m: float) -> PlacedVehicle:
    member = next(index for index, one in enumerate(simulation.population) if one.profile is profile)
    driven_m = 20.0 - x_m if lane == LOWER else 20.0 + x_m
    return PlacedVehicle(lane, driven_m + 5.0, member)


def until(simulation: SceneSimulation, desired_mps: float, done: Callable[[], bool], limit_s: float = 60.0) -> None:
    """Drive until something is the case."""
    for _ in range(round(limit_s / STEP_S)):
        if done():
            return
        simulation.step(np.array([desired_mps]))
    raise AssertionError("the scene did not come to its end")


def stand_at(simulation: SceneSimulation, path_m: float) -> None:
    """Drive the ego until its front stands about this far past the stem's end."""

    def must_brake() -> bool:
        speed_mps = simulation.egos.speed_mps[0]
        return bool(simulation.egos.front_m[0] + speed_mps**2 / 6 + 0.35 >= STEM_M + path_m)

    until(simulation, GO, must_brake)
    until(simulation, STOP, lambda: bool(simulation.egos.speed_mps[0] < 1e-3))


def speeds(simulation: SceneSimulation, desired_mps: float, seconds: float = 12.0) -> list[float]:
    """Speeds of the vehicle in slot 0 while the ego drives; ends when the vehicle leaves the street."""
    found = []
    for _ in range(round(seconds / STEP_S)):
        before_m = simulation.slots.front_m[0, 0]
        simulation.step(np.array([desired_mps]))
        if not simulation.slots.present[0, 0]:
            break
        found.append((simulation.slots.front_m[0, 0] - before_m) / STEP_S)
    return found
