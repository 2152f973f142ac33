"""Ways by arc length, the boxes of vehicles that drive along them, and distances between boxes.

A way is the trace of a front bumper, as points at every ``SPACING_M`` of its arc length. SUMO leads the front along the
lanes' shapes, and the back along the same shapes a vehicle's length behind; so it is here.
"""

import math
from typing import Any

import numpy as np
import shapely
from numpy.typing import NDArray

from tint_sumo.core.compiling import compiled

Floats = NDArray[np.float64]
Bools = NDArray[np.bool_]
Numbers = NDArray[np.int64]

SPACING_M = 0.02  # a chord of a circle of 6 m lies within 0.01 mm of it

# A vehicle's box: centre, unit heading and size.
BOX = np.dtype(
    (np.record, [(part, np.float64) for part in ("x_m", "y_m", "heading_x", "heading_y", "length_m", "width_m")])
)
Boxes = NDArray[np.void]  # records of BOX

NO_VEHICLE = -1  # slot of the leader of a vehicle that has none, and whatever else an empty slot has a number for


def new_boxes(count: int, length_m: float, width_m: float) -> Boxes:
    """Return boxes (count,) of one size that are nowhere yet."""
    boxes = np.zeros(count, BOX)
    boxes["length_m"], boxes["width_m"] = length_m, width_m
    return boxes


def resample(points: Floats, length_m: float) -> Floats:
    """Return points (P, 2) at every ``SPACING_M`` of a polyline (N, 2), which goes straight on up to this length."""
    step_m = np.hypot(*np.diff(points, axis=0).T)
    keep = np.r_[True, step_m > 0.0]
    points, step_m = points[keep], step_m[step_m > 0.0]
    along_m = np.r_[0.0, np.cumsum(step_m)]
    wanted_m = np.arange(math.ceil(length_m / SPACING_M) + 2) * SPACING_M
    inside = np.stack([np.interp(wanted_m, along_m, points[:, axis]) for axis in range(2)], axis=1)
    beyond_m = np.maximum(wanted_m - along_m[-1], 0.0)
    return np.asarray(inside + beyond_m[:, None] * (points[-1] - points[-2]) / step_m[-1])


def along(way: Floats) -> Floats:
    """Return the arc lengths (P,) of a way's points (P, 2)."""
    return np.asarray(np.arange(len(way)) * SPACING_M)


def as_line(way: Floats) -> shapely.LineString:
    """Return a way as a line of few points, within a millimetre of it."""
    return shapely.LineString(way).simplify(1e-3)


def project(points: Floats, line: shapely.LineString) -> tuple[Floats, Floats]:
    """Return the distances of points (N, 2) along a line, where they are nearest to it, and from it; both (N,)."""
    found = shapely.points(points)
    return shapely.line_locate_point(line, found), shapely.distance(line, found)


@compiled
def way_point(way: Floats, along_m: float) -> tuple[float, float]:
    """Return the point of a way (P, 2) at an arc length; beyond its ends it goes straight on."""
    steps = along_m / SPACING_M
    index = min(max(int(steps), 0), way.shape[0] - 2)
    part = steps - index
    x_m = way[index, 0] + part * (way[index + 1, 0] - way[index, 0])
    y_m = way[index, 1] + part * (way[index + 1, 1] - way[index, 1])
    return x_m, y_m


@compiled
def place_one(front_m: float, way: Floats, box: Any) -> None:
    """Write centre and heading of a box, one record, whose front has come so far along its way."""
    front_x_m, front_y_m = way_point(way, front_m)
    back_x_m, back_y_m = way_point(way, front_m - box.length_m)
    along_x_m, along_y_m = front_x_m - back_x_m, front_y_m - back_y_m
    norm_m = math.hypot(along_x_m, along_y_m)
    box.heading_x, box.heading_y = along_x_m / norm_m, along_y_m / norm_m
    box.x_m = front_x_m - box.length_m / 2 * box.heading_x
    box.y_m = front_y_m - box.length_m / 2 * box.heading_y


@compiled
def place(front_m: Floats, way: Floats, boxes: Boxes) -> None:
    """Write centres and headings of boxes (N,) whose fronts (N,) have come so far along one way."""
    for index in range(len(front_m)):
        place_one(front_m[index], way, boxes[index])


