"""Where things are: the lanes, the ego's fixed path, and distances between vehicle boxes.

Frame of one intersection as in :class:`tint_sumo.config.Street`. Along its lane a vehicle is located by ``front_m``,
the distance of its front bumper from the lane's start; SUMO reports lane positions of the front bumper, too.
"""

import math
from typing import NamedTuple

import numpy as np
import shapely
from numpy.typing import NDArray

from tint_sumo.compiling import compiled
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


@compiled
def centre_x_m(front_m: float, lane: int, half_length_m: float, vehicle_length_m: float) -> float:
    """x of a vehicle's centre, on a street of a half length."""
    along_m = front_m - vehicle_length_m - half_length_m  # from -20 at entry to 20 at exit
    return float(LANE_DIRECTION[lane] * along_m)


def junction_span_m(street: Street, vehicle: VehicleShape) -> Floats:
    """x where each junction starts and ends, seen by its lane's drivers; (2, 2) for lower and upper."""
    half = street.junction_half_length_m
    return np.array([(half, -half), (-half, EgoPath.of(street, vehicle).end_x_m)])


def stage_start_m(street: Street, vehicle: VehicleShape) -> Floats:
    """Distance along the lane at which its three SUMO lanes (before, on, after the junction) start; (2, 3)."""
    outer_m = street.half_length_m + vehicle.length_m / 2
    on_junction = outer_m + junction_span_m(street, vehicle) * LANE_DIRECTION[:, None]
    return np.column_stack([np.zeros(2), on_junction])


@compiled
def locate(
    slots: NDArray[np.int64],
    position_m: Floats,
    lane: NDArray[np.int64],
    stage_start_m: Floats,
    half_length_m: float,
    vehicle_length_m: float,
    stage: NDArray[np.int64],
    lane_pos_m: Floats,
    front_m: Floats,
    x_m: Floats,
) -> None:
    """Follow vehicles to where SUMO has them.

    Args:
        slots: (K,) of vehicles, indices into the arrays (S,) of all slots: ``lane``, and those written to.
        position_m: (K,) on the vehicles' SUMO lanes.
        stage_start_m: see :func:`stage_start_m`.
        stage, lane_pos_m: SUMO lane, 0 to 2, and position on it; read and written.
        front_m, x_m: along the lane, and of the centre; written.
    """
    for slot, one_m in zip(slots, position_m):  # noqa: B905 - Numba knows no strict
        # Vehicles only move forward: a lane position that dropped belongs to the next SUMO lane.
        if one_m < lane_pos_m[slot]:
            stage[slot] += 1
        lane_pos_m[slot] = one_m
        front_m[slot] = stage_start_m[lane[slot], stage[slot]] + one_m
        x_m[slot] = centre_x_m(front_m[slot], lane[slot], half_length_m, vehicle_length_m)


class EgoPath(NamedTuple):
    """The ego's fixed path by the length its front bumper has driven from the stem's start.

    The ego's centre drives up x = 0 to the origin, then a quarter circle to the upper lane's middle (code). SUMO leads
    the front along a lane's shape and the back along the same shape one vehicle length behind it, so the shape is the
    front's trace: straight on for half a vehicle more, then a quarter of the slightly larger circle around the same
    centre. The ego's centre then stays within 0.3 m of its path.
    """

    stem_length_m: float
    turn_radius_m: float  # of the centre's arc
    vehicle_length_m: float
    radius_m: float  # of the front's arc
    start_rad: float  # of the front on its arc where the turn starts; 0 is west of the arc's centre, pi/2 north of it
    turn_start_m: float
    turn_end_m: float

    @classmethod
    def of(cls, street: Street, vehicle: VehicleShape) -> "EgoPath":
        half_m = vehicle.length_m / 2
        radius_m = math.hypot(street.turn_radius_m, half_m)
        turn_start_m = street.stem_length_m + half_m
        return cls(
            street.stem_length_m,
            street.turn_radius_m,
            vehicle.length_m,
            radius_m,
            math.asin(half_m / radius_m),
            turn_start_m,
            turn_start_m + math.pi / 2 * radius_m,
        )

    @property
    def end_x_m(self) -> float:
        """x of the front where the turn ends."""
        return self.turn_radius_m + self.vehicle_length_m / 2

    def start_m(self, centre_y_m: float) -> float:
        """Front's path length for an ego on the stem with its centre at ``centre_y_m``."""
        return self.stem_length_m + centre_y_m + self.vehicle_length_m / 2

    def crossing_m(self, y_m: float) -> float:
        """Path length at which the front reaches ``y_m`` on the first half of its turn."""
        return self.turn_start_m + self.radius_m * (math.asin(y_m / self.radius_m) - self.start_rad)


