"""The egos: the PD law on speed, the safety check, and collisions."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

from tint_sumo.core.compiling import compiled
from tint_sumo.scenes.geometry import (
    BOX,
    NO_VEHICLE,
    Bools,
    Boxes,
    Floats,
    Numbers,
    measure_distances_m,
    new_boxes,
    sweep,
)
from tint_sumo.scenes.scene import Scene
from tint_sumo.scenes.sumocfg import SumocfgScene
from tint_sumo.simulation.slots import Slots
from tint_sumo.simulation.timing import StepPart, does

_SHORT_STEP_S = 0.1  # in which boxes at both ends are enough


@dataclass(frozen=True)
class Collision:
    """The ego's first collision in an episode."""

    slot: int  # slot of the other vehicle; NO_VEHICLE for a person on foot
    trait: int  # number of its driver's trait then; NO_VEHICLE for a person
    route: str  # name of its route; in a SUMO configuration, the edge that it is on
    ego_x_m: float  # the ego's centre
    ego_y_m: float


class EgoRules(NamedTuple):
    """The numbers of a scene's controller (see ``tint_sumo.config.EgoController``) for compiled functions."""

    gain_per_s: float
    accel_limit_mps2: float
    braking_gain_per_s: float
    braking_limit_mps2: float
    unsafe_distance_m: float
    closing_distance_m: float
    closing_speed_mps: float
    watches_behind: bool
    step_s: float

    @classmethod
    def of(cls, scene: Scene | SumocfgScene) -> "EgoRules":
        """Return the rules of a scene; the gain is at most one that reaches a speed in a single step."""
        *names, _ = cls._fields
        rules = cls(**{name: getattr(scene.ego.controller, name) for name in names}, step_s=scene.step_s)
        return rules._replace(gain_per_s=min(rules.gain_per_s, 1.0 / rules.step_s))


class Egos:
    """The egos of R replicas. Read only for others.

    =============== ======= ======================================================================
    ``front_m``     (R,)    front bumper's distance along the ego's way
    ``speed_mps``   (R,)
    ``box``         (R,)    records of ``tint_sumo.scenes.geometry.BOX``
    ``distance_m``  (R, V)  from its box to the vehicles' boxes; infinite if far, or in empty slots
    ``unsafe``      (R,)    result of the safety check for the next step
    ``collision``   R items the first collision in the episode, or None
    ``lost``        (R,)    SUMO has taken the ego off the road, or off its route
    ``hit_person``  (R,)    it has touched a person on foot in the episode
    ``ran_red``     (R,)    it has driven over a stop line at red, where that ends the episode
    =============== ======= ======================================================================
    """

    def __init__(self, replicas: int, scene: Scene | SumocfgScene) -> None:
        self.rules = EgoRules.of(scene)
        # The safety check needs the distance of a vehicle a step before it is near.
        near_m = max(self.rules.closing_distance_m, self.rules.unsafe_distance_m)
        fastest_mps = scene.speed_limit_mps + scene.ego.controller.desired_speeds_mps[-1]
        self._reach_m = near_m + fastest_mps * scene.step_s
        self.front_m: Floats = np.zeros(replicas)
        self.speed_mps: Floats = np.zeros(replicas)
        self.box: Boxes = new_boxes(replicas, scene.vehicle.length_m, scene.vehicle.width_m)
        self._nowhere = self.box[:1].copy()
        self.distance_m: Floats = np.full((replicas, scene.max_vehicles), np.inf)
        self._was_distance_m: Floats = np.full((replicas, scene.max_vehicles), np.inf)  # distances one step ago
        self.unsafe: Bools = np.zeros(replicas, bool)
        self._hit_slot: Numbers = np.full(replicas, NO_VEHICLE)
        # In a long step, vehicles can pass through each other unless their boxes are swept from its begin to its end.
        self.parts = round(scene.step_s / _SHORT_STEP_S)
        self._was_box: Boxes = self.box.copy()
        self._were: Boxes = np.zeros((replicas, scene.max_vehicles), BOX)
        self._was_number: Numbers = np.full((replicas, scene.max_vehicles), NO_VEHICLE)
        self.collision: list[Collision | None] = [None] * replicas
        self.lost: Bools = np.zeros(replicas, bool)
        self.hit_person: Bools = np.zeros(replicas, bool)
        self.ran_red: Bools = np.zeros(replicas, bool)

    @property
    def collided(self) -> Bools:
        """Whether the ego has had a collision in the episode; (R,)."""
        return np.asarray((self._hit_slot != NO_VEHICLE) | self.hit_person)

    def clear(self, replica: int) -> None:
        """Forget the episode of a replica."""
        self.front_m[replica] = self.speed_mps[replica] = 0.0
        self.box[replica] = self._nowhere[0]
        self.distance_m[replica] = self._was_distance_m[replica] = np.inf
        for flag in (self.unsafe, self.lost, self.hit_person, self.ran_red):
            flag[replica] = False
        self._hit_slot[replica] = NO_VEHICLE
        self._was_number[replica] = NO_VEHICLE
        self.collision[replica] = None

    def drive(self, desired_mps: Floats) -> None:
        """Choose the speeds of a step, and move the fronts on; the boxes follow."""
        drive(desired_mps, self.unsafe, self.rules, self.speed_mps, self.front_m)

    @does(StepPart.SAFETY_CHECK)
    def look_around(self, slots: Slots) -> Sequence[tuple[int, int]]:
        """Run the safety check for the next step; return replica and slot of each episode's first collision."""
        self.distance_m, self._was_distance_m = self._was_distance_m, self.distance_m
        measure_distances_m(self.box, slots.present, slots.box, self._reach_m, self.distance_m)
        any_new = check_safety(
            self.distance_m, self._was_distance_m, self.box, slots.box, self.rules, self.unsafe, self._hit_slot
        )
        if self.parts > 1:
            any_new |= self._sweep(slots)
        if not any_new:
            return ()
        collided = np.flatnonzero(self._hit_slot != NO_VEHICLE).tolist()
        return [(replica, int(self._hit_slot[replica])) for replica in collided if self.collision[replica] is None]

    def _sweep(self, slots: Slots) -> bool:
        """Look for collisions within the step just made; return whether there is a new one."""
        same = slots.present & (slots.vehicle_number == self._was_number)
        any_new = sweep(self._was_box, self.box, same, self._were, slots.box, self.parts, self._hit_slot)
        np.copyto(self._was_box, self.box)
        np.copyto(self._were, slots.box)
        np.copyto(self._was_number, slots.vehicle_number)
        return any_new


