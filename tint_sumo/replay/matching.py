"""Recorded positions on the lanes of a SUMO network, and the routes that lead over them."""

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import groupby, pairwise
from typing import Any

import numpy as np
import shapely
import sumolib
from numpy.typing import NDArray

from tint_sumo.scenes.geometry import Bools, Boxes, Floats, Numbers

BESIDE_M = 1.0  # beyond a lane's border a vehicle's front is on no lane
_LEAST_COSINE = 0.5  # of the angle between a vehicle and its lane
_TANGENT_M = 0.5
_UNSURE_M = 1.0  # a vehicle is on a lane that is so much farther away than another one only on a wrong map
_SPACING_M = 2.0  # between positions from which a route is found
_GAP_M = 200.0  # edges in which no position was found are filled in up to this length
_NO_LANE = -1
_NO_CARS = ("crossing", "walkingarea")  # functions of edges


@dataclass(frozen=True, eq=False)
class Matched:
    """The track of a vehicle on the network."""

    route: tuple[str, ...]  # edges; empty where it is on none
    on_road: Bools  # (R,)
    keeps_route: bool


@dataclass(frozen=True, eq=False)
class Position:
    """Positions on a route; all (R,)."""

    lane: NDArray[np.int64]  # number of the lane, or -1
    lane_m: Floats  # along it
    route_m: Floats  # along the route


