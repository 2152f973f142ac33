"""Decisions less often than every simulation step."""

from typing import Any

import numpy as np
from stable_baselines3.common.vec_env import VecEnv, VecEnvWrapper
from stable_baselines3.common.vec_env.base_vec_env import VecEnvObs, VecEnvStepReturn

from tint_sumo.core.errors import InputError

_STOP = 0  # action of an episode that began within a decision


class ActionRepeat(VecEnvWrapper):
    """Takes each action for ``repeat`` steps and returns the sum of their rewards.

    An episode that ends within a decision ends the decision; the next episode then waits, with desired speed 0, for
    the rest of it. The controller and its safety check go on working at every step.

    It differs from the environments' ``decision_s`` in two ways, and trainings depend on both. What it wraps goes step
    by step, so that traits are inferred at each of them; an environment with ``decision_s`` shows only what is there
    after the decision. And with ``decision_s`` the next episode begins when the decision is over, and does not wait.

    Raises:
        InputError: ``repeat`` is less than 1.
    """

    def __init__(self, venv: VecEnv, repeat: int) -> None:
        if repeat < 1:
            raise InputError(f"an action is taken for at least 1 step, not {repeat}")
        super().__init__(venv)
        self.repeat = repeat
        self._actions = np.zeros(venv.num_envs, np.int64)

    def reset(self) -> VecEnvObs:
        return self.venv.reset()

    def step_async(self, actions: np.ndarray) -> None:
        self._actions = np.asarray(actions)

    def step_wait(self) -> VecEnvStepReturn:
        total = np.zeros(self.num_envs, np.float32)
        ended = np.zeros(self.num_envs, bool)
        last: list[dict[str, Any]] = [{} for _ in range(self.num_envs)]
        for _ in range(self.repeat):
            observation, rewards, done, infos = self.venv.step(np.where(ended, _STOP, self._actions))
            total += np.where(ended, 0.0, rewards)
            for index in np.flatnonzero(~ended):
                last[index] = infos[index]
            ended |= done
        return observation, total, ended, last
