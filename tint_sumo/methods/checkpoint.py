"""The state of a policy's training between two rollouts, from which it goes on to the very end it would have had.

On a GPU it does not: actions are drawn from the GPU's random numbers there, whose state is not kept.
"""

from collections import deque
from collections.abc import Iterable, Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
import torch
from gymnasium import spaces
from stable_baselines3.common.vec_env import VecEnv

from tint_sumo.core.checkpoints import (
    Tensors,
    copy_into,
    damage_reported,
    pack,
    read_checkpoint,
    restore_training,
    training_tensors,
)
from tint_sumo.core.ranges import Range
from tint_sumo.envs.batch import Snapshot
from tint_sumo.envs.rows import OUTCOMES
from tint_sumo.policy import RecurrentPPO
from tint_sumo.policy.wrappers import VenvSnapshot, memories, restore, snapshot

_GENERATOR, _HIDDEN, _STARTS = "generator", "hidden", "episode_starts"  # names of tensors
_OBSERVATION, _MEMORY = "observation.", "memory."
_ACTIONS, _COUNTS = "episodes.actions", "episodes.counts"
_Count = Annotated[int, Range(0, 2**62)]
_Bits32 = Annotated[int, Range(0, 2**32 - 1)]
_Bits128 = Annotated[int, Range(0, 2**128 - 1)]


@dataclass(frozen=True)
class _Pcg64:
    """State of one of NumPy's generators."""

    state: _Bits128
    inc: _Bits128
    has_uint32: Literal[0, 1]
    uinteger: _Bits32

    @classmethod
    def of(cls, state: Mapping[str, Any]) -> "_Pcg64":
        """Build it from ``numpy.random.PCG64.state``."""
        return cls(**state["state"], has_uint32=state["has_uint32"], uinteger=state["uinteger"])

    def to_numpy(self) -> dict[str, Any]:
        counter = {"state": self.state, "inc": self.inc}
        rest = {"has_uint32": self.has_uint32, "uinteger": self.uinteger}
        return {"bit_generator": "PCG64", "state": counter, **rest}


@dataclass(frozen=True)
class _EpisodeInfo:
    """Stable-Baselines3's record of an episode: its return, its steps, and the time of its end, s."""

    r: float
    l: int  # noqa: E741 - Stable-Baselines3's names
    t: float


@dataclass(frozen=True)
class _State:
    """The part of a checkpoint that is no tensor."""

    decisions: _Count
    updates: _Count  # epochs of PPO so far
    recent: tuple[str, ...]  # outcomes of the last episodes
    infos: tuple[_EpisodeInfo, ...]  # of the last episodes
    successes: tuple[bool, ...]  # of the last episodes
    began: tuple[_Pcg64, ...]  # see ``tint_sumo.envs.batch.Snapshot``
    numbers: tuple[_Count, ...] | None = None  # of the present episodes in their rows; None: each is the first one


def make_checkpoint(model: RecurrentPPO, recent: Iterable[str]) -> bytes:
    """Return the content of a checkpoint file; call it where a rollout starts.

    Args:
        model: with environments made by ``tint_sumo.policy.wrappers.policy_venv``.
        recent: outcomes of the last episodes.
    """
    venv = model.get_env()
    assert venv is not None and model.ep_info_buffer is not None and model.ep_success_buffer is not None
    there = snapshot(venv)
    tensors = {
        **training_tensors(model.policy, model.policy.optimizer),
        **_shown(model),
        **_memory(there),
        _GENERATOR: torch.get_rng_state(),
        _ACTIONS: torch.tensor([action for episode in there.episodes for action in episode.actions], dtype=torch.int8),
        _COUNTS: torch.tensor([len(episode.actions) for episode in there.episodes]),
    }
    state = _State(
        model.num_timesteps,
        model._n_updates,
        tuple(recent),
        tuple(_EpisodeInfo(float(info["r"]), int(info["l"]), float(info["t"])) for info in model.ep_info_buffer),
        tuple(bool(success) for success in model.ep_success_buffer),
        tuple(_Pcg64.of(episode.began) for episode in there.episodes),
        tuple(episode.number for episode in there.episodes),
    )
    return pack(tensors, state)


