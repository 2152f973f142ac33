"""Lines of sight from an eye to the boxes of vehicles, past other boxes and the walls of buildings."""

import math
from collections.abc import Iterable
from typing import Any, NamedTuple

import numpy as np

from tint_sumo.config import Sensor
from tint_sumo.core.compiling import compiled
from tint_sumo.scenes.geometry import Bools, Boxes, Floats, Numbers
from tint_sumo.scenes.network import Point

_POINTS = 5  # of a box that may be seen: its centre and its corners


class Sight(NamedTuple):
    """The limits of a sensor's sight, for compiled functions."""

    range_m: float  # from centre to centre
    least_cosine: float  # of the angle between the ego's heading and the line to a vehicle's centre
    occlusion: bool

    @classmethod
    def of(cls, sensor: Sensor) -> "Sight":
        all_around = sensor.field_of_view_deg >= 360.0
        return cls(
            math.inf if sensor.range_m is None else sensor.range_m,
            -math.inf if all_around else math.cos(math.radians(sensor.field_of_view_deg / 2)),
            sensor.occlusion,
        )


def walls_of(buildings: Iterable[tuple[Point, ...]]) -> Floats:
    """Return the sides of polygons as lines from x and y to x and y, (W, 4)."""
    sides = [np.hstack([shape, np.roll(shape, -1, axis=0)]) for shape in map(np.array, buildings)]
    return np.concatenate([np.zeros((0, 4)), *sides])


@compiled
def _cuts_box(x_m: float, y_m: float, to_x_m: float, to_y_m: float, box: Any) -> bool:
    """Return whether a line crosses the inside of a box."""
    dx_m, dy_m = to_x_m - x_m, to_y_m - y_m
    off_x_m, off_y_m = box.x_m - x_m, box.y_m - y_m
    radius_m2 = (box.length_m**2 + box.width_m**2) / 4
    if (off_x_m * dy_m - off_y_m * dx_m) ** 2 > radius_m2 * (dx_m**2 + dy_m**2):  # it passes by the circle around it
        return False
    # The parts of the line, from 0 to 1, that are between the box's front and back and between its sides.
    start, end = 0.0, 1.0
    ahead_m, abreast_m = (
        -off_x_m * box.heading_x - off_y_m * box.heading_y,
        off_x_m * box.heading_y - off_y_m * box.heading_x,
    )
    by_ahead_m, by_abreast_m = (
        dx_m * box.heading_x + dy_m * box.heading_y,
        dy_m * box.heading_x - dx_m * box.heading_y,
    )
    for from_m, by_m, half_m in (
        (ahead_m, by_ahead_m, box.length_m / 2),
        (abreast_m, by_abreast_m, box.width_m / 2),
    ):
        if by_m == 0.0:
            if abs(from_m) >= half_m:
                return False
            continue
        one, other = (-half_m - from_m) / by_m, (half_m - from_m) / by_m
        start, end = max(start, min(one, other)), min(end, max(one, other))
    return start < end


@compiled
def _cuts_wall(x_m: float, y_m: float, to_x_m: float, to_y_m: float, wall: Floats) -> bool:
    """Return whether a line crosses a wall (4,); one that only touches it does not."""
    dx_m, dy_m = to_x_m - x_m, to_y_m - y_m
    wall_x_m, wall_y_m = wall[2] - wall[0], wall[3] - wall[1]
    begin = dx_m * (wall[1] - y_m) - dy_m * (wall[0] - x_m)
    end = dx_m * (wall[3] - y_m) - dy_m * (wall[2] - x_m)
    if begin * end >= 0.0:
        return False
    eye = wall_x_m * (y_m - wall[1]) - wall_y_m * (x_m - wall[0])
    point = wall_x_m * (to_y_m - wall[1]) - wall_y_m * (to_x_m - wall[0])
    return bool(eye * point < 0.0)


@compiled
def _is_hidden(
    ego: Any, slot: int, present: Bools, vehicles: Boxes, walls: Floats, near: Numbers, near_walls: int
) -> bool:
    """Return whether a vehicle's centre and corners are all behind others or behind walls, seen from an ego's centre.

    Args:
        ego: its box.
        slot: of the vehicle.
        present, vehicles: (V,) all vehicles.
        walls: (W, 4).
        near: numbers of the walls that may be in the way, so many as ``near_walls``.
    """
    box = vehicles[slot]
    ahead_x_m, ahead_y_m = box.heading_x * box.length_m / 2, box.heading_y * box.length_m / 2
    aside_x_m, aside_y_m = -box.heading_y * box.width_m / 2, box.heading_x * box.width_m / 2
    for point in range(_POINTS):
        along = 0.0 if point == 0 else (1.0 if point < 3 else -1.0)
        across = 0.0 if point == 0 else (1.0 if point % 2 == 0 else -1.0)
        x_m = box.x_m + along * ahead_x_m + across * aside_x_m
        y_m = box.y_m + along * ahead_y_m + across * aside_y_m
        clear = True
        for other in range(len(present)):
            if present[other] and other != slot and _cuts_box(ego.x_m, ego.y_m, x_m, y_m, vehicles[other]):
                clear = False
                break
        if clear:
            for number in range(near_walls):
                if _cuts_wall(ego.x_m, ego.y_m, x_m, y_m, walls[near[number]]):
                    clear = False
                    break
        if clear:
            return False
    return True


@compiled
def _find_near(x_m: float, y_m: float, reach_m: float, walls: Floats, near: Numbers) -> int:
    """Write the numbers of the walls that may come so near to a point; return how many they are."""
    count = 0
    for number in range(len(walls)):
        wall = walls[number]
        low_x_m, high_x_m = min(wall[0], wall[2]), max(wall[0], wall[2])
        low_y_m, high_y_m = min(wall[1], wall[3]), max(wall[1], wall[3])
        across = low_x_m <= x_m + reach_m and high_x_m >= x_m - reach_m
        if across and low_y_m <= y_m + reach_m and high_y_m >= y_m - reach_m:
            near[count] = number
            count += 1
    return count


@compiled
def find_seen(egos: Boxes, present: Bools, vehicles: Boxes, walls: Floats, sight: Sight, seen: Bools) -> None:
    """Write which vehicles are in sight of each ego, whose eye is above its centre (see ``tint_sumo.config.Sensor``).

    Args:
        egos: (N,).
        present, vehicles: (N, V) which slots hold a vehicle, and its box.
        walls: (W, 4) of buildings, as ``walls_of`` returns them.
        sight: limits of the sensor.
        seen: (N, V) written.
    """
    near = np.empty(len(walls), np.int64)
    for row in range(len(egos)):
        ego, reach_m = egos[row], 0.0
        for slot in range(present.shape[1]):
            seen[row, slot] = False
            if present[row, slot]:
                box = vehicles[row, slot]
                dx_m, dy_m = box.x_m - ego.x_m, box.y_m - ego.y_m
                distance_m = math.sqrt(dx_m**2 + dy_m**2)
                ahead_m = dx_m * ego.heading_x + dy_m * ego.heading_y
                seen[row, slot] = distance_m <= sight.range_m and not ahead_m < sight.least_cosine * distance_m
                reach_m = max(reach_m, distance_m + box.length_m)
        if sight.occlusion:
            near_walls = _find_near(ego.x_m, ego.y_m, reach_m, walls, near)
            for slot in range(present.shape[1]):
                if seen[row, slot]:
                    hidden = _is_hidden(ego, slot, present[row], vehicles[row], walls, near, near_walls)
                    seen[row, slot] = not hidden
