"""The record of an environment after a step, written by compiled code: observation, infos, rewards and outcome."""

import math
from collections.abc import Collection, Mapping, Sequence
from typing import Any, Literal, NamedTuple, get_args

import numpy as np
from numpy.typing import NDArray

from tint_sumo.config import OBSERVATION_BOUND, STEP_S, RewardPreset
from tint_sumo.core.compiling import compiled
from tint_sumo.scenes.drivers import NO_TOWN
from tint_sumo.scenes.geometry import NO_VEHICLE, Bools, Boxes, Floats, Numbers
from tint_sumo.scenes.scene import Scene
from tint_sumo.scenes.sumocfg import SumocfgScene

Observation = dict[str, NDArray[np.float32]]
OBSERVATION_KEYS = ("ego", "vehicles", "mask")
TRACKS = ("position_m", "gap_m", "passed", "claimed", "to_stop_m")  # per vehicle slot, if they are asked for
SEEN = ("vehicles", "mask", "traits", "track", "slot", *TRACKS)  # what the sensor says, and true traits that fit it
SEEN_IN_NETWORKS = ("priority", "pedestrians", "pedestrian_mask")  # what else it says where rows have more fields
TRUTH = ("track", "slot", "true_mask", "true_vehicles", "true_traits")  # per vehicle slot, if the sensor is not perfect
SLOT_INFOS = ("traits", *TRACKS, *TRUTH)  # what infos can have for each vehicle slot
REWARD_TERMS = ("goal", "collision", "speed", "step")
RED_LIGHT_TERM, COST = "red_light", "cost"  # fields of rows where driving over stop lines at red has consequences
Outcome = Literal["success", "timeout", "collision", "lost", "red_light"]
OUTCOMES: tuple[str, ...] = get_args(Outcome)
BUILT_IN_OUTCOMES = OUTCOMES[:3]  # SUMO takes no ego off the roads of built-in scenes
_PAPER_WAY_M = 17.2  # from the ego's start to its goal in the paper's scene
# Numbers of outcomes in rows: positions in OUTCOMES, plus 1.
GOING_ON, SUCCESS, _TIMEOUT, COLLISION, _LOST, RED_LIGHT = range(6)
BOUND = OBSERVATION_BOUND

Rows = NDArray[np.void]  # records (N,) of a row type


class Contents(NamedTuple):
    """Fields of rows that observations and infos have."""

    keys: tuple[str, ...] = OBSERVATION_KEYS  # of the observation
    slot_infos: tuple[str, ...] = ("traits",)  # infos with a value for each vehicle slot
    terms: tuple[str, ...] = REWARD_TERMS
    step_infos: tuple[str, ...] = ()  # further infos after a step
    infos: tuple[str, ...] = ()  # further infos after a step or a reset


def row_type(max_vehicles: int, more: Sequence[tuple[str, Any, tuple[int, ...]]] = ()) -> np.dtype[np.void]:
    """Return the type of an environment's record, with so many vehicle slots and with more fields."""
    slots = (max_vehicles,)
    layout = np.dtype(
        [
            ("ego", np.float32, (4,)),
            ("vehicles", np.float32, (max_vehicles, 2)),
            ("mask", np.float32, slots),
            ("traits", np.int16, slots),  # number of the driver's profile, or NO_VEHICLE
            ("track", np.int64, slots),  # number of the track in the episode, or NO_VEHICLE
            ("slot", np.int64, slots),  # the simulation's slot of the vehicle that is shown, or NO_VEHICLE
            ("position_m", np.float64, slots),  # along the route, as observed; 0 in empty slots
            ("gap_m", np.float64, slots),  # gap to the leader, as observed; infinite without one
            ("passed", np.int8, slots),  # 1 where the ego has left the vehicle's route behind
            ("claimed", np.int8, slots),  # 1 where the ego claims the vehicle's route, see ``tint_sumo.config.Claim``
            ("to_stop_m", np.float64, slots),  # to where it would wait for the ego, as observed; infinite if nowhere
            ("true_mask", np.int8, slots),  # of the simulation's slots, as they are: 1 where there is a vehicle
            ("true_vehicles", np.float32, (max_vehicles, 2)),
            ("true_traits", np.int16, slots),
            ("town", np.int64),  # number of the episode's town, or NO_TOWN
            ("time_s", np.float64),
            ("outcome", np.int64),
            ("terminated", np.bool_),
            ("truncated", np.bool_),
            ("reward", np.float64),
            *((term, np.float64) for term in REWARD_TERMS),
            *more,
        ],
        align=True,
    )
    return np.dtype((np.record, layout))  # fields are attributes where functions are not compiled, too


