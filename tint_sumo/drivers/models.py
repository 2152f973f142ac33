"""SUMO's car-following models: one follower behind a leader that moves as recorded, step by step as SUMO drives it.

The steps are those of SUMO 1.28 with its default Euler update, on a lane whose speed limit is above all speeds. Tests
compare them with SUMO. Randomness is left out: Krauss has ``sigma="0"``, and EIDM no errors of perception and driving.

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


# SUMO's defaults of EIDM's further parameters, which are not fitted.
_REACTION_S = 0.5  # tReaction
_STARTING_S = 1.2  # taccmax: until a vehicle that starts has its full acceleration
_STEEPNESS, _SHIFT = 2.0, 0.7  # mFlatness and mBegin of its start
_JERK_MPS3 = 3.0  # jerkmax: by how much acceleration rises
_JUMP_MPS2 = 1.0  # epsilonacc: drivers react at once if they want to brake so much harder
_COOLNESS = 0.99  # ccoolness: how far drivers trust that their leaders do not brake all at once
# Constants of EIDM's source.
_MARGIN_M = 0.05  # of the wished gap
_TOLERANCE_M = 0.25  # by which the minimum gap may be missed
_FREE_M = 500.0  # gap on a free road
_FAR = 1.5  # wished gaps from which on a leader's acceleration counts for less
_CREEPING_MPS = 0.01  # least speed of a leader in the formula of coolness
_HALTING_MPS = 0.1  # vehicles that are slower stand
_CLUTCH_MPS = 0.5  # slower ones may start
_SLOW_MPS = 3.0  # slower ones that brake react at once
_STANDING_S = 2.0  # until a start counts as one
_RESTART_S = 4.0  # between two starts
_LONG_S = 86400.0


@compiled
def _improved_idm(speed: float, gap: float, wished: float, desired: float, accel: float, decel: float) -> float:
    """Return the acceleration of Treiber and Kesting's improved IDM."""
    if speed <= desired:
        free = accel * (1.0 - (speed / desired) ** _DELTA)
        if wished >= gap:
            return accel * (1.0 - (wished / gap) ** 2)
        return 0.0 if free <= 0.0 else free * (1.0 - math.pow(wished / gap, 2.0 * accel / free))
    free = -decel * (1.0 - math.pow(desired / speed, accel * _DELTA / decel))
    return free + accel * (1.0 - (wished / gap) ** 2) if wished >= gap else free


@compiled
def _cool(change: float, speed: float, ahead: float, gap: float, leader_accel: float, decel: float) -> float:
    """Return an acceleration that brakes less where the leader's present acceleration allows it."""
    if ahead * (speed - ahead) <= -2.0 * gap * leader_accel:
        steady = speed * speed * leader_accel / (ahead * ahead - 2.0 * gap * leader_accel)
    else:
        steady = leader_accel - max(speed - ahead, 0.0) ** 2 / (2.0 * gap)
    if change >= steady:
        return change
    return (1.0 - _COOLNESS) * change + _COOLNESS * (steady + decel * math.tanh((change - steady) / decel))


@compiled
def _started(
    speed: float, new: float, began_s: float, now_s: float, may_begin: bool, step_s: float
) -> tuple[float, float]:
    """Return the next speed of a vehicle that starts, and when it began to."""
    iterations = max(1, int(step_s / _STEPPING_S + 0.5))
    reached = speed
    for index in range(iterations):
        at_s = now_s - step_s * (iterations - index - 1.0) / iterations
        if may_begin and began_s + _RESTART_S - _EPS < at_s:
            began_s = at_s
        share = 1.0
        if began_s + _STARTING_S + _EPS > at_s:
            share = (math.tanh(((at_s - began_s) * 2.0 / _STARTING_S - _SHIFT) * _STEEPNESS) + 1.0) / 2.0
        reached += (new - speed) / iterations * share
    return reached, began_s


@compiled
def _wished(speed: float, ahead: float, tau: float, min_gap: float, braking: float) -> float:
    """Return the gap that a driver wishes."""
    return max(0.0, speed * tau + speed * (speed - ahead) / braking) + min_gap + _MARGIN_M


@compiled
def _eidm_plan(
    parameters: Floats,
    memory: Floats,
    since: int,
    speed_mps: float,
    gap: float,
    ahead_mps: float,
    leader_accel_mps2: float,
    began_s: float,
    now_s: float,
    step_s: float,
) -> tuple[float, float, float, float]:
    """Return what a driver plans behind one leader: next speed, accelerations with and without reaction time, leader's.

    Args:
        parameters: (5,) of the driver.
        memory: gap, speed, leader's speed, acceleration and leader's acceleration when the driver last looked.
        since: steps ago.
        speed_mps, gap, ahead_mps, leader_accel_mps2: at present.
        began_s: when the vehicle last started to drive.
        now_s: present time.
        step_s: step length.
    """
    desired, tau, min_gap, accel, decel = parameters
    iterations = max(1, int(step_s / _STEPPING_S + 0.5))
    braking = 2.0 * math.sqrt(accel * decel)
    new, wanted, would, leader_accel = speed_mps, 0.0, 0.0, 0.0
    for index in range(iterations):
        left_s = step_s * (iterations - index - 1.0) / iterations
        speed, ahead, seen = new, ahead_mps, gap
        if since > 0:
            ago_s = since * step_s - left_s
            speed, ahead = max(memory[1] + memory[3] * ago_s, 0.0), max(memory[2] + memory[4] * ago_s, 0.0)
            seen = memory[0] - (memory[1] + speed - memory[2] - ahead) / 2.0 * ago_s
        wished = _wished(speed, ahead, tau, min_gap, braking)
        if seen < min_gap + (step_s * 10.0 + 1.0) * _MARGIN_M and speed < _SLOW_MPS:
            wished = max(wished, seen * math.sqrt(1.0 + 2.0 * _MARGIN_M / accel))
        change = _improved_idm(speed, seen, wished, desired, accel, decel)
        wanted = max(change, -speed / step_s)
        would = _improved_idm(new, gap, _wished(new, ahead_mps, tau, min_gap, braking), desired, accel, decel)
        would = max(would, -new / step_s)
        leader_accel = _EPS
        if ahead >= _CREEPING_MPS:
            leader_accel = min(leader_accel_mps2, accel) * min(1.0, _FAR * wished / seen)
        if began_s + _STARTING_S + _EPS < now_s - left_s and speed_mps > _HALTING_MPS:
            change = _cool(change, speed, max(ahead, _CREEPING_MPS), seen, leader_accel, decel)
        new = max(0.0, new + change * step_s / iterations)
        gap = max(_EPS, gap - max(0.0, (new - ahead_mps) * step_s / iterations))
    return new, wanted, would, leader_accel


