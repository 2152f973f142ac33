"""Driver traits as a part of the policy's observation (paper III-C)."""

from typing import Any

import numpy as np
from gymnasium import spaces
from stable_baselines3.common.vec_env import VecEnv, VecEnvWrapper
from stable_baselines3.common.vec_env.base_vec_env import VecEnvStepReturn

from tint_sumo.core.errors import InputError
from tint_sumo.policy.trait_sources import Frame, Observation, TraitSource

TRAITS, TRUE_TRAITS = "traits", "true_traits"
_NEEDED = frozenset({"ego", "vehicles", "mask"})


class TraitObservation(VecEnvWrapper):
    """Adds traits, (V, size) under a key, to the observations of a scene, terminal ones included.

    Args:
        venv: a ``tint_sumo.envs.sb3.SceneVecEnv``, or a wrapper around one.
        source: where the traits come from; for one environment only.
        key: ``"traits"``, or ``"true_traits"`` for those that only a critic may see.

    Raises:
        InputError: the environment does not observe ego, vehicles and mask.
    """

    def __init__(self, venv: VecEnv, source: TraitSource, key: str = TRAITS) -> None:
        if not isinstance(venv.observation_space, spaces.Dict) or not set(venv.observation_space.spaces) >= _NEEDED:
            raise InputError(
                f"traits belong to observations with {', '.join(sorted(_NEEDED))}, as a scene's; "
                f"this environment's space is {venv.observation_space}"
            )
        slots = venv.observation_space["mask"].shape
        assert slots is not None
        space = trait_space(slots[0], source.size)
        super().__init__(venv, spaces.Dict({**venv.observation_space.spaces, key: space}))
        self.source = source
        self.key = key
        source.attach(venv.num_envs, slots[0])

    def reset(self) -> Observation:
        observation = _dictionary(self.venv.reset())
        self.reset_infos = self.venv.reset_infos  # a wrapper around this one reads them
        self.source.begin(Frame(observation, self._slots(), np.ones(self.num_envs, bool)))
        return self._with_traits(observation)

    def step_wait(self) -> VecEnvStepReturn:
        fresh, rewards, done, infos = self.venv.step_wait()
        observation, slots = _dictionary(fresh), self._slots()
        ended = np.flatnonzero(done).tolist()
        last = {env: infos[env]["terminal_observation"] for env in ended}
        last_slots = {env: infos[env]["terminal_slots"] for env in ended}
        self.source.advance(Frame(_continued(observation, last), _continued(slots, last_slots), done))
        for env in ended:
            infos[env]["terminal_observation"][self.key] = self.source.traits[env].copy()
        if len(ended):
            self.source.begin(Frame(observation, slots, done))
        return self._with_traits(observation), rewards, done, infos

    def _slots(self) -> dict[str, np.ndarray]:
        slots: dict[str, np.ndarray] = self.venv.slots  # type: ignore[attr-defined]  # a wrapper asks what it wraps
        return slots

    def _with_traits(self, observation: Observation) -> Observation:
        return {**observation, self.key: self.source.traits.copy()}


def trait_space(max_vehicles: int, size: int) -> spaces.Box:
    """Space of the traits of all slots, so many numbers each."""
    return spaces.Box(-np.inf, np.inf, (max_vehicles, size), np.float32)


def _continued(arrays: dict[str, np.ndarray], last: dict[int, dict[str, np.ndarray]]) -> dict[str, np.ndarray]:
    """Arrays (N, ...) with what ended episodes showed last in place of what their successors show first."""
    if not last:
        return arrays
    continued = {key: values.copy() for key, values in arrays.items()}
    for env, values in last.items():
        for key, array in continued.items():
            array[env] = values[key]
    return continued


def _dictionary(observation: Any) -> Observation:
    assert isinstance(observation, dict)
    return observation