_OUTCOME_NAMES = np.array(["", *OUTCOMES], object)  # by their numbers in rows


def outcomes_in(scene: Scene | SumocfgScene) -> tuple[str, ...]:
    """Return the outcomes that episodes of a scene can have."""
    if not isinstance(scene, SumocfgScene):
        return BUILT_IN_OUTCOMES
    return OUTCOMES if scene.red_light == "end" else OUTCOMES[:-1]


def outcome_name(code: int) -> str:
    """Return the name of a row's outcome; empty while the episode goes on."""
    return OUTCOMES[code - 1] if code else ""


def outcome_names(codes: NDArray[np.int64]) -> NDArray[np.object_]:
    """Return the names (N,) of the outcomes of rows."""
    return _OUTCOME_NAMES[codes]


def fields_of(row: np.void | Rows) -> dict[str, Any]:
    """Return the fields of a row, or of the only one of some rows, as Python's numbers and views of the arrays."""
    return dict(zip(row.dtype.names or (), row.item(), strict=True))


def observation_of(fields: Mapping[str, NDArray[Any]], contents: Contents) -> Observation:
    """Return the observation among the fields of a row, or of all rows."""
    return {key: fields[key] for key in contents.keys}


def start_info(fields: Mapping[str, Any], contents: Contents) -> dict[str, Any]:
    """Return the info of an environment after a reset."""
    slots = {key: fields[key].copy() for key in contents.slot_infos}
    return {
        **slots,
        "outcome": outcome_name(fields["outcome"]),
        "time_s": fields["time_s"],
        **{name: fields[name] for name in contents.infos},
        **town_info(fields["town"]),
    }


def town_info(town: int) -> dict[str, int]:
    """Return the town of an episode as infos hold it: only where there are towns."""
    return {} if town == NO_TOWN else {"town": town}


def step_info(fields: Mapping[str, Any], contents: Contents, collision: dict[str, Any]) -> dict[str, Any]:
    """Return the info of an environment after a step; ``collision`` is empty without one."""
    info = start_info(fields, contents)
    info["reward_terms"] = {term: fields[term] for term in contents.terms}
    info |= {name: fields[name] for name in contents.step_infos}
    return info | end_info(info["outcome"], collision)


def end_info(outcome: str, collision: dict[str, Any]) -> dict[str, Any]:
    """Return what a step's info says of the end of the episode; ``collision`` is empty without one.

    ``is_success`` is False while the episode goes on: a wrapper may end it then, and its success is still read.
    """
    ending = {"is_success": outcome == "success"}
    return {**ending, "collision": collision} if collision else ending


def full_info(info: Mapping[str, Any], contents: Contents) -> dict[str, Any]:
    """Return an info with the same keys in every step of an episode, as arrays of all steps need them.

    After a reset rewards and costs are 0 and ``is_success`` is False, and without a collision its texts are empty, its
    slot is -1 and its position nan.
    """
    start = {"reward_terms": dict.fromkeys(contents.terms, 0.0), **dict.fromkeys(contents.step_infos, 0.0)}
    no_collision = {"trait": "", "route": "", "slot": NO_VEHICLE, "ego_m": (math.nan, math.nan)}
    return {**start, "is_success": False, "collision": no_collision, **info}


class TaskRules(NamedTuple):
    """The numbers by which an episode ends, and the rewards of a step."""

    goal_m: float  # the ego's front past it is a success
    step_limit: int
    goal: float
    collision: float
    speed_weight_per_mps: float
    step: float

    @classmethod
    def of(cls, scene: Scene | SumocfgScene, preset: RewardPreset) -> "TaskRules":
        """Return the rules of a scene.

        In a SUMO configuration, driving all the way is worth as much as in the paper's scene, however long and fast it
        is, and so that goal and collision weigh as much beside it. Waiting for a second costs as much as there.
        """
        steps, ways = 1.0, 1.0  # steps of built-in scenes in one, and ways of the paper's scene in this one
        if isinstance(scene, SumocfgScene):
            steps = scene.step_s / STEP_S
            ways = (scene.goal_m - scene.start_m) / _PAPER_WAY_M
        return cls(
            scene.ego.goal_m,
            round(scene.time_limit_s / scene.step_s),
            preset.goal,
            preset.collision,
            preset.speed_weight_per_mps * steps / ways,
            preset.step * steps,
        )


