"""Episodes that a policy drives, each the first one of an environment with its seed."""

from collections.abc import Callable, Generator, Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from stable_baselines3.common.vec_env import VecEnv

from tint_sumo.envs.rows import COST
from tint_sumo.methods.registry import Policy

_STOP = 0  # action of environments whose episode is over
_RANDOM_ACTIONS = 1  # stream of an episode's seed, beside that of its traffic


@dataclass(frozen=True)
class DrivenEpisode:
    """An episode that a policy has driven."""

    number: int  # from 0
    seed: int  # of its environment
    info: dict[str, Any]  # of its last step
    cost: float  # sum of the costs of its steps
    actions: list[int]  # of its decisions


def drive(
    policy: Policy,
    make_venv: Callable[[int], VecEnv],
    first_seed: int,
    episodes: int,
    batch: int,
    random_share: float = 0.0,
) -> Generator[DrivenEpisode]:
    """Drive episodes with the policy's likeliest actions, and yield them as they end.

    Episode i is the first one of an environment seeded with ``first_seed + i``, whatever the batch.

    Args:
        policy: a rule or a Stable-Baselines3 model; recurrent states are carried along.
        make_venv: makes the vector environment of so many environments; closed at the end.
        first_seed: seed of the first episode.
        episodes: number of episodes.
        batch: environments at a time.
        random_share: share of the decisions whose action is drawn at random, by the episode's seed.
    """
    venv = make_venv(min(batch, episodes))
    try:
        for done in range(0, episodes, venv.num_envs):
            seeds = range(first_seed + done, first_seed + min(episodes, done + venv.num_envs))
            yield from _first_episodes(policy, venv, seeds, done, random_share)
    finally:
        venv.close()


def _first_episodes(
    policy: Policy, venv: VecEnv, seeds: Sequence[int], first: int, random_share: float
) -> Iterator[DrivenEpisode]:
    """Yield the first episode of each of the first environments, with these seeds, as they end."""
    venv.seed(seeds[0])
    observation: Any = venv.reset()
    state, starts, costs = None, np.ones(venv.num_envs, bool), np.zeros(venv.num_envs)
    running = np.arange(venv.num_envs) < len(seeds)
    generators = [np.random.default_rng((seed, _RANDOM_ACTIONS)) for seed in seeds]
    taken: list[NDArray[np.integer]] = []
    while running.any():
        actions, state = policy.predict(observation, state=state, episode_start=starts, deterministic=True)
        actions = np.where(running, actions, _STOP)
        if random_share:
            for index in np.flatnonzero(running).tolist():
                if generators[index].random() < random_share:
                    actions[index] = generators[index].integers(venv.action_space.n)  # type: ignore[attr-defined]
        taken.append(actions)
        observation, _, starts, infos = venv.step(actions)
        costs += [info.get(COST, 0.0) for info in infos]
        ended = np.flatnonzero(starts & running).tolist()
        for index in ended:
            actions_of = [int(at_once[index]) for at_once in taken]
            yield DrivenEpisode(first + index, seeds[index], infos[index], float(costs[index]), actions_of)
        if ended:
            running &= ~starts
            venv.env_method("park", indices=ended)
