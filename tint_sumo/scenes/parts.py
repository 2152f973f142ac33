"""Parts that several scenes are made of."""

import math

from tint_sumo.config import EgoController, VehicleShape
from tint_sumo.scenes.network import Point

OVERHANG_M = VehicleShape().length_m / 2  # traffic lanes reach this far past the roads, on which vehicle centres lie
_DEGREES_PER_POINT = 4.0

# Where roads part, a driver that waits behind the ego can stand so close to its side that the two would wait for each
# other for ever if the ego minded vehicles behind it.
AHEAD_ONLY = EgoController(watches_behind=False)


def arc(centre: Point, radius_m: float, start_deg: float, end_deg: float) -> tuple[Point, ...]:
    """Return points of a circle from one angle (0 east, 90 north) to another; clockwise if the second is smaller."""
    steps = max(1, round(abs(end_deg - start_deg) / _DEGREES_PER_POINT))
    angles = [math.radians(start_deg + (end_deg - start_deg) * step / steps) for step in range(steps + 1)]
    return tuple((centre[0] + radius_m * math.cos(angle), centre[1] + radius_m * math.sin(angle)) for angle in angles)


def quarter_turns(points: tuple[Point, ...], times: int) -> tuple[Point, ...]:
    """Return points turned counterclockwise about the origin."""
    for _ in range(times):
        points = tuple((-y_m, x_m) for x_m, y_m in points)
    return points


def mirrored_x(points: tuple[Point, ...]) -> tuple[Point, ...]:
    """Return points mirrored at x = 0."""
    return tuple((-x_m, y_m) for x_m, y_m in points)
