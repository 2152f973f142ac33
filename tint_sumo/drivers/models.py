"""SUMO's car-following models: one follower behind a leader that moves as recorded, step by step as SUMO drives it.

The steps are those of SUMO 1.28 with its default Euler update, on a lane whose speed limit is above all speeds. Tests
compare them with SUMO. Randomness is left out: Krauss has ``sigma="0"``.

Source of the facts: https://github.com/eclipse-sumo/sumo, src/microsim/cfmodels.
"""

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from tint_sumo.core.compiling import compiled

Floats = NDArray[np.float64]

LEADER_DECEL_MPS2 = 4.5  # SUMO's decel of passenger cars, which Krauss' followers expect of their leaders
EMERGENCY_DECEL_MPS2 = 9.0  # SUMO's emergencyDecel of passenger cars


@dataclass(frozen=True)
class Parameter:
    """Parameter of a driver: a positive number between two bounds, which is fitted by its logarithm."""

    name: str
    attribute: str  # of SUMO's vType
    unit: str
    title: str  # for people
    low: float
    high: float
    usual: float  # where a fit begins, and the median of the prior
    default: float  # SUMO's


_SPEED = Parameter("desired_speed_mps", "maxSpeed", "m/s", "desired speed", 5.0, 70.0, 33.3, 33.3)
_TAU = Parameter("tau_s", "tau", "s", "time headway", 0.1, 6.0, 1.2, 1.0)
_MIN_GAP = Parameter("min_gap_m", "minGap", "m", "minimum gap", 0.1, 30.0, 2.5, 2.5)
_ACCEL = Parameter("accel_mps2", "accel", "m/s²", "acceleration", 0.1, 6.0, 1.5, 2.6)
_DECEL = Parameter("decel_mps2", "decel", "m/s²", "comfortable braking", 0.1, 12.0, 2.0, 4.5)
PARAMETERS = (_SPEED, _TAU, _MIN_GAP, _ACCEL, _DECEL)
_Drive = Callable[[Floats, Floats, float, float, Floats, float, Floats, Floats], None]


@dataclass(frozen=True)
class CarFollowing:
    """One of SUMO's car-following models."""

    name: str  # SUMO's carFollowModel
    drive: _Drive
    parameters: tuple[Parameter, ...] = PARAMETERS
    attributes: tuple[tuple[str, str], ...] = ()  # further ones of a vType, which switch randomness off

    @cached_property
    def low(self) -> Floats:
        """Lower bounds of the parameters' logarithms; (P,)."""
        return np.log([parameter.low for parameter in self.parameters])

    @cached_property
    def high(self) -> Floats:
        """Upper bounds of the parameters' logarithms; (P,)."""
        return np.log([parameter.high for parameter in self.parameters])

    @cached_property
    def usual(self) -> Floats:
        """Logarithms of usual parameters; (P,)."""
        return np.log([parameter.usual for parameter in self.parameters])

    @cached_property
    def defaults(self) -> Floats:
        """Logarithms of SUMO's default parameters; (P,)."""
        return np.log([parameter.default for parameter in self.parameters])

    def follow(
        self,
        leader_rear_m: Floats,
        leader_speed_mps: Floats,
        front_m: float,
        speed_mps: float,
        log_parameters: Floats,
        step_s: float,
    ) -> tuple[Floats, Floats]:
        """Drive a follower behind its leader.

        Args:
            leader_rear_m: (T,) positions of the leader's rear bumper.
            leader_speed_mps: (T,) speeds of the leader.
            front_m: position of the follower's front bumper in the first row.
            speed_mps: speed of the follower in the first row.
            log_parameters: (P,) logarithms of the parameters.
            step_s: time between rows, SUMO's step length.

        Returns:
            (T,) positions of the follower's front bumper, and (T,) its speeds.
        """
        fronts_m, speeds_mps = np.empty(len(leader_rear_m)), np.empty(len(leader_rear_m))
        parameters = np.exp(log_parameters)
        self.drive(
            leader_rear_m, leader_speed_mps, float(front_m), float(speed_mps), parameters, step_s, fronts_m, speeds_mps
        )
        return fronts_m, speeds_mps

    def vtype(self, log_parameters: Floats, speed_limit_mps: float | None = None) -> dict[str, str]:
        """Return the attributes of a vType that drives so in SUMO.

        Args:
            log_parameters: (P,) logarithms of the parameters.
            speed_limit_mps: of the road where they hold: the desired speed rises and falls with the limit elsewhere.
        """
        values = dict(zip(self.parameters, np.exp(log_parameters), strict=True))
        named = {parameter.name: value for parameter, value in values.items()}
        factor = 1.0 if speed_limit_mps is None else named["desired_speed_mps"] / speed_limit_mps
        return {
            "carFollowModel": self.name,
            **{parameter.attribute: f"{value:.6g}" for parameter, value in values.items()},
            "emergencyDecel": f"{max(EMERGENCY_DECEL_MPS2, named['decel_mps2']):.6g}",
            "speedFactor": f"{factor:.6g}",
            "speedDev": "0",
            **dict(self.attributes),
        }


