"""The ego's low-level control: the PD law on speed, the safety check, and its claim on a lane."""

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from tint_sumo.compiling import compiled
from tint_sumo.config import Scenario
from tint_sumo.scenario.geometry import Bools, Floats, Poses, lane_y_m


class EgoRules(NamedTuple):
    """What the controller and the claims of a scenario come down to (see :mod:`tint_sumo.config`)."""

    gain_per_s: float
    accel_limit_mps2: float
    braking_gain_per_s: float
    braking_limit_mps2: float
    unsafe_distance_m: float
    closing_distance_m: float
    closing_speed_mps: float
    approach_speed_mps: float
    path_margin_m: float
    lower_border_y_m: float  # past which the front is on the lower lane
    upper_border_y_m: float
    step_s: float

    @classmethod
    def of(cls, scenario: Scenario) -> "EgoRules":
        controller, claim, street = scenario.ego, scenario.claim, scenario.street
        lower_y_m, upper_y_m = (lane_y_m(street) - street.lane_width_m / 2).tolist()
        return cls(
            controller.gain_per_s,
            controller.accel_limit_mps2,
            controller.braking_gain_per_s,
            controller.braking_limit_mps2,
            controller.unsafe_distance_m,
            controller.closing_distance_m,
            controller.closing_speed_mps,
            claim.approach_speed_mps,
            claim.path_margin_m,
            lower_y_m,
            upper_y_m,
            scenario.episode.step_s,
        )


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
def check_safety(distance_m: Floats, before_m: Floats, rules: EgoRules, unsafe: Bools, hit: NDArray[np.int64]) -> bool:
    """Look at the vehicles around each ego.

    Args:
        distance_m, before_m: (R, V) to vehicles, now and a step ago; infinite where there is none, or none was.
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
            unsafe[row] = unsafe[row] or is_unsafe(now_m, closing_mps, rules)
            if now_m == 0.0 and hit[row] < 0:
                hit[row] = slot
                any_new = True
    return any_new


@compiled
def claims(front_y_m: float, towards_mps: float, border_y_m: float, rules: EgoRules) -> bool:
    """Whether an ego claims the lane behind a border.

    It does once its front is past the border and it either moves in or stands in the vehicles' path. Without the second
    condition a standing ego could probe drivers at no risk.
    """
    past_m = front_y_m - border_y_m
    return past_m > 0.0 and (towards_mps > rules.approach_speed_mps or past_m > rules.path_margin_m)


@compiled
def update_claims(poses: Poses, speed_mps: Floats, rules: EgoRules, claimed: Bools, changed: Bools) -> bool:
    """Write which lanes (lower, upper) each ego claims and where that changed, both (R, 2); whether any did."""
    any_changed = False
    for row in range(len(poses)):
        towards_mps = speed_mps[row] * poses[row].front_direction_y
        for lane, border_y_m in enumerate((rules.lower_border_y_m, rules.upper_border_y_m)):
            now = claims(poses[row].front_y_m, towards_mps, border_y_m, rules)
            changed[row, lane] = now != claimed[row, lane]
            claimed[row, lane] = now
            any_changed = any_changed or changed[row, lane]
    return any_changed
