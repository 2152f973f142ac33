"""Where things are: the lanes, the ego's fixed path, and distances between vehicle boxes. Pure functions of arrays.

Frame of one intersection as in :class:`tint_sumo.config.Street`. Along its lane a vehicle is located by ``front_m``,
the distance of its front bumper from the lane's start; SUMO reports lane positions of the front bumper, too.
"""

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from tint_sumo.config import Street, VehicleShape

Floats = NDArray[np.float64]
Bools = NDArray[np.bool_]

LOWER, UPPER = 0, 1  # lane indices
LANE_NAMES = ("lower", "upper")
LANE_DIRECTION = np.array([-1.0, 1.0])  # sign of the velocity along x


def lane_y_m(street: Street) -> Floats:
    """Centre line of the lower and the upper lane."""
    return np.array([street.lower_y_m, street.upper_y_m])


def lane_border_y_m(street: Street) -> float:
    """Border between the lower and the upper lane."""
    return street.lower_y_m + street.lane_width_m / 2


def lane_length_m(street: Street, vehicle: VehicleShape) -> float:
    """Length of a lane: the street, and half a vehicle beyond it at either end."""
    return 2 * street.half_length_m + vehicle.length_m


def centre_x_m(front_m: Floats, lane: NDArray[np.integer], street: Street, vehicle: VehicleShape) -> Floats:
    """x of vehicle centres."""
    along = front_m - vehicle.length_m - street.half_length_m  # from -20 at entry to 20 at exit
    x: Floats = LANE_DIRECTION[lane] * along
    return x


def junction_span_m(street: Street, vehicle: VehicleShape) -> Floats:
    """x where each junction starts and ends, seen by its lane's drivers; (2, 2) for lower and upper."""
    half = street.junction_half_length_m
    return np.array([(half, -half), (-half, EgoPath(street, vehicle).end_x_m)])


def stage_start_m(street: Street, vehicle: VehicleShape) -> Floats:
    """Distance along the lane at which its three SUMO lanes (before, on, after the junction) start; (2, 3)."""
    outer_m = street.half_length_m + vehicle.length_m / 2
    on_junction = outer_m + junction_span_m(street, vehicle) * LANE_DIRECTION[:, None]
    return np.column_stack([np.zeros(2), on_junction])


@dataclass(frozen=True)
class Pose:
    """Centre, unit heading and front bumper of a batch of egos; each array (R,)."""

    x_m: Floats
    y_m: Floats
    heading_x: Floats
    heading_y: Floats
    front_x_m: Floats
    front_y_m: Floats


