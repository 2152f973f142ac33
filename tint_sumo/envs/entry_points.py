"""Entry points of gymnasium, which give the fields of ``TaskSettings`` as keyword arguments.

``gymnasium.make`` and ``make_vec`` know keyword arguments alone, and look for what they can render in an attribute of
the entry point. So these are classes, and here alone keyword arguments become settings; everything below takes
``TaskSettings``, whose fields are the only list of what can be set.
"""

from collections.abc import Mapping
from dataclasses import fields
from inspect import signature
from typing import Any

from gymnasium.vector import AutoresetMode

from tint_sumo.core.structures import require_fields
from tint_sumo.envs.episodes import TaskSettings
from tint_sumo.envs.scene_env import SceneEnv
from tint_sumo.envs.vector import SceneVectorEnv


class GymnasiumEnv(SceneEnv):
    """``SceneEnv`` as ``gymnasium.make`` makes it."""

    def __init__(self, render_mode: str | None = None, **task: Any) -> None:
        _require_known(GymnasiumEnv, task)
        super().__init__(TaskSettings(**task), render_mode)


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
        _require_known(GymnasiumVectorEnv, task)
        scenes = task.get("scene")
        if isinstance(scenes, list | tuple):
            each = [TaskSettings(**{**task, "scene": scene}) for scene in scenes]
            super().__init__(num_envs, each, render_mode, workers, autoreset_mode)
        else:
            super().__init__(num_envs, TaskSettings(**task), render_mode, workers, autoreset_mode)


def _require_known(entry_point: type, task: Mapping[str, Any]) -> None:
    """Raise InputError if neither an entry point nor ``TaskSettings`` has an argument of this name."""
    arguments = signature(entry_point).parameters.values()
    named = [argument.name for argument in arguments if argument.kind is not argument.VAR_KEYWORD]
    require_fields(task, dict.fromkeys([*named, *(field.name for field in fields(TaskSettings))]))
