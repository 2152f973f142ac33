"""The routes of a scene in its network, and the zones in which the ego's way meets them; computed once.

Routes have numbers, in the order of the scene's traffic. Vehicles are located by ``front_m``, the distance of
their front bumper from the route's start; SUMO reports positions of the front bumper on its lanes, too.
"""

import tempfile
from bisect import bisect_right
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from itertools import pairwise
from pathlib import Path as FilePath
from typing import Any

import numpy as np
import shapely
import sumolib
from numpy.typing import NDArray
from shapely.geometry.base import BaseGeometry

from tint_sumo.config import Population, Traffic
from tint_sumo.core.errors import InputError
from tint_sumo.scenes.geometry import SPACING_M, Boxes, Floats, along, new_boxes, place, resample
from tint_sumo.scenes.network import Point, build_network, name, plain_xml
from tint_sumo.scenes.roads import Roads, border_marks, paved_areas
from tint_sumo.scenes.scene import Scene

_SWEEP_SPACING_M = 0.05  # between the poses of the ego whose boxes make up its swept area
_STOP_MARGIN_M = 0.05  # more than the ego's modelled way may differ from SUMO's
_PRECISION_M = 1e-6
_COLLINEAR_M = 1e-9  # points of a way that lie so close to a straight line add nothing but time
_SEAM_M = 0.02  # joins junctions to their roads in spite of rounding
EGO = "ego"  # the name of its route
_FIRST = ".0_"  # the first replica in ids of lanes


@dataclass(frozen=True, eq=False)
class Path:
    """The SUMO lanes of a route, those on junctions included, and its way."""

    lanes: tuple[str, ...]  # ids, with ``{replica}`` for the replica's number
    lane_start_m: Floats  # (S,): where each of them starts
    length_m: float
    way: Floats  # (P, 2): see ``tint_sumo.scenes.geometry``

    def lane_at(self, front_m: float) -> tuple[int, float]:
        """Return the number of the lane at a distance from the route's start, and the position on it."""
        starts_m = self.lane_start_m.tolist()
        lane = bisect_right(starts_m, front_m) - 1
        return lane, front_m - starts_m[lane]


@dataclass(frozen=True, eq=False)
class ConflictZones:
    """The zones in which the ego's way meets the K routes of the traffic, as arc lengths; infinite where it does not.

    The ego's are those of its front: where it (or its box, see ``tint_sumo.config.Claim``) enters the route's
    lane, where it stands in the vehicles' path, and where its centre has left the lane on the other side (never, where
    it merges).
    """

    enter_m: Floats  # (K,)
    inside_m: Floats  # (K,)
    passed_m: Floats  # (K,)
    stop_line_m: Floats  # (K,): of the route; a vehicle that stands short of it never comes near the ego's box
    towards: Floats  # (K, P): share of the ego's speed that leads it into the route's lane, along its way


@dataclass(frozen=True, eq=False)
class Layout:
    scene: Scene
    routes: tuple[Path, ...]
    ego: Path
    zones: ConflictZones
    lane_start_m: Floats  # (K, S): where each lane of a route starts; infinite beyond the last
    lane_on_route_m: (
        Floats  # (K, K, S): where on the first route each lane of the second one starts; NaN if it does not
    )
    ways: Floats  # (K, P, 2)
    roads: Roads


@lru_cache(maxsize=16)
def layout(scene: Scene) -> Layout:
    """Return the layout of a scene, whose network is built once for all drivers and time limits.

    Raises:
        InputError: a route does not exist or is not connected, or the scene does not fit its network.
    """
    same_roads = replace(
        scene, traffic=Traffic(), population=Population(), time_limit_s=Scene.time_limit_s, buildings=()
    )
    return replace(_layout(same_roads), scene=scene)


@lru_cache(maxsize=16)
def _layout(scene: Scene) -> Layout:
    net = _read(scene)
    routes = tuple(_path(net, route.name, route.edges, scene, ()) for route in scene.routes)
    ego = _path(net, EGO, scene.ego.edges, scene, scene.ego.way)
    if scene.ego.goal_m > ego.length_m:
        raise InputError(f"the ego's goal ({scene.ego.goal_m:g} m) lies beyond its route ({ego.length_m:g} m)")
    points = max(len(path.way) for path in routes)
    return Layout(
        scene=scene,
        routes=routes,
        ego=ego,
        zones=_zones(scene, routes, ego.way),
        lane_start_m=_padded([path.lane_start_m for path in routes]),
        lane_on_route_m=_shared_lanes(routes),
        ways=np.stack([resample(path.way, (points - 2) * SPACING_M)[:points] for path in routes]),
        roads=_roads(net, scene, routes),
    )


