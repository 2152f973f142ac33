"""Paths and conflict zones of scenes."""

from dataclasses import replace
from itertools import pairwise
from typing import Any

import numpy as np
import pytest
import shapely

from tint_sumo import ENV_IDS
from tint_sumo.core.errors import InputError
from tint_sumo.scenes import SCENES, T_INTERSECTION, EgoTask, Route, find_scene
from tint_sumo.scenes.geometry import SPACING_M, Boxes, measure_distances_m, new_boxes, place
from tint_sumo.scenes.layout import Layout, layout
from tint_sumo.scenes.registry import register

T = find_scene(T_INTERSECTION)
LOWER, UPPER = 0, 1
scenes = pytest.mark.parametrize("name", SCENES)


def boxes(way: np.ndarray, fronts_m: np.ndarray) -> Boxes:
    found = new_boxes(len(fronts_m), T.vehicle.length_m, T.vehicle.width_m)
    place(fronts_m, way, found)
    return found


def test_every_scene_has_its_name_and_an_environment() -> None:
    assert {name: find_scene(name).name for name in SCENES} == {name: name for name in SCENES}
    assert ENV_IDS.keys() == SCENES.keys()
    assert len({find_scene(name).digest for name in SCENES}) == len(SCENES)


def test_no_two_scenes_have_one_name() -> None:
    with pytest.raises(ValueError, match="two scenes are called 't_intersection'"):
        register(SCENES[T_INTERSECTION])
    with pytest.raises(InputError, match="unknown scene 'moon'; choose one of: "):
        find_scene("moon")


@pytest.mark.parametrize(
    ("given", "message"),
    [
        (None, r"scene must be a name \(.*four_way.*\) or a scene, not None"),
        (3, "or a scene, not 3"),
        (["on_ramp", "four_way"], "give one scene; a list of scenes is for gymnasium.make_vec without a vectorizatio"),
    ],
)
def test_what_is_no_scene_is_refused(given: Any, message: str) -> None:
    with pytest.raises(InputError, match=message):
        find_scene(given)


@scenes
def test_lanes_join_up_into_smooth_ways(name: str) -> None:
    found = layout(find_scene(name))
    for path in (*found.routes, found.ego):
        assert len(set(path.lanes)) == len(path.lanes)
        assert all(before < after for before, after in pairwise(path.lane_start_m))
        inner = path.way[: int(path.length_m / SPACING_M)]
        step = np.diff(inner, axis=0)
        assert np.hypot(*step.T) == pytest.approx(SPACING_M, abs=2e-3)  # no gap between lanes
        length_m = shapely.length(shapely.LineString(inner))
        assert length_m == pytest.approx(path.length_m, abs=0.1)


@scenes
def test_the_ego_starts_beside_the_traffic_and_meets_every_route_before_its_goal(name: str) -> None:
    scene, zones = find_scene(name), layout(find_scene(name)).zones
    assert (scene.ego.start_m < zones.enter_m).all()
    assert (zones.enter_m < zones.inside_m).all()
    assert (zones.inside_m < zones.passed_m).all()
    assert (zones.inside_m < scene.ego.goal_m).all()


def nearest_m(found: Layout, route: int, front_m: float) -> float:
    """Return how close the ego comes on its way to a vehicle that stands with its front there."""
    scene = found.scene
    egos = boxes(found.ego.way, np.arange(scene.ego.start_m, scene.ego.goal_m + 5.0, 0.02))
    standing = np.repeat(boxes(found.routes[route].way, np.array([front_m]))[None], len(egos), axis=0)
    distance_m = np.zeros((len(egos), 1))
    measure_distances_m(egos, np.ones((len(egos), 1), bool), standing, np.inf, distance_m)
    return float(distance_m.min())


@scenes
def test_vehicles_short_of_their_stop_line_never_hold_the_ego(name: str) -> None:
    found = layout(find_scene(name))
    unsafe_m = found.scene.ego.controller.unsafe_distance_m
    for route, stop_m in enumerate(found.zones.stop_line_m.tolist()):
        assert unsafe_m < nearest_m(found, route, stop_m - 0.03) < unsafe_m + 0.35
        assert nearest_m(found, route, stop_m + 0.5) < unsafe_m


def test_zones_of_the_t_intersection() -> None:
    """The ego drives up x = 0 from y = -20 with its front, and turns right after y = 2.5."""
    zones = layout(T).zones
    assert zones.enter_m[LOWER] == pytest.approx(20.0)  # y = 0
    assert zones.inside_m[LOWER] == pytest.approx(21.0)
    assert np.isinf(zones.passed_m[UPPER])  # it stays there
    front = boxes(layout(T).ego.way, np.array([zones.enter_m[UPPER], zones.inside_m[UPPER], zones.passed_m[LOWER]]))
    front_y_m = front["y_m"] + 2.5 * front["heading_y"]
    assert front_y_m[:2].tolist() == pytest.approx([4.0, 5.0], abs=1e-3)
    assert front["y_m"][2] == pytest.approx(4.0, abs=1e-3)  # of the centre
    assert zones.towards[LOWER, round(20.5 / SPACING_M)] == pytest.approx(1.0)


def test_the_right_hand_t_intersection_is_the_mirror_image() -> None:
    left, right = layout(T), layout(find_scene("t_intersection_right"))
    for path, mirrored in zip((*left.routes, left.ego), (*right.routes, right.ego), strict=True):
        np.testing.assert_allclose(mirrored.way * [-1.0, 1.0], path.way, atol=1e-6)
    for key in ("enter_m", "inside_m", "passed_m", "stop_line_m"):
        np.testing.assert_allclose(getattr(right.zones, key), getattr(left.zones, key), atol=1e-6)


def test_an_ego_that_merges_obliquely_claims_with_its_box_before_its_front() -> None:
    scene = find_scene("on_ramp")
    by_front = replace(scene, claim=replace(scene.claim, by="front"))
    assert layout(scene).zones.enter_m[0] < layout(by_front).zones.enter_m[0] - 1.0


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"routes": (Route("lower", ("lower_in", "moon")),)}, "route 'lower': the network has no edge 'moon.0'"),
        ({"routes": (Route("lower", ("lower_in", "upper_out")),)}, "no way leads from edge 'lower_in.0'"),
        ({"ego": EgoTask(("stem", "mid", "upper_out"), 17.5, 90.0)}, r"goal \(90 m\) lies beyond its route"),
        ({"ego": EgoTask(("upper_in", "upper_out"), 5.0, 30.0)}, "the ego's start lies on route 'upper'"),
    ],
)
def test_scenes_that_do_not_fit_their_network_are_refused(changes: dict[str, object], message: str) -> None:
    with pytest.raises(InputError, match=message):
        layout(replace(T, **changes))  # type: ignore[arg-type]


def test_a_goal_before_the_start_is_refused() -> None:
    with pytest.raises(InputError, match=r"goal \(10 m\) must lie beyond its start \(17.5 m\)"):
        replace(T, ego=EgoTask(T.ego.edges, 17.5, 10.0))


def test_a_route_with_a_lane_that_vehicles_could_pass_within_a_step_is_refused() -> None:
    with pytest.raises(InputError, match=r"route 'lower' has a lane of 12\.00 m; make it 15 m or longer"):
        layout(replace(T, network=replace(T.network, speed_limit_mps=150.0)))
