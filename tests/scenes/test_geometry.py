import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from shapely.affinity import rotate, translate
from shapely.geometry import Polygon, box

from tint_sumo.config import VehicleShape
from tint_sumo.scenes.geometry import (
    POSE,
    SPACING_M,
    as_line,
    box_distance_m,
    find_leaders,
    follow,
    measure_distances_m,
    measure_unlike_distances_m,
    place,
    project,
    resample,
    way_point,
)

SHAPE = VehicleShape()
RADIUS_M = 7.0
# East for 10 m, then a quarter circle to the north.
BEND = np.array(
    [(0.0, 0.0), *((10 + RADIUS_M * np.sin(a), RADIUS_M - RADIUS_M * np.cos(a)) for a in np.arange(0, 1.58, 0.01))]
)
WAY = resample(BEND, 25.0)


BICYCLE = VehicleShape(1.6, 0.65)


def car(x_m: float, y_m: float, heading_rad: float, shape: VehicleShape = SHAPE) -> Polygon:
    body = box(-shape.length_m / 2, -shape.width_m / 2, shape.length_m / 2, shape.width_m / 2)
    return translate(rotate(body, heading_rad, origin=(0, 0), use_radians=True), x_m, y_m)


def pose(x_m: float, y_m: float, heading_rad: float) -> tuple[float, float, float, float]:
    return x_m, y_m, math.cos(heading_rad), math.sin(heading_rad)


@given(st.floats(-6, 6), st.floats(-6, 6), st.floats(0, math.pi))
def test_box_distance_is_that_of_the_polygons(x_m: float, y_m: float, heading_rad: float) -> None:
    sizes_m = (SHAPE.length_m, SHAPE.width_m, BICYCLE.length_m, BICYCLE.width_m)
    found = box_distance_m(x_m, y_m, math.cos(heading_rad), math.sin(heading_rad), *sizes_m)
    assert found == pytest.approx(car(0.0, 0.0, heading_rad, BICYCLE).distance(car(x_m, y_m, 0.0)), abs=1e-9)


CARS = st.tuples(st.floats(-12, 12), st.floats(-12, 12), st.floats(0, 2 * math.pi))


@given(CARS, st.lists(CARS, min_size=3, max_size=3), st.floats(0.0, 3.0))
def test_distances_are_those_of_the_polygons_however_the_boxes_stand(
    ego: tuple[float, float, float], others: list[tuple[float, float, float]], reach_m: float
) -> None:
    egos, vehicles = np.array([pose(*ego)], POSE), np.array([[pose(*one) for one in [*others, others[0]]]], POSE)
    present = np.array([[True, True, True, False]])
    exact, found = np.empty((1, 4)), np.empty((1, 4))
    measure_distances_m(egos, present, vehicles, np.inf, SHAPE.length_m, SHAPE.width_m, exact)
    measure_distances_m(egos, present, vehicles, reach_m, SHAPE.length_m, SHAPE.width_m, found)
    expected = [car(*ego).distance(car(*one)) for one in others]
    assert exact[0].tolist() == pytest.approx([*expected, math.inf], abs=1e-9)
    assert ((found == exact) | ((exact > reach_m) & np.isinf(found))).all()


def test_a_way_is_followed_by_arc_length_and_straight_on_beyond_its_ends() -> None:
    assert way_point(WAY, 4.0) == pytest.approx((4.0, 0.0))
    assert way_point(WAY, -3.0) == pytest.approx((-3.0, 0.0))
    quarter_m = RADIUS_M * math.pi / 2
    assert way_point(WAY, 10.0 + quarter_m) == pytest.approx((10.0 + RADIUS_M, RADIUS_M), abs=1e-2)
    x_m, y_m = way_point(WAY, 25.0)
    assert (x_m, y_m) == pytest.approx((10.0 + RADIUS_M, RADIUS_M + 15.0 - quarter_m), abs=0.05)


@given(st.floats(0.0, 24.0))
def test_the_front_moves_by_arc_length(front_m: float) -> None:
    before, after = way_point(WAY, front_m), way_point(WAY, front_m + 0.5)
    assert 0.5 - 1e-2 < math.dist(before, after) <= 0.5 + 1e-9