@compiled
def judge(
    front_m: Floats,
    speed_mps: Floats,
    collided: Bools,
    ran_red: Bools,
    lost: Bools,
    steps: Numbers,
    rules: TaskRules,
    rows: Rows,
) -> bool:
    """Write outcomes and rewards of the step just made (paper IV-A); return whether any episode has ended.

    Args:
        front_m, speed_mps, collided, ran_red, lost: (N,) of the egos.
        steps: (N,) since the episodes' start.
    """
    any_ended = False
    for index in range(len(rows)):
        row = rows[index]
        if collided[index]:
            row.outcome = COLLISION
        elif ran_red[index]:
            row.outcome = RED_LIGHT
        elif front_m[index] > rules.goal_m:
            row.outcome = SUCCESS
        elif lost[index]:
            row.outcome = _LOST
        else:
            row.outcome = _TIMEOUT if steps[index] >= rules.step_limit else GOING_ON
        row.terminated = row.outcome in (SUCCESS, COLLISION, RED_LIGHT)
        row.truncated = row.outcome in (_TIMEOUT, _LOST)
        row.goal = rules.goal if row.outcome == SUCCESS else 0.0
        row.collision = rules.collision if row.outcome == COLLISION else 0.0
        row.speed = 0.0 if row.terminated else rules.speed_weight_per_mps * speed_mps[index]
        row.step = 0.0 if row.terminated else rules.step
        row.reward = row.goal + row.collision + row.speed + row.step
        any_ended = any_ended or row.outcome != GOING_ON
    return any_ended


@compiled
def add_up(before: Rows, rows: Rows) -> None:
    """Add the rows of a decision's earlier steps to those of this step.

    Rewards and their terms are summed up. Rows of episodes that had ended already stay as they were.

    Args:
        before: (N,) rows of the decision's steps before this one.
        rows: (N,) rows of this step, changed in place.
    """
    for index in range(len(rows)):
        row, earlier = rows[index], before[index]
        if earlier.outcome != GOING_ON:
            rows[index] = earlier
        else:
            row.goal += earlier.goal
            row.collision += earlier.collision
            row.speed += earlier.speed
            row.step += earlier.step
            row.reward += earlier.reward


class Scales(NamedTuple):
    """The units of observations, and the length of a step."""

    position_m: float  # of the others
    ego_m: float
    speed_mps: float
    step_s: float


@compiled
def _bounded(value: float) -> float:
    return min(max(value, -BOUND), BOUND)


@compiled
def observe(
    egos: Boxes,
    speed_mps: Floats,
    source: Numbers,
    vehicles: Boxes,
    traits: NDArray[np.int16],
    track: Numbers,
    noise_m: Floats,
    steps: Numbers,
    scales: Scales,
    rows: Rows,
) -> None:
    """Write observations, normalised and bounded, and the true traits that go with them.

    Args:
        egos, speed_mps: (N,).
        source: (N, V) which of the simulation's slots holds the vehicle that each slot of the observation shows;
            negative where it is empty.
        vehicles, traits: (N, V) of the simulation's slots.
        track: (N, V) of the observation's slots.
        noise_m: (N, V, 2) of the positions in the simulation's slots.
        steps: (N,) since the episodes' start.
    """
    for index in range(len(rows)):
        row, ego = rows[index], egos[index]
        speed = speed_mps[index] / scales.speed_mps
        row.time_s = steps[index] * scales.step_s
        row.ego[0] = _bounded(ego.x_m / scales.ego_m)
        row.ego[1] = _bounded(ego.y_m / scales.ego_m)
        row.ego[2] = _bounded(speed * ego.heading_x)
        row.ego[3] = _bounded(speed * ego.heading_y)
        for slot in range(source.shape[1]):
            shown = source[index, slot]
            there, other = shown >= 0, vehicles[index, max(shown, 0)]
            dx_m = other.x_m - ego.x_m + noise_m[index, max(shown, 0), 0]
            dy_m = other.y_m - ego.y_m + noise_m[index, max(shown, 0), 1]
            row.vehicles[slot, 0] = _bounded(dx_m / scales.position_m) if there else 0.0
            row.vehicles[slot, 1] = _bounded(dy_m / scales.position_m) if there else 0.0
            row.mask[slot] = 1.0 if there else 0.0
            row.traits[slot] = traits[index, shown] if there else -1
            row.track[slot] = track[index, slot]
            row.slot[slot] = shown


@compiled
def reveal(egos: Boxes, present: Bools, vehicles: Boxes, traits: NDArray[np.int16], scales: Scales, rows: Rows) -> None:
    """Write which vehicles there are and where, seen or not, in the units of observations.

    Args:
        egos: (N,).
        present, vehicles, traits: (N, V) of the simulation's slots.
    """
    for index in range(len(rows)):
        row, ego = rows[index], egos[index]
        for slot in range(present.shape[1]):
            there, other = present[index, slot], vehicles[index, slot]
            row.true_mask[slot] = there
            row.true_vehicles[slot, 0] = _bounded((other.x_m - ego.x_m) / scales.position_m) if there else 0.0
            row.true_vehicles[slot, 1] = _bounded((other.y_m - ego.y_m) / scales.position_m) if there else 0.0
            row.true_traits[slot] = traits[index, slot]


