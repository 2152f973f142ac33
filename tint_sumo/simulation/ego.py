"""The egos: the PD law on speed, the safety check, and their claims on the traffic's routes."""

import math
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

from tint_sumo.core.compiling import compiled
from tint_sumo.scenes.geometry import POSE, SPACING_M, Bools, Floats, Numbers, Poses, measure_distances_m, place
from tint_sumo.scenes.layout import Layout
from tint_sumo.scenes.scene import Scene
from tint_sumo.scenes.sumocfg import SumocfgScene
from tint_sumo.simulation.slots import EMPTY, Slots
from tint_sumo.simulation.timing import StepPart, does

_STEP_MARGIN_M = 1.0  # more than a vehicle and the ego come closer in a step


@dataclass(frozen=True)
class Collision:
    """The ego's first collision in an episode."""

    slot: int  # slot of the other vehicle
    member: int  # number of its driver in the population
    route: str  # name of its route
    ego_x_m: float  # the ego's centre
    ego_y_m: float


class EgoRules(NamedTuple):
    """What the controller of a scene comes down to (see ``tint_sumo.config``)."""

    gain_per_s: float
    accel_limit_mps2: float
    braking_gain_per_s: float
    braking_limit_mps2: float
    unsafe_distance_m: float
    closing_distance_m: float
    closing_speed_mps: float
    approach_speed_mps: float
    watches_behind: bool
    half_length_m: float  # half the length of the ego
    step_s: float
    way_spacing_m: float

    @classmethod
    def of(cls, scene: Scene | SumocfgScene) -> "EgoRules":
        controller = scene.ego.controller
        return cls(
            controller.gain_per_s,
            controller.accel_limit_mps2,
            controller.braking_gain_per_s,
            controller.braking_limit_mps2,
            controller.unsafe_distance_m,
            controller.closing_distance_m,
            controller.closing_speed_mps,
            scene.claim.approach_speed_mps,
            controller.watches_behind,
            scene.vehicle.length_m / 2,
            scene.step_s,
            SPACING_M,
        )


class Egos:
    """The egos of R replicas. Read only for others.

    =============== ======= ======================================================================
    ``front_m``     (R,)    front bumper's distance along the ego's way
    ``speed_mps``   (R,)
    ``pose``        (R,)    records of ``tint_sumo.scenes.geometry.POSE``
    ``distance_m``  (R, V)  from its box to the vehicles' boxes; infinite if far, or where there is none
    ``unsafe``      (R,)    what the safety check says for the next step
    ``has_claimed`` (R, K)  which of the traffic's routes it claims
    ``collision``   R items the first collision in the episode, or None
    =============== ======= ======================================================================
    """

    def __init__(self, replicas: int, layout: Layout) -> None:
        scene, routes = layout.scene, len(layout.routes)
        self._layout = layout
        self._rules = EgoRules.of(scene)
        # The safety check needs to know how far away a vehicle was a step before.
        self._reach_m = max(self._rules.closing_distance_m, self._rules.unsafe_distance_m) + _STEP_MARGIN_M
        self.front_m: Floats = np.zeros(replicas)
        self.speed_mps: Floats = np.zeros(replicas)
        self.pose: Poses = np.zeros(replicas, POSE)
        self.distance_m: Floats = np.full((replicas, scene.max_vehicles), np.inf)
        self._was_distance_m: Floats = np.full((replicas, scene.max_vehicles), np.inf)  # distances one step ago
        self.unsafe: Bools = np.zeros(replicas, bool)
        self.has_claimed: Bools = np.zeros((replicas, routes), bool)
        self.claim_changed: Bools = np.zeros((replicas, routes), bool)
        self._hit_slot: Numbers = np.full(replicas, EMPTY)
        self.collision: list[Collision | None] = [None] * replicas

    @property
    def collided(self) -> Bools:
        """Whether the ego has had a collision in the episode; (R,)."""
        return np.asarray(self._hit_slot != EMPTY)

    def begin(self, replica: int) -> None:
        """Put an ego at its start, where it stands."""
        self.forget(replica)
        self.front_m[replica] = self._layout.scene.ego.start_m
        self._place(slice(replica, replica + 1))

    def forget(self, replica: int) -> None:
        """Forget what happened in a replica."""
        self.front_m[replica] = self.speed_mps[replica] = 0.0
        self.pose[replica] = np.zeros((), POSE)
        self.distance_m[replica] = self._was_distance_m[replica] = np.inf
        self.unsafe[replica] = False
        self.has_claimed[replica] = self.claim_changed[replica] = False
        self._hit_slot[replica] = EMPTY
        self.collision[replica] = None

    def _place(self, replicas: slice) -> None:
        layout = self._layout
        place(self.front_m[replicas], layout.ego.way, layout.scene.vehicle.length_m, self.pose[replicas])

    def drive(self, desired_mps: Floats) -> None:
        """Move on by a step."""
        drive(desired_mps, self.unsafe, self._rules, self.speed_mps, self.front_m)
        self._place(slice(None))

    @does(StepPart.CLAIMS)
    def update_claims(self) -> bool:
        """Claim routes and give them up; ``claim_changed`` (R, K) tells where that changed, the answer whether any."""
        zones = self._layout.zones
        return update_claims(
            self.front_m,
            self.speed_mps,
            zones.enter_m,
            zones.inside_m,
            zones.towards,
            self._rules,
            self.has_claimed,
            self.claim_changed,
        )

    @does(StepPart.SAFETY_CHECK)
    def look_around(self, slots: Slots) -> None:
        """Run the safety check for the next step, and latch collisions."""
        shape = self._layout.scene.vehicle
        self.distance_m, self._was_distance_m = self._was_distance_m, self.distance_m
        measure_distances_m(
            self.pose, slots.present, slots.pose, self._reach_m, shape.length_m, shape.width_m, self.distance_m
        )
        if check_safety(
            self.distance_m,
            self._was_distance_m,
            self.pose,
            slots.pose,
            self._rules,
            self.unsafe,
            self._hit_slot,
        ):
            for replica in np.flatnonzero(self.collided).tolist():
                if self.collision[replica] is None:
                    self.collision[replica] = self._collision(replica, int(self._hit_slot[replica]), slots)

    def _collision(self, replica: int, slot: int, slots: Slots) -> Collision:
        route = self._layout.scene.routes[slots.route[replica, slot]].name
        pose = self.pose[replica]
        return Collision(slot, int(slots.member[replica, slot]), route, float(pose["x_m"]), float(pose["y_m"]))


