import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from shapely.affinity import rotate, translate
from shapely.geometry import Polygon, box

from tint_sumo.config import Street, VehicleShape
from tint_sumo.scenario.geometry import EgoPath, Pose, box_distance_m, centre_x_m

SHAPE = VehicleShape()
PATH = EgoPath(Street(), SHAPE)


def car(x_m: float, y_m: float, heading_rad: float) -> Polygon:
    body = box(-SHAPE.length_m / 2, -SHAPE.width_m / 2, SHAPE.length_m / 2, SHAPE.width_m / 2)
    return translate(rotate(body, heading_rad, origin=(0, 0), use_radians=True), x_m, y_m)


@given(st.floats(-6, 6), st.floats(-6, 6), st.floats(0, math.pi))
def test_box_distance_is_that_of_the_polygons(x_m: float, y_m: float, heading_rad: float) -> None:
    pose = Pose(*(np.array([v]) for v in (0.0, 0.0, math.cos(heading_rad), math.sin(heading_rad), 0.0, 0.0, 0.0)))
    found = box_distance_m(pose, np.array([[x_m]]), np.array([[y_m]]), SHAPE)[0, 0]
    assert found == pytest.approx(car(0.0, 0.0, heading_rad).distance(car(x_m, y_m, 0.0)), abs=1e-9)


def test_lanes_run_in_opposite_directions() -> None:
    front_m = np.array([5.0, 45.0])
    assert centre_x_m(front_m, np.array([0, 0]), Street(), SHAPE) == pytest.approx([20.0, -20.0])
    assert centre_x_m(front_m, np.array([1, 1]), Street(), SHAPE) == pytest.approx([-20.0, 20.0])


def test_the_front_leads_up_the_stem_round_the_turn_and_along_the_upper_lane() -> None:
    fronts_m = np.array([PATH.start_m(-5.0), PATH.turn_start_m, PATH.turn_end_m, PATH.turn_end_m + 10.0])
    pose = PATH.pose(fronts_m)
    assert (pose.x_m[0], pose.y_m[0]) == (0.0, -5.0)
    assert (pose.front_x_m[1], pose.front_y_m[1]) == pytest.approx((0.0, 2.5))
    assert (pose.front_x_m[2], pose.front_y_m[2]) == pytest.approx((8.5, 6.0))
    assert (pose.x_m[3], pose.y_m[3], pose.heading_x[3]) == pytest.approx((16.0, 6.0, 1.0))
    assert PATH.point(np.array([PATH.crossing_m(4.0)]))[1] == pytest.approx(4.0)


def test_the_centre_keeps_to_the_papers_quarter_circle() -> None:
    pose = PATH.pose(np.linspace(PATH.turn_start_m, PATH.turn_end_m, 100))
    on_circle = np.abs(np.hypot(pose.x_m - 6.0, pose.y_m) - 6.0)
    assert on_circle.max() < 0.3
    assert np.median(on_circle) < 0.05


@given(st.floats(17.0, 45.0))
def test_the_front_moves_by_path_length_and_along_the_tangent(front_m: float) -> None:
    step_m = 1e-4
    (x0, x1), (y0, y1), (direction_y, _) = PATH.point(np.array([front_m, front_m + step_m]))
    assert math.hypot(x1 - x0, y1 - y0) == pytest.approx(step_m, rel=1e-3)
    if min(abs(front_m - PATH.turn_start_m), abs(front_m - PATH.turn_end_m)) > step_m:  # the turn begins with a bend
        assert (y1 - y0) / step_m == pytest.approx(direction_y, abs=1e-3)
