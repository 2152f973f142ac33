"""Measure rules and shipped policies with sensors: does creeping forward to see help, and who copes with which sensor?

Writes ``creeping.csv`` and ``sensors.csv`` into data/results: python scripts/measure_sensors.py
"""

import csv
import io
from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tint_sumo.config import ALL_MIXES, SENSORS, Mix, Sensor
from tint_sumo.core.files import write_text
from tint_sumo.envs import TaskSettings
from tint_sumo.envs.rows import BUILT_IN_OUTCOMES
from tint_sumo.methods.evaluation import REPORTED_SET, Evaluation, evaluate
from tint_sumo.methods.loading import load_policy
from tint_sumo.methods.rules import CREEP, GO, STOP, Observation, State, TimeToCollision
from tint_sumo.policy.wrappers import policy_venv
from tint_sumo.scenes import read_scene

RESULTS = Path(__file__).parents[1] / "data" / "results"
CASES = 300
ARRIVALS_PER_S = 0.1  # on each route: gaps of some seconds, as they are worth looking for
CREEPING_THRESHOLD_S = 3.0
CREEPING_SENSORS = {
    "perfect": Sensor(),
    "other vehicles hide": Sensor(occlusion=True),
    "and buildings 1.5 m from the roads": Sensor(occlusion=True, corners_m=1.5),
    "and buildings 0.5 m from the roads": Sensor(occlusion=True, corners_m=0.5),
}
POLICIES = ("no_labels", "cross_window", "oracle")
_AT_LINE_M = 0.3  # before the place at which the rule stops, since it comes to it slowly


@dataclass(frozen=True)
class DecidesOnce(TimeToCollision):
    """Goes once it sees no vehicle that will soon be in its way, and then goes on whatever comes.

    Args:
        creeps: it creeps to the first lane at 0.5 m/s and decides there; otherwise it decides where it starts.
    """

    creeps: bool = False

    def predict(
        self,
        observation: Observation,
        state: State | None = None,
        episode_start: NDArray[np.bool_] | None = None,
        deterministic: bool = True,
    ) -> tuple[NDArray[np.int64], State]:
        """Return actions (N,) for N observations; the state holds who has gone already, behind that of the rule."""
        free, seen = super().predict(observation, state and state[:2], episode_start, deterministic)
        count = len(free)
        gone = np.zeros(count, bool) if state is None else state[2] > 0.0
        if episode_start is not None:
            gone &= ~episode_start
        is_there = np.ones(count, bool)
        if self.creeps:
            front_m = self._geometry.ego_front_m((observation["ego"][:, :2] * 20.0).astype(np.float64))
            is_there = front_m >= self._geometry.enter_m[0] - self.line_margin_m - _AT_LINE_M
        gone |= is_there & (free == GO)
        wait = np.where(is_there, STOP, CREEP)
        return np.where(gone, GO, wait), (*seen, gone.astype(np.float64))


def creeping() -> Iterator[dict[str, Any]]:
    """Yield a row for each sensor and each place where the rule decides."""
    scene = read_scene({"base": "t_intersection", "arrivals_per_s": ARRIVALS_PER_S})
    for name, sensor in CREEPING_SENSORS.items():
        task = TaskSettings(scene, Mix(0.4), sensor=sensor)
        for creeps in (False, True):
            rule = DecidesOnce(threshold_s=CREEPING_THRESHOLD_S, creeps=creeps)
            found = evaluate(rule, partial(policy_venv, source=None, settings=[task]), CASES, REPORTED_SET)
            yield {"sensor": name, "decides": "at the lane" if creeps else "at the start", **_rates(found)}


def policies() -> Iterator[dict[str, Any]]:
    """Yield a row for each named sensor and each of some shipped policies, which were trained with a perfect one."""
    for name, sensor in SENSORS.items():
        for policy in POLICIES:
            contender = load_policy(policy)
            task = replace(contender.task, p_conservative=ALL_MIXES, sensor=sensor)
            found = evaluate(contender.policy, partial(contender.make_venv, task=task), CASES, REPORTED_SET)
            yield {"sensor": name, "policy": policy, **_rates(found)}


def _rates(found: Evaluation) -> dict[str, str]:
    return {f"{outcome}_percent": f"{100 * found.rate(outcome).value:.1f}" for outcome in BUILT_IN_OUTCOMES}


def write_rows(name: str, rows: Iterator[dict[str, Any]]) -> None:
    """Write rows as a CSV file of data/results, and print each when it is there."""
    text, writer = io.StringIO(), None
    for row in rows:
        if writer is None:
            writer = csv.DictWriter(text, row, lineterminator="\n")
            writer.writeheader()
        writer.writerow(row)
        print(*row.values(), sep=" | ", flush=True)
    write_text(RESULTS / name, text.getvalue())


if __name__ == "__main__":
    write_rows("creeping.csv", creeping())
    write_rows("sensors.csv", policies())