@compiled
def acceleration_mps2(speed_mps: float, desired_mps: float, unsafe: bool, rules: EgoRules) -> float:
    """The PD law, or braking where the safety check fires."""
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
    """Whether a vehicle is dangerously close."""
    close = distance_m < rules.unsafe_distance_m
    return close or (distance_m < rules.closing_distance_m and closing_mps > rules.closing_speed_mps)


@compiled
def check_safety(
    distance_m: Floats,
    before_m: Floats,
    egos: Poses,
    vehicles: Poses,
    rules: EgoRules,
    unsafe: Bools,
    hit: Numbers,
) -> bool:
    """Look at the vehicles around each ego.

    Args:
        distance_m, before_m: (R, V) to vehicles, now and a step ago; infinite where there is none, or none was.
        egos, vehicles: (R,) and (R, V) poses.
        unsafe: (R,) written: whether any vehicle is dangerously close.
        hit: (R,) the first slot whose vehicle the ego has touched, written where it was -1.

    Returns:
        whether any ego has newly touched a vehicle.
    """
    any_new = False
    for row in range(len(unsafe)):
        unsafe[row] = False
        for slot in range(distance_m.shape[1]):
            now_m, was_m = distance_m[row, slot], before_m[row, slot]
            closing_mps = (was_m - now_m) / rules.step_s if math.isfinite(was_m) else 0.0
            if is_unsafe(now_m, closing_mps, rules):
                counts = rules.watches_behind or not is_behind(vehicles[row, slot], egos[row], rules.half_length_m)
                unsafe[row] = unsafe[row] or counts
            if now_m == 0.0 and hit[row] < 0:
                hit[row] = slot
                any_new = True
    return any_new


@compiled
def is_behind(vehicle: Any, ego: Any, half_length_m: float) -> bool:
    """Whether a vehicle's centre is behind an ego's back; both are poses."""
    ahead_m = (vehicle.x_m - ego.x_m) * ego.heading_x + (vehicle.y_m - ego.y_m) * ego.heading_y
    return bool(ahead_m < -half_length_m)


@compiled
def update_claims(
    front_m: Floats,
    speed_mps: Floats,
    enter_m: Floats,
    inside_m: Floats,
    towards: Floats,
    rules: EgoRules,
    claimed: Bools,
    changed: Bools,
) -> bool:
    """Write which routes each ego claims and where that changed, both (R, K); whether any did.

    An ego claims a route once its front has entered the lane and it either moves in or stands in the vehicles' path.
    Without the second condition a standing ego could probe drivers at no risk.

    Args:
        front_m, speed_mps: (R,).
        enter_m, inside_m, towards: (K,), (K,) and (K, P); see ``tint_sumo.scenes.layout.ConflictZones``.
    """
    any_changed = False
    for row in range(len(front_m)):
        index = min(max(int(front_m[row] / rules.way_spacing_m), 0), towards.shape[1] - 1)
        for route in range(len(enter_m)):
            moves_in = speed_mps[row] * towards[route, index] > rules.approach_speed_mps
            now = front_m[row] > enter_m[route] and (moves_in or front_m[row] > inside_m[route])
            changed[row, route] = now != claimed[row, route]
            claimed[row, route] = now
            any_changed = any_changed or changed[row, route]
    return any_changed