# An ego's centre, unit heading and front bumper, and how much of the front's speed leads across the lanes.
POSE = np.dtype(
    [
        (part, np.float64)
        for part in ("x_m", "y_m", "heading_x", "heading_y", "front_x_m", "front_y_m", "front_direction_y")
    ]
)
Poses = NDArray[np.void]  # of POSE, (R,)


@compiled
def path_point(path_m: float, path: EgoPath) -> tuple[float, float, float]:
    """x and y of a point of the path, and the y component of the path's unit tangent there."""
    on_turn_m = min(max(path_m, path.turn_start_m), path.turn_end_m)
    angle_rad = path.start_rad + (on_turn_m - path.turn_start_m) / path.radius_m
    cos, past_turn_m, before_turn_m = math.cos(angle_rad), path_m - path.turn_end_m, path_m - path.turn_start_m
    x_m = path.turn_radius_m - path.radius_m * cos + max(past_turn_m, 0.0)
    y_m = path.radius_m * math.sin(angle_rad) + min(before_turn_m, 0.0)
    return x_m, y_m, 1.0 if before_turn_m < 0.0 else cos if past_turn_m < 0.0 else 0.0


@compiled
def place(front_m: Floats, path: EgoPath, poses: Poses) -> None:
    """Write the poses of egos whose fronts have come so far along the path; both (R,)."""
    for front, pose in zip(front_m, poses):  # noqa: B905 - Numba knows no strict
        front_x, front_y, pose.front_direction_y = path_point(front, path)
        back_x, back_y, _ = path_point(front - path.vehicle_length_m, path)
        along_x, along_y = front_x - back_x, front_y - back_y
        norm = math.hypot(along_x, along_y)
        pose.heading_x, pose.heading_y = along_x / norm, along_y / norm
        pose.x_m = front_x - path.vehicle_length_m / 2 * pose.heading_x
        pose.y_m = front_y - path.vehicle_length_m / 2 * pose.heading_y
        pose.front_x_m, pose.front_y_m = front_x, front_y


_SWEEP_SPACING_M = 0.05  # between the poses of the ego whose boxes make up its swept area


def swept_area_start_m(street: Street, vehicle: VehicleShape, margin_m: float) -> Floats:
    """Distance along each lane at which a vehicle's front comes closer than a margin to the ego's way; (2,).

    A vehicle that stands short of it is never closer than ``margin_m`` to the box of an ego that drives by.
    """
    path = EgoPath.of(street, vehicle)
    fronts_m = np.arange(0.0, path.turn_end_m + vehicle.length_m, _SWEEP_SPACING_M)
    poses = np.zeros(len(fronts_m), POSE)
    place(fronts_m, path, poses)
    ahead = np.stack([poses["heading_x"], poses["heading_y"]], axis=-1) * (vehicle.length_m / 2)
    abreast = np.stack([-poses["heading_y"], poses["heading_x"]], axis=-1) * (vehicle.width_m / 2)
    centre = np.stack([poses["x_m"], poses["y_m"]], axis=-1)
    corners = [centre + ahead + abreast, centre + ahead - abreast, centre - ahead - abreast, centre - ahead + abreast]
    swept = shapely.buffer(shapely.union_all(shapely.polygons(np.stack(corners, axis=1))), margin_m)
    starts_m = []
    for y_m, direction in zip(lane_y_m(street), LANE_DIRECTION, strict=True):
        half_width_m = vehicle.width_m / 2
        driven_over = shapely.box(-street.half_length_m, y_m - half_width_m, street.half_length_m, y_m + half_width_m)
        west_m, _, east_m, _ = shapely.bounds(shapely.intersection(swept, driven_over))
        first_x_m = west_m if direction > 0.0 else east_m
        starts_m.append(street.half_length_m + vehicle.length_m / 2 + direction * first_x_m)
    return np.array(starts_m)


