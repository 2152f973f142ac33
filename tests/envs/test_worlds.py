"""Worlds of drivers and sensors."""

from dataclasses import replace

import pytest

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
    with pytest.raises(InputError, match=r"unknown world 'moon'; choose one of: old, strangers"):
        find_world("moon")