def _read(scene: Scene) -> Any:
    """Return the network of one replica, as sumolib reads it."""
    with tempfile.TemporaryDirectory(prefix="tint_sumo.") as folder:
        file = FilePath(folder) / "net.xml"
        file.write_text(build_network(plain_xml(scene.network, replicas=1)), encoding="utf-8")
        return sumolib.net.readNet(str(file), withInternal=True)


def _roads(net: Any, scene: Scene, routes: Sequence[Path]) -> Roads:
    """Return the area of all lanes and junctions, in one piece, and the marks along the routes."""
    paved = shapely.union_all(paved_areas(net, seam_m=_SEAM_M))
    ways = [path.way[: round(path.length_m / SPACING_M)] for path in routes]
    marks = [mark for way in ways for mark in border_marks(way, scene.network.lane_width_m)]
    return Roads(shapely.STRtree([paved]), shapely.STRtree(marks))


def _path(net: Any, route: str, edges: tuple[str, ...], scene: Scene, way: tuple[Point, ...]) -> Path:
    """Return the path along some edges; ``way`` in place of the lanes' shapes if it is given."""
    lanes = _lanes(net, route, [name(edge, 0) for edge in edges])
    length_m = np.array([lane.getLength() for lane in lanes])
    shortest_m = scene.network.speed_limit_mps * scene.step_s
    if route != EGO and length_m.min() < shortest_m:
        raise InputError(f"route {route!r} has a lane of {length_m.min():.2f} m; make it {shortest_m:g} m or longer")
    points = np.array(way or [point for lane in lanes for point in lane.getShape()], float)
    total_m = float(length_m.sum())
    return Path(
        lanes=tuple(lane.getID().replace(_FIRST, ".{replica}_", 1) for lane in lanes),
        lane_start_m=np.r_[0.0, np.cumsum(length_m)[:-1]],
        length_m=total_m,
        way=resample(points, total_m),
    )


def _lanes(net: Any, route: str, edges: Sequence[str]) -> list[Any]:
    """Return the lanes along some edges, with those on the junctions between them."""
    unknown = [edge for edge in edges if not net.hasEdge(edge)]
    if unknown:
        raise InputError(f"route {route!r}: the network has no edge {unknown[0]!r}")
    lanes = [net.getEdge(edges[0]).getLane(0)]
    for before, after in pairwise(edges):
        ways = [way for way in lanes[-1].getOutgoing() if way.getToLane().getEdge().getID() == after]
        if not ways:
            raise InputError(f"route {route!r}: no way leads from edge {before!r} to edge {after!r}")
        via = ways[0].getViaLaneID()
        while via:  # a junction's lane can consist of two, with a place to wait between them
            lanes.append(net.getLane(via))
            via = lanes[-1].getOutgoing()[0].getViaLaneID()
        lanes.append(ways[0].getToLane())
    return lanes


def _padded(rows: Sequence[Floats]) -> Floats:
    """Return rows of different lengths as a matrix, infinite where they have ended."""
    matrix = np.full((len(rows), max(map(len, rows))), np.inf)
    for row, values in zip(matrix, rows, strict=True):
        row[: len(values)] = values
    return matrix


def _shared_lanes(routes: Sequence[Path]) -> Floats:
    starts_m = np.full((len(routes), len(routes), max(len(path.lanes) for path in routes)), np.nan)
    for this, path in enumerate(routes):
        start_m = dict(zip(path.lanes, path.lane_start_m.tolist(), strict=True))
        for other, theirs in enumerate(routes):
            for stage, lane in enumerate(theirs.lanes):
                starts_m[this, other, stage] = start_m.get(lane, np.nan)
    return starts_m


