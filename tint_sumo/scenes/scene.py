"""A scene as data: a network, the traffic's routes through it, the ego's task, and the drivers.

A new scene is a file that makes one, and a line in ``tint_sumo/scenes/__init__.py``.
"""

import math
import re
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import ClassVar

import shapely

from tint_sumo.config import (
    POSITION_SCALE_M,
    SPEED_SCALE_MPS,
    Claim,
    CoordinateM,
    EgoController,
    Gain,
    Mix,
    Population,
    Slots,
    StepS,
    TimeS,
    Traffic,
    VehicleShape,
)
from tint_sumo.core.errors import InputError, shown
from tint_sumo.core.ranges import require_ranges
from tint_sumo.scenes.digest import scene_digest
from tint_sumo.scenes.network import Network, Point

BUILDING = "building"  # type of its polygon in SUMO
Building = tuple[tuple[CoordinateM, CoordinateM], ...]  # its corners, in order


@dataclass(frozen=True)
class Route:
    """Edges that vehicles drive along, one after the other, from the network's border to its border."""

    name: str
    edges: tuple[str, ...]


@dataclass(frozen=True)
class EgoTask:
    """The ego's way from start to goal; arc lengths are those of its front bumper from its route's start."""

    edges: tuple[str, ...]
    start_m: float
    goal_m: float  # success when its front is past it
    way: tuple[Point, ...] = ()  # trace of its front, finer than the lanes' shapes; those shapes if it is not given
    controller: EgoController = field(default_factory=EgoController)


@dataclass(frozen=True)
class View:
    """The part of a network that pictures show, m."""

    left_m: float
    bottom_m: float
    right_m: float
    top_m: float

    def moved(self, x_m: float, y_m: float) -> "View":
        """Return the view from a frame whose origin is at the other end of this vector."""
        return View(self.left_m + x_m, self.bottom_m + y_m, self.right_m + x_m, self.top_m + y_m)


@dataclass(frozen=True)
class Scene:
    """All that defines a simulated episode, apart from its seed.

    Every traffic route begins where a vehicle's back is when it enters, and is long enough for its front to arrive at
    the route's end just when its centre crosses the border of the modelled roads.
    """

    name: str
    title: str  # what the ego does
    network: Network
    routes: tuple[Route, ...]
    ego: EgoTask
    view: View
    traffic: Traffic = field(default_factory=Traffic)
    population: Population = field(default_factory=Population)
    vehicle: VehicleShape = field(default_factory=VehicleShape)
    claim: Claim = field(default_factory=Claim)
    max_vehicles: Slots = 12  # so many are on the roads, and in an observation, at most (code)
    step_s: StepS = 0.1  # code; SUMO counts whole milliseconds
    time_limit_s: TimeS = 50.0  # code
    base: str = ""  # name of the built-in scene that it is with other numbers
    position_scale_m: Gain = POSITION_SCALE_M  # positions are observed divided by this
    speed_scale_mps: Gain = SPEED_SCALE_MPS  # velocities are observed divided by this
    buildings: tuple[Building, ...] = ()  # they hide vehicles from a sensor with occlusion, and change nothing else

    sumocfg: ClassVar[Path | None] = None  # the SUMO configuration whose traffic it has: none

    def __post_init__(self) -> None:
        if not 0.0 <= self.ego.start_m < self.ego.goal_m:
            start_m, goal_m = self.ego.start_m, self.ego.goal_m
            raise InputError(f"the ego's goal ({goal_m:g} m) must lie beyond its start ({start_m:g} m)")
        require_ranges(self)
        require_scene_name(self.name)
        require_whole_milliseconds(self.step_s)
        for profile in self.population.profiles:
            if profile.desired_speed_mps[1] > self.network.speed_limit_mps:
                raise InputError(
                    f"desired_speed_mps of {profile.name} must not exceed the roads' limit of "
                    f"{self.network.speed_limit_mps:g} m/s, {profile.desired_speed_mps[1]:g} m/s does"
                )
        for building in self.buildings:
            if len(building) < 3 or not shapely.Polygon(building).is_valid:
                raise InputError(f"buildings must have simple outlines of three corners or more, not {shown(building)}")
        towns, least_tau_s = self.population.towns, self.population.least_tau_s
        if towns is not None and towns.top_speed_mps > self.network.speed_limit_mps:
            raise InputError(
                f"desired_speed_mps and half of speed_shift_mps of towns must not exceed the roads' limit of "
                f"{self.network.speed_limit_mps:g} m/s, {towns.top_speed_mps:g} m/s does"
            )
        if not self.step_s <= least_tau_s < math.inf:  # with less, SUMO's drivers hit each other
            raise InputError(f"tau_s must be at least a step of {self.step_s:g} s, and finite, not {least_tau_s}")

    @property
    def traits(self) -> tuple[str, ...]:
        """Names of the drivers' traits; labels are their numbers."""
        return tuple(profile.name for profile in self.population.profiles)

    @property
    def trait_colours(self) -> tuple[tuple[int, ...], ...]:
        """Red, green and blue of each trait in pictures."""
        return tuple(tuple(map(int, profile.colour.split(","))) for profile in self.population.profiles)

    @property
    def tau_s(self) -> float:
        """Time headway of the drivers, or the one in the middle where they differ in it."""
        return self.population.middle_tau_s

    @property
    def speed_limit_mps(self) -> float:
        """Speed that no vehicle exceeds."""
        return self.network.speed_limit_mps

    @property
    def ego_scale_m(self) -> float:
        """The ego's position is observed divided by this."""
        return self.position_scale_m

    def with_drivers(self, p_conservative: Mix | None, tau_s: float | None) -> "Scene":
        """Return the scene with another mix and another time headway of its drivers, where they are given."""
        population, traffic = self.population, self.traffic
        if tau_s is not None:
            population = population.with_tau(tau_s)
        if p_conservative is not None:
            traffic = replace(traffic, p_conservative=p_conservative)
        return replace(self, traffic=traffic, population=population)

    @property
    def digest(self) -> str:
        """Digest of the roads, the vehicles and the ego's task; drivers, their mix and buildings do not count."""
        return scene_digest(self)


def require_whole_milliseconds(step_s: float) -> None:
    """Raise InputError unless a step has whole milliseconds, as SUMO counts them."""
    if abs(step_s * 1000 - round(step_s * 1000)) > 1e-6:
        raise InputError(f"step_s must be whole milliseconds, not {step_s}")


def require_scene_name(name: str) -> None:
    """Raise InputError unless a scene can be called so: its name is part of the names of files."""
    if not re.fullmatch(r"[A-Za-z0-9][\w.-]{0,63}", name):
        raise InputError(
            f"name must be of up to 64 letters, digits, '_', '-' and '.', a letter first, not {shown(name)}"
        )
