"""The share of cases that an ego can finish at best: a search in the simulation that knows everything beforehand."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import product
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from tint_sumo.core.errors import InputError
from tint_sumo.envs import TaskSettings
from tint_sumo.envs.episodes import Episodes
from tint_sumo.envs.rows import GOING_ON, outcome_name
from tint_sumo.scenes import Scene
from tint_sumo.scenes.layout import layout
from tint_sumo.study.ceiling import traffic_seed

_BATCH = 128  # plans that are tried at a time
_FIRST_WAITS_M = (np.inf, 1.0)  # before the first lane; infinitely far is where the ego starts
_SECOND_WAITS_M = (2.5, 0.5)  # before the second lane, on the first one
_EARLIEST, _LATEST = 1, 3  # plans that are gone on with for each time of leaving the second wait
_NEVER = np.inf


class Plan(NamedTuple):
    """Drive as fast as the ego can, but for two waits: from a position on until some time.

    An ego that comes later than that does not wait.
    """

    first_wait_m: float
    first_until_s: float
    second_wait_m: float
    second_until_s: float

    def waits(self, front_m: float, time_s: float) -> bool:
        """Return whether an ego whose front is there waits at some time."""
        return bool(_waits(np.array([self]), np.array([front_m]), time_s)[0])


@dataclass(frozen=True)
class Tried:
    """Results of plans, arrays (P,)."""

    succeeded: NDArray[np.bool_]
    arrived_s: NDArray[np.float64]  # time at the second wait; infinite for an ego that never came there
    ended_s: NDArray[np.float64]

    @classmethod
    def nothing(cls, plans: int) -> "Tried":
        return cls(np.zeros(plans, bool), np.full(plans, np.inf), np.full(plans, np.inf))


def find_plan(task: TaskSettings, case_set: int, case: int) -> Plan | None:
    """Return a plan that finishes a case in time, if the search finds one.

    The episode is played again and again with the same traffic, which only the ego changes: first with each time of
    leaving the first wait, up to a wait on the first lane, then with each time of leaving that one, too. Times are
    those of the task's decisions. The search has no need to know who yields: it sees what comes of each plan.

    Args:
        task: settings of the environment; of a built-in scene with two lanes.
        case_set, case: see ``tint_sumo.methods.evaluation.evaluate``.

    Raises:
        InputError: the ego's way crosses other than two lanes.
    """
    search = _Search(task, case_set, case)
    try:
        return search.run()
    finally:
        search.close()


class _Search:
    """The plans of one case, all in replicas of one simulation."""

    def __init__(self, task: TaskSettings, case_set: int, case: int) -> None:
        scene = task.played
        if not isinstance(scene, Scene) or len(scene.routes) != 2:
            raise InputError("the planner knows scenes in which the ego's way meets two lanes")
        self._enter_m = np.sort(layout(scene).zones.enter_m)
        self._episodes = Episodes(_BATCH, [task])
        self._times_s = task.steps_per_decision * scene.step_s * np.arange(task.decisions_per_episode)
        self._fastest = int(np.argmax(scene.ego.controller.desired_speeds_mps))
        self._seed = traffic_seed(scene, case_set, case)

    def close(self) -> None:
        self._episodes.simulation.close()

    def run(self) -> Plan | None:
        first = list(self._first_plans())
        found, tried = self._try_all(first)
        if found is not None:
            return found
        return self._try_all(list(self._second_plans(first, tried)))[0]

    def _try_all(self, plans: Sequence[Plan]) -> tuple[Plan | None, Tried]:
        """Try plans some at a time, in an order in which neighbours are far apart, until one succeeds."""
        tried = Tried.nothing(len(plans))
        order = np.random.default_rng(0).permutation(len(plans))
        for first in range(0, len(order), _BATCH):
            batch = order[first : first + _BATCH]
            self._try([plans[number] for number in batch], tried, batch)
            if tried.succeeded.any():
                return plans[int(tried.succeeded.argmax())], tried
        return None, tried

    def _first_plans(self) -> Iterator[Plan]:
        """Yield plans that never leave the second wait, and those without one."""
        first, second = self._enter_m
        for wait_m, until_s in product(_FIRST_WAITS_M, self._times_s.tolist()):
            yield Plan(first - wait_m, until_s, _NEVER, 0.0)
            for other_m in _SECOND_WAITS_M:
                yield Plan(first - wait_m, until_s, second - other_m, _NEVER)

    def _second_plans(self, plans: Sequence[Plan], tried: Tried) -> Iterator[Plan]:
        """Yield plans that leave the second wait: at each time those of the first plans that came last and first.

        While the ego waits on the first lane, nothing changes in the second one. So when it leaves matters, and when it
        came matters little.
        """
        for wait_m, until_s in product(self._enter_m[1] - np.array(_SECOND_WAITS_M), self._times_s.tolist()):
            waits = (tried.arrived_s < until_s) & (until_s <= tried.ended_s)
            there = [number for number in np.flatnonzero(waits).tolist() if plans[number].second_wait_m == wait_m]
            there.sort(key=lambda number: tried.arrived_s[number])
            for number in dict.fromkeys([*there[:_EARLIEST], *there[-_LATEST:]]):
                yield plans[number]._replace(second_until_s=until_s)

    def _try(self, plans: Sequence[Plan], tried: Tried, numbers: NDArray[np.int64]) -> None:
        """Play the episode with some plans, until one succeeds or all have ended; write their results."""
        episodes, count, waits = self._episodes, len(plans), np.array(plans)
        going_on = np.ones(count, bool)
        for index in range(_BATCH):
            if index < count:
                episodes.begin(index, self._seed)
            else:
                episodes.park(index)
        for time_s in self._times_s.tolist():
            front_m = episodes.simulation.egos.front_m[:count]
            comes = going_on & (front_m >= waits[:, 2]) & np.isinf(tried.arrived_s[numbers])
            tried.arrived_s[numbers[comes]] = time_s
            actions = np.zeros(_BATCH, np.int64)
            actions[:count] = np.where(_waits(waits, front_m, time_s), 0, self._fastest)
            episodes.step(actions)
            for index in np.flatnonzero(going_on & (episodes.rows["outcome"][:count] != GOING_ON)).tolist():
                going_on[index] = False
                tried.ended_s[numbers[index]] = time_s
                tried.succeeded[numbers[index]] = outcome_name(episodes.rows["outcome"][index]) == "success"
                episodes.park(index)
            if tried.succeeded.any() or not going_on.any():
                return


def _waits(plans: NDArray[np.float64], front_m: NDArray[np.float64], time_s: float) -> NDArray[np.bool_]:
    """Return which egos (P,) wait now, by the numbers of their plans (P, 4) and their positions (P,)."""
    first = (front_m >= plans[:, 0]) & (time_s < plans[:, 1])
    second = (front_m >= plans[:, 2]) & (time_s < plans[:, 3])
    return first | second
