"""The ego's low-level control: the PD law on speed, the safety check, and its claim on a lane. Pure functions."""

import numpy as np

from tint_sumo.config import Claim, EgoController, Street
from tint_sumo.scenario.geometry import Bools, Floats, lane_y_m


def is_unsafe(distance_m: Floats, closing_mps: Floats, controller: EgoController) -> Bools:
    """Whether each vehicle is dangerously close; any shape. Absent vehicles have infinite distance."""
    close = distance_m < controller.unsafe_distance_m
    closing = (distance_m < controller.closing_distance_m) & (closing_mps > controller.closing_speed_mps)
    return np.asarray(close | closing)


def acceleration_mps2(speed_mps: Floats, desired_mps: Floats, unsafe: Bools, controller: EgoController) -> Floats:
    """The PD law, or braking where the safety check fires; (R,)."""
    limit, braking_limit = controller.accel_limit_mps2, controller.braking_limit_mps2
    follow = np.minimum(np.maximum(controller.gain_per_s * (desired_mps - speed_mps), -limit), limit)
    brake = np.maximum(-controller.braking_gain_per_s * speed_mps, -braking_limit)
    return np.where(unsafe, brake, follow)


def claims(front_y_m: Floats, speed_towards_mps: Floats, claim: Claim, street: Street) -> Bools:
    """Which lanes (lower, upper) each ego claims; (R, 2).

    An ego claims a lane once its front is past the lane's border and it either moves in or stands in the vehicles'
    path. Without the second condition a standing ego could probe drivers at no risk.
    """
    border_m = lane_y_m(street) - street.lane_width_m / 2
    past = front_y_m[:, None] - border_m
    moving_in = speed_towards_mps[:, None] > claim.approach_speed_mps
    return (past > 0.0) & (moving_in | (past > claim.path_margin_m))
