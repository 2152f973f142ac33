"""Rollouts kept as sequences, for recurrent policies."""

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from gymnasium import spaces
from stable_baselines3.common.buffers import DictRolloutBuffer, RolloutBuffer
from stable_baselines3.common.type_aliases import PyTorchObs
from torch import Tensor


@dataclass(frozen=True)
class Sequences:
    """Rollouts of n environments over T steps; flat tensors hold all n of the first step first."""

    observations: PyTorchObs  # (T * n, ...)
    actions: Tensor  # (T * n, ...)
    log_probs: Tensor  # (T * n,) when the actions were taken
    advantages: Tensor  # (T * n,) with mean 0 and standard deviation 1 over the whole rollout
    returns: Tensor  # (T * n,)
    states: Tensor  # (n, hidden_size) before the first step
    episode_starts: Tensor  # (T, n)


class SequenceBuffer(RolloutBuffer):
    """Stable-Baselines3's rollout buffer with its advantage estimation, read as whole sequences."""

    states: Tensor  # (n_envs, hidden_size) before the first step of the rollout

    def sequences(self, n_minibatches: int) -> Iterator[Sequences]:
        """Yield every environment's sequence once, in ``n_minibatches`` random groups."""
        spread = self.advantages.std() + 1e-8
        advantages = (self.advantages - self.advantages.mean()) / spread
        for envs in torch.randperm(self.n_envs).tensor_split(n_minibatches):
            chosen = envs.numpy()
            yield Sequences(
                observations=self._observations(chosen),
                actions=self._actions(chosen),
                log_probs=self._flat(self.log_probs, chosen),
                advantages=self._flat(advantages, chosen),
                returns=self._flat(self.returns, chosen),
                states=self.states[envs.to(self.states.device)],
                episode_starts=self.to_torch(self.episode_starts[:, chosen], copy=False),
            )

    def _flat(self, values: np.ndarray, envs: np.ndarray) -> Tensor:
        """Return the flat tensor of some environments from steps x environments x ..."""
        return self.to_torch(values[:, envs].reshape(-1, *values.shape[2:]), copy=False)

    def _observations(self, envs: np.ndarray) -> PyTorchObs:
        return self._flat(self.observations, envs)

    def _actions(self, envs: np.ndarray) -> Tensor:
        actions = self._flat(self.actions, envs)
        return actions.flatten() if isinstance(self.action_space, spaces.Discrete) else actions


class DictSequenceBuffer(DictRolloutBuffer, SequenceBuffer):
    """The same for observations that are dictionaries."""

    def _observations(self, envs: np.ndarray) -> dict[str, Tensor]:
        return {key: self._flat(values, envs) for key, values in self.observations.items()}


def buffer_class(observation_space: spaces.Space[Any]) -> type[SequenceBuffer]:
    """Return the buffer class for an observation space."""
    return DictSequenceBuffer if isinstance(observation_space, spaces.Dict) else SequenceBuffer