@compiled
def _drive_eidm(
    leader_rear_m: Floats,
    leader_speed_mps: Floats,
    front_m: float,
    speed_mps: float,
    parameters: Floats,
    step_s: float,
    fronts_m: Floats,
    speeds_mps: Floats,
) -> None:
    """Drive as SUMO's EIDM (Salles, Kaufmann and Reuss 2020), with a reaction time, limited jerk and soft starts."""
    desired, _, min_gap, accel, decel = parameters
    emergency = max(EMERGENCY_DECEL_MPS2, decel)
    tolerated = max(_EPS, min_gap - _TOLERANCE_M)
    memory, since = np.zeros(5), 0
    began_s, now_s, waiting_s, moving_s = -_LONG_S, step_s, 0.0, _LONG_S
    before = 0.0  # acceleration in the step before
    for row in range(len(leader_rear_m)):
        fronts_m[row], speeds_mps[row] = front_m, speed_mps
        ahead = leader_speed_mps[row]
        ahead_accel = (ahead - leader_speed_mps[row - 1]) / step_s if row > 0 else 0.0
        gap = max(_EPS, leader_rear_m[row] - front_m - min_gap + tolerated)
        fastest = min(speed_mps + accel * step_s, desired)
        new, wanted, would, leader_accel = _eidm_plan(
            parameters, memory, since, speed_mps, gap, ahead, ahead_accel, began_s, now_s, step_s
        )
        # SUMO also plans for a free road, behind a leader that is 500 m ahead and as fast as this driver wants to be.
        free, free_wanted, free_would, free_accel = _eidm_plan(
            parameters, memory, since, speed_mps, _FREE_M + tolerated, desired, ahead_accel, began_s, now_s, step_s
        )
        real = (min(new, fastest) - speed_mps) / step_s
        is_free = wanted > free_wanted - _EPS
        if is_free:
            gap, ahead, leader_accel, wanted = _FREE_M + tolerated, desired, free_accel, free_wanted
            real = min(real, (min(free, fastest) - speed_mps) / step_s)
            new = min(new, free)
        would = min(would, free_would)
        if since == 0:
            memory[:3] = gap, speed_mps, ahead

        planned = min(fastest, new)
        hardest = max(speed_mps - emergency * step_s, 0.0)
        least = min(max(speed_mps - decel * step_s, 0.0), max(planned, hardest))
        after = max(least, planned)
        if after > speed_mps > 2.0 * _CLUTCH_MPS and began_s + _STARTING_S + _EPS < now_s:
            rise = _JERK_MPS3 * step_s
            rise = before + (2.0 * rise if rise + before < 0.0 else rise)
            after = max(min(after, speed_mps + rise * step_s), 0.0)
        waits = planned <= _HALTING_MPS * step_s and waiting_s > _STANDING_S
        moving_s = 0.0 if waits and planned - speed_mps <= accel / 2.0 * step_s else moving_s + step_s
        if moving_s > 0.0 and since * step_s - moving_s > -_EPS:
            after = 0.0
        if after > speed_mps:
            may_begin = speed_mps < _CLUTCH_MPS and since == 0 and before < min(accel / 4.0, 0.2)
            after, began_s = _started(speed_mps, after, began_s, now_s, may_begin, step_s)

        if since == 0:
            memory[3], memory[4] = real, leader_accel
            last_wanted = would = wanted
        since = 0 if since >= _REACTION_S / step_s - 1.0 - _EPS else since + 1
        slows = speed_mps < _SLOW_MPS and after < speed_mps
        if would - last_wanted < -_JUMP_MPS2 or would < -emergency or slows:
            since = 0
        before = (after - speed_mps) / step_s
        waiting_s = waiting_s + step_s if after <= _HALTING_MPS and before <= accel / 2.0 else 0.0
        speed_mps = after
        front_m += speed_mps * step_s
        now_s += step_s


MODELS: Mapping[str, CarFollowing] = {
    model.name: model
    for model in (
        CarFollowing("IDM", _drive_idm),
        CarFollowing("Krauss", _drive_krauss, attributes=(("sigma", "0"),)),
        CarFollowing("EIDM", _drive_eidm, attributes=(("sigmaleader", "0"), ("sigmagap", "0"), ("sigmaerror", "0"))),
    )
}
