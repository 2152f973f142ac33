"""What each environment has to tell after a step: one record, written by compiled code."""

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from tint_sumo.compiling import compiled
from tint_sumo.config import MAX_VEHICLES, RewardPreset, Scenario
from tint_sumo.scenario.geometry import Bools, Floats, Poses

Observation = dict[str, NDArray[np.float32]]
OBSERVATION_KEYS = ("ego", "vehicles", "mask")
REWARD_TERMS = ("goal", "collision", "speed", "step")
OUTCOMES = ("", "success", "collision", "timeout")
_GOING_ON, _SUCCESS, _COLLISION, _TIMEOUT = range(4)
BOUND = 2.0  # of normalised observations: 40 m, 6 m/s

ROW = np.dtype(
    [
        ("ego", np.float32, (4,)),
        ("vehicles", np.float32, (MAX_VEHICLES, 2)),
        ("mask", np.float32, (MAX_VEHICLES,)),
        ("traits", np.int8, (MAX_VEHICLES,)),
        ("time_s", np.float64),
        ("outcome", np.int64),  # index into OUTCOMES
        ("terminated", np.bool_),
        ("truncated", np.bool_),
        ("reward", np.float64),
        *((term, np.float64) for term in REWARD_TERMS),
    ],
    align=True,
)
Rows = NDArray[np.void]  # of ROW, (N,)


class TaskRules(NamedTuple):
    """When an episode ends, and what a step is worth."""

    goal_x_m: float  # the ego's centre past it, and
    goal_y_m: float  # this close to the upper lane's middle, is a success
    goal_margin_m: float
    step_limit: int
    goal: float
    collision: float
    speed_weight_per_mps: float
    step: float

    @classmethod
    def of(cls, scenario: Scenario, preset: RewardPreset) -> "TaskRules":
        rules, street = scenario.episode, scenario.street
        return cls(
            rules.goal_x_m,
            street.upper_y_m,
            street.lane_width_m / 4,
            round(rules.time_limit_s / rules.step_s),
            preset.goal,
            preset.collision,
            preset.speed_weight_per_mps,
            preset.step,
        )


@compiled
def judge(
    poses: Poses, speed_mps: Floats, collided: Bools, steps: NDArray[np.int64], rules: TaskRules, rows: Rows
) -> bool:
    """Write outcomes and rewards of the step just made (paper IV-A); whether any episode has ended.

    Args:
        poses, speed_mps, collided: (N,) of the egos.
        steps: (N,) since the episodes' start.
    """
    any_ended = False
    for index in range(len(rows)):
        row, pose = rows[index], poses[index]
        arrived = pose.x_m > rules.goal_x_m and abs(pose.y_m - rules.goal_y_m) < rules.goal_margin_m
        if collided[index]:
            row.outcome = _COLLISION
        elif arrived:
            row.outcome = _SUCCESS
        else:
            row.outcome = _TIMEOUT if steps[index] >= rules.step_limit else _GOING_ON
        row.terminated = row.outcome in (_SUCCESS, _COLLISION)
        row.truncated = row.outcome == _TIMEOUT
        row.goal = rules.goal if row.outcome == _SUCCESS else 0.0
        row.collision = rules.collision if row.outcome == _COLLISION else 0.0
        row.speed = 0.0 if row.terminated else rules.speed_weight_per_mps * speed_mps[index]
        row.step = 0.0 if row.terminated else rules.step
        row.reward = row.goal + row.collision + row.speed + row.step
        any_ended = any_ended or row.outcome != _GOING_ON
    return any_ended


class Scales(NamedTuple):
    """What observations are divided by, and the length of a step."""

    position_m: float
    speed_mps: float
    step_s: float


@compiled
def _bounded(value: float) -> float:
    return min(max(value, -BOUND), BOUND)


@compiled
def observe(
    poses: Poses,
    speed_mps: Floats,
    present: Bools,
    x_m: Floats,
    y_m: Floats,
    traits: NDArray[np.int8],
    noise_m: Floats,
    steps: NDArray[np.int64],
    scales: Scales,
    rows: Rows,
) -> None:
    """Write observations, normalised and bounded, and what goes with them.

    Args:
        poses, speed_mps: (N,) of the egos.
        present, x_m, y_m: (N, 12) of the vehicle slots.
        traits: (N, 12) true traits.
        noise_m: (N, 12, 2) of the positions.
        steps: (N,) since the episodes' start.
    """
    for index in range(len(rows)):
        row, pose = rows[index], poses[index]
        speed = speed_mps[index] / scales.speed_mps
        row.time_s = steps[index] * scales.step_s
        row.ego[0] = _bounded(pose.x_m / scales.position_m)
        row.ego[1] = _bounded(pose.y_m / scales.position_m)
        row.ego[2] = _bounded(speed * pose.heading_x)
        row.ego[3] = _bounded(speed * pose.heading_y)
        for slot in range(present.shape[1]):
            there = present[index, slot]
            dx_m = x_m[index, slot] - pose.x_m + noise_m[index, slot, 0]
            dy_m = y_m[index, slot] - pose.y_m + noise_m[index, slot, 1]
            row.vehicles[slot, 0] = _bounded(dx_m / scales.position_m) if there else 0.0
            row.vehicles[slot, 1] = _bounded(dy_m / scales.position_m) if there else 0.0
            row.mask[slot] = 1.0 if there else 0.0
            row.traits[slot] = traits[index, slot]


def copied(rows: Rows) -> dict[str, NDArray[Any]]:
    """Arrays (N, ...) of their own for each field."""
    return {field: rows[field].copy() for field in ROW.names or ()}
