import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from shapely.affinity import rotate, translate
from shapely.geometry import Polygon, box

from tint_sumo.config import Street, VehicleShape
from tint_sumo.scenario.geometry import (
    LOWER,
    POSE,
    UPPER,
    EgoPath,
    box_distance_m,
    centre_x_m,
    locate,
    measure_distances_m,
    path_point,
    place,
    stage_start_m,
    swept_area_start_m,
)

SHAPE = VehicleShape()
PATH = EgoPath.of(Street(), SHAPE)


def car(x_m: float, y_m: float, heading_rad: float) -> Polygon:
    body = box(-SHAPE.length_m / 2, -SHAPE.width_m / 2, SHAPE.length_m / 2, SHAPE.width_m / 2)
    return translate(rotate(body, heading_rad, origin=(0, 0), use_radians=True), x_m, y_m)


def poses(fronts_m: list[float] | np.ndarray) -> np.ndarray:
    found = np.zeros(len(fronts_m), POSE)
    place(np.array(fronts_m), PATH, found)
    return found


@given(st.floats(-6, 6), st.floats(-6, 6), st.floats(0, math.pi))
def test_box_distance_is_that_of_the_polygons(x_m: float, y_m: float, heading_rad: float) -> None:
    found = box_distance_m(x_m, y_m, math.cos(heading_rad), math.sin(heading_rad), SHAPE.length_m, SHAPE.width_m)
    assert found == pytest.approx(car(0.0, 0.0, heading_rad).distance(car(x_m, y_m, 0.0)), abs=1e-9)


@given(st.lists(st.floats(-12, 12), min_size=8, max_size=8), st.floats(17.0, 45.0), st.floats(0.0, 3.0))
def test_distances_within_reach_are_exact(x_m: list[float], front_m: float, reach_m: float) -> None:
    pose, present = poses([front_m]), np.arange(8)[None] != 7
    state = (pose, present, np.array([x_m]), np.array([[2.0, 6.0] * 4]))
    exact, found = np.empty((1, 8)), np.empty((1, 8))
    measure_distances_m(*state, np.inf, SHAPE.length_m, SHAPE.width_m, exact)
    measure_distances_m(*state, reach_m, SHAPE.length_m, SHAPE.width_m, found)
    assert np.isinf(exact).tolist() == [[False] * 7 + [True]]
    assert ((found == exact) | ((exact > reach_m) & np.isinf(found))).all()


def test_lanes_run_in_opposite_directions() -> None:
    assert [centre_x_m(front_m, LOWER, 20.0, 5.0) for front_m in (5.0, 45.0)] == [20.0, -20.0]
    assert [centre_x_m(front_m, UPPER, 20.0, 5.0) for front_m in (5.0, 45.0)] == [-20.0, 20.0]


def test_a_vehicle_whose_lane_position_drops_is_on_the_next_lane() -> None:
    starts_m = stage_start_m(Street(), SHAPE)
    lane, stage = np.array([UPPER, LOWER, LOWER]), np.array([0, 1, 0])
    lane_pos_m, front_m, x_m = np.array([16.0, 3.0, 7.0]), np.zeros(3), np.zeros(3)
    locate(np.array([0, 1]), np.array([0.2, 3.1]), lane, starts_m, 20.0, 5.0, stage, lane_pos_m, front_m, x_m)
    assert stage.tolist() == [1, 1, 0]
    assert lane_pos_m.tolist() == [0.2, 3.1, 7.0]
    assert front_m.tolist() == [starts_m[UPPER, 1] + 0.2, starts_m[LOWER, 1] + 3.1, 0.0]
    assert x_m.tolist() == [front_m[0] - 25.0, 25.0 - front_m[1], 0.0]


def test_the_front_leads_up_the_stem_round_the_turn_and_along_the_upper_lane() -> None:
    pose = poses([PATH.start_m(-5.0), PATH.turn_start_m, PATH.turn_end_m, PATH.turn_end_m + 10.0])
    assert (pose["x_m"][0], pose["y_m"][0]) == (0.0, -5.0)
    assert (pose["front_x_m"][1], pose["front_y_m"][1]) == pytest.approx((0.0, 2.5))
    assert (pose["front_x_m"][2], pose["front_y_m"][2]) == pytest.approx((8.5, 6.0))
    assert (pose["x_m"][3], pose["y_m"][3], pose["heading_x"][3]) == pytest.approx((16.0, 6.0, 1.0))
    assert path_point(PATH.crossing_m(4.0), PATH)[1] == pytest.approx(4.0)


def test_the_centre_keeps_to_the_papers_quarter_circle() -> None:
    pose = poses(np.linspace(PATH.turn_start_m, PATH.turn_end_m, 100))
    on_circle = np.abs(np.hypot(pose["x_m"] - 6.0, pose["y_m"]) - 6.0)
    assert on_circle.max() < 0.3
    assert np.median(on_circle) < 0.05


@given(st.floats(17.0, 45.0))
def test_the_front_moves_by_path_length_and_along_the_tangent(front_m: float) -> None:
    step_m = 1e-4
    (x0, y0, direction_y), (x1, y1, _) = path_point(front_m, PATH), path_point(front_m + step_m, PATH)
    assert math.hypot(x1 - x0, y1 - y0) == pytest.approx(step_m, rel=1e-3)
    if min(abs(front_m - PATH.turn_start_m), abs(front_m - PATH.turn_end_m)) > step_m:  # the turn begins with a bend
        assert (y1 - y0) / step_m == pytest.approx(direction_y, abs=1e-3)


@pytest.mark.parametrize("margin_m", [0.0, 0.8])
@pytest.mark.parametrize("lane", [LOWER, UPPER])
def test_vehicles_short_of_the_swept_area_never_touch_the_ego(lane: int, margin_m: float) -> None:
    """Drive the whole path past a vehicle that stands just short of the area, and past one that stands just in it."""
    fronts_m = np.arange(0.0, 50.0, 0.02)
    poses = np.zeros(len(fronts_m), POSE)
    place(fronts_m, PATH, poses)
    start_m = swept_area_start_m(Street(), SHAPE, margin_m)[lane]

    def nearest_m(front_m: float) -> float:
        x_m = np.full((len(poses), 1), centre_x_m(front_m, lane, Street.half_length_m, SHAPE.length_m))
        y_m = np.full_like(x_m, (Street.lower_y_m, Street.upper_y_m)[lane])
        distance_m = np.zeros_like(x_m)
        present = np.ones(x_m.shape, bool)
        measure_distances_m(poses, present, x_m, y_m, 5.0, SHAPE.length_m, SHAPE.width_m, distance_m)
        return float(distance_m.min())

    assert margin_m < nearest_m(start_m - 0.03) < margin_m + 0.03
    assert nearest_m(start_m + 0.03) <= max(margin_m - 0.01, 0.0)


def test_the_swept_area_follows_the_geometry() -> None:
    wide = Street(turn_radius_m=9.0, upper_y_m=9.0)
    narrow_m, wide_m = (swept_area_start_m(street, SHAPE, 0.0)[UPPER] for street in (Street(), wide))
    assert wide_m > narrow_m + 0.5  # the ego reaches the upper lane further east