@compiled
def follow(
    index: Numbers,
    lane_pos_m: Floats,
    route: Numbers,
    lane_start_m: Floats,
    ways: Floats,
    stage: Numbers,
    was_pos_m: Floats,
    front_m: Floats,
    boxes: Boxes,
) -> None:
    """Move vehicles to where SUMO has them.

    Args:
        index: (N,) of vehicles in the arrays (S,) of all slots: ``route``, and those written to.
        lane_pos_m: (N,) of their fronts on their SUMO lanes.
        lane_start_m: (K, S) where each lane of a route starts.
        ways: (K, P, 2) of the routes.
        stage, was_pos_m: number of the SUMO lane on the route, and position on it; read and written.
        front_m, boxes: written.
    """
    for vehicle in range(len(index)):
        slot, position_m = index[vehicle], lane_pos_m[vehicle]
        # Vehicles only move forward: a lane position that dropped belongs to the next SUMO lane.
        if position_m < was_pos_m[slot]:
            stage[slot] += 1
        was_pos_m[slot] = position_m
        front_m[slot] = lane_start_m[route[slot], stage[slot]] + position_m
        place_one(front_m[slot], ways[route[slot]], boxes[slot])


@compiled
def place_seen(
    slot: Numbers, seen: Floats, origin_x_m: float, origin_y_m: float, front_m: Floats, boxes: Boxes
) -> None:
    """Write where SUMO sees vehicles.

    Args:
        slot: (N,) of the vehicles in the arrays (S,) that are written: ``front_m`` and ``boxes``, which have sizes.
        seen: (N, 4) x and y of their fronts in the network, their angles clockwise from north in degrees, and the
            distances that they have driven.
        origin_x_m, origin_y_m: the origin of the boxes' frame in the network.
    """
    for vehicle in range(len(slot)):
        x_m, y_m, angle_deg, driven_m = seen[vehicle]
        angle_rad = math.radians(angle_deg)
        box = boxes[slot[vehicle]]
        box.heading_x, box.heading_y = math.sin(angle_rad), math.cos(angle_rad)
        half_m = box.length_m / 2
        box.x_m = x_m - half_m * box.heading_x - origin_x_m
        box.y_m = y_m - half_m * box.heading_y - origin_y_m
        front_m[slot[vehicle]] = driven_m


@compiled
def find_leaders(
    present: Bools,
    route: Numbers,
    stage: Numbers,
    front_m: Floats,
    boxes: Boxes,
    lane_start_m: Floats,
    lane_on_route_m: Floats,
    leader: Numbers,
    gap_m: Floats,
) -> None:
    """Write the slot of the next vehicle ahead on each vehicle's route, and the gap to it, infinite without one.

    Args:
        present, route, stage, front_m, boxes: (R, V) of the vehicles.
        lane_start_m: (K, S) where each lane of a route starts.
        lane_on_route_m: (K, K, S) where on the first route each lane of the second one starts; NaN if it does not.
        leader, gap_m: (R, V) written; the gap is bumper to bumper.
    """
    occupied = np.empty(present.shape[1], np.int64)  # slots of a row that hold a vehicle
    for row in range(present.shape[0]):
        count = 0
        for slot in range(present.shape[1]):
            leader[row, slot] = NO_VEHICLE
            gap_m[row, slot] = math.inf
            if present[row, slot]:
                occupied[count] = slot
                count += 1
        for slot in occupied[:count]:
            this, nearest_m = route[row, slot], math.inf
            for other in occupied[:count]:
                theirs, ahead_m = route[row, other], front_m[row, other] - front_m[row, slot]
                if theirs != this:
                    lane = stage[row, other]
                    ahead_m += lane_on_route_m[this, theirs, lane] - lane_start_m[theirs, lane]
                if 0.0 < ahead_m < nearest_m:  # neither the vehicle itself nor NaN
                    nearest_m = ahead_m
                    leader[row, slot] = other
            if leader[row, slot] >= 0:
                gap_m[row, slot] = nearest_m - boxes[row, leader[row, slot]].length_m


