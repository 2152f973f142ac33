"""All wrappers of gymnasium, around single environments and around vectors in every mode that they take."""

import warnings
from collections.abc import Callable, Iterator
from contextlib import closing
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import pytest
import torch
from gymnasium import spaces, wrappers
from gymnasium.vector import AutoresetMode
from gymnasium.wrappers import vector as vector_wrappers

from tint_sumo import ENV_IDS
from tint_sumo.scenes import T_INTERSECTION

ENV_ID = ENV_IDS[T_INTERSECTION]
TASK: dict[str, Any] = {"render_mode": "rgb_array", "time_limit_s": 0.5}
STEPS = 7  # an episode of five steps, and a part of the next one
FOREIGN = {"AtariPreprocessing", "JaxToNumpy", "JaxToTorch"}  # for Atari games, and for environments written in JAX
TENSORS = {"ArrayConversion", "NumpyToTorch"}  # they return torch's tensors, and take such actions
SPEED = spaces.Box(-1.0, 1.0, (), np.float32)  # for wrappers of continuous actions

Wrap = Callable[..., Any]


def flat(env: Any) -> Any:
    return wrappers.FlattenObservation(env)


def pictures(env: Any) -> Any:
    return wrappers.AddRenderObservation(env)


def action_of(speed: Any) -> Any:
    return np.rint(np.asarray(speed) + 1.0).astype(np.int64)


def continuous(env: Any) -> Any:
    return wrappers.TransformAction(env, action_of, SPEED)


SINGLE: dict[str, Wrap] = {
    "DelayObservation": lambda env: wrappers.DelayObservation(env, 2),
    "DtypeObservation": lambda env: wrappers.DtypeObservation(flat(env), np.float64),
    "DiscretizeObservation": lambda env: wrappers.DiscretizeObservation(flat(env), 5, multidiscrete=True),
    "FilterObservation": lambda env: wrappers.FilterObservation(env, ["ego"]),
    "FrameStackObservation": lambda env: wrappers.FrameStackObservation(env, 2),
    "GrayscaleObservation": lambda env: wrappers.GrayscaleObservation(pictures(env)),
    "TransformObservation": lambda env: wrappers.TransformObservation(env, lambda seen: seen, None),
    "MaxAndSkipObservation": lambda env: wrappers.MaxAndSkipObservation(flat(env), 2),
    "NormalizeObservation": lambda env: wrappers.NormalizeObservation(flat(env)),
    "ResizeObservation": lambda env: wrappers.ResizeObservation(pictures(env), (32, 74)),
    "ReshapeObservation": lambda env: wrappers.ReshapeObservation(flat(env), (4, 10)),
    "RescaleObservation": lambda env: wrappers.RescaleObservation(flat(env), np.float32(0.0), np.float32(1.0)),
    "ClipAction": lambda env: wrappers.ClipAction(continuous(env)),
    "DiscretizeAction": lambda env: wrappers.DiscretizeAction(continuous(env), 3),
    "TransformAction": lambda env: wrappers.TransformAction(env, lambda action: action, None),
    "RescaleAction": lambda env: wrappers.RescaleAction(continuous(env), np.float32(0.0), np.float32(1.0)),
    "StickyAction": lambda env: wrappers.StickyAction(env, 0.5),
    "RepeatAction": lambda env: wrappers.RepeatAction(env, 2),
    "ClipReward": lambda env: wrappers.ClipReward(env, -1.0, 0.0),
    "TransformReward": lambda env: wrappers.TransformReward(env, lambda reward: reward),
    "TimeLimit": lambda env: wrappers.TimeLimit(env, 4),
    "AddWhiteNoise": lambda env: wrappers.AddWhiteNoise(env, 0.1),
    "ObstructView": lambda env: wrappers.ObstructView(env, 0.1, 4),
    "ArrayConversion": lambda env: wrappers.ArrayConversion(env, np, torch),
}


def all_flat(env: Any) -> Any:
    return vector_wrappers.VectorizeTransformObservation(env, wrappers.FlattenObservation)


def all_pictures(env: Any) -> Any:
    single = spaces.Box(0, 255, (8, 8, 3), np.uint8)
    every = spaces.Box(0, 255, (env.num_envs, 8, 8, 3), np.uint8)
    return vector_wrappers.TransformObservation(env, lambda _: np.zeros(every.shape, np.uint8), every, single)


def all_continuous(env: Any) -> Any:
    every = spaces.Box(-1.0, 1.0, (env.num_envs,), np.float32)
    return vector_wrappers.TransformAction(env, action_of, every, SPEED)