def _zones(scene: Scene, routes: Sequence[Path], way: Floats) -> ConflictZones:
    """Return the zones in which the ego's way meets the routes."""
    fronts_m = along(way)
    egos = new_boxes(len(way), scene.vehicle.length_m, scene.vehicle.width_m)
    place(fronts_m, way, egos)
    centres = np.stack([egos["x_m"], egos["y_m"]], axis=-1)
    ahead = fronts_m >= scene.ego.start_m
    boxes = _polygons(egos)
    swept = _swept_area(scene, way)
    half_m = scene.network.lane_width_m / 2
    enter_m, inside_m, passed_m, stop_line_m, towards = [], [], [], [], []
    for route, path in zip(scene.routes, routes, strict=True):
        middle = shapely.LineString(path.way).simplify(_COLLINEAR_M)
        off_m = shapely.distance(shapely.points(way) if scene.claim.by == "front" else boxes, middle)
        if off_m[ahead.argmax()] < half_m:
            raise InputError(f"the ego's start lies on route {route.name!r}; let it start beside the traffic")
        centre_off_m = shapely.distance(shapely.points(centres), middle)
        enter_m.append(_first_m(off_m - half_m, ahead))
        inside_m.append(_first_m(off_m - half_m + scene.claim.path_margin_m, ahead))
        passed_m.append(_first_m(half_m - centre_off_m, ahead & (np.minimum.accumulate(centre_off_m) < half_m)))
        stop_line_m.append(_first_contact_m(path, swept, scene.vehicle.width_m))
        towards.append(-np.gradient(off_m, SPACING_M))
    return ConflictZones(
        np.array(enter_m), np.array(inside_m), np.array(passed_m), np.array(stop_line_m), np.stack(towards)
    )


def _first_m(values: Floats, considered: NDArray[np.bool_]) -> float:
    """Return the arc length at which considered values along a way first fall below 0; infinite if never."""
    below = considered & (values < 0.0)
    if not below.any():
        return np.inf
    index = int(below.argmax())
    before, after = values[max(index - 1, 0)], values[index]
    part = before / (before - after) if before >= 0.0 else 1.0
    return float((index - 1 + part) * SPACING_M)


def _swept_area(scene: Scene, way: Floats) -> BaseGeometry:
    """Return the area that a vehicle must keep out of, and a little more, lest the ego's safety check holds the ego."""
    vehicle = scene.vehicle
    end_m = min(scene.ego.goal_m + vehicle.length_m, (len(way) - 2) * SPACING_M)
    fronts_m: Floats = np.arange(scene.ego.start_m, end_m, _SWEEP_SPACING_M)
    egos = new_boxes(len(fronts_m), vehicle.length_m, vehicle.width_m)
    place(fronts_m, way, egos)
    margin_m = scene.ego.controller.unsafe_distance_m + _STOP_MARGIN_M
    swept = shapely.buffer(shapely.union_all(_polygons(egos)), margin_m)
    shapely.prepare(swept)
    return swept


def _polygons(boxes: Boxes) -> NDArray[Any]:
    """Return boxes (N,) as polygons (N,)."""
    ahead = np.stack([boxes["heading_x"], boxes["heading_y"]], axis=-1) * (boxes["length_m"] / 2)[:, None]
    abreast = np.stack([-boxes["heading_y"], boxes["heading_x"]], axis=-1) * (boxes["width_m"] / 2)[:, None]
    centre = np.stack([boxes["x_m"], boxes["y_m"]], axis=-1)
    corners = [centre + ahead + abreast, centre + ahead - abreast, centre - ahead - abreast, centre - ahead + abreast]
    return np.asarray(shapely.polygons(np.stack(corners, axis=1)))


def _first_contact_m(path: Path, area: BaseGeometry, width_m: float) -> float:
    """Return the arc length at which a vehicle's front first touches an area; infinite if it never does."""

    def touches(along_m: Floats) -> NDArray[np.bool_]:
        index = np.clip((along_m / SPACING_M).astype(int), 0, len(path.way) - 2)
        start, step = path.way[index], path.way[index + 1] - path.way[index]
        point = start + (along_m / SPACING_M - index)[:, None] * step
        across = np.stack([-step[:, 1], step[:, 0]], axis=-1) / np.hypot(*step.T)[:, None] * (width_m / 2)
        lines = shapely.linestrings(np.stack([point - across, point + across], axis=1))
        return np.asarray(shapely.intersects(area, lines))

    along_m = along(path.way[:-1])
    found = touches(along_m)
    if not found.any():
        return np.inf
    high_m = float(along_m[found.argmax()])
    low_m = high_m - SPACING_M
    while high_m - low_m > _PRECISION_M:
        middle_m = (low_m + high_m) / 2
        low_m, high_m = (low_m, middle_m) if touches(np.array([middle_m]))[0] else (middle_m, high_m)
    return high_m