@dataclass(frozen=True)
class EgoPath:
    """The ego's fixed path by the length its front bumper has driven from the stem's start.

    The ego's centre drives up x = 0 to the origin, then a quarter circle to the upper lane's middle (code). SUMO leads
    the front along a lane's shape and the back along the same shape one vehicle length behind it, so the shape is the
    front's trace: straight on for half a vehicle more, then a quarter of the slightly larger circle around the same
    centre. The ego's centre then stays within 0.3 m of its path.
    """

    street: Street
    vehicle: VehicleShape

    @property
    def radius_m(self) -> float:
        """Of the front's arc."""
        return math.hypot(self.street.turn_radius_m, self.vehicle.length_m / 2)

    @property
    def start_rad(self) -> float:
        """Angle of the front on its arc where the turn starts; 0 is west of the arc's centre, pi/2 north of it."""
        return math.asin(self.vehicle.length_m / 2 / self.radius_m)

    @property
    def turn_start_m(self) -> float:
        return self.street.stem_length_m + self.vehicle.length_m / 2

    @property
    def turn_end_m(self) -> float:
        return self.turn_start_m + math.pi / 2 * self.radius_m

    @property
    def end_x_m(self) -> float:
        """x of the front where the turn ends."""
        return self.street.turn_radius_m + self.vehicle.length_m / 2

    def start_m(self, centre_y_m: float) -> float:
        """Front's path length for an ego on the stem with its centre at ``centre_y_m``."""
        return self.street.stem_length_m + centre_y_m + self.vehicle.length_m / 2

    def crossing_m(self, y_m: float) -> float:
        """Path length at which the front reaches ``y_m`` on the first half of its turn."""
        return self.turn_start_m + self.radius_m * (math.asin(y_m / self.radius_m) - self.start_rad)

    def _angle_rad(self, path_m: Floats) -> Floats:
        turned_m: Floats = np.clip(path_m, self.turn_start_m, self.turn_end_m) - self.turn_start_m
        return self.start_rad + turned_m / self.radius_m

    def point(self, path_m: Floats) -> tuple[Floats, Floats]:
        """x and y of path points."""
        angle = self._angle_rad(path_m)
        x = self.street.turn_radius_m - self.radius_m * np.cos(angle) + np.maximum(path_m - self.turn_end_m, 0.0)
        y = self.radius_m * np.sin(angle) + np.minimum(path_m - self.turn_start_m, 0.0)
        return x, y

    def direction_y(self, path_m: Floats) -> Floats:
        """y component of the path's unit tangent: how much of the front's speed leads across the lanes."""
        in_turn = np.where(path_m < self.turn_end_m, np.cos(self._angle_rad(path_m)), 0.0)
        return np.where(path_m < self.turn_start_m, 1.0, in_turn)

    def pose(self, front_m: Floats) -> Pose:
        front_x, front_y = self.point(front_m)
        back_x, back_y = self.point(front_m - self.vehicle.length_m)
        along_x, along_y = front_x - back_x, front_y - back_y
        norm = np.hypot(along_x, along_y)
        heading_x, heading_y = along_x / norm, along_y / norm
        half = self.vehicle.length_m / 2
        return Pose(front_x - half * heading_x, front_y - half * heading_y, heading_x, heading_y, front_x, front_y)


_CORNERS = np.array([(1.0, 1.0), (1.0, -1.0), (-1.0, -1.0), (-1.0, 1.0)])


def box_distance_m(pose: Pose, x_m: Floats, y_m: Floats, vehicle: VehicleShape) -> Floats:
    """Shortest distance between each ego's box and axis-aligned vehicle boxes; 0 where they overlap.

    Args:
        pose: of R egos.
        x_m, y_m: (R, V) centres of the other vehicles, which head along x.

    Returns:
        (R, V) distances.
    """
    half_length, half_width = vehicle.length_m / 2, vehicle.width_m / 2
    cos, sin = pose.heading_x[:, None], pose.heading_y[:, None]
    dx, dy = x_m - pose.x_m[:, None], y_m - pose.y_m[:, None]
    along, across = dx * cos + dy * sin, dy * cos - dx * sin
    # The corners of either box relative to its centre, in the frame of the other: (4, R, 1). Both boxes are alike.
    length, width = _CORNERS[:, 0, None, None] * half_length, _CORNERS[:, 1, None, None] * half_width
    others_along, others_across = along + length * cos + width * sin, across + width * cos - length * sin
    egos_x, egos_y = dx - (length * cos - width * sin), dy - (length * sin + width * cos)

    def outside(a: Floats, b: Floats) -> Floats:
        return np.hypot(np.maximum(np.abs(a) - half_length, 0.0), np.maximum(np.abs(b) - half_width, 0.0))

    # Disjoint convex polygons are closest at a corner of one of them.
    gap: Floats = np.minimum(outside(others_along, others_across).min(axis=0), outside(egos_x, egos_y).min(axis=0))
    reach_along = half_length + half_length * np.abs(cos) + half_width * np.abs(sin)
    reach_across = half_width + half_length * np.abs(sin) + half_width * np.abs(cos)
    apart = (np.abs(dx) >= reach_along) | (np.abs(dy) >= reach_across)
    apart |= (np.abs(along) >= reach_along) | (np.abs(across) >= reach_across)
    return np.where(apart, gap, 0.0)
