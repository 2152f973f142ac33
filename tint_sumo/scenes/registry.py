"""The built-in scenes by their names."""

import hashlib
import math
from collections.abc import Callable, Sequence
from functools import cache
from typing import overload

from tint_sumo.config import STEP_S
from tint_sumo.core.errors import InputError, find_named, shown
from tint_sumo.scenes.scene import Scene
from tint_sumo.scenes.sumocfg import SumocfgScene

T_INTERSECTION = "t_intersection"  # the paper's scene

ALL_SCENES = "all"  # the scene's name for a policy that was trained in all scenes of the paper's scale at once
# Their vehicles, desired speeds and units of observations are alike. Policies carry the digest of them all.
_ALL = ("four_way", "four_way_turn", "on_ramp", "roundabout", T_INTERSECTION, "t_intersection_right")

SCENES: dict[str, Callable[[], Scene]] = {}

AnyScene = Scene | SumocfgScene


def register(make: Callable[[], Scene]) -> Callable[[], Scene]:
    """Register a scene under the name of the function that makes it, which is called once.

    Raises:
        ValueError: the name is taken.
    """
    if make.__name__ in SCENES:
        raise ValueError(f"two scenes are called {make.__name__!r}")
    SCENES[make.__name__] = cache(make)
    return make


@overload
def find_scene(scene: str | Scene) -> Scene: ...
@overload
def find_scene(scene: str | AnyScene) -> AnyScene: ...
def find_scene(scene: str | AnyScene) -> AnyScene:
    """Return the scene of a name; a scene itself is returned as it is. Commands and users' calls do so once.

    Raises:
        InputError: there is none, or it is no scene.
    """
    if isinstance(scene, str):
        return find_named("scene", scene, SCENES)()
    if isinstance(scene, list | tuple):
        raise InputError(
            "give one scene; a list of scenes is for gymnasium.make_vec without a vectorization_mode, "
            "of tint_sumo/Scene-v0"
        )
    if not isinstance(scene, AnyScene):
        raise InputError(f"scene must be a name ({', '.join(SCENES)}) or a scene, not {shown(scene)}")
    return scene


def find_scenes(scene: str | AnyScene) -> tuple[AnyScene, ...]:
    """Return the scenes of ``ALL_SCENES``, or the one that ``find_scene`` finds."""
    return tuple(SCENES[name]() for name in _ALL) if scene == ALL_SCENES else (find_scene(scene),)


def paper_scene() -> Scene:
    """Return the T-intersection of the paper."""
    return find_scene(T_INTERSECTION)


def require_built_in(work: str, scene: AnyScene) -> Scene:
    """Return a scene whose roads and traffic this package makes, as some work needs it.

    Args:
        work: beginning of the message, such as ``"a study"``.
        scene: the scene.

    Raises:
        InputError: the scene's traffic is that of a SUMO configuration.
    """
    if not isinstance(scene, Scene):
        raise InputError(f"{work} needs a built-in scene, or one with other numbers, not a SUMO configuration")
    return scene


def require_trait_steps(scene: AnyScene) -> None:
    """Raise InputError unless a scene has the steps in which traits, and the speeds beside them, are inferred."""
    if not math.isclose(scene.step_s, STEP_S):
        raise InputError(
            f"scene {scene.name} has steps of {scene.step_s:g} s, and traits are inferred in steps of {STEP_S:g} s; "
            f"set its step_s, or the step-length of its .sumocfg, to {STEP_S:g}"
        )


def digest_of(scenes: Sequence[AnyScene]) -> str:
    """Return the digest of a scene, or of several together."""
    if len(scenes) == 1:
        return scenes[0].digest
    return hashlib.sha256("".join(scene.digest for scene in scenes).encode()).hexdigest()[:16]