@compiled
def box_distance_m(
    dx_m: float,
    dy_m: float,
    cos: float,
    sin: float,
    length_m: float,
    width_m: float,
    turned_length_m: float,
    turned_width_m: float,
) -> float:
    """Return the shortest distance between two boxes, one along x and the other turned; 0 where they overlap.

    Args:
        dx_m, dy_m: centre of the box along x, relative to the centre of the turned one.
        cos, sin: heading of the turned box.
        length_m, width_m: of the box along x.
        turned_length_m, turned_width_m: of the turned box.
    """
    nearest_m = math.inf
    apart = False
    # Two views: the box along x as the turned one has it ahead and abreast, and the turned one as that one has it. Each
    # box is turned by the same angle in the other's view, to one side and to the other.
    for ahead_m, abreast_m, turn, seen_length_m, seen_width_m, from_length_m, from_width_m in (
        (dx_m * cos + dy_m * sin, dy_m * cos - dx_m * sin, -sin, length_m, width_m, turned_length_m, turned_width_m),
        (dx_m, dy_m, sin, turned_length_m, turned_width_m, length_m, width_m),
    ):
        half_length_m, half_width_m = from_length_m / 2, from_width_m / 2
        low_ahead_m, high_ahead_m, low_abreast_m, high_abreast_m = math.inf, -math.inf, math.inf, -math.inf
        for along_m in (seen_length_m / 2, -seen_length_m / 2):
            for across_m in (seen_width_m / 2, -seen_width_m / 2):
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
def clearance_m(box: Any, other: Any) -> float:
    """Return the shortest distance between two boxes; 0 where they overlap."""
    dx_m, dy_m = other.x_m - box.x_m, other.y_m - box.y_m
    # seen from a frame that heads like the other
    ahead_m = dx_m * other.heading_x + dy_m * other.heading_y
    abreast_m = dy_m * other.heading_x - dx_m * other.heading_y
    cos = box.heading_x * other.heading_x + box.heading_y * other.heading_y
    sin = box.heading_y * other.heading_x - box.heading_x * other.heading_y
    return box_distance_m(ahead_m, abreast_m, cos, sin, other.length_m, other.width_m, box.length_m, box.width_m)


@compiled
def measure_distances_m(egos: Boxes, present: Bools, vehicles: Boxes, reach_m: float, distance_m: Floats) -> None:
    """Write the distances from each ego's box to the vehicles' boxes.

    Args:
        egos: (R,).
        present, vehicles: (R, V) which slots hold a vehicle, and its box.
        reach_m: distances beyond it may be written as infinite.
        distance_m: (R, V) written; infinite for empty slots.
    """
    for row in range(len(egos)):
        ego = egos[row]
        ego_radius_m = math.hypot(ego.length_m, ego.width_m) / 2  # the circle around the box
        for slot in range(present.shape[1]):
            distance_m[row, slot] = math.inf
            if present[row, slot]:
                other = vehicles[row, slot]
                near_m = reach_m + ego_radius_m + math.hypot(other.length_m, other.width_m) / 2
                if abs(other.x_m - ego.x_m) < near_m and abs(other.y_m - ego.y_m) < near_m:
                    distance_m[row, slot] = clearance_m(ego, other)


@compiled
def sweep(
    egos_before: Boxes, egos: Boxes, same: Bools, before: Boxes, vehicles: Boxes, parts: int, hit: Numbers
) -> bool:
    """Write which vehicles egos have touched between two steps, if all drive straight on at a constant speed.

    Args:
        egos_before, egos: (R,) boxes.
        same: (R, V) slots with the same vehicle at both times.
        before, vehicles: (R, V) boxes.
        parts: of the step, at whose ends within it boxes are compared.
        hit: (R,) the first slot whose vehicle the ego has touched, written where it was negative.

    Returns:
        whether any ego has touched a vehicle for the first time.
    """
    any_new = False
    ego, vehicle = egos[:1].copy(), egos[:1].copy()
    for row in range(len(egos)):
        for part in range(1, parts):
            share = part / parts
            between(egos_before[row], egos[row], share, ego[0])
            for slot in range(same.shape[1]):
                if hit[row] < 0 and same[row, slot]:
                    between(before[row, slot], vehicles[row, slot], share, vehicle[0])
                    if clearance_m(ego[0], vehicle[0]) == 0.0:
                        hit[row] = slot
                        any_new = True
    return any_new


