"""Tiny vector environments for policy tests."""

from typing import Any

import numpy as np
from gymnasium import spaces
from stable_baselines3.common.vec_env import VecEnv

from tint_sumo.config import PolicySettings

SMALL = PolicySettings((16, 16), (16,), 16, (16, 16), 16, (16,))


def box(*shape: int) -> spaces.Box:
    return spaces.Box(-2.0, 2.0, shape, np.float32)


STREET = spaces.Dict(ego=box(4), vehicles=box(12, 2), mask=box(12))
STREET_WITH_TRAITS = spaces.Dict({**STREET.spaces, "traits": box(12, 2)})


class FakeVecEnv(VecEnv):
    """Methods that a VecEnv must have, and that no test here uses."""

    def close(self) -> None: ...

    def get_attr(self, attr_name: str, indices: Any = None) -> list[Any]:
        return [None] * self.num_envs

    def set_attr(self, attr_name: str, value: Any, indices: Any = None) -> None: ...

    def env_method(self, method_name: str, *args: Any, indices: Any = None, **kwargs: Any) -> list[Any]:
        return []

    def env_is_wrapped(self, wrapper_class: Any, indices: Any = None) -> list[bool]:
        return [False] * self.num_envs


class TinyVecEnv(FakeVecEnv):
    """Base of the tasks below: N environments in numpy that all end after ``length`` steps."""

    def __init__(self, num_envs: int, observation_space: spaces.Space, action_space: spaces.Space, length: int) -> None:
        super().__init__(num_envs, observation_space, action_space)
        self.length = length
        self.rng = np.random.default_rng(0)

    def observe(self) -> Any: ...

    def start(self) -> None: ...

    def reward(self) -> np.ndarray: ...

    def reset(self) -> Any:
        self.time = 0
        self.start()
        return self.observe()

    def step_async(self, actions: np.ndarray) -> None:
        self.actions = actions

    def step_wait(self) -> Any:
        rewards = self.reward().astype(np.float32)
        self.time += 1
        infos: list[dict[str, Any]] = [{} for _ in range(self.num_envs)]
        done = np.full(self.num_envs, self.time == self.length)
        if done.all():
            terminal = self.observe()
            for i, info in enumerate(infos):
                info["terminal_observation"] = (
                    {k: v[i] for k, v in terminal.items()} if isinstance(terminal, dict) else terminal[i]
                )
                info["episode"] = {"r": float(rewards[i]), "l": self.length, "t": 0.0}
            return self.reset(), rewards, done, infos
        return self.observe(), rewards, done, infos


class Memory(TinyVecEnv):
    """A cue of -1 or +1 is shown once; three steps later the action must say which it was."""

    def __init__(self, num_envs: int) -> None:
        super().__init__(num_envs, box(1), spaces.Discrete(2), length=4)

    def start(self) -> None:
        self.cue = self.rng.integers(0, 2, self.num_envs)

    def observe(self) -> np.ndarray:
        shown = 2.0 * self.cue - 1.0 if self.time == 0 else np.zeros(self.num_envs)
        return shown.astype(np.float32)[:, None]

    def reward(self) -> np.ndarray:
        return (self.time == self.length - 1) * (self.actions == self.cue)


class FollowTheLeader(TinyVecEnv):
    """Up to 12 vehicles; the action must say on which side the only one with trait (1, 0) is."""

    def __init__(self, num_envs: int) -> None:
        super().__init__(num_envs, STREET_WITH_TRAITS, spaces.Discrete(2), length=1)

    def start(self) -> None:
        n = self.num_envs
        self.mask = (self.rng.random((n, 12)) < 0.5).astype(np.float32)
        leader = self.rng.integers(0, 12, n)
        self.mask[np.arange(n), leader] = 1.0
        self.vehicles = self.rng.uniform(-1, 1, (n, 12, 2)).astype(np.float32)
        self.traits = np.tile(np.float32([0.0, 1.0]), (n, 12, 1))
        self.traits[np.arange(n), leader] = (1.0, 0.0)
        self.side = self.vehicles[np.arange(n), leader, 0] > 0

    def observe(self) -> dict[str, np.ndarray]:
        ego = np.zeros((self.num_envs, 4), np.float32)
        return {"ego": ego, "vehicles": self.vehicles, "mask": self.mask, "traits": self.traits}

    def reward(self) -> np.ndarray:
        return self.actions == self.side