@compiled
def acceleration_mps2(speed_mps: float, desired_mps: float, unsafe: bool, rules: EgoRules) -> float:
    """Return what the PD law asks for, or braking where the safety check fires."""
    if unsafe:
        return max(-rules.braking_gain_per_s * speed_mps, -rules.braking_limit_mps2)
    wanted_mps2 = rules.gain_per_s * (desired_mps - speed_mps)
    return min(max(wanted_mps2, -rules.accel_limit_mps2), rules.accel_limit_mps2)


@compiled
def drive(desired_mps: Floats, unsafe: Bools, rules: EgoRules, speed_mps: Floats, front_m: Floats) -> None:
    """Move egos on by a step, in place; all (R,)."""
    for row in range(len(speed_mps)):
        accel_mps2 = acceleration_mps2(speed_mps[row], desired_mps[row], unsafe[row], rules)
        speed_mps[row] = max(speed_mps[row] + accel_mps2 * rules.step_s, 0.0)
        front_m[row] += speed_mps[row] * rules.step_s


@compiled
def is_unsafe(distance_m: float, closing_mps: float, rules: EgoRules) -> bool:
    """Return whether a vehicle is dangerously close."""
    close = distance_m < rules.unsafe_distance_m
    return close or (distance_m < rules.closing_distance_m and closing_mps > rules.closing_speed_mps)


@compiled
def check_safety(
    distance_m: Floats,
    before_m: Floats,
    egos: Boxes,
    vehicles: Boxes,
    rules: EgoRules,
    unsafe: Bools,
    hit: Numbers,
) -> bool:
    """Check the vehicles around each ego.

    Args:
        distance_m, before_m: (R, V) to vehicles, now and a step ago; infinite where there is none, or none was.
        egos, vehicles: (R,) and (R, V) boxes.
        unsafe: (R,) written: whether any vehicle is dangerously close.
        hit: (R,) the first slot whose vehicle the ego has touched, written where it was negative.

    Returns:
        whether any ego has touched a vehicle for the first time.
    """
    any_new = False
    for row in range(len(unsafe)):
        unsafe[row] = False
        for slot in range(distance_m.shape[1]):
            now_m, was_m = distance_m[row, slot], before_m[row, slot]
            closing_mps = (was_m - now_m) / rules.step_s if math.isfinite(was_m) else 0.0
            if is_unsafe(now_m, closing_mps, rules):
                counts = rules.watches_behind or not is_behind(vehicles[row, slot], egos[row])
                unsafe[row] = unsafe[row] or counts
            if now_m == 0.0 and hit[row] < 0:
                hit[row] = slot
                any_new = True
    return any_new


@compiled
def is_behind(vehicle: Any, ego: Any) -> bool:
    """Return whether a vehicle's centre is behind an ego's back; both are boxes."""
    ahead_m = (vehicle.x_m - ego.x_m) * ego.heading_x + (vehicle.y_m - ego.y_m) * ego.heading_y
    return bool(ahead_m < -ego.length_m / 2)
