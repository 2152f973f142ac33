"""Traffic as an ego's sensor gives it: sequences of all that is in sight, and windows of single tracks."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from gymnasium.vector import AutoresetMode
from numpy.typing import NDArray

from tint_sumo.core.ranges import Range
from tint_sumo.dataset.windows import Windows, cut_windows, window_rows
from tint_sumo.envs import SceneVectorEnv, TaskSettings
from tint_sumo.scenes import require_trait_steps

_WAIT = 0  # action
_STEPS = Range(1, 10_000_000)
_TRACKS_PER_EPISODE = 100_000
_BOLDNESS = (0.0, 0.03, 0.1, 0.3)  # probabilities of an explorer's move, one of them drawn for each episode
_MOVE_STEPS = (4, 9)  # drawn from this range, the end excluded; it keeps an action for one step more

Drive = Callable[[NDArray[np.bool_]], NDArray[np.int64]]
"""Takes which of N episodes have just begun, and returns N actions."""


@dataclass(frozen=True)
class Perceived:
    """Vehicles that N egos perceive in T steps; arrays are (T, N, V) for V slots of the observation."""

    present: NDArray[np.bool_]  # whether the slot shows a vehicle
    track: NDArray[np.int64]  # number of its track in the episode, or NO_VEHICLE
    position_m: NDArray[np.float64]  # along its route
    gap_m: NDArray[np.float64]  # to its leader; infinite without one
    traits: NDArray[np.int64]  # label of its driver at that step, or NO_VEHICLE
    begins: NDArray[np.bool_]  # (T, N) whether an episode begins

    @property
    def episode(self) -> NDArray[np.int64]:
        """(T, N) number of the episode, which no other episode of any ego has."""
        count = self.begins.shape[1]
        number: NDArray[np.int64] = np.arange(count) + count * (np.cumsum(self.begins, axis=0) - 1)
        return number

    @property
    def begins_track(self) -> NDArray[np.bool_]:
        """(T, N, V) whether a vehicle is seen that was not seen in that slot at the step before, in this episode."""
        found = self.present.copy()
        same = (self.track[1:] == self.track[:-1]) & ~self.begins[1:, :, None]
        found[1:] &= ~(self.present[:-1] & same)
        return found


def wait(begins: NDArray[np.bool_]) -> NDArray[np.int64]:
    """Let all egos wait; a ``Drive``."""
    return np.full(len(begins), _WAIT)


class Explorer:
    """A ``Drive`` that moves now and then, so that drivers must react to it, and waits in between.

    Args:
        num_envs: number N of egos.
        actions: number of actions, the first of which waits.
        seed: of all that is random.
    """

    def __init__(self, num_envs: int, actions: int, seed: int) -> None:
        self._rng = np.random.default_rng(seed)
        self._actions = actions
        self._boldness = np.zeros(num_envs)
        self._left = np.zeros(num_envs, np.int64)
        self._action = np.zeros(num_envs, np.int64)

    def __call__(self, begins: NDArray[np.bool_]) -> NDArray[np.int64]:
        rng, count = self._rng, len(begins)
        self._boldness = np.where(begins, rng.choice(_BOLDNESS, count), self._boldness)
        moves = np.where(rng.random(count) < self._boldness, rng.integers(1, self._actions, count), _WAIT)
        due = begins | (self._left <= 0)
        self._action = np.where(due, moves, self._action)
        self._left = np.where(due, rng.integers(*_MOVE_STEPS, count), self._left - 1)
        return self._action


def perceive(tasks: Sequence[TaskSettings], steps: int, num_envs: int, seed: int, drive: Drive = wait) -> Perceived:
    """Return what egos perceive, from the beginning of their episodes on; an episode follows another.

    Args:
        tasks: settings among which the environments are shared out, in order.
        steps: T of the simulation in each environment.
        num_envs: number N of environments.
        seed: of the first environment; the others have those that follow.
        drive: the egos' actions.

    Raises:
        InputError: the number of steps makes no sense, or a scene's steps are not those that traits are inferred in.
    """
    _STEPS.require("steps", steps)
    for task in tasks:
        require_trait_steps(task.scene)
    settings = [replace(task, tracks=True, decision_s=None) for task in tasks]
    env = SceneVectorEnv(num_envs, settings, None, None, AutoresetMode.SAME_STEP)
    seen: dict[str, list[NDArray[Any]]] = {key: [] for key in ("track", "position_m", "gap_m", "traits")}
    begins = [np.ones(num_envs, bool)]
    try:
        env.reset(seed=seed)
        for _ in range(steps):
            for key, values in seen.items():
                values.append(env.batch.rows[key].copy())
            _, _, terminated, truncated, _ = env.step(drive(begins[-1]))
            begins.append(terminated | truncated)
    finally:
        env.close()
    found = {key: np.array(values) for key, values in seen.items()}
    return Perceived(
        present=found["track"] >= 0,
        track=found["track"],
        position_m=found["position_m"],
        gap_m=found["gap_m"],
        traits=found["traits"].astype(np.int64),
        begins=np.array(begins[:-1]),
    )


def perceived_windows(
    task: TaskSettings, steps: int, *, num_envs: int = 64, seed: int = 0
) -> tuple[Windows, NDArray[np.int64]]:
    """Return windows (N,) of the tracks that a waiting ego perceives, and the labels (N,) of their drivers then.

    They come the same way as what a policy's trait model reads while it drives. A track ends where the sensor loses its
    vehicle, which is another driver in the windows when it is seen again. Where labels change with time, a window has
    that of its last step.

    Args:
        task: scene, drivers and sensor.
        steps: of the simulation in each environment; an episode follows another.
        num_envs: number of environments.
        seed: of the first environment; the others have those that follow.

    Raises:
        InputError: as in ``perceive``.
    """
    seen = perceive([task], steps, num_envs, seed)
    when, at_env, slot = np.nonzero(seen.present)
    driver = seen.episode[when, at_env] * _TRACKS_PER_EPISODE + seen.track[when, at_env, slot]
    order = np.lexsort((when, driver))
    at = (when[order], at_env[order], slot[order])
    driver = driver[order]
    windows = cut_windows(driver, driver // _TRACKS_PER_EPISODE, seen.position_m[at], seen.gap_m[at])
    first, length = window_rows(driver)
    return windows, seen.traits[at][first + length - 1]