VECTOR: dict[str, Wrap] = {
    "VectorizeTransformObservation": all_flat,
    "VectorizeTransformAction": lambda env: vector_wrappers.VectorizeTransformAction(
        env, wrappers.TransformAction, func=lambda action: action, action_space=spaces.Discrete(3)
    ),
    "VectorizeTransformReward": lambda env: vector_wrappers.VectorizeTransformReward(
        env, wrappers.TransformReward, func=lambda reward: reward
    ),
    "TransformObservation": lambda env: vector_wrappers.TransformObservation(env, lambda seen: seen),
    "FilterObservation": lambda env: vector_wrappers.FilterObservation(env, ["ego"]),
    "GrayscaleObservation": lambda env: vector_wrappers.GrayscaleObservation(all_pictures(env)),
    "ResizeObservation": lambda env: vector_wrappers.ResizeObservation(all_pictures(env), (4, 4)),
    "ReshapeObservation": lambda env: vector_wrappers.ReshapeObservation(all_flat(env), (4, 10)),
    "RescaleObservation": lambda env: vector_wrappers.RescaleObservation(
        all_flat(env), np.float32(0.0), np.float32(1.0)
    ),
    "DtypeObservation": lambda env: vector_wrappers.DtypeObservation(all_flat(env), np.float64),
    "NormalizeObservation": lambda env: vector_wrappers.NormalizeObservation(all_flat(env)),
    "TransformAction": lambda env: vector_wrappers.TransformAction(env, lambda action: action),
    "ClipAction": lambda env: vector_wrappers.ClipAction(all_continuous(env)),
    "RescaleAction": lambda env: vector_wrappers.RescaleAction(all_continuous(env), np.float32(0.0), np.float32(1.0)),
    "TransformReward": lambda env: vector_wrappers.TransformReward(env, lambda reward: reward),
    "ClipReward": lambda env: vector_wrappers.ClipReward(env, -1.0, 0.0),
    "ArrayConversion": lambda env: vector_wrappers.ArrayConversion(env, np, torch),
}

# Gymnasium's wrappers of observations leave final observations alone, and so refuse this mode.
NOT_SAME_STEP = {name for name in vector_wrappers.__all__ if name.endswith("Observation")}
MODES = {
    name: [
        mode
        for mode in AutoresetMode
        if not (mode is AutoresetMode.SAME_STEP and name in NOT_SAME_STEP)
        and not (mode is AutoresetMode.DISABLED and name == "NormalizeObservation")
    ]
    for name in vector_wrappers.__all__
    if name not in FOREIGN
}


class WithoutText(gymnasium.vector.VectorWrapper[Any, Any, Any, Any, Any]):
    """Leaves arrays of objects out of the infos: no tensor can hold them."""

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> Any:
        observations, infos = self.env.reset(seed=seed, options=options)
        return observations, numbers(infos)

    def step(self, actions: Any) -> Any:
        *returned, infos = self.env.step(actions)
        return *returned, numbers(infos)


def numbers(infos: dict[str, Any]) -> dict[str, Any]:
    inner = {key: numbers(value) for key, value in infos.items() if isinstance(value, dict)}
    arrays = {key: value for key, value in infos.items() if isinstance(value, np.ndarray)}
    return inner | {key: value for key, value in arrays.items() if value.dtype.kind != "O"}


@pytest.fixture
def wrap(request: pytest.FixtureRequest, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Wrap]:
    """Puts the wrapper of a name and kind around an environment; its warnings are errors."""
    table, module, name = request.param
    if name == "RecordVideo":
        pytest.importorskip("moviepy")
        yield lambda env: module.RecordVideo(env, str(tmp_path / "videos"))
        return
    monkeypatch.setenv("SDL_VIDEODRIVER", "dummy")  # where HumanRendering opens its window
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        warnings.filterwarnings("ignore", message="overflow encountered in cast")  # DtypeObservation
        yield table.get(name) or getattr(module, name)


SINGLE_NAMES = [name for name in wrappers.__all__ if name not in {"vector", *FOREIGN}]


@pytest.mark.parametrize(
    ("wrap", "name"),
    [pytest.param((SINGLE, wrappers, name), name, id=name) for name in SINGLE_NAMES],
    indirect=["wrap"],
)
def test_single_environments_take_the_wrapper(wrap: Wrap, name: str) -> None:
    ended = 0
    with closing(wrap(gymnasium.make(ENV_ID, **TASK))) as env:
        observation, _ = env.reset(seed=0)
        for _ in range(STEPS):
            assert name in TENSORS or observation in env.observation_space
            action = env.action_space.sample()
            observation, _, terminated, truncated, _ = env.step(torch.as_tensor(action) if name in TENSORS else action)
            env.render()
            if terminated or truncated:
                ended += 1
                if name != "Autoreset":
                    observation, _ = env.reset()
    assert ended >= 1


@pytest.mark.parametrize(
    ("wrap", "name", "mode"),
    [
        pytest.param((VECTOR, vector_wrappers, name), name, mode, id=f"{name}-{mode.value}")
        for name, modes in MODES.items()
        for mode in modes
    ],
    indirect=["wrap"],
)
def test_vectors_take_the_wrapper(wrap: Wrap, name: str, mode: AutoresetMode) -> None:
    made = gymnasium.make_vec(ENV_ID, num_envs=2, autoreset_mode=mode, **TASK)
    ended = 0
    with closing(wrap(WithoutText(made) if name in TENSORS else made)) as env:
        observation, _ = env.reset(seed=0)
        for _ in range(STEPS):
            assert name in TENSORS or observation in env.observation_space
            action = env.action_space.sample()
            observation, _, terminated, truncated, _ = env.step(torch.as_tensor(action) if name in TENSORS else action)
            env.render()
            over = np.asarray(terminated | truncated)
            ended += int(over.sum())
            if mode is AutoresetMode.DISABLED and over.any():
                observation, _ = env.reset(options={"reset_mask": over})
    assert ended >= 2
