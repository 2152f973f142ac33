"""Scenes in files."""

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import pytest

from tests.scenes.networks import UserNetwork
from tint_sumo.config import AGGRESSIVE, CONSERVATIVE, DRIVER_PROFILES, POPULATIONS, Population, Willingness
from tint_sumo.core.errors import InputError
from tint_sumo.core.structures import plain
from tint_sumo.scenes import (
    ALL_SCENES,
    SCENES,
    Scene,
    described,
    find_scene,
    find_scenes,
    read_described,
    read_scene,
    scene_settings,
)
from tint_sumo.scenes.buildings import corner_buildings
from tint_sumo.scenes.drivers import read_population

SHY = {
    "name": "shy",
    "desired_speed_mps": [1, 1.5],
    "min_gap_m": [2, 3],
    "entry_gap_m": [6, 8],
    "yields": True,
    "colour": "0,0,0",
}


def changed(**settings: Any) -> Scene:
    scene = read_scene({"base": "four_way", **settings})
    assert isinstance(scene, Scene)
    return scene


@pytest.mark.parametrize("name", SCENES)
def test_a_scene_with_unchanged_numbers_is_the_built_in_one(name: str) -> None:
    scene = find_scene(name)
    assert read_scene({"base": name}) == read_scene(name) == scene
    assert read_scene(plain(scene_settings(scene))) == scene
    assert read_described(described([scene])) == (scene,)


def test_what_is_not_said_is_as_in_the_base() -> None:
    scene, base = changed(time_limit_s=20, controller={"gain_per_s": 1}), find_scene("four_way")
    assert scene.time_limit_s == 20.0
    assert scene.ego == replace(base.ego, controller=replace(base.ego.controller, gain_per_s=1.0))
    assert replace(scene, name=base.name, base="", ego=base.ego, time_limit_s=base.time_limit_s) == base


def test_a_changed_scene_has_another_name() -> None:
    assert changed(time_limit_s=20, name="short").name == "short"
    names = {changed(time_limit_s=limit_s).name for limit_s in (20, 30)}
    assert len(names) == 2
    assert all(name.startswith("four_way-") for name in names)
    assert changed(time_limit_s=20).name in names


@pytest.mark.parametrize(
    ("settings", "differs"),
    [
        ({"claim": {"braking_mps2": 3}}, True),
        ({"step_s": 0.2}, True),
        ({"goal_m": 30}, True),
        ({"max_vehicles": 5}, True),
        ({"population": [SHY]}, False),  # drivers and their mix do not count
        ({"arrivals_per_s": 0.1}, False),
    ],
)
def test_the_digest_differs_with_roads_and_tasks(settings: dict[str, Any], differs: bool) -> None:
    assert (changed(**settings).digest != find_scene("four_way").digest) == differs


def test_a_card_contains_all_settings_of_a_changed_scene() -> None:
    scene = changed(arrivals_per_s=0.2, population=[SHY, {**SHY, "name": "bold", "yields": False}], step_s=0.05)
    card = described([scene])
    assert (card["scene"], card["scene_digest"]) == (scene.name, scene.digest)
    assert read_described(card) == (scene,)
    assert set(described([find_scene("four_way")])) == {"scene", "scene_digest"}
    assert read_described(described(find_scenes(ALL_SCENES))) == find_scenes(ALL_SCENES)


def test_buildings_change_neither_the_digest_nor_the_names_of_scenes_without_them() -> None:
    shed = [[8, -8], [12, -8], [12, -12]]
    corners, shacks = changed(buildings=2), changed(buildings=[shed, shed])
    assert [len(scene.buildings) for scene in (corners, shacks)] == [4, 2]
    assert corners.digest == shacks.digest == find_scene("four_way").digest
    assert corners.buildings == corner_buildings(find_scene("four_way"), 2.0)
    assert len({corners.name, shacks.name, changed(buildings=3).name}) == 3
    assert changed(time_limit_s=20).name == "four_way-50c424"  # as in cards of earlier versions
    for scene in (corners, shacks):
        assert read_described(described([scene])) == (scene,)


