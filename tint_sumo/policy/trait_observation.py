"""Driver traits as a part of the policy's observation (paper III-C)."""

from typing import Any

import numpy as np
from gymnasium import spaces
from stable_baselines3.common.vec_env import VecEnv, VecEnvWrapper
from stable_baselines3.common.vec_env.base_vec_env import VecEnvStepReturn

from tint_sumo.config import MAX_VEHICLES
from tint_sumo.errors import InputError
from tint_sumo.policy.tracks import Observation
from tint_sumo.policy.trait_sources import Frame, TraitSource

TRAITS, TRUE_TRAITS = "traits", "true_traits"
_NEEDED = frozenset({"ego", "vehicles", "mask"})


class TraitObservation(VecEnvWrapper):
    """Adds traits, (12, size) under a key, to the observations of a T-intersection, terminal ones included.

    Args:
        venv: Stable-Baselines3 vector environment of T-intersections.
        source: where the traits come from; for one environment only.
        key: ``"traits"``, or ``"true_traits"`` for those that only a critic may see.

    Raises:
        InputError: the environment does not observe ego, vehicles and mask.
    """

    def __init__(self, venv: VecEnv, source: TraitSource, key: str = TRAITS) -> None:
        if not isinstance(venv.observation_space, spaces.Dict) or not set(venv.observation_space.spaces) >= _NEEDED:
            raise InputError(
                f"traits belong to observations with {', '.join(sorted(_NEEDED))}, as a T-intersection's; "
                f"this environment's space is {venv.observation_space}"
            )
        super().__init__(venv, spaces.Dict({**venv.observation_space.spaces, key: trait_space(source.size)}))
        self.source = source
        self.key = key
        source.attach(venv.num_envs)

    def reset(self) -> Observation:
        observation = _dictionary(self.venv.reset())
        self.reset_infos = self.venv.reset_infos  # for a wrapper around this one
        self.source.begin(Frame(observation, self.reset_infos, np.ones(self.num_envs, bool)))
        return self._with_traits(observation)

    def step_wait(self) -> VecEnvStepReturn:
        fresh, rewards, done, infos = self.venv.step_wait()
        observation = _dictionary(fresh)
        ended = np.flatnonzero(done)
        self.source.advance(Frame(_continued(observation, infos, ended), infos, done))
        for env in ended:
            infos[env]["terminal_observation"][self.key] = self.source.traits[env].copy()
        if len(ended):
            self.source.begin(Frame(observation, infos, done))
        return self._with_traits(observation), rewards, done, infos

    def _with_traits(self, observation: Observation) -> Observation:
        return {**observation, self.key: self.source.traits.copy()}


def trait_space(size: int) -> spaces.Box:
    """Space of the traits of all slots, so many numbers each."""
    return spaces.Box(-np.inf, np.inf, (MAX_VEHICLES, size), np.float32)


def _dictionary(observation: Any) -> Observation:
    assert isinstance(observation, dict)
    return observation


def _continued(observation: Observation, infos: list[dict[str, Any]], ended: np.ndarray) -> Observation:
    """The observations that continue the last ones' episodes: the terminal ones in the ``ended`` environments."""
    if not len(ended):
        return observation
    continued = {key: values.copy() for key, values in observation.items()}
    for env in ended:
        for key, value in infos[env]["terminal_observation"].items():
            if key in continued:
                continued[key][env] = value
    return continued
