"""Lines of sight in streets that are made by hand."""

import math

import numpy as np
import pytest
import shapely

from tint_sumo.config import Sensor
from tint_sumo.scenes.geometry import BOX
from tint_sumo.scenes.sight import Sight, find_seen, walls_of

NORTH, EAST, WEST = (0.0, 1.0), (1.0, 0.0), (-1.0, 0.0)
OCCLUSION = Sensor(occlusion=True)


def box(x_m: float, y_m: float, heading: tuple[float, float] = EAST, size_m: tuple[float, float] = (5.0, 2.0)) -> tuple:
    return (x_m, y_m, *heading, *size_m)


def seen(
    sensor: Sensor, ego: tuple, *vehicles: tuple, buildings: tuple = (), present: list[bool] | None = None
) -> list:
    found = np.zeros((1, len(vehicles)), bool)
    there = np.array([present or [True] * len(vehicles)])
    street = np.array(list(vehicles), BOX)[None]
    find_seen(np.array([ego], BOX), there, street, walls_of(buildings), Sight.of(sensor), found)
    return found[0].tolist()


def test_a_perfect_sensor_sees_all_vehicles_and_no_empty_slots() -> None:
    street = [box(x_m, 2.0, WEST) for x_m in (3.0, 10.0, 500.0)]
    assert seen(Sensor(), box(0.0, -5.0, NORTH), *street, present=[True, True, False]) == [True, True, False]


@pytest.mark.parametrize("heading", [NORTH, EAST, WEST, (0.6, -0.8)])
def test_the_range_ends_at_a_distance_from_centre_to_centre(heading: tuple[float, float]) -> None:
    sensor, ego = Sensor(range_m=15.0), box(1.0, 1.0, heading)
    assert seen(sensor, ego, box(10.0, 13.0), box(10.001, 13.0), box(-14.0, 1.0), box(-14.001, 1.0)) == [
        True,
        False,
        True,
        False,
    ]


@pytest.mark.parametrize(("degrees", "heading"), [(90.0, NORTH), (90.0, (0.6, 0.8)), (200.0, NORTH), (200.0, WEST)])
def test_the_field_of_view_is_centred_on_the_heading(degrees: float, heading: tuple[float, float]) -> None:
    facing = math.atan2(heading[1], heading[0])
    for side in (-1.0, 1.0):
        inside, outside = (facing + side * math.radians(degrees / 2 + more) for more in (-0.1, 0.1))
        around = [box(2.0 + 9.0 * math.cos(angle), 3.0 + 9.0 * math.sin(angle)) for angle in (inside, outside)]
        assert seen(Sensor(field_of_view_deg=degrees), box(2.0, 3.0, heading), *around) == [True, False]
        assert seen(Sensor(), box(2.0, 3.0, heading), *around) == [True, True]


def test_all_directions_are_in_a_field_of_view_of_360_degrees() -> None:
    rng = np.random.default_rng(0)
    for angle in rng.uniform(-math.pi, math.pi, 50):
        heading = (math.cos(angle), math.sin(angle))
        behind = box(-7.0 * heading[0], -7.0 * heading[1])
        assert seen(Sensor(field_of_view_deg=360.0), box(0.0, 0.0, heading), behind) == [True]


def test_a_truck_hides_the_car_behind_it_but_no_truck_hides_itself() -> None:
    ego, truck = box(0.0, -5.0, NORTH), box(0.0, 2.0, WEST, (12.0, 2.5))
    car, beside = box(0.0, 6.0), box(14.0, 6.0)
    assert seen(OCCLUSION, ego, truck, car, beside) == [True, False, True]
    assert seen(OCCLUSION, ego, truck, car, beside, present=[False, True, True]) == [False, True, True]
    assert seen(Sensor(), ego, truck, car, beside) == [True, True, True]


def test_a_car_is_seen_as_soon_as_one_of_its_corners_is() -> None:
    """The truck's right end at (6, 3.25) hides what lies left of the line through it: x = 6 * 12 / 8.25 at y = 7."""
    ego, truck, limit_m = box(0.0, -5.0, NORTH), box(0.0, 2.0, WEST, (12.0, 2.5)), 6.0 * 10.0 / 5.75
    for off_m, visible in ((-0.01, False), (0.01, True)):
        car = box(limit_m - 2.5 + off_m, 6.0)  # its corner at the lower right is the first to be seen
        assert seen(OCCLUSION, ego, truck, car) == [True, visible]


