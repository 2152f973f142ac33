import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from shapely.affinity import rotate, translate
from shapely.geometry import Polygon, box

from tint_sumo.config import VehicleShape
from tint_sumo.scenes.geometry import (
    BOX,
    NO_VEHICLE,
    SPACING_M,
    as_line,
    box_distance_m,
    find_leaders,
    follow,
    measure_distances_m,
    new_boxes,
    place,
    project,
    resample,
    sweep,
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


def placed(x_m: float, y_m: float, heading_rad: float, shape: VehicleShape = SHAPE) -> tuple[float, ...]:
    """Return a record of ``BOX``."""
    return x_m, y_m, math.cos(heading_rad), math.sin(heading_rad), shape.length_m, shape.width_m


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
    """Vehicles are of different sizes; the last slot is empty."""
    shapes = [SHAPE, BICYCLE, VehicleShape(12.0, 2.5)]
    egos = np.array([placed(*ego)], BOX)
    vehicles = np.array(
        [[*(placed(*one, shape) for one, shape in zip(others, shapes, strict=True)), placed(*ego)]], BOX
    )
    present = np.array([[True, True, True, False]])
    exact, found = np.empty((1, 4)), np.empty((1, 4))
    measure_distances_m(egos, present, vehicles, np.inf, exact)
    measure_distances_m(egos, present, vehicles, reach_m, found)
    expected = [car(*ego).distance(car(*one, shape)) for one, shape in zip(others, shapes, strict=True)]
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
    boxes = new_boxes(1, SHAPE.length_m, SHAPE.width_m)
    place(np.array([front_m]), WAY, boxes)
    one = boxes[0]
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
    was_pos_m, front_m, boxes = np.array([5.9, 3.0, 7.0]), np.zeros(3), new_boxes(3, 5.0, 2.0)
    moved = (np.array([0, 1]), np.array([0.2, 3.1]))
    follow(*moved, route, lane_start_m, ways, stage, was_pos_m, front_m, boxes)
    assert stage.tolist() == [1, 1, 0]
    assert was_pos_m.tolist() == [0.2, 3.1, 7.0]
    assert front_m.tolist() == [6.2, 13.1, 0.0]
    assert (boxes["x_m"][0], boxes["y_m"][0]) == pytest.approx((3.7, 0.0))
    assert boxes["x_m"][1] > 100.0
    assert boxes["x_m"][2] == 0.0


def test_leaders_are_seen_on_shared_lanes_of_other_routes_and_nowhere_else() -> None:
    """Route 0 has lanes of 10 m and 20 m; route 1 a separate lane of 6 m, and then route 0's second one."""
    lane_start_m = np.array([[0.0, 10.0], [0.0, 6.0]])
    nan = np.nan
    lane_on_route_m = np.array([[[0.0, 10.0], [nan, 10.0]], [[nan, 6.0], [0.0, 6.0]]])
    present = np.array([[True, True, True, True, False]])
    route, stage = np.array([[0, 1, 1, 0, 0]]), np.array([[0, 1, 0, 1, 1]])
    front_m = np.array([[8.0, 9.0, 5.5, 29.0, 20.0]])  # the second is 3 m along the shared lane, the fourth 19 m
    boxes = new_boxes(5, 5.0, 2.0)[None]
    boxes["length_m"][0, 3] = 7.0
    leader, gap_m = np.zeros((1, 5), np.int64), np.zeros((1, 5))
    find_leaders(present, route, stage, front_m, boxes, lane_start_m, lane_on_route_m, leader, gap_m)
    assert leader.tolist() == [[1, 3, 1, NO_VEHICLE, NO_VEHICLE]]
    assert gap_m[0, :3].tolist() == [13.0 - 8.0 - 5.0, 25.0 - 9.0 - 7.0, 9.0 - 5.5 - 5.0]
    assert np.isinf(gap_m[0, 3:]).all()


def test_boxes_turn_on_their_way_between_two_steps() -> None:
    """A car that drives away around a bend, close ahead of an ego that stands, does not touch it."""
    ego, before, after = new_boxes(1, 5.0, 2.0), new_boxes(1, 5.0, 2.0), new_boxes(1, 5.0, 2.0)
    ego[0] = (0.0, 0.0, 1.0, 0.0, 5.0, 2.0)
    before[0] = (5.05, 0.0, 1.0, 0.0, 5.0, 2.0)
    turned_rad = math.radians(20.0)
    after[0] = (11.0, 1.0, math.cos(turned_rad), math.sin(turned_rad), 5.0, 2.0)
    hit = np.full(1, NO_VEHICLE)
    same = np.ones((1, 1), bool)
    assert not sweep(ego, ego, same, before[None], after[None], 10, hit)
    across = np.array([(0.0, 8.0, 0.0, 1.0, 5.0, 2.0)], BOX)
    come_from = np.array([(0.0, -8.0, 0.0, 1.0, 5.0, 2.0)], BOX)
    assert sweep(ego, ego, same, come_from[None], across[None], 10, hit)
    assert hit[0] == 0
