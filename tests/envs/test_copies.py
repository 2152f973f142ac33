"""Copies and pickles of environments: independent, in the same state, and the original untouched."""

import copy
import pickle
import subprocess
import sys
from collections.abc import Callable
from contextlib import closing
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import pytest

from tests.envs.test_resets import assert_same_answers
from tests.envs.test_workers import assert_infos_equal
from tests.scenes.networks import UserNetwork
from tint_sumo import ENV_IDS, SCENE_ENV_ID
from tint_sumo.core.errors import InputError
from tint_sumo.envs import SceneEnv, SceneVectorEnv, TaskSettings
from tint_sumo.envs.sb3 import SceneVecEnv
from tint_sumo.scenes import T_INTERSECTION

TASK: dict[str, Any] = {"sensor": "noisy_0.1", "tracks": True, "time_limit_s": 6.0, "p_conservative": (0.2, 0.8)}
Copy = Callable[[Any], Any]
COPIES: dict[str, Copy] = {"deepcopy": copy.deepcopy, "pickle": lambda env: pickle.loads(pickle.dumps(env))}
copies = pytest.mark.parametrize("copied", COPIES.values(), ids=COPIES)


def episodes(env: Any, steps: int = 90) -> list[tuple[Any, ...]]:
    """Drive on through several episodes, each of which follows from the environment's generator."""
    answers: list[tuple[Any, ...]] = []
    for action in np.random.default_rng(1).integers(3, size=steps):
        answers.append(env.step(int(action)))
        if answers[-1][2] or answers[-1][3]:
            answers.append(env.reset())
    return answers


def assert_all_same(first: list[tuple[Any, ...]], second: list[tuple[Any, ...]]) -> None:
    for one, other in zip(first, second, strict=True):
        assert_same_answers(one, other)


@copies
@pytest.mark.parametrize("scene", [T_INTERSECTION, "merge"])
def test_a_copy_goes_on_like_the_original_which_does_not_notice(
    copied: Copy, scene: str, user_network: Callable[[str], UserNetwork]
) -> None:
    """As planners use it: with the registered arguments, of the wrapped and of the bare environment."""
    task: dict[str, Any] = TASK
    if scene == "merge":
        task = {"sensor": "noisy_0.1", "time_limit_s": 6.0, "scene": user_network("merge").scene(warm_up_s=5.0)}
    with closing(gymnasium.make(ENV_IDS.get(scene, SCENE_ENV_ID), backend="libsumo", **task)) as env:
        env.reset(seed=3)
        for _ in range(20):
            env.step(2)
        env.np_random.integers(10)  # the user's own draws are part of the state
        env.action_space.sample()
        with closing(copied(env)) as twin, closing(copied(env.unwrapped)) as bare:
            assert twin.unwrapped.simulation.backend == bare.simulation.backend == "traci"
            assert twin.spec == env.spec
            for _ in range(15):
                bare.step(0)
            planned = episodes(twin)
            drawn = twin.action_space.sample()
        went_on = episodes(env)
        assert_all_same(planned, went_on)
        assert sum(len(answer) == 2 for answer in went_on) >= 1
        assert env.action_space.sample() == drawn


@copies
def test_a_copy_takes_libsumo_where_it_is_free(copied: Copy) -> None:
    with closing(SceneEnv(TaskSettings(backend="traci"))) as env:
        env.reset(seed=0)
        with closing(copied(env)) as twin:
            assert twin.simulation.backend == "traci"
    env = SceneEnv()
    env.reset(seed=0)
    stored = pickle.dumps(env)
    env.close()
    with closing(pickle.loads(stored)) as twin:
        assert twin.simulation.backend == "libsumo"
        assert_all_same([twin.step(2)], [_stepped(seed=0)])


def _stepped(seed: int) -> tuple[Any, ...]:
    with closing(SceneEnv(TaskSettings(backend="traci"))) as env:
        env.reset(seed=seed)
        return env.step(2)


def test_a_pickle_is_loaded_in_another_process(tmp_path: Path) -> None:
    with closing(gymnasium.make(ENV_IDS[T_INTERSECTION], **TASK)) as env:
        env.reset(seed=3)
        env.step(2)
        (tmp_path / "env.pickle").write_bytes(pickle.dumps(env))
        code = (
            "import pickle, sys\n"
            f"env = pickle.load(open({str(tmp_path / 'env.pickle')!r}, 'rb'))\n"
            "sys.stdout.buffer.write(pickle.dumps([env.step(2) for _ in range(10)]))\n"
            "env.close()\n"
        )
        found = subprocess.run([sys.executable, "-c", code], capture_output=True, check=True)
        assert_all_same(pickle.loads(found.stdout), [env.step(2) for _ in range(10)])


@pytest.mark.parametrize("make", [SceneEnv, lambda: SceneVectorEnv(2)], ids=["single", "vector"])
@copies
def test_environments_without_an_episode_are_copied_as_they_are(copied: Copy, make: Callable[[], Any]) -> None:
    env = make()
    with closing(copied(env)) as new:
        with pytest.raises(InputError, match="no episode has begun"):
            new.snapshot()
        assert_same_answers(new.reset(seed=2), env.reset(seed=2))
    env.close()
    closed = copied(env)
    with pytest.raises(InputError, match="the environment is closed"):
        closed.reset()
    closed.close()


VECTORS: dict[str, Callable[[], Any]] = {
    "one process": lambda: SceneVectorEnv(3, TaskSettings(**TASK)),
    "workers": lambda: SceneVectorEnv(3, TaskSettings(**TASK), workers=2),
    "stable-baselines3": lambda: SceneVecEnv(3, TaskSettings(**TASK)),
    "gymnasium": lambda: gymnasium.make_vec(
        ENV_IDS[T_INTERSECTION], num_envs=3, vectorization_mode="vector_entry_point", **TASK
    ),
}


@pytest.mark.parametrize("kind", VECTORS)
def test_a_copy_of_a_vector_goes_on_like_the_original(kind: str) -> None:
    actions = np.random.default_rng(0).integers(3, size=(110, 3))
    with closing(VECTORS[kind]()) as env:
        env.reset(**({} if kind == "stable-baselines3" else {"seed": 5}))
        for action in actions[:45]:
            env.step(action)
        with closing(copy.deepcopy(env)) as twin:
            went_on = [twin.step(action) for action in actions[45:]]
        for before, action in zip(went_on, actions[45:], strict=True):
            for one, other in zip(before, env.step(action), strict=True):
                assert_infos_equal(_without_lists(one), _without_lists(other))


def _without_lists(part: Any) -> Any:
    return dict(enumerate(part)) if isinstance(part, list) else part
