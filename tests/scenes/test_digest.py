"""Changes of a scene that change its digest, and others."""

from collections.abc import Iterator
from copy import deepcopy
from dataclasses import dataclass, fields, is_dataclass, make_dataclass, replace
from typing import Any

import numpy as np
import pytest

from tint_sumo.scenes import ALL_SCENES, SCENES, digest_of, find_scene, find_scenes
from tint_sumo.scenes.scene import Scene

VERSION_1 = {  # what shipped policies and trait models were trained in
    "four_way": "099567169240f69c",
    "four_way_turn": "7b874bd79344f023",
    "on_ramp": "4a5a5916b319ee42",
    "roundabout": "7476dff85342449f",
    "t_intersection": "3a6f90b52dfe6049",
    "t_intersection_right": "ebaaaa813247b35a",
    "t_intersection_street": "04f69dc2278c3444",
    ALL_SCENES: "ac752bac8ce9d393",
}
NOT_COUNTED = {
    "name",
    "title",
    "view",
    "traffic",
    "population",
    "time_limit_s",
    "base",
    "buildings",
    "position_scale_m",  # the roads come with them
    "speed_scale_mps",
}  # fields of a scene


def owners(value: Any) -> Iterator[Any]:
    """Yield all dataclasses that a value is made of, itself included."""
    if isinstance(value, tuple):
        for part in value:
            yield from owners(part)
    elif is_dataclass(value):
        yield value
        for field in fields(value):
            yield from owners(getattr(value, field.name))


def other(value: Any) -> Any:
    """Return a value that differs a little."""
    if isinstance(value, bool):
        return not value
    if isinstance(value, float):
        return float(np.nextafter(value, np.inf))
    if isinstance(value, int):
        return value + 1
    if isinstance(value, str):
        return f"{value}x"
    if isinstance(value, tuple):
        return value[:-1] if value else ((0.0, 0.0),)
    return None


@pytest.mark.parametrize("name", VERSION_1)
def test_built_in_scenes_keep_the_digests_of_what_is_shipped(name: str) -> None:
    assert set(VERSION_1) == {*SCENES, ALL_SCENES}
    assert digest_of(find_scenes(name)) == VERSION_1[name]


@pytest.mark.parametrize("name", SCENES)
def test_every_value_of_the_roads_and_of_the_task_counts(name: str) -> None:
    """A new field fails here until it is decided whether it counts, in ``tint_sumo.scenes.digest`` or above."""
    scene = deepcopy(find_scene(name))
    counted = [(scene, field.name) for field in fields(scene) if field.name not in NOT_COUNTED]
    counted += [
        (owner, field.name) for _, part in counted for owner in owners(getattr(scene, part)) for field in fields(owner)
    ]
    digests = {scene.digest}
    for owner, field in counted:
        value = getattr(owner, field)
        object.__setattr__(owner, field, other(value))
        digests.add(scene.digest)
        object.__setattr__(owner, field, value)
    assert scene.digest == VERSION_1[name]
    assert len(digests) == 1 + len(counted) > 70


@pytest.mark.parametrize("field", sorted(NOT_COUNTED))
def test_names_drivers_buildings_and_the_time_limit_do_not_count(field: str) -> None:
    scene = deepcopy(find_scene("t_intersection"))
    object.__setattr__(scene, field, other(getattr(scene, field)))
    assert scene.digest == VERSION_1["t_intersection"]


def test_a_new_field_with_a_default_does_not_count() -> None:
    scene = deepcopy(find_scene("t_intersection"))
    counted = (scene.network, scene.routes, scene.ego, scene.vehicle, scene.claim)
    parts = [owner for part in counted for owner in owners(part)]
    for owner in (scene, *parts):
        kind = type(owner)
        grown = make_dataclass(kind.__name__, [("weather", str, "dry")], bases=(kind,), frozen=True)
        object.__setattr__(owner, "__class__", grown)
    assert repr(scene).count("weather='dry'") > 20
    assert scene.digest == VERSION_1["t_intersection"]


def test_whole_numbers_and_those_of_numpy_are_numbers_like_others() -> None:
    scene = find_scene("four_way")
    edges = tuple(replace(edge, priority=np.int64(edge.priority)) for edge in scene.network.edges)
    same = replace(
        scene,
        network=replace(scene.network, edges=edges, lane_width_m=4),
        ego=replace(scene.ego, goal_m=34, start_m=np.float64(scene.ego.start_m)),
        max_vehicles=np.int64(scene.max_vehicles),
    )
    assert same.digest == scene.digest


def test_scenes_of_a_class_derived_from_scene_have_digests() -> None:
    @dataclass(frozen=True)
    class Rainy(Scene):
        grip: float = 0.5

    scene = find_scene("on_ramp")
    rainy = Rainy(**{field.name: getattr(scene, field.name) for field in fields(scene)})
    assert rainy.digest == scene.digest
