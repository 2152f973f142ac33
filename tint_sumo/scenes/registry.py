"""The built-in scenes by their names."""

import hashlib
from collections.abc import Callable
from functools import cache
from typing import overload

from tint_sumo.core.errors import InputError, find_named
from tint_sumo.scenes.scene import Scene
from tint_sumo.scenes.sumocfg import SumocfgScene

T_INTERSECTION = "t_intersection"  # the paper's scene

ALL_SCENES = "all"  # the scene's name for a policy that was trained in every scene at once

SCENES: dict[str, Callable[[], Scene]] = {}

AnyScene = str | Scene | SumocfgScene


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
def find_scene(scene: AnyScene) -> Scene | SumocfgScene: ...
def find_scene(scene: AnyScene) -> Scene | SumocfgScene:
    """Return the scene of a name; a scene itself is returned as it is.

    Raises:
        InputError: there is none.
    """
    return find_named("scene", scene, SCENES)() if isinstance(scene, str) else scene


def require_built_in(work: str, scene: AnyScene, profiles: int | None = None) -> Scene:
    """Return a scene whose roads and traffic this package makes, as some work needs it.

    Args:
        work: beginning of the message, such as ``"a study"``.
        scene: or its name.
        profiles: number of profiles of drivers that the scene shall have; any if not given.

    Raises:
        InputError: the scene's traffic is that of a SUMO configuration, or its drivers are of more or fewer profiles.
    """
    found = find_scene(scene)
    if not isinstance(found, Scene):
        raise InputError(f"{work} needs a built-in scene, or one with other numbers, not a SUMO configuration")
    count = len(found.population.profiles)
    if profiles not in (None, count):
        raise InputError(f"{work} needs drivers of {profiles} profiles, and scene {found.name} has {count}")
    return found


def digest_of(name: str) -> str:
    """Return the digest of a scene, or of all scenes together.

    Raises:
        InputError: there is no such scene.
    """
    if name != ALL_SCENES:
        return find_scene(name).digest
    return hashlib.sha256("".join(make().digest for make in SCENES.values()).encode()).hexdigest()[:16]
