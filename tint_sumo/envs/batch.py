"""Environments in a batch, whose episodes follow one another."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np
from gymnasium.utils import seeding
from numpy.typing import NDArray

from tint_sumo.config import MAX_VEHICLES
from tint_sumo.envs.episodes import REWARD_TERMS, Episodes, Observation, TaskSettings, Transition
from tint_sumo.envs.rendering import render_intersection

# What each environment has to tell after every step.
ROW = np.dtype(
    [
        ("ego", np.float32, (4,)),
        ("vehicles", np.float32, (MAX_VEHICLES, 2)),
        ("mask", np.float32, (MAX_VEHICLES,)),
        ("traits", np.int8, (MAX_VEHICLES,)),
        ("time_s", np.float64),
        ("reward", np.float64),
        ("terminated", np.bool_),
        ("truncated", np.bool_),
        *((term, np.float64) for term in REWARD_TERMS),
    ],
    align=True,
)
Rows = dict[str, NDArray[Any]]  # an array (N, ...) for each field of ROW


@dataclass(frozen=True)
class Ended:
    """How an environment's episode ended, as seen before its next one began in the same step."""

    index: int
    observation: Observation
    traits: NDArray[np.int8]
    outcome: str
    time_s: float
    collision: dict[str, Any]  # empty without one


class Batch(Protocol):
    """Environments that step together. Returned arrays belong to the caller."""

    def reset(self, seeds: Sequence[int | None], mask: NDArray[np.bool_]) -> Rows:
        """Start a new episode where the mask (N,) is true; without a seed, from the environment's own generator."""

    def step(self, actions: NDArray[np.integer]) -> tuple[Rows, list[Ended]]:
        """Take valid actions (N,); an episode that ends is followed by the next one at once."""

    def render(self) -> list[NDArray[np.uint8]]: ...

    def close(self) -> None: ...


class LocalBatch:
    """A batch in this process: intersections of one simulation."""

    def __init__(self, num_envs: int, settings: TaskSettings) -> None:
        self.episodes = Episodes(num_envs, settings)
        self._rngs: list[np.random.Generator | None] = [None] * num_envs

    def reset(self, seeds: Sequence[int | None], mask: NDArray[np.bool_]) -> Rows:
        for index in np.flatnonzero(mask).tolist():
            self._begin(index, seeds[index])
        return self._state()

    def _begin(self, index: int, seed: int | None = None) -> None:
        rng = self._rngs[index]
        if rng is None or seed is not None:
            rng, _ = seeding.np_random(seed)
            self._rngs[index] = rng
        self.episodes.begin(index, rng)

    def step(self, actions: NDArray[np.integer]) -> tuple[Rows, list[Ended]]:
        transition = self.episodes.step(actions)
        state = self._state()
        ended = [self._ended(index, state, transition) for index in np.flatnonzero(transition.done).tolist()]
        for one in ended:
            self._begin(one.index)
        if ended:
            state = self._state()
        outcome = {
            "reward": transition.reward,
            "terminated": transition.terminated,
            "truncated": transition.timeout,
        }
        return state | outcome | transition.reward_terms, ended

    def _state(self) -> Rows:
        return {**self.episodes.observe(), "traits": self.episodes.traits(), "time_s": self.episodes.time_s()}

    def _ended(self, index: int, state: Rows, transition: Transition) -> Ended:
        return Ended(
            index,
            {key: state[key][index] for key in ("ego", "vehicles", "mask")},
            state["traits"][index],
            str(transition.outcome[index]),
            float(state["time_s"][index]),
            self.episodes.collision_info(index),
        )

    def render(self) -> list[NDArray[np.uint8]]:
        simulation = self.episodes.simulation
        return [render_intersection(simulation, index) for index in range(simulation.replicas)]

    def close(self) -> None:
        self.episodes.simulation.close()
