"""Lanes of a SUMO network as arrays, and which lanes can be reached from which."""

from dataclasses import dataclass
from heapq import heappop, heappush
from pathlib import Path
from typing import Any
from xml.sax import SAXException

import numpy as np
import shapely
import sumolib
from numpy.typing import NDArray

from tint_sumo.core.errors import InputError
from tint_sumo.core.reading import TABLE_BYTES, require_file

_CHANGE_M = 5.0  # a way with a change of lanes is taken if it is shorter by more
_ROADS = ("", "internal", "connector")  # functions of edges that vehicles drive on


@dataclass(frozen=True)
class Lanes:
    """All lanes that vehicles drive on, also those over junctions; N of them."""

    file: Path
    ids: list[str]
    edges: list[str]
    edge: NDArray[np.int64]  # (N,) number of each lane's edge
    on_junction: NDArray[np.bool_]  # (N,)
    lines: NDArray[np.object_]  # (N,) centre lines
    width_m: NDArray[np.float64]  # (N,)
    length_m: NDArray[np.float64]  # (N,) as SUMO counts positions, which may differ from the length of the line
    successors: list[list[int]]
    beside: list[list[int]]  # lanes of the same edge that a vehicle can change to
    projection: str | None  # PROJ string, if the network lies on Earth
    offset_m: tuple[float, float]  # from coordinates of the projection to those of the network

    @property
    def extent_m(self) -> tuple[float, float, float, float]:
        """Return left, bottom, right and top."""
        left, bottom, right, top = shapely.total_bounds(self.lines)
        return float(left), float(bottom), float(right), float(top)


@dataclass(frozen=True)
class Reach:
    """Lanes that can be reached from each lane, in rows from ``first[lane]`` to ``first[lane + 1]``."""

    first: NDArray[np.int64]  # (N + 1,)
    lane: NDArray[np.int64]  # (R,)
    distance_m: NDArray[np.float64]  # (R,) from the beginning of one lane to that of the other
    changes: NDArray[np.int64]  # (R,) of lanes on the way


def read_lanes(net_file: Path) -> Lanes:
    """Read the lanes of a SUMO network.

    Raises:
        InputError: there is no such file, it is no network, or it has no lanes for vehicles.
    """
    require_file(net_file, "network", TABLE_BYTES)
    try:
        net = sumolib.net.readNet(str(net_file), withInternal=True)
        lanes = [lane for edge in net.getEdges() if edge.getFunction() in _ROADS for lane in edge.getLanes()]
    except (SAXException, SyntaxError, ValueError, KeyError, AttributeError, OSError, EOFError) as error:
        raise InputError(f"{net_file} is no network that SUMO reads ({' '.join(str(error).split())})") from None
    lanes = [lane for lane in lanes if any(lane.allows(kind) for kind in ("passenger", "bus", "truck", "bicycle"))]
    if not lanes:
        raise InputError(f"{net_file} has no lanes for vehicles; give a SUMO network (.net.xml)")
    number = {lane.getID(): index for index, lane in enumerate(lanes)}
    edges = list(dict.fromkeys(lane.getEdge().getID() for lane in lanes))
    edge_number = {edge: index for index, edge in enumerate(edges)}
    on_junction = [lane.getEdge().isSpecial() for lane in lanes]
    siblings = [[number.get(other.getID()) for other in lane.getEdge().getLanes()] for lane in lanes]
    projected = net.hasGeoProj()
    return Lanes(
        net_file,
        list(number),
        edges,
        np.array([edge_number[lane.getEdge().getID()] for lane in lanes]),
        np.array(on_junction),
        np.array([shapely.LineString(_distinct(lane.getShape())) for lane in lanes], object),
        np.array([lane.getWidth() for lane in lanes]),
        np.array([lane.getLength() for lane in lanes]),
        [[number[after] for after in _next(lane) if after in number] for lane in lanes],
        [
            [] if special else [other for other in beside if other is not None and other != index]
            for index, (beside, special) in enumerate(zip(siblings, on_junction, strict=True))
        ],
        net._location["projParameter"] if projected else None,
        tuple(net.getLocationOffset()),
    )


def _next(lane: Any) -> list[str]:
    """Return the lanes behind a lane: those over the junction, where the network has them."""
    return [one.getViaLaneID() or one.getToLane().getID() for one in lane.getOutgoing()]


def _distinct(points: list[tuple[float, ...]]) -> list[tuple[float, float]]:
    """Return the points of a line, of which the first two differ, as a line without length has no direction."""
    flat = [(point[0], point[1]) for point in points]
    return flat if len(set(flat)) > 1 else [flat[0], (flat[0][0] + 1e-3, flat[0][1])]


def reach(lanes: Lanes, most_m: float) -> Reach:
    """Find the lanes that begin within a distance of the end of each lane, or lie beside such a lane."""
    found = [_reached(lanes, lane, lanes.length_m[lane] + most_m) for lane in range(len(lanes.ids))]
    first = np.cumsum([0, *map(len, found)])
    rows = np.array([(lane, *way) for ways in found for lane, way in ways.items()], np.float64).reshape(-1, 3)
    return Reach(first, rows[:, 0].astype(np.int64), rows[:, 1].copy(), rows[:, 2].astype(np.int64))


def _reached(lanes: Lanes, start: int, most_m: float) -> dict[int, tuple[float, int]]:
    """Return distance and changes of lanes on the best way to each lane that can be reached."""
    found: dict[int, tuple[float, int]] = {}
    ways = [(0.0, 0.0, 0, start)]  # costs, distance, changes, lane
    while ways:
        costs, distance_m, changes, lane = heappop(ways)
        if lane in found or distance_m > most_m:
            continue
        found[lane] = (distance_m, changes)
        for after in lanes.successors[lane]:
            further_m = float(lanes.length_m[lane])
            heappush(ways, (costs + further_m, distance_m + further_m, changes, after))
        for beside in lanes.beside[lane]:
            heappush(ways, (costs + _CHANGE_M, distance_m, changes + 1, beside))
    return found
