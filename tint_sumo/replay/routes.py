"""Routes over the lanes on which vehicles were recorded, and lengths along them."""

from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from functools import cached_property
from itertools import groupby, pairwise
from typing import Any, NamedTuple

import numpy as np
import shapely

from tint_sumo.scenes.sumocfg import EGO_CLASS

_JUNCTION = ":"  # lanes and edges on junctions begin so
NO_LANE = ""


def is_on_edge(lane: str) -> bool:
    """Return whether there is such a lane, and it is on no junction."""
    return lane != NO_LANE and not lane.startswith(_JUNCTION)


class _Ahead(NamedTuple):
    """Number of edges of a route that a lane reaches, and the connection to the next of them."""

    edges: int  # number of edges of the route, its own included, that an ego reaches without changing lanes
    way: Any  # sumolib's connection to the lane on the next of these edges; None on the last


def _ahead(lane: Any, after: Mapping[str, _Ahead]) -> _Ahead:
    """Return how many edges a lane reaches, from the numbers that the lanes of the next edge reach, by their ids."""
    ways = [way for way in lane.getOutgoing() if way.getToLane().getID() in after]
    best = max(ways, key=lambda way: after[way.getToLane().getID()].edges, default=None)
    return _Ahead(1, None) if best is None else _Ahead(1 + after[best.getToLane().getID()].edges, best)


class Routes:
    """The routes through a network, as sumolib has read it."""

    def __init__(self, net: Any) -> None:
        self.net = net

    def of(self, lanes: Sequence[str]) -> tuple[str, ...]:
        """Return the connected edges that most of a vehicle's positions are on; none if there are no lanes.

        Args:
            lanes: (R,) ids of the lanes that it was on, one after the other, ``NO_LANE`` where on none.
        """
        edges = [self.net.getLane(lane).getEdge() for lane in lanes if is_on_edge(lane)]
        runs: list[list[Any]] = [[]]
        counts = [0]
        for edge, rows in groupby(edges):
            if runs[-1] and edge not in runs[-1][-1].getOutgoing():
                runs.append([])
                counts.append(0)
            runs[-1].append(edge)
            counts[-1] += len(list(rows))
        return self._with_ends(runs[int(np.argmax(counts))], lanes)

    def _with_ends(self, run: list[Any], lanes: Iterable[str]) -> tuple[str, ...]:
        """Return a route with the edges from which and to which a vehicle crosses junctions at its ends.

        There is always one to follow, straight on if nothing is known: nobody arrives where a recording ends.
        """
        seen = Counter(way for lane in lanes for way in self._ways_over.get(lane, ()))
        if not run:
            best = max(seen, key=seen.__getitem__, default=None)
            return () if best is None else (best.getFrom().getID(), best.getTo().getID())
        before = [way for way in seen if way.getTo() is run[0]]
        after = [way for ways in run[-1].getOutgoing().values() for way in ways if way.getTo().getFunction() == ""]
        first = [max(before, key=seen.__getitem__).getFrom()] if before else []
        last = [max(after, key=lambda way: (seen[way], way.getDirection() == "s")).getTo()] if after else []
        return tuple(edge.getID() for edge in [*first, *run, *last])

    @cached_property
    def _ways_over(self) -> dict[str, list[Any]]:
        """Connections that lead over each lane on a junction, by its id."""
        found: dict[str, list[Any]] = {}
        for edge in self.net.getEdges(withInternal=False):
            for way in (way for ways in edge.getOutgoing().values() for way in ways):
                for lane in self._inner(way):
                    found.setdefault(lane, []).append(way)
        return found

    def _inner(self, way: Any) -> list[str]:
        """Return the ids of the lanes on a junction by which a connection leads over it."""
        found: list[str] = []
        lane = way.getViaLaneID()
        while lane and lane not in found:
            found.append(lane)
            further = [after.getViaLaneID() for after in self.net.getLane(lane).getOutgoing() if after.getViaLaneID()]
            lane = further[0] if further else ""
        return found

    def limit_mps(self, route: Sequence[str]) -> float:
        """Return the highest speed limit on a route; on all roads for none."""
        edges = [self.net.getEdge(edge) for edge in route] or self.net.getEdges(withInternal=False)
        return max(float(edge.getSpeed()) for edge in edges)

    def lane_starts_m(self, route: Sequence[str]) -> dict[str, float]:
        """Return where each lane of a route begins along it, by the lanes' ids; lanes on junctions included."""
        found: dict[str, float] = {}
        start_m = 0.0
        edges = [self.net.getEdge(edge) for edge in route]
        for edge, after in pairwise([*edges, None]):
            found |= {lane.getID(): start_m for lane in edge.getLanes()}
            start_m += float(edge.getLength())
            lengths_m = []
            for way in edge.getOutgoing().get(after, []) if after is not None else []:
                lengths_m.append(0.0)
                for lane in self._inner(way):
                    found[lane] = start_m + lengths_m[-1]
                    lengths_m[-1] += float(self.net.getLane(lane).getLength())
            start_m += min(lengths_m, default=0.0)
        return found

    def ego_lanes(self, route: Sequence[str]) -> list[tuple[str, list[str]]]:
        """Return the lanes that an ego takes: one on each edge of a route, and those over the junction behind it.

        It stays in its lane if that leads on. Otherwise, and at first, it takes the lane that leads on over most edges.
        """
        found: list[tuple[str, list[str]]] = []
        entered = ""
        for open_lanes in self._open_lanes(route):
            lane, (_, way) = max(
                open_lanes.items(), key=lambda one: (one[1].way is not None, one[0] == entered, one[1].edges)
            )
            entered = "" if way is None else way.getToLane().getID()
            found.append((lane, [] if way is None else self._inner(way)))
        return found

    def _open_lanes(self, route: Sequence[str]) -> list[dict[str, "_Ahead"]]:
        """Return how many edges each lane that is open to an ego reaches, by its id, for each edge of a route."""
        found: list[dict[str, _Ahead]] = [{}]
        for edge in reversed(route):
            after = found[0]
            lanes = (lane for lane in self.net.getEdge(edge).getLanes() if lane.allows(EGO_CLASS))
            found.insert(0, {lane.getID(): _ahead(lane, after) for lane in lanes})
        return found[:-1]

    def edge_starts_m(self, route: Sequence[str]) -> tuple[float, ...]:
        """Return where each edge of a route begins along it."""
        lanes = self.lane_starts_m(route)
        return tuple(lanes[self.net.getEdge(edge).getLanes()[0].getID()] for edge in route)

    @cached_property
    def _tree(self) -> tuple[Any, list[str]]:
        lanes = [lane for edge in self.net.getEdges(withInternal=False) for lane in edge.getLanes()]
        return shapely.STRtree([shapely.LineString(lane.getShape()) for lane in lanes]), [
            lane.getEdge().getID() for lane in lanes
        ]

    def nearest(self, x_m: float, y_m: float) -> str:
        """Return the edge that is nearest to a position."""
        tree, edges = self._tree
        return edges[int(tree.nearest(shapely.Point(x_m, y_m)))]