@given(st.floats(0.0, 20.0))
def test_a_box_has_front_and_back_on_its_way(front_m: float) -> None:
    poses = np.zeros(1, POSE)
    place(np.array([front_m]), WAY, SHAPE.length_m, poses)
    one = poses[0]
    front, back = way_point(WAY, front_m), way_point(WAY, front_m - SHAPE.length_m)
    heading = np.subtract(front, back) / math.dist(front, back)
    assert (one["heading_x"], one["heading_y"]) == pytest.approx(tuple(heading))
    reached = (one["x_m"] + 2.5 * one["heading_x"], one["y_m"] + 2.5 * one["heading_y"])
    assert reached == pytest.approx(front)


@given(st.floats(0.0, 20.0), st.floats(-1.0, 1.0))
def test_projecting_finds_the_place_on_a_way(along_m: float, off_m: float) -> None:
    (x0, y0), (x1, y1) = way_point(WAY, along_m), way_point(WAY, along_m + SPACING_M)
    across = np.array([y0 - y1, x1 - x0]) / math.hypot(x1 - x0, y1 - y0)
    found_m, found_off_m = project(np.array([(x0, y0) + off_m * across]), as_line(WAY))
    assert found_m[0] == pytest.approx(along_m, abs=0.05)
    assert found_off_m[0] == pytest.approx(abs(off_m), abs=5e-3)


def test_a_vehicle_whose_lane_position_drops_is_on_the_next_lane() -> None:
    lane_start_m = np.array([[0.0, 6.0, 12.0], [0.0, 10.0, np.inf]])
    ways = np.stack([WAY, WAY + 100.0])
    route, stage = np.array([0, 1, 1]), np.array([0, 1, 0])
    was_pos_m, front_m, poses = np.array([5.9, 3.0, 7.0]), np.zeros(3), np.zeros(3, POSE)
    moved = (np.array([0, 1]), np.array([0.2, 3.1]))
    follow(*moved, route, lane_start_m, ways, 5.0, stage, was_pos_m, front_m, poses)
    assert stage.tolist() == [1, 1, 0]
    assert was_pos_m.tolist() == [0.2, 3.1, 7.0]
    assert front_m.tolist() == [6.2, 13.1, 0.0]
    assert (poses["x_m"][0], poses["y_m"][0]) == pytest.approx((3.7, 0.0))
    assert poses["x_m"][1] > 100.0
    assert poses["x_m"][2] == 0.0


def test_leaders_are_seen_on_shared_lanes_of_other_routes_and_nowhere_else() -> None:
    """Route 0 has lanes of 10 m and 20 m; route 1 a lane of its own of 6 m, and then route 0's second one."""
    lane_start_m = np.array([[0.0, 10.0], [0.0, 6.0]])
    nan = np.nan
    lane_on_route_m = np.array([[[0.0, 10.0], [nan, 10.0]], [[nan, 6.0], [0.0, 6.0]]])
    present = np.array([[True, True, True, True, False]])
    route, stage = np.array([[0, 1, 1, 0, 0]]), np.array([[0, 1, 0, 1, 1]])
    front_m = np.array([[8.0, 9.0, 5.5, 29.0, 20.0]])  # the second is 3 m along the shared lane, the fourth 19 m
    leader, gap_m = np.zeros((1, 5), np.int64), np.zeros((1, 5))
    find_leaders(present, route, stage, front_m, lane_start_m, lane_on_route_m, 5.0, leader, gap_m)
    assert leader.tolist() == [[1, 3, 1, -1, -1]]
    assert gap_m[0, :3].tolist() == [13.0 - 8.0 - 5.0, 25.0 - 9.0 - 5.0, 9.0 - 5.5 - 5.0]
    assert np.isnan(gap_m[0, 3:]).all()


@given(CARS, CARS, CARS)
def test_boxes_may_be_of_different_sizes(
    ego: tuple[float, float, float], truck: tuple[float, float, float], bicycle: tuple[float, float, float]
) -> None:
    shapes = [VehicleShape(12.0, 2.5), BICYCLE]
    vehicles = np.array([pose(*truck), pose(*bicycle), pose(*ego)], POSE)
    length_m, width_m = (np.array([getattr(one, part) for one in [*shapes, SHAPE]]) for part in ("length_m", "width_m"))
    found = np.empty(3)
    measure_unlike_distances_m(
        np.array([pose(*ego)], POSE)[0],
        np.array([True, True, False]),
        vehicles,
        SHAPE.length_m,
        SHAPE.width_m,
        length_m,
        width_m,
        found,
    )
    wanted = [car(*ego).distance(car(*one, shape)) for one, shape in zip([truck, bicycle], shapes, strict=True)]
    assert found.tolist() == pytest.approx([*wanted, math.inf], abs=1e-9)
