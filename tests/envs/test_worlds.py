"""Worlds of drivers and sensors."""

from contextlib import closing
from dataclasses import replace
from typing import Any

import gymnasium
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env

from tint_sumo import STRANGERS_ENV_ID
from tint_sumo.config import (
    HELD_OUT_WORLDS,
    POPULATIONS,
    SENSORS,
    TRAINING_SENSORS,
    WORLDS,
    Mix,
)
from tint_sumo.core.errors import InputError
from tint_sumo.envs import TaskSettings
from tint_sumo.envs.worlds import find_world, scene_in, task_in
from tint_sumo.scenes import paper_scene


def test_a_world_changes_drivers_and_sensor_alone() -> None:
    task = TaskSettings(p_conservative=Mix(0.3), time_limit_s=20.0, tracks=True)
    acc, noisy = (task_in(find_world(name), task) for name in ("acc", "noise_0.2"))
    assert acc == replace(
        task, scene=replace(task.scene, population=replace(POPULATIONS["traits"], car_following="ACC"))
    )
    assert noisy == replace(task, sensor=SENSORS["noisy_0.2"])
    assert task_in(find_world("old"), task) == task
    late = scene_in(find_world("headway_2.0"), paper_scene())
    assert late.population.idm.tau_s == 2.0 and late.digest == paper_scene().digest


@pytest.mark.parametrize("name", list(WORLDS))
def test_every_world_has_drivers(name: str) -> None:
    world = find_world(name)
    scene = scene_in(world, paper_scene())
    assert scene.population.car_following == world.car_following and len(scene.traits) == 2


def test_what_is_held_out_is_not_in_the_training() -> None:
    trained = WORLDS["strangers"]
    assert trained.sensors == TRAINING_SENSORS and len(set(TRAINING_SENSORS)) == 9
    towns = POPULATIONS[trained.population]
    for world in HELD_OUT_WORLDS.values():
        differs = POPULATIONS[world.population] != towns or world.car_following != "IDM"
        assert differs and (world.sensors == (SENSORS["perfect"],) or world.sensors[0] not in TRAINING_SENSORS)


def test_a_test_has_one_sensor_and_a_world_one_name() -> None:
    with pytest.raises(InputError, match="are for training, and a test has one sensor; give another world"):
        task_in(find_world("strangers"), TaskSettings())
    with pytest.raises(InputError, match="num_envs must be at least 9, one for each scene or sensor, not 4"):
        gymnasium.make_vec(STRANGERS_ENV_ID, num_envs=4, world="strangers")
    with pytest.raises(InputError, match=r"unknown world 'moon'; choose one of: old, strangers"):
        find_world("moon")


def test_the_environment_of_strangers_is_a_scene_in_a_world() -> None:
    with (
        closing(gymnasium.make(STRANGERS_ENV_ID, p_conservative=0.5, time_limit_s=2.0)) as strangers,
        closing(gymnasium.make(STRANGERS_ENV_ID, p_conservative=0.5, time_limit_s=2.0, world="acc")) as others,
    ):
        check_env(strangers.unwrapped, skip_render_check=True)
        assert strangers.unwrapped._settings.reward == "careful"  # type: ignore[attr-defined]
        town = {strangers.reset(seed=seed)[1]["town"] for seed in range(8)}
        assert len(town) > 4 and min(town) >= 0
        assert others.unwrapped._settings == task_in(  # type: ignore[attr-defined]
            find_world("acc"), TaskSettings(p_conservative=Mix(0.5), time_limit_s=2.0, reward="careful")
        )


def test_environments_of_strangers_share_the_sensors_of_their_world() -> None:
    with closing(gymnasium.make_vec(STRANGERS_ENV_ID, num_envs=9, world="strangers", time_limit_s=2.0)) as vector:
        observation, _ = vector.reset(seed=3)
        with closing(gymnasium.make_vec(STRANGERS_ENV_ID, num_envs=9, time_limit_s=2.0)) as perfect:
            plain, _ = perfect.reset(seed=3)
    seen = [np.array_equal(one, other) for one, other in zip(observation["vehicles"], plain["vehicles"], strict=True)]
    assert seen[0] and not all(seen)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"world": "moon"}, "unknown world 'moon'"),
        ({"world": "strangers"}, "are for training, and a test has one sensor"),
        ({"tau_s": 1.0}, "tau_s: the world has that; leave it out, or give another `world`"),
        ({"position_noise_m": 0.1}, "position_noise_m: the world has that"),
        ({"towns": 3}, "towns"),
    ],
)
def test_arguments_that_a_world_has_are_refused(arguments: dict[str, Any], message: str) -> None:
    with pytest.raises(InputError, match=message):
        gymnasium.make(STRANGERS_ENV_ID, **arguments)