@pytest.mark.parametrize(
    "buildings", [[[[0, 0], [1, 0]]], [[[0, 0], [1, 1], [1, 0], [0, 1]]], [[0, 0], [1, 0], [1, 1]], -1, "corners"]
)
def test_buildings_without_sense_are_refused(buildings: Any) -> None:
    with pytest.raises(InputError, match="buildings"):
        changed(buildings=buildings)


def test_a_sumo_configuration(user_network: Callable[[str], UserNetwork]) -> None:
    merge = user_network("merge")
    task = {"ego_route": list(merge.ego_route), "start_m": 20, "goal_m": 130, "warm_up_s": 20}
    scene = read_scene({"sumocfg": str(merge.sumocfg), **task})
    assert scene == merge.scene(controller=None)
    assert read_described(described([scene])) == (scene,)
    assert "perceives" not in described([scene])["scene_settings"], "cards are as before where nothing is perceived"
    watchful = read_scene({"sumocfg": str(merge.sumocfg), **task, "perceives": "lane", "red_light": "end"})
    assert watchful == replace(scene, perceives=("lane",), red_light="end")
    assert read_described(described([watchful])) == (watchful,)
    driven = replace(scene, ego_control="sumo")
    assert read_described(described([driven])) == (driven,)
    with pytest.raises(InputError, match=r"scene: the ego's start \(20 m\) and goal \(900 m\) must lie on its route"):
        read_scene({"sumocfg": str(merge.sumocfg), **task, "goal_m": 900}, ("scene",))


def test_populations() -> None:
    assert read_population("continuous") == POPULATIONS["continuous"]
    assert read_population({"base": "continuous", "members": 8}) == replace(POPULATIONS["continuous"], members=8)
    assert read_population({"idm": {"tau_s": 2}}).profiles == DRIVER_PROFILES
    assert [profile.name for profile in read_population([SHY]).profiles] == ["shy"]
    assert read_population(plain(POPULATIONS["traits"])) == POPULATIONS["traits"]
    assert read_population(plain(POPULATIONS["gentle"])) == POPULATIONS["gentle"]
    states = {"probability": 0.5, "braking_mps2": [1, 4]}
    assert read_population({"willingness": states}).willingness == Willingness(0.5, braking_mps2=(1.0, 4.0))


def test_populations_without_newer_settings_give_scenes_the_names_of_earlier_versions() -> None:
    assert changed(population="towns").name == "four_way-2f3616"
    others: list[Any] = [{"base": "towns", "towns": {"episodes": 2}}, "willing", "gentle"]
    assert len({changed(population=population).name for population in ("towns", *others)}) == 4


@pytest.mark.parametrize(
    ("wrong", "message"),
    [
        ({"name": "two words"}, "name must be of letters"),
        (
            {"desired_speed_mps": [2, 1]},
            "desired_speed_mps must be two numbers from low to high, not 2 and 1",
        ),
        ({"desired_speed_mps": [0, 1]}, r"desired_speed_mps\[0\]: must lie in 0.01 to 60"),
        ({"min_gap_m": [-1, 1]}, r"min_gap_m\[0\]: must lie in 0 to 1000"),
        (
            {"entry_gap_m": 3},
            r"entry_gap_m: must be a list of 2, each item a number from 0 to 1000, not 3",
        ),
        ({"colour": "blue"}, 'colour must be "red,green,blue", each 0 to 255'),
        ({"colour": "1,2,300"}, "each 0 to 255"),
        ({"weight": 0}, "weight: must lie in 0.001 to 1000"),
        ({"yields": "maybe"}, r"population\[0\].yields: must be true or false, not 'maybe'"),
        ({"speed": 3}, r"population\[0\].speed: there is no such setting"),
    ],
)
def test_wrong_profiles(wrong: dict[str, Any], message: str) -> None:
    with pytest.raises(InputError, match=message):
        read_population([{**SHY, **wrong}], ("population",))


def test_wrong_populations() -> None:
    for profiles, message in (((), "profiles must be 1 to 32,767, not 0"), ((CONSERVATIVE,) * 2, "names of their own")):
        with pytest.raises(InputError, match=message):
            Population(profiles)
    with pytest.raises(InputError, match="population: profiles must have names of their own, not shy, shy"):
        read_population([SHY, SHY], ("population",))
    assert Population((AGGRESSIVE,)).profiles == (AGGRESSIVE,)
