"""Entry points of gymnasium, which give the fields of ``TaskSettings`` as keyword arguments.

``gymnasium.make`` and ``make_vec`` know keyword arguments alone, and look for what they can render in an attribute of
the entry point. So these are classes, and here alone keyword arguments become settings; everything below takes
``TaskSettings``, whose fields are the only list of what can be set.
"""

from collections.abc import Collection, Iterable, Mapping
from copy import deepcopy
from dataclasses import fields
from inspect import signature
from typing import Any

import gymnasium
from gymnasium.envs.registration import EnvSpec
from gymnasium.vector import AutoresetMode

from tint_sumo import ENV_IDS, SCENE_ENV_ID
from tint_sumo.config import NOISES, SENSORS, Sensor
from tint_sumo.core.errors import InputError
from tint_sumo.core.structures import plain, require_fields
from tint_sumo.envs.episodes import TaskSettings
from tint_sumo.envs.scene_env import SceneEnv
from tint_sumo.envs.vector import SceneVectorEnv
from tint_sumo.envs.worlds import find_world, task_in, tasks_in
from tint_sumo.scenes import SCENES, scene_settings

_NOISE = "position_noise_m"  # shorthand for a sensor that has this noise alone
_OF_THE_WORLD = ("sensor", "tau_s")


class GymnasiumEnv(SceneEnv):
    """``SceneEnv`` as ``gymnasium.make`` makes it."""

    def __init__(self, render_mode: str | None = None, **task: Any) -> None:
        super().__init__(TaskSettings(**known_arguments(GymnasiumEnv, task)), render_mode)


class GymnasiumVectorEnv(SceneVectorEnv):
    """``SceneVectorEnv`` as ``gymnasium.make_vec`` makes it; ``scene`` may be a list of scenes."""

    def __init__(
        self,
        num_envs: int = 1,
        render_mode: str | None = None,
        workers: int | None = None,
        autoreset_mode: AutoresetMode | str = AutoresetMode.NEXT_STEP,
        **task: Any,
    ) -> None:
        task = known_arguments(GymnasiumVectorEnv, task)
        scenes = task.get("scene")
        if isinstance(scenes, list | tuple):
            each = [TaskSettings(**{**task, "scene": scene}) for scene in scenes]
            super().__init__(num_envs, each, render_mode, workers, autoreset_mode)
        else:
            super().__init__(num_envs, TaskSettings(**task), render_mode, workers, autoreset_mode)


class StrangersEnv(SceneEnv):
    """A scene in a world: drivers of one of many towns, and a sensor; the benchmark of driving among strangers.

    ## Description
    ``SceneEnv`` in one of ``tint_sumo.config.WORLDS``, by default among the drivers of 128 towns. Each episode is in
    one town. Its drivers keep headways, speeds and gaps of their own, and those who yield differ from those who do not
    by as much as the town has it, so that who yields shows only in comparison with the neighbours, if at all. Spaces,
    episodes and info are those of ``SceneEnv``; a collision costs 10 by default (``reward="careful"``).

    ## Arguments
    world: name of the world; one with several sensors is for ``gymnasium.make_vec`` alone. All other arguments are
    those of ``SceneEnv`` but ``sensor``, ``position_noise_m`` and ``tau_s``, which the world has.

    ## Version History
    v0: first version.
    """

    def __init__(self, render_mode: str | None = None, world: str = "towns", **task: Any) -> None:
        super().__init__(task_in(find_world(world), _stranger_task(StrangersEnv, task)), render_mode)


class StrangersVectorEnv(SceneVectorEnv):
    """Several of ``StrangersEnv``; in a world with several sensors each has an equal share of them."""

    def __init__(
        self,
        num_envs: int = 1,
        render_mode: str | None = None,
        workers: int | None = None,
        autoreset_mode: AutoresetMode | str = AutoresetMode.NEXT_STEP,
        world: str = "towns",
        **task: Any,
    ) -> None:
        tasks = tasks_in(find_world(world), _stranger_task(StrangersVectorEnv, task))
        super().__init__(num_envs, tasks, render_mode, workers, autoreset_mode)


def env_spec(task: TaskSettings) -> EnvSpec:
    """Return gymnasium's specification of the environment with these settings, which can be written as JSON.

    Raises:
        InputError: the scene cannot be described, as in ``tint_sumo.scenes.scene_settings``.
    """
    default = TaskSettings()
    arguments = {field.name: getattr(task, field.name) for field in fields(task)}
    given = {name: plain(value) for name, value in arguments.items() if value != getattr(default, name)}
    if "sensor" in given:
        given["sensor"] = next((name for name, known in SENSORS.items() if known == task.sensor), given["sensor"])
    scene = next((name for name, make in SCENES.items() if make() == task.scene), None)
    given["scene"] = scene or plain(scene_settings(task.scene))
    spec = deepcopy(gymnasium.spec(ENV_IDS.get(scene or "", SCENE_ENV_ID)))
    spec.kwargs = given
    return spec


def _stranger_task(entry_point: type, task: Mapping[str, Any]) -> TaskSettings:
    """Return the settings that the further arguments of an environment among strangers give.

    Raises:
        InputError: there is no argument of some name, or the world has it.
    """
    given = [name for name in (*_OF_THE_WORLD, _NOISE) if name in task]
    if given:
        raise InputError(f"{', '.join(given)}: the world has that; leave it out, or give another `world`")
    return TaskSettings(**{"reward": "careful", **known_arguments(entry_point, task, without=_OF_THE_WORLD)})


def known_arguments(
    entry_point: type, task: Mapping[str, Any], more: Iterable[str] = (), without: Collection[str] = ()
) -> dict[str, Any]:
    """Return the further arguments of an entry point; ``position_noise_m`` makes a sensor.

    Args:
        entry_point: class with named arguments.
        task: the further arguments.
        more: names of those that are none of ``TaskSettings``.
        without: names of ``TaskSettings`` that this entry point does not have.

    Raises:
        InputError: there is no argument of some name, or the noise has no sense.
    """
    arguments = signature(entry_point).parameters.values()
    named = [argument.name for argument in arguments if argument.kind is not argument.VAR_KEYWORD]
    settings = [field.name for field in fields(TaskSettings) if field.name not in without]
    require_fields(task, dict.fromkeys([*named, *settings, *more, _NOISE]))
    if _NOISE not in task:
        return dict(task)
    if "sensor" in task:
        raise InputError(f"{_NOISE} is noise_m of the sensor; leave it out where sensor is given")
    NOISES.require(_NOISE, task[_NOISE])
    others = {name: value for name, value in task.items() if name != _NOISE}
    return {**others, "sensor": Sensor(noise_m=task[_NOISE])}