class Lanes:
    """The lanes of a network on which vehicles drive, those on junctions included."""

    def __init__(self, net: Any) -> None:
        self.net = net
        self.lanes = [lane for edge in net.getEdges() if edge.getFunction() not in _NO_CARS for lane in edge.getLanes()]
        self.lines = np.array([shapely.LineString(lane.getShape()) for lane in self.lanes], object)
        self.half_width_m = np.array([lane.getWidth() for lane in self.lanes]) / 2.0
        self.edges = [lane.getEdge() for lane in self.lanes]
        self.is_internal = np.array([edge.getFunction() == "internal" for edge in self.edges], bool)

    @cached_property
    def _tree(self) -> Any:
        return shapely.STRtree(self.lines)

    def near(self, boxes: Boxes, *, any_heading: bool = False) -> tuple[Numbers, Numbers, Floats]:
        """Find the lanes under the fronts of vehicles that head as the lane does, or anywhere.

        Returns:
            indices of the boxes, numbers of lanes, and distances from the lanes' middle; (M,) each.
        """
        fronts = fronts_of(boxes)
        reach_m = float(self.half_width_m.max()) + BESIDE_M
        index, lane = self._tree.query(fronts, predicate="dwithin", distance=reach_m)
        beside_m = shapely.distance(fronts[index], self.lines[lane])
        cosine = _cosines(boxes[index], fronts[index], self.lines[lane])
        fits = (beside_m <= self.half_width_m[lane] + BESIDE_M) & (any_heading | (cosine >= _LEAST_COSINE))
        return index[fits], lane[fits], beside_m[fits]

    def match(self, boxes: Boxes, driven_m: Floats) -> Matched:
        """Find the route of a vehicle, whose boxes (R,) have come so far (R,)."""
        index, lane, beside_m = self.near(boxes)
        on_road = np.zeros(len(boxes), bool)
        on_road[index] = True
        nearest_m = np.full(len(boxes), np.inf)
        np.minimum.at(nearest_m, index, beside_m)
        likely = beside_m <= nearest_m[index] + _UNSURE_M
        route = self._with_ends(self._edges_under(boxes, driven_m, index[likely], lane[likely]), lane[likely])
        if not route:
            return Matched((), np.zeros(len(boxes), bool), keeps_route=False)
        on_route = np.zeros(len(boxes), bool)
        ways = np.isin(lane, self.of_route(route)[0])
        on_route[index[ways]] = True
        return Matched(route, on_road, keeps_route=bool((on_route | ~on_road).all()))

    def match_walker(self, boxes: Boxes) -> Matched:
        """Find where somebody on foot, or on a bicycle, is on a lane; the route is only an edge there."""
        index, lane, _ = self.near(boxes, any_heading=True)
        on_edges = lane[~self.is_internal[lane]]
        on_road = np.zeros(len(boxes), bool)
        if len(on_edges) == 0:
            return Matched((), on_road, keeps_route=False)
        on_road[index] = True
        return Matched((self.edges[on_edges[0]].getID(),), on_road, keeps_route=False)

    def limit_mps(self, route: Sequence[str]) -> float:
        """Return the highest speed limit on a route; on all roads for none."""
        edges = [self.net.getEdge(edge) for edge in route] or self.edges
        return max(float(edge.getSpeed()) for edge in edges)

    def of_route(self, route: Sequence[str]) -> tuple[Numbers, Floats]:
        """Return the numbers of the lanes of a route, and where each begins along the route; (L,) both."""
        known = self._numbers
        numbers, starts_m, start_m = [], [], 0.0
        edges = [self.net.getEdge(edge) for edge in route]
        for edge, after in pairwise([*edges, None]):
            numbers += [known[lane.getID()] for lane in edge.getLanes()]
            starts_m += [start_m] * len(edge.getLanes())
            start_m += float(edge.getLength())
            ways = edge.getOutgoing().get(after, []) if after is not None else []
            lengths_m = []
            for way in ways:
                inner = self._inner(way)
                numbers += inner
                lengths_m.append(0.0)
                for number in inner:
                    starts_m.append(start_m + lengths_m[-1])
                    lengths_m[-1] += float(self.lanes[number].getLength())
            start_m += min(lengths_m, default=0.0)
        return np.array(numbers, np.int64), np.array(starts_m)

    @cached_property
    def _numbers(self) -> dict[str, int]:
        return {lane.getID(): number for number, lane in enumerate(self.lanes)}

    def _inner(self, way: Any) -> list[int]:
        """Return the numbers of the lanes on a junction by which a connection leads over it."""
        known = self._numbers
        found: list[int] = []
        via = way.getViaLaneID()
        while via and via in known and known[via] not in found:
            found.append(known[via])
            ways = [way for way in self.lanes[known[via]].getOutgoing() if way.getViaLaneID()]
            via = ways[0].getViaLaneID() if ways else ""
        return found

    def along(self, route: Sequence[str], boxes: Boxes) -> Position:
        """Return where on a route the fronts of vehicles (R,) are."""
        numbers, starts_m = self.of_route(route)
        start_m = dict(zip(numbers.tolist(), starts_m.tolist(), strict=True))
        lane_of, lane_m, route_m = np.full(len(boxes), _NO_LANE), np.zeros(len(boxes)), np.full(len(boxes), np.nan)
        index, lane, beside_m = self.near(boxes)
        fronts = fronts_of(boxes)
        for place in np.argsort(-beside_m, kind="stable").tolist():  # the nearest lane comes last
            number = int(lane[place])
            if number in start_m:
                line, row = self.lines[number], int(index[place])
                stretch = float(self.lanes[number].getLength()) / line.length
                lane_of[row] = number
                lane_m[row] = line.project(fronts[row]) * stretch
                route_m[row] = start_m[number] + lane_m[row]
        return Position(lane_of, lane_m, route_m)

    def _edges_under(self, boxes: Boxes, driven_m: Floats, index: Numbers, lane: Numbers) -> list[Any]:
        """Return the connected edges that most of a vehicle's positions are on."""
        on_edges = ~self.is_internal[lane]
        candidates: dict[int, set[str]] = {}
        for row, number in zip(index[on_edges].tolist(), lane[on_edges].tolist(), strict=True):
            candidates.setdefault(row, set()).add(self.edges[number].getID())
        rows, last_m = [], -np.inf
        for row in sorted(candidates):
            if driven_m[row] - last_m >= _SPACING_M:
                rows.append(row)
                last_m = driven_m[row]
        if not rows:
            return []
        trace = [(point.x, point.y) for point in fronts_of(boxes[rows])]
        vias = {place: sorted(candidates[row]) for place, row in enumerate(rows)}
        edges = sumolib.route.mapTrace(trace, self.net, 0.0, direction=True, fillGaps=_GAP_M, vias=vias)
        runs: list[list[Any]] = [[]]
        for edge in (edge for edge, _ in groupby(edges)):
            if runs[-1] and edge not in runs[-1][-1].getOutgoing():
                runs.append([])
            runs[-1].append(edge)
        names = [{edge.getID() for edge in run} for run in runs]
        counts = [sum(not candidates[row].isdisjoint(run) for row in rows) for run in names]
        return runs[int(np.argmax(counts))]

    def _with_ends(self, run: list[Any], lane: Numbers) -> tuple[str, ...]:
        """Return a route with the edges from which and to which a vehicle crosses junctions at its ends.

        There is always one to follow, straight on if nothing is known: nobody arrives where a recording ends.

        Args:
            run: edges that a vehicle is on; none if it is only seen on a junction.
            lane: (M,) numbers of all lanes that it is likely to be on.
        """
        seen = Counter(way for number in lane.tolist() for way in self._ways_over.get(number, ()))
        if not run:
            best = max(seen, key=seen.__getitem__, default=None)
            return () if best is None else (best.getFrom().getID(), best.getTo().getID())
        before = [way for way in seen if way.getTo() is run[0]]
        after = [way for ways in run[-1].getOutgoing().values() for way in ways if way.getTo().getFunction() == ""]
        first = [max(before, key=seen.__getitem__).getFrom()] if before else []
        last = [max(after, key=lambda way: (seen[way], way.getDirection() == "s")).getTo()] if after else []
        return tuple(edge.getID() for edge in [*first, *run, *last])

    @cached_property
    def _ways_over(self) -> dict[int, list[Any]]:
        """Connections that lead over each lane on a junction, by its number."""
        found: dict[int, list[Any]] = {}
        for edge in self.net.getEdges(withInternal=False):
            for way in (way for ways in edge.getOutgoing().values() for way in ways):
                for number in self._inner(way):
                    found.setdefault(number, []).append(way)
        return found


def fronts_of(boxes: Boxes) -> NDArray[np.object_]:
    """Return the middles of the fronts of boxes (R,) as points."""
    half_m = boxes["length_m"] / 2.0
    points = shapely.points(boxes["x_m"] + half_m * boxes["heading_x"], boxes["y_m"] + half_m * boxes["heading_y"])
    return np.asarray(points, object).reshape(len(boxes))


def _cosines(boxes: Boxes, fronts: NDArray[np.object_], lines: NDArray[np.object_]) -> Floats:
    """Return the cosines of the angles between vehicles and lines at their fronts; (M,)."""
    along_m = shapely.line_locate_point(lines, fronts)
    ends = [
        shapely.line_interpolate_point(lines, np.clip(along_m + off_m, 0.0, shapely.length(lines)))
        for off_m in (-_TANGENT_M, _TANGENT_M)
    ]
    dx_m, dy_m = (axis(ends[1]) - axis(ends[0]) for axis in (shapely.get_x, shapely.get_y))
    norm_m = np.maximum(np.hypot(dx_m, dy_m), 1e-9)
    return np.asarray((boxes["heading_x"] * dx_m + boxes["heading_y"] * dy_m) / norm_m)
