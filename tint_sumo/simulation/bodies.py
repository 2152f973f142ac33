"""Bodies of long vehicles, which bend along the lanes behind their front: trains, trams and articulated buses."""

import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from itertools import pairwise
from typing import Any, Self

import numpy as np
from libsumo import constants

from tint_sumo.scenes.geometry import BOX, Boxes, measure_distances_m
from tint_sumo.simulation.connection import Connection

LONG_M = 15.0  # a longer vehicle bends
_PIECE_M = 10.0  # longest piece of a body
_SAME_M = 1e-6

Point = tuple[float, float]
Box = tuple[float, float, float, float, float, float]  # fields of ``tint_sumo.scenes.geometry.BOX``


@dataclass(frozen=True)
class Body:
    """A long vehicle in the scene's frame."""

    boxes: Boxes  # (P,) its pieces, the front first
    nearest: int  # number of the piece that is nearest to the ego
    distance_m: float  # of its box to the ego's

    @classmethod
    def of(cls, pieces: list[Box], origin_m: Point, ego: Boxes) -> Self:
        """Return a body of pieces in the network's frame; (1,) box of the ego in the scene's."""
        boxes = np.array(pieces, BOX)
        boxes["x_m"] -= origin_m[0]
        boxes["y_m"] -= origin_m[1]
        distances_m = np.full((1, len(boxes)), np.inf)
        measure_distances_m(ego, np.ones(distances_m.shape, bool), boxes[None], np.inf, distances_m)
        nearest = int(distances_m[0].argmin())
        return cls(boxes, nearest, float(distances_m[0, nearest]))

    @property
    def nearest_box(self) -> np.void:
        box: np.void = self.boxes[self.nearest]
        return box


class Bodies:
    """Looks up how the long vehicles of a running simulation lie on their lanes."""

    def __init__(self, connection: Connection) -> None:
        self._connection = connection
        self._behind: dict[tuple[str, str], str | None] = {}  # lane before a lane, for those who come from an edge

    def pieces(self, vehicle_id: str, size_m: tuple[float, float], angle_rad: float) -> list[Box]:
        """Return the pieces of a vehicle's body, the front first, in the network's frame.

        Args:
            vehicle_id: id.
            size_m: length and width of the vehicle.
            angle_rad: of its heading, clockwise from north, for one that has no lane behind its front.
        """
        trace = list(self._trace(vehicle_id, size_m[0]))
        x_m, y_m = trace[0]
        if all(math.dist(trace[0], other) < _SAME_M for other in trace):
            trace.append((x_m - math.sin(angle_rad), y_m - math.cos(angle_rad)))
        return cut(trace, size_m)

    def height_m(self, vehicle_id: str, back_m: float) -> float:
        """Return z of the lane under a vehicle, so far behind its front, or of the last lane that is known."""
        found, position_m = "", 0.0
        for lane, along_m in self._lanes_under(vehicle_id):
            found, position_m = lane, along_m - back_m
            if position_m >= 0.0:
                break
            back_m -= along_m
        edge, _, number = found.rpartition("_")
        _, _, z_m = self._connection.simulation.convert3D(edge, max(position_m, 0.0), int(number))
        return float(z_m)

    def _trace(self, vehicle_id: str, length_m: float) -> Iterator[Point]:
        """Yield points from a vehicle's front along its lanes, at least as far as it is long where lanes are known."""
        lanes = self._connection.lane
        yield self._connection.vehicle.getPosition(vehicle_id)
        for lane, along_m in self._lanes_under(vehicle_id):
            shape = lanes.getShape(lane)
            yield from reversed(_first(shape, along_m * _stretch(shape, lanes.getLength(lane))))
            length_m -= along_m
            if length_m <= 0.0:
                return

    def _lanes_under(self, vehicle_id: str) -> Iterator[tuple[str, float]]:
        """Yield the lanes that a vehicle has come along, its present one first, each with how far it has come on it."""
        vehicle = self._connection.vehicle
        route, index = vehicle.getRoute(vehicle_id), vehicle.getRouteIndex(vehicle_id)
        lane: str | None = vehicle.getLaneID(vehicle_id)
        along_m = vehicle.getLanePosition(vehicle_id)
        while lane:
            yield lane, along_m
            behind = self._lane_behind(route, index, lane)
            if not lane.startswith(":"):
                index -= 1
            lane = behind
            along_m = self._connection.lane.getLength(lane) if lane else 0.0

    def _lane_behind(self, route: tuple[str, ...], index: int, lane: str) -> str | None:
        """Return the lane from which a route leads to a lane; None at the route's beginning.

        Args:
            route: edges.
            index: of the edge that the lane is on or, for one on a junction, of the edge before.
            lane: id.
        """
        before = index if lane.startswith(":") else index - 1
        if before < 0:
            return None
        target = (route[before], lane)
        if target not in self._behind:
            self._behind[target] = self._find(route[before], lane)
        return self._behind[target]

    def _find(self, edge: str, lane: str) -> str | None:
        """Return the lane from which those who come from an edge reach a lane; None if they do not."""
        lanes = self._connection.lane
        for number in range(self._connection.edge.getLaneNumber(edge)):
            first = f"{edge}_{number}"
            for link in lanes.getLinks(first):
                before, after = first, link[4] or link[0]
                passed = set()  # from a pavement, persons can go round and round a junction
                while after != lane and after.startswith(":") and after not in passed and lanes.getLinks(after):
                    passed.add(after)
                    follow = lanes.getLinks(after)[0]
                    before, after = after, follow[4] or follow[0]
                if after == lane:
                    return before
        return None