@compiled
def between(first: Any, last: Any, share: float, box: Any) -> None:
    """Write the box at a share of the way from one box to another, towards whose heading it has turned as far."""
    box.x_m = first.x_m + share * (last.x_m - first.x_m)
    box.y_m = first.y_m + share * (last.y_m - first.y_m)
    heading_x = first.heading_x + share * (last.heading_x - first.heading_x)
    heading_y = first.heading_y + share * (last.heading_y - first.heading_y)
    norm = math.hypot(heading_x, heading_y)
    if norm > 0.0:  # else it has turned round
        box.heading_x, box.heading_y = heading_x / norm, heading_y / norm
    else:
        box.heading_x, box.heading_y = last.heading_x, last.heading_y
    box.length_m, box.width_m = last.length_m, last.width_m


@compiled
def box_on_way(way: Boxes, driven_m: Floats, along_m: float, box: Any) -> None:
    """Write the box that has come so far along a way; beyond its end it goes straight on.

    Args:
        way: (P,) boxes one after the other.
        driven_m: (P,) how far along the way they are; never falling.
        along_m: wanted.
        box: written.
    """
    last, along_m = len(way) - 1, max(along_m, driven_m[0])
    index = min(max(int(np.searchsorted(driven_m, along_m, side="right")) - 1, 0), last)
    if index < last:
        between(way[index], way[index + 1], (along_m - driven_m[index]) / (driven_m[index + 1] - driven_m[index]), box)
        return
    between(way[last], way[last], 1.0, box)
    beyond_m = along_m - driven_m[last]
    box.x_m += beyond_m * box.heading_x
    box.y_m += beyond_m * box.heading_y


_SAME_DIRECTION = 0.5  # least cosine of the angle between two headings


@compiled
def find_meetings(
    way: Boxes,
    driven_m: Floats,
    along_m: float,
    speed_mps: float,
    step: int,
    steps: int,
    every: int,
    step_s: float,
    tracks: Numbers,
    first_step: Numbers,
    first_row: Numbers,
    rows: Numbers,
    boxes: Boxes,
    near_m: float,
    meets: Bools,
) -> None:
    """Find the recorded vehicles that would come near to a vehicle that drives on along its way at its speed.

    Vehicles that it would only come up to from behind do not count.

    Args:
        way, driven_m, along_m: as in ``box_on_way``, of the vehicle.
        speed_mps: its speed.
        step: the present one.
        steps, every: to look ahead, all so many.
        step_s: length of a step.
        tracks: (M,) numbers of recorded vehicles, among N.
        first_step, first_row, rows: (N,) of their tracks.
        boxes: (R,) of all rows.
        near_m: distance between boxes.
        meets: (M,) set to true where a vehicle would come so near.
    """
    own = way[:1].copy()
    behind = np.zeros(len(tracks), np.bool_)
    for ahead in range(0, steps + 1, every):
        box_on_way(way, driven_m, along_m + speed_mps * ahead * step_s, own[0])
        box = own[0]
        for index in range(len(tracks)):
            track = tracks[index]
            row = step + ahead - first_step[track]
            if meets[index] or behind[index] or row < 0 or row >= rows[track]:
                continue
            other = boxes[first_row[track] + row]
            reach_m = near_m + (math.hypot(box.length_m, box.width_m) + math.hypot(other.length_m, other.width_m)) / 2
            dx_m, dy_m = box.x_m - other.x_m, box.y_m - other.y_m
            if abs(dx_m) < reach_m and abs(dy_m) < reach_m and clearance_m(box, other) <= near_m:
                turned = box.heading_x * other.heading_x + box.heading_y * other.heading_y
                ahead_m = dx_m * other.heading_x + dy_m * other.heading_y
                behind[index] = turned > _SAME_DIRECTION and ahead_m < -other.length_m / 2
                meets[index] = not behind[index]


@compiled
def find_overlaps(boxes: Boxes, overlaps: Bools) -> bool:
    """Find boxes (M,) that overlap; write them in ``overlaps`` (M, M), each pair once, and return whether any do."""
    any_do = False
    for first in range(len(boxes)):
        for second in range(first + 1, len(boxes)):
            a, b = boxes[first], boxes[second]
            reach_m = (math.hypot(a.length_m, a.width_m) + math.hypot(b.length_m, b.width_m)) / 2
            near = abs(a.x_m - b.x_m) < reach_m and abs(a.y_m - b.y_m) < reach_m
            overlaps[first, second] = near and clearance_m(a, b) == 0.0
            any_do = any_do or overlaps[first, second]
    return any_do