def test_vehicles_out_of_range_or_out_of_view_hide_others_all_the_same() -> None:
    ego, bus, car = box(0.0, 0.0, NORTH), box(0.0, 4.0, EAST, (20.0, 3.0)), box(0.0, 9.0)
    assert seen(Sensor(occlusion=True, range_m=20.0), ego, bus, car) == [True, False]
    narrow = Sensor(occlusion=True, field_of_view_deg=20.0)
    bus = box(9.0, 4.0, EAST, (20.0, 3.0))  # its centre is at the side
    assert seen(narrow, ego, bus, car) == [False, False]


def test_a_corner_building_hides_the_lane_until_the_ego_has_crept_to_where_it_sees_past_it() -> None:
    """The car's lower front corner is at (7.5, 1), the building's corner at (3.5, -1.5): they are in line with y."""
    building, car = ((3.5, -1.5), (20.0, -1.5), (20.0, -15.0), (3.5, -15.0)), box(10.0, 2.0, WEST)
    upper_y_m = 3.0 + (3.0 - -1.5) / (7.5 - 3.5) * -7.5  # of the line from the upper front corner
    for off_m, visible in ((-0.01, False), (0.01, True)):
        assert seen(OCCLUSION, box(0.0, upper_y_m + off_m, NORTH), car, buildings=(building,)) == [visible]
    assert seen(Sensor(), box(0.0, -10.0, NORTH), car, buildings=(building,)) == [True]


def test_walls_beyond_a_vehicle_and_behind_the_ego_hide_nothing() -> None:
    behind = ((-9.0, -9.0), (9.0, -9.0), (9.0, -12.0), (-9.0, -12.0))
    beyond = ((-9.0, 9.0), (9.0, 9.0), (9.0, 12.0), (-9.0, 12.0))
    assert seen(OCCLUSION, box(0.0, -5.0, NORTH), box(0.0, 6.0), buildings=(behind, beyond)) == [True]


def test_egos_look_for_themselves_alone() -> None:
    egos = np.array([box(0.0, -5.0, NORTH), box(0.0, 12.0, (0.0, -1.0))], BOX)
    street = np.array([box(0.0, 2.0, WEST, (12.0, 2.5)), box(0.0, 6.0)], BOX)
    found = np.zeros((2, 2), bool)
    find_seen(egos, np.ones((2, 2), bool), np.stack([street, street]), walls_of(()), Sight.of(OCCLUSION), found)
    assert found.tolist() == [[True, False], [True, True]]


def test_walls_are_the_sides_of_polygons() -> None:
    triangle = ((0.0, 0.0), (2.0, 0.0), (0.0, 1.0))
    sides = [[0.0, 0.0, 2.0, 0.0], [2.0, 0.0, 0.0, 1.0], [0.0, 1.0, 0.0, 0.0]]
    assert walls_of((triangle,)).tolist() == sides
    assert walls_of((triangle, triangle)).tolist() == sides + sides
    assert walls_of(()).shape == (0, 4)


def test_random_streets_are_seen_as_shapely_has_it() -> None:
    rng = np.random.default_rng(3)
    hidden = 0
    for _ in range(30):
        angles, count = rng.uniform(-math.pi, math.pi, 8), 7
        street = [
            box(*rng.uniform(-15.0, 15.0, 2), (math.cos(angle), math.sin(angle)), tuple(rng.uniform(1.0, 8.0, 2)))
            for angle in angles[:count]
        ]
        building = tuple(tuple(rng.uniform(-9.0, 9.0, 2)) for _ in range(3))
        ego = box(*rng.uniform(-15.0, 15.0, 2), NORTH)
        shapes = [_polygon(one) for one in street]
        ring = shapely.LinearRing(building)
        expected = []
        for number, one in enumerate(street):
            points = [one[:2], *shapes[number].exterior.coords[:-1]]
            lines = [shapely.LineString([ego[:2], point]) for point in points]
            others = shapely.union_all(shapes[:number] + shapes[number + 1 :])
            expected.append(any(not line.intersects(others) and not line.intersects(ring) for line in lines))
        assert seen(OCCLUSION, ego, *street, buildings=(building,)) == expected
        hidden += expected.count(False)
    assert 40 < hidden < 30 * 7 - 40


def _polygon(one: tuple) -> shapely.Polygon:
    x_m, y_m, ahead_x, ahead_y, length_m, width_m = one
    ahead, aside = np.array([ahead_x, ahead_y]) * length_m / 2, np.array([-ahead_y, ahead_x]) * width_m / 2
    return shapely.Polygon(
        [np.array([x_m, y_m]) + a * ahead + b * aside for a, b in ((1, 1), (1, -1), (-1, -1), (-1, 1))]
    )