def box_of(sight: Mapping[int, Any], size_m: tuple[float, float], origin_m: tuple[float, float]) -> Box:
    """Return the box of a vehicle, or a person, a record; SUMO gives its front, and its angle from north."""
    x_m, y_m, _ = sight[constants.VAR_POSITION3D]
    angle_rad = math.radians(sight[constants.VAR_ANGLE])  # clockwise
    heading_x, heading_y = math.sin(angle_rad), math.cos(angle_rad)
    half_m = size_m[0] / 2
    x_m, y_m = x_m - half_m * heading_x - origin_m[0], y_m - half_m * heading_y - origin_m[1]
    return (x_m, y_m, heading_x, heading_y, *size_m)


def record_of(box: Box) -> np.void:
    """Return a box as a record of ``tint_sumo.scenes.geometry.BOX``."""
    record: np.void = np.array([box], BOX)[0]
    return record


def _stretch(shape: tuple[Point, ...], length_m: float) -> float:
    """Return the drawn length of a lane over its length in SUMO."""
    drawn_m = sum(math.dist(a, b) for a, b in pairwise(shape))
    return drawn_m / length_m


def _first(shape: tuple[Point, ...], length_m: float) -> list[Point]:
    """Return the points of a line before so much of its length, without the end itself."""
    points, passed_m = [shape[0]], 0.0
    for a, b in pairwise(shape):
        passed_m += math.dist(a, b)
        if passed_m >= length_m - _SAME_M:
            break
        points.append(b)
    return points


def cut(points: list[Point], size_m: tuple[float, float]) -> list[Box]:
    """Return a body as pieces of equal length.

    Args:
        points: from its front along its lanes; where they end, the body goes straight on.
        size_m: length and width.
    """
    count = math.ceil(size_m[0] / _PIECE_M)
    piece_m = size_m[0] / count
    ends = [_at(points, number * piece_m) for number in range(count + 1)]
    boxes = []
    for (ahead_x, ahead_y), (back_x, back_y) in pairwise(ends):
        chord_m = math.hypot(ahead_x - back_x, ahead_y - back_y)
        heading = ((ahead_x - back_x) / chord_m, (ahead_y - back_y) / chord_m)
        boxes.append(((ahead_x + back_x) / 2, (ahead_y + back_y) / 2, *heading, chord_m, size_m[1]))
    return boxes


def _at(points: list[Point], along_m: float) -> Point:
    """Return the point at a distance along a line, which goes straight on at its end."""
    distinct = [points[0], *(b for a, b in pairwise(points) if math.dist(a, b) > _SAME_M)]
    for number, (a, b) in enumerate(pairwise(distinct), 1):
        length_m = math.dist(a, b)
        if along_m <= length_m or number == len(distinct) - 1:
            share = along_m / length_m
            return (a[0] + share * (b[0] - a[0]), a[1] + share * (b[1] - a[1]))
        along_m -= length_m
    return distinct[0]
