"""Where things are: the lanes, the ego's fixed path, and distances between vehicle boxes. Pure functions of arrays.

Frame of one intersection as in :class:`tint_sumo.config.Street`. Along its lane a vehicle is located by ``front_m``,
the distance of its front bumper from the lane's start; SUMO reports lane positions of the front bumper, too.
"""

import math
from dataclasses import dataclass
from functools import cached_property

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


def centre_x_m(front_m: Floats, lane: NDArray[np.integer] | int, street: Street, vehicle: VehicleShape) -> Floats:
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
    """Centre, unit heading and front bumper of a batch of egos; each array (R,).

    ``front_direction_y`` is how much of the front's speed leads across the lanes.
    """

    x_m: Floats
    y_m: Floats
    heading_x: Floats
    heading_y: Floats
    front_x_m: Floats
    front_y_m: Floats
    front_direction_y: Floats

    def of(self, rows: NDArray[np.int64]) -> "Pose":
        """The poses of some egos, (K,)."""
        return Pose(
            self.x_m[rows],
            self.y_m[rows],
            self.heading_x[rows],
            self.heading_y[rows],
            self.front_x_m[rows],
            self.front_y_m[rows],
            self.front_direction_y[rows],
        )


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

    @cached_property
    def radius_m(self) -> float:
        """Of the front's arc."""
        return math.hypot(self.street.turn_radius_m, self.vehicle.length_m / 2)

    @cached_property
    def start_rad(self) -> float:
        """Angle of the front on its arc where the turn starts; 0 is west of the arc's centre, pi/2 north of it."""
        return math.asin(self.vehicle.length_m / 2 / self.radius_m)

    @cached_property
    def turn_start_m(self) -> float:
        return self.street.stem_length_m + self.vehicle.length_m / 2

    @cached_property
    def turn_end_m(self) -> float:
        return self.turn_start_m + math.pi / 2 * self.radius_m

    @cached_property
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
        on_turn_m = np.minimum(np.maximum(path_m, self.turn_start_m), self.turn_end_m)  # np.clip takes twice as long
        angle: Floats = self.start_rad + (on_turn_m - self.turn_start_m) / self.radius_m
        return angle

    def point(self, path_m: Floats) -> tuple[Floats, Floats, Floats]:
        """x and y of path points, and the y component of the path's unit tangent there."""
        angle = self._angle_rad(path_m)
        cos, past_turn_m, before_turn_m = np.cos(angle), path_m - self.turn_end_m, path_m - self.turn_start_m
        x = self.street.turn_radius_m - self.radius_m * cos + np.maximum(past_turn_m, 0.0)
        y = self.radius_m * np.sin(angle) + np.minimum(before_turn_m, 0.0)
        return x, y, np.where(before_turn_m < 0.0, 1.0, np.where(past_turn_m < 0.0, cos, 0.0))

    def pose(self, front_m: Floats) -> Pose:
        ends_m = np.array([front_m, front_m - self.vehicle.length_m])
        (front_x, back_x), (front_y, back_y), (front_direction_y, _) = self.point(ends_m)
        along_x, along_y = front_x - back_x, front_y - back_y
        norm = np.hypot(along_x, along_y)
        heading_x, heading_y = along_x / norm, along_y / norm
        half = self.vehicle.length_m / 2
        x, y = front_x - half * heading_x, front_y - half * heading_y
        return Pose(x, y, heading_x, heading_y, front_x, front_y, front_direction_y)


_CORNERS = np.array([(1.0, 1.0, -1.0, -1.0), (1.0, -1.0, -1.0, 1.0)])[:, :, None, None, None, None]


def box_distance_m(pose: Pose, x_m: Floats, y_m: Floats, vehicle: VehicleShape) -> Floats:
    """Shortest distance between each ego's box and axis-aligned vehicle boxes; 0 where they overlap.

    Args:
        pose: of R egos.
        x_m, y_m: (R, V) centres of the other vehicles, which head along x.

    Returns:
        (R, V) distances.
    """
    half_m = np.array([vehicle.length_m, vehicle.width_m])[:, None, None, None] / 2
    cos, sin = pose.heading_x[:, None], pose.heading_y[:, None]
    dx, dy = x_m - pose.x_m[:, None], y_m - pose.y_m[:, None]
    # Each pair in two views, the other as the ego has it ahead and abreast, and the ego as the other has it. Both boxes
    # are alike, turned to one side and to the other. Axes: corner, (ahead, abreast), view, R, V.
    centre = np.array([[dx * cos + dy * sin, dx], [dy * cos - dx * sin, dy]])
    lengthwise = np.array([[cos, cos], [-sin, sin]])
    crosswise = np.array([[sin, -sin], [cos, cos]])
    corners = centre + _CORNERS[0] * half_m[0] * lengthwise + _CORNERS[1] * half_m[1] * crosswise
    # Disjoint convex polygons are closest at a corner of one of them, and apart along a side of one of them.
    outside = np.maximum(np.abs(corners) - half_m, 0.0)
    gap = np.hypot(outside[:, 0], outside[:, 1]).min(axis=(0, 1))
    apart = ((corners.min(axis=0) >= half_m) | (corners.max(axis=0) <= -half_m)).any(axis=(0, 1))
    return np.where(apart, gap, 0.0)