@compiled
def observe_tracks(
    ego_front_m: Floats,
    claims: Bools,
    passed_m: Floats,
    stop_line_m: Floats,
    source: Numbers,
    route: Numbers,
    vehicles: Boxes,
    front_m: Floats,
    leader: Numbers,
    gap_m: Floats,
    noise_m: Floats,
    rows: Rows,
) -> None:
    """Write the observed positions of vehicles on their routes, with the same noise as in the observations.

    Args:
        ego_front_m: (N,).
        claims: (N, K) which of the K routes each ego claims.
        passed_m, stop_line_m: (K,) see ``tint_sumo.scenes.layout.ConflictZones``.
        source: (N, V) as in ``observe``.
        route, vehicles, front_m: (N, V) of the simulation's slots.
        leader, gap_m: (N, V) of the simulation's slots: the next vehicle ahead that is seen, and the gap to it.
        noise_m: (N, V, 2) of the positions.
    """
    for index in range(len(rows)):
        row = rows[index]
        for slot in range(source.shape[1]):
            row.position_m[slot], row.gap_m[slot], row.passed[slot] = 0.0, math.inf, 0
            row.claimed[slot], row.to_stop_m[slot] = 0, math.inf
            shown = source[index, slot]
            if shown < 0:
                continue
            this, ahead = vehicles[index, shown], leader[index, shown]
            noise_along_m = noise_m[index, shown, 0] * this.heading_x + noise_m[index, shown, 1] * this.heading_y
            row.position_m[slot] = front_m[index, shown] + noise_along_m
            row.to_stop_m[slot] = stop_line_m[route[index, shown]] - row.position_m[slot]
            row.claimed[slot] = claims[index, route[index, shown]]
            if ahead >= 0:
                other = vehicles[index, ahead]
                row.gap_m[slot] = gap_m[index, shown] - noise_along_m
                row.gap_m[slot] += noise_m[index, ahead, 0] * other.heading_x
                row.gap_m[slot] += noise_m[index, ahead, 1] * other.heading_y
            row.passed[slot] = ego_front_m[index] > passed_m[route[index, shown]]


@compiled
def show_earlier(rows: Rows, frames: Rows, steps: Numbers) -> None:
    """Put in place of what is seen in rows, which is ``SEEN``, what was seen D steps before, or else at the beginning.

    Args:
        rows: (N,).
        frames: (D + 1, N) those of the last steps, written.
        steps: (N,) since the episodes' start.
    """
    kept = len(frames)
    for index in range(len(rows)):
        step, row = steps[index], rows[index]
        frames[step % kept, index] = row
        earlier = frames[max(step - kept + 1, 0) % kept, index]
        for slot in range(len(row.mask)):
            row.vehicles[slot, 0] = earlier.vehicles[slot, 0]
            row.vehicles[slot, 1] = earlier.vehicles[slot, 1]
            row.mask[slot] = earlier.mask[slot]
            row.traits[slot] = earlier.traits[slot]
            row.track[slot] = earlier.track[slot]
            row.slot[slot] = earlier.slot[slot]
            row.position_m[slot] = earlier.position_m[slot]
            row.gap_m[slot] = earlier.gap_m[slot]
            row.passed[slot] = earlier.passed[slot]
            row.claimed[slot] = earlier.claimed[slot]
            row.to_stop_m[slot] = earlier.to_stop_m[slot]


def show_earlier_in_networks(rows: Rows, frames: Rows, steps: Numbers) -> None:
    """Do as ``show_earlier``, after it, with ``SEEN_IN_NETWORKS``; rows that have no such fields stay as they are."""
    earlier = np.maximum(steps - len(frames) + 1, 0) % len(frames)
    for field in SEEN_IN_NETWORKS:
        if field in (rows.dtype.names or ()):
            rows[field] = frames[field][earlier, np.arange(len(rows))]


def copied(rows: Rows, slot_infos: Collection[str] = SLOT_INFOS) -> dict[str, NDArray[Any]]:
    """Return a copy of each field, (N, ...), without the fields of ``SLOT_INFOS`` that are not among ``slot_infos``."""
    return {
        field: rows[field].copy() for field in rows.dtype.names or () if field in slot_infos or field not in SLOT_INFOS
    }
