"""Environments after a reset, which are like new ones whatever came before."""

from collections.abc import Callable, Iterator
from contextlib import closing
from typing import Any

import numpy as np
import pytest

from tests.envs.test_workers import assert_infos_equal
from tests.scenes.networks import USER_NETWORKS, UserNetwork
from tint_sumo.envs import SceneEnv, SceneVectorEnv, TaskSettings
from tint_sumo.envs.episodes import Episodes
from tint_sumo.scenes import SCENES

GO, STOP = 2, 0
TASK: dict[str, Any] = {"tracks": True, "sensor": "noisy_0.1", "time_limit_s": 30.0}
Make = Callable[[str], UserNetwork]


def state(episodes: Episodes) -> dict[str, Any]:
    """Every array and list that has an entry per environment, and the generators of the noise."""
    simulation = episodes.simulation
    parts = [simulation, simulation.slots, simulation.egos, episodes.sensing(0)]
    parts += [getattr(simulation, name) for name in ("yielding", "_demand") if hasattr(simulation, name)]
    found = {
        f"{type(part).__name__}.{name}": value.tolist() if isinstance(value, np.ndarray) else list(value)
        for part in parts
        for name, value in vars(part).items()
        if isinstance(value, np.ndarray | list) and len(value) == simulation.replicas and name != "_newcomer"
    }
    for objects in ("_streams", "_pools", "_towns"):
        found.pop(f"Demand.{objects}", None)
    sensing = episodes.sensing(0)
    assert sensing._normals is not None
    noise = [rng and rng.bit_generator.state for rng in sensing._normals._generators]
    drawn = (sensing._normals._ahead.tolist(), sensing._normals._next.tolist())
    return {**found, "noise": noise, "drawn": drawn, "rows": episodes.rows.tolist(), "steps": episodes.steps.tolist()}


def assert_same_state(first: dict[str, Any], second: dict[str, Any]) -> None:
    assert first.keys() == second.keys()
    for name, value in first.items():
        assert repr(value) == repr(second[name]), name


def assert_same_answers(first: tuple[Any, ...], second: tuple[Any, ...]) -> None:
    for one, other in zip(first, second, strict=True):
        assert_infos_equal(one, other)


def actions(seed: int) -> Iterator[int]:
    """Mostly go, so that all kinds of ends come; the first episode waits."""
    rng = np.random.default_rng(seed)
    while True:
        yield STOP if seed == 0 else int(rng.choice([GO, GO, GO, 1, STOP]))


@pytest.mark.parametrize("name", [*SCENES, *USER_NETWORKS])
def test_nothing_of_an_episode_is_left_after_a_reset(name: str, user_network: Make) -> None:
    scene: Any = name if name in SCENES else user_network(name).scene(warm_up_s=5.0, warm_starts=2)
    with closing(SceneEnv(TaskSettings(scene, **TASK))) as env:
        fresh = env.reset(seed=7)
        fresh_state, snapshot = state(env._episodes), env.snapshot()
    outcomes = set()
    with closing(SceneEnv(TaskSettings(scene, **TASK))) as env:
        for seed in range(3):
            _, info = env.reset(seed=seed)
            assert info["outcome"] == ""
            for action in actions(seed):
                *_, info = env.step(action)
                if info["outcome"]:
                    break
            outcomes.add(info["outcome"])
            for again in (env.restore(snapshot), env.reset(seed=7)):
                assert_same_answers(again, fresh)
            assert_same_state(state(env._episodes), fresh_state)
    assert "timeout" in outcomes and (len(outcomes) > 1 or name in USER_NETWORKS)


@pytest.mark.parametrize("name", SCENES)
def test_nothing_of_the_episodes_of_a_vector_is_left_after_a_reset(name: str) -> None:
    """Whether they went on, had ended, were parked or reset alone."""
    task = TASK | {"time_limit_s": 8.0}
    with closing(SceneVectorEnv(4, TaskSettings(name, **task))) as vector:
        fresh = vector.reset(seed=7)
        fresh_state = state(vector.batch.episodes)
    with closing(SceneVectorEnv(4, TaskSettings(name, **task))) as vector:
        vector.reset(seed=1)
        ended = 0
        for step in range(100):
            if step == 50:
                vector.batch.park(np.array([False, True, False, False]))
                vector.reset(options={"reset_mask": np.array([False, False, True, False])})
            *_, terminated, truncated, _ = vector.step(np.array([GO, GO, 1, STOP]))
            ended += int((terminated | truncated).sum())
        assert ended
        again = vector.reset(seed=7)
        assert_same_answers(again, fresh)
        assert_same_state(state(vector.batch.episodes), fresh_state)


def test_a_parked_environment_stays_so_for_as_long_as_an_episode_can_take() -> None:
    with closing(SceneVectorEnv(2, TaskSettings(time_limit_s=5.0))) as vector:
        vector.reset(seed=0)
        vector.batch.park(np.array([True, False]))
        for _ in range(200):  # the ego would be at its goal before, and the time over
            observation, _, terminated, truncated, infos = vector.step(np.array([GO, GO]))
            assert not observation["mask"][0].any() and infos["time_s"][0] == 0.0
            assert not terminated[0] and not truncated[0]