def restore_checkpoint(out: Path, model: RecurrentPPO) -> tuple[str, ...]:
    """Go on from the checkpoint in the folder of a training, if there is one; return the last outcomes.

    Args:
        out: the folder.
        model: new, with the environments of the training; these and the random numbers are brought to where they were.

    Raises:
        InputError: the checkpoint is damaged, or a pickle of an earlier version.
    """
    found = read_checkpoint(out, _State)
    if found is None:
        return ()
    tensors, state = found
    with damage_reported(out):
        _restore(model, tensors, state)
    return state.recent


def _restore(model: RecurrentPPO, tensors: Tensors, state: _State) -> None:
    """Raise ValueError or RuntimeError if something does not fit."""
    venv = model.get_env()
    assert venv is not None and isinstance(venv.observation_space, spaces.Dict)
    if not set(state.recent) <= set(OUTCOMES):
        raise ValueError(f"recent outcomes are others than {', '.join(OUTCOMES)}")
    model._last_obs = {
        key: np.zeros((venv.num_envs, *(space.shape or ())), space.dtype)
        for key, space in venv.observation_space.spaces.items()
    }
    model._last_episode_starts = np.zeros(venv.num_envs, bool)
    restore_training(model.policy, model.policy.optimizer, tensors)
    copy_into(_shown(model), tensors)
    model.num_timesteps, model._n_updates = state.decisions, state.updates
    model.ep_info_buffer = deque(map(asdict, state.infos), maxlen=model._stats_window_size)
    model.ep_success_buffer = deque(state.successes, maxlen=model._stats_window_size)
    episodes = _episodes(venv, tensors, state)
    there = VenvSnapshot(episodes, memories(venv))
    copy_into(_memory(there), tensors)
    restore(venv, there)
    torch.set_rng_state(tensors[_GENERATOR])


def _shown(model: RecurrentPPO) -> Tensors:
    """Return the last observations and hidden states of the policy, as tensors that share memory with the model."""
    assert isinstance(model._last_obs, dict) and model._last_episode_starts is not None
    seen = {f"{_OBSERVATION}{key}": torch.from_numpy(array) for key, array in model._last_obs.items()}
    return {**seen, _STARTS: torch.from_numpy(model._last_episode_starts), _HIDDEN: model.hidden_states}


def _memory(there: VenvSnapshot) -> Tensors:
    """Return the state of the wrappers, as tensors that share memory with the snapshot."""
    return {
        f"{_MEMORY}{number}.{name}": torch.as_tensor(array)
        for number, memory in enumerate(there.memories)
        for name, array in memory.items()
    }


def _episodes(venv: VecEnv, tensors: Tensors, state: _State) -> list[Snapshot]:
    """Return the snapshots of the environments."""
    assert isinstance(venv.action_space, spaces.Discrete)
    counts, actions = tensors[_COUNTS].tolist(), tensors[_ACTIONS].tolist()
    numbers = state.numbers or (0,) * len(counts)
    if not len(counts) == len(state.began) == len(numbers) == venv.num_envs:
        raise ValueError(f"it is of {len(counts)} environments, not of {venv.num_envs}")
    if min(counts) < 0 or sum(counts) != len(actions) or not set(actions) <= set(range(int(venv.action_space.n))):
        raise ValueError("the actions of its episodes do not fit")
    ends, (tasks,) = np.cumsum(counts).tolist(), venv.get_attr("tasks", 0)
    return [
        Snapshot(began.to_numpy(), tuple(actions[end - count : end]), task, number)
        for began, count, end, task, number in zip(state.began, counts, ends, tasks, numbers, strict=True)
    ]
