"""Scenes and environments in a world: a population of drivers and a sensor."""

from dataclasses import replace

from tint_sumo.config import POPULATIONS, WORLDS, World
from tint_sumo.core.errors import InputError, find_named
from tint_sumo.envs.episodes import TaskSettings
from tint_sumo.scenes import AnyScene, Scene, require_built_in


def find_world(name: str) -> World:
    """Return the world of this name.

    Raises:
        InputError: there is none.
    """
    return find_named("world", name, WORLDS)


def scene_in(world: World, scene: AnyScene) -> Scene:
    """Return a built-in scene with the drivers of a world.

    Raises:
        InputError: the scene is a SUMO configuration, which has its own drivers.
    """
    built_in = require_built_in("a world", scene)
    population = replace(POPULATIONS[world.population], car_following=world.car_following)
    return replace(built_in, population=population if world.tau_s is None else population.with_tau(world.tau_s))


def tasks_in(world: World, task: TaskSettings) -> list[TaskSettings]:
    """Return settings of environments in a world, one for each of its sensors, with all else as in ``task``.

    Raises:
        InputError: the scene is a SUMO configuration.
    """
    scene = scene_in(world, task.scene)
    return [replace(task, scene=scene, sensor=sensor) for sensor in world.sensors]


def task_in(world: World, task: TaskSettings) -> TaskSettings:
    """Return settings of environments in a world, with all else as in ``task``.

    Raises:
        InputError: the world has several sensors, or the scene is a SUMO configuration.
    """
    if len(world.sensors) > 1:
        raise InputError(f"{world.title} are for training, and a test has one sensor; give another world")
    return tasks_in(world, task)[0]