# Constants of SUMO's source. Compiled functions may use those of their own file alone.
_EPS = 0.001
_STEPPING_S = 0.25  # IDM's attribute stepping: its speed is found in steps of about so long
_DELTA = 4.0  # IDM's exponent
_AMPLIFIER = 1.2  # of an emergency braking


@compiled
def _bounded(speed: float, wanted: float, desired: float, accel: float, decel: float, step_s: float) -> float:
    """Return the next speed: the wanted one within what the vehicle's acceleration and braking allow."""
    planned = min(wanted, desired)
    hardest = max(speed - EMERGENCY_DECEL_MPS2 * step_s, 0.0)  # or with decel, if that is more
    least = min(max(speed - decel * step_s, 0.0), max(planned, hardest))
    return max(least, min(planned, speed + accel * step_s, desired))


@compiled
def _drive_idm(
    leader_rear_m: Floats,
    leader_speed_mps: Floats,
    front_m: float,
    speed_mps: float,
    parameters: Floats,
    step_s: float,
    fronts_m: Floats,
    speeds_mps: Floats,
) -> None:
    desired, tau, min_gap, accel, decel = parameters
    iterations = max(1, int(step_s / _STEPPING_S + 0.5))
    braking = 2.0 * math.sqrt(accel * decel)
    for row in range(len(leader_rear_m)):
        fronts_m[row], speeds_mps[row] = front_m, speed_mps
        gap, new, ahead = leader_rear_m[row] - front_m, speed_mps, leader_speed_mps[row]
        for _ in range(iterations):
            wished = min_gap + max(0.0, new * tau + new * (new - ahead) / braking)
            gap = max(_EPS, gap)
            change = accel * (1.0 - (new / desired) ** _DELTA - (wished / gap) ** 2)
            new = max(0.0, new + change * step_s / iterations)
            gap -= max(0.0, (new - ahead) * step_s / iterations)
        speed_mps = _bounded(speed_mps, new, desired, accel, max(decel, min(EMERGENCY_DECEL_MPS2, 1.5)), step_s)
        front_m += speed_mps * step_s


@compiled
def _brake_gap_m(speed: float, decel: float, step_s: float) -> float:
    """Return the distance in which a vehicle stops, braking step by step."""
    steps = int(speed / (decel * step_s))
    return step_s * (steps * speed - decel * step_s * steps * (steps + 1) / 2)


@compiled
def _safe_stop_mps(gap: float, decel: float, headway: float, step_s: float) -> float:
    """Return the highest speed from which a vehicle stops within a gap."""
    room = gap - _EPS
    if room < 0.0:
        return 0.0
    change = decel * step_s
    root = math.sqrt(step_s * step_s + 4.0 * (step_s * (2.0 * room / change - headway) + headway * headway))
    steps = math.floor(0.5 - (headway - root * 0.5) / step_s)
    used = 0.5 * steps * (steps - 1) * change * step_s + steps * change * headway
    return steps * change + (room - used) / (steps * step_s + headway)


@compiled
def _needed_decel(gap: float, speed: float, ahead: float, emergency: float) -> float:
    """Return how hard a vehicle must brake so as not to touch its leader."""
    if gap <= 0.0:
        return emergency
    steady = 0.5 * speed * speed / (gap + 0.5 * ahead * ahead / LEADER_DECEL_MPS2)
    if steady <= LEADER_DECEL_MPS2:
        return steady
    return 0.5 * (speed * speed - ahead * ahead) / gap


@compiled
def _drive_krauss(
    leader_rear_m: Floats,
    leader_speed_mps: Floats,
    front_m: float,
    speed_mps: float,
    parameters: Floats,
    step_s: float,
    fronts_m: Floats,
    speeds_mps: Floats,
) -> None:
    desired, tau, min_gap, accel, decel = parameters
    emergency = max(EMERGENCY_DECEL_MPS2, decel)
    for row in range(len(leader_rear_m)):
        fronts_m[row], speeds_mps[row] = front_m, speed_mps
        gap, ahead = leader_rear_m[row] - front_m - min_gap, leader_speed_mps[row]
        braking_m = _brake_gap_m(ahead, max(decel, LEADER_DECEL_MPS2), step_s)
        wanted = max(speed_mps - emergency * step_s, 0.0)
        if gap >= 0.0:
            wanted = _safe_stop_mps(gap + braking_m, decel, tau, step_s)
        planned_decel = (speed_mps - wanted) / step_s
        if emergency != decel and planned_decel > decel + _EPS:
            needed = _AMPLIFIER * _needed_decel(gap, speed_mps, ahead, emergency)
            wanted = max(speed_mps - min(max(needed, decel), planned_decel) * step_s, 0.0)
        speed_mps = _bounded(speed_mps, wanted, desired, accel, decel, step_s)
        front_m += speed_mps * step_s


MODELS: Mapping[str, CarFollowing] = {
    model.name: model
    for model in (CarFollowing("IDM", _drive_idm), CarFollowing("Krauss", _drive_krauss, attributes=(("sigma", "0"),)))
}