@compiled
def box_distance_m(dx_m: float, dy_m: float, cos: float, sin: float, length_m: float, width_m: float) -> float:
    """Shortest distance between two boxes of one size, one along x and the other turned; 0 where they overlap.

    Args:
        dx_m, dy_m: centre of the box along x, seen from the turned one's.
        cos, sin: heading of the turned box.
    """
    half_length_m, half_width_m = length_m / 2, width_m / 2
    nearest_m = math.inf
    apart = False
    # Two views: the box along x as the turned one has it ahead and abreast, and the turned one as that one has it. Each
    # box is turned by the same angle in the other's view, to one side and to the other.
    for ahead_m, abreast_m, turn in (
        (dx_m * cos + dy_m * sin, dy_m * cos - dx_m * sin, -sin),
        (dx_m, dy_m, sin),
    ):
        low_ahead_m, high_ahead_m, low_abreast_m, high_abreast_m = math.inf, -math.inf, math.inf, -math.inf
        for along_m in (half_length_m, -half_length_m):
            for across_m in (half_width_m, -half_width_m):
                corner_ahead_m = ahead_m + along_m * cos - across_m * turn
                corner_abreast_m = abreast_m + along_m * turn + across_m * cos
                # Disjoint convex polygons are closest at a corner of one of them...
                outside_ahead_m = max(abs(corner_ahead_m) - half_length_m, 0.0)
                outside_abreast_m = max(abs(corner_abreast_m) - half_width_m, 0.0)
                nearest_m = min(nearest_m, math.hypot(outside_ahead_m, outside_abreast_m))
                low_ahead_m, high_ahead_m = min(low_ahead_m, corner_ahead_m), max(high_ahead_m, corner_ahead_m)
                low_abreast_m = min(low_abreast_m, corner_abreast_m)
                high_abreast_m = max(high_abreast_m, corner_abreast_m)
        # ... and apart along a side of one of them.
        apart = apart or low_ahead_m >= half_length_m or high_ahead_m <= -half_length_m
        apart = apart or low_abreast_m >= half_width_m or high_abreast_m <= -half_width_m
    return nearest_m if apart else 0.0


@compiled
def measure_distances_m(
    poses: Poses,
    present: Bools,
    x_m: Floats,
    y_m: Floats,
    reach_m: float,
    length_m: float,
    width_m: float,
    distance_m: Floats,
) -> None:
    """Write the distances from each ego's box to the vehicles' boxes.

    Args:
        poses: of R egos.
        present, x_m, y_m: (R, V) which slots hold a vehicle, and its centre; vehicles head along x.
        reach_m: distances beyond it may be written as infinite.
        length_m, width_m: of every box.
        distance_m: (R, V) written; infinite for empty slots.
    """
    ego_radius_m = math.hypot(length_m, width_m) / 2  # however the ego stands
    reach_x_m, reach_y_m = reach_m + ego_radius_m + length_m / 2, reach_m + ego_radius_m + width_m / 2
    for row in range(len(poses)):
        pose = poses[row]
        for slot in range(present.shape[1]):
            dx_m, dy_m = x_m[row, slot] - pose.x_m, y_m[row, slot] - pose.y_m
            near = present[row, slot] and abs(dx_m) < reach_x_m and abs(dy_m) < reach_y_m
            distance_m[row, slot] = (
                box_distance_m(dx_m, dy_m, pose.heading_x, pose.heading_y, length_m, width_m) if near else math.inf
            )
