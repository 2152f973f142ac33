"""Arguments of ``gymnasium.make``, and specifications that can be written as JSON."""

from collections.abc import Callable
from contextlib import closing
from dataclasses import replace
from typing import Any

import gymnasium
import numpy as np
import pytest
from gymnasium.envs.registration import EnvSpec

from tests.scenes.networks import UserNetwork
from tint_sumo import ENV_IDS, SCENE_ENV_ID
from tint_sumo.config import Sensor
from tint_sumo.core.errors import InputError
from tint_sumo.envs import SceneEnv, TaskSettings
from tint_sumo.envs.entry_points import env_spec
from tint_sumo.envs.worlds import find_world, task_in
from tint_sumo.scenes import find_scene

GO = 2


def made_again(task: TaskSettings) -> TaskSettings:
    """Return the settings of the environment that a specification in JSON makes."""
    with closing(gymnasium.make(EnvSpec.from_json(env_spec(task).to_json())).unwrapped) as env:
        assert isinstance(env, SceneEnv)
        return env._settings


@pytest.mark.parametrize(
    ("task", "env_id"),
    [
        (TaskSettings(), "tint_sumo/TIntersection-v1"),
        (TaskSettings("four_way", (0.1, 0.9), "authors", 9.5, "noisy_0.1", 1.5), "tint_sumo/FourWay-v0"),
        (TaskSettings("on_ramp", sensor=Sensor(noise_m=0.3, range_m=15.0), tracks=True), "tint_sumo/OnRamp-v0"),
        (TaskSettings(decision_s=0.4, max_episode_steps=7, backend="traci"), "tint_sumo/TIntersection-v1"),
    ],
)
def test_settings_come_back_from_json(task: TaskSettings, env_id: str) -> None:
    assert env_spec(task).id == env_id
    assert made_again(task) == task


@pytest.mark.parametrize(
    "task",
    [
        TaskSettings(replace(find_scene("roundabout"), max_vehicles=9)),
        task_in(find_world("towns"), TaskSettings("t_intersection", (0.2, 0.8))),
    ],
)
def test_scenes_with_other_numbers_and_worlds_come_back_with_the_same_episodes(task: TaskSettings) -> None:
    assert env_spec(task).id == SCENE_ENV_ID
    again = made_again(task)
    assert again.played.digest == task.played.digest
    ways = []
    for settings in (task, again):
        with closing(SceneEnv(settings)) as env:
            env.reset(seed=3)
            ways.append([env.step(np.int64(GO))[0]["vehicles"] for _ in range(20)])
    np.testing.assert_array_equal(*ways)


def test_sumo_configurations_come_back(user_network: Callable[[str], UserNetwork]) -> None:
    scene = user_network("grid").scene(perceives=("lane",), red_light="cost", sight_m=40.0)
    task = TaskSettings(scene, time_limit_s=30.0)
    spec = EnvSpec.from_json(env_spec(task).to_json())
    assert spec.id == SCENE_ENV_ID
    assert TaskSettings(**spec.kwargs) == task


def test_scenes_and_sensors_are_described_as_in_files() -> None:
    scene, sensor = {"base": "four_way", "max_vehicles": 5}, {"base": "range_15", "noise_m": 0.2}
    with closing(gymnasium.make(SCENE_ENV_ID, scene=scene, sensor=sensor)) as env:
        assert env.observation_space["vehicles"].shape == (5, 2)  # type: ignore[index]
    with closing(gymnasium.make_vec(SCENE_ENV_ID, 2, scene=scene, sensor=sensor)) as vector:
        assert vector.observation_space["vehicles"].shape == (2, 5, 2)  # type: ignore[index]
    assert TaskSettings(sensor=sensor).sensor == replace(TaskSettings(sensor="range_15").sensor, noise_m=0.2)  # type: ignore[arg-type]
    assert TaskSettings(sensor={"base": "noisy_0.1"}) == TaskSettings(sensor="noisy_0.1")  # type: ignore[arg-type]


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"scene": {"base": "five_way"}}, "scene.base: is not known: 'five_way'"),
        ({"scene": {"max_vehicle": 5}}, "scene.max_vehicle: there is no such setting; did you mean max_vehicles?"),
        ({"sensor": {"noise": 0.1}}, "sensor.noise: there is no such setting"),
        ({"sensor": {"noise_m": -1}}, "sensor.noise_m: must lie in"),
    ],
)
def test_what_a_description_cannot_say_is_refused(arguments: dict[str, Any], message: str) -> None:
    with pytest.raises(InputError) as refused:
        gymnasium.make(ENV_IDS["t_intersection"], **arguments)
    assert message in str(refused.value) and "\n" not in str(refused.value)
