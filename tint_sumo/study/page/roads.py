"""The roads of a scene as the page's player draws them."""

from typing import Any

import numpy as np
import shapely

from tint_sumo.films.frames import HALO_M, LEAST_WEIGHT
from tint_sumo.scenes import Scene
from tint_sumo.scenes.geometry import SPACING_M, Floats, as_line
from tint_sumo.scenes.layout import layout

_TOLERANCE_M = 0.02


def scene_shapes(scene: Scene) -> dict[str, Any]:
    """Return the shapes of a scene as SVG paths in m; y leads down the picture, as in SVG.

    ``view`` is left, top, width and height.
    """
    roads, view, task = layout(scene), scene.view, scene.ego
    half_m = scene.network.lane_width_m / 2
    lanes = [as_line(_part(path.way, 0.0, path.length_m)) for path in roads.routes]
    borders = [lane.offset_curve(side_m) for lane in lanes for side_m in (half_m, -half_m)]
    return {
        "view": [view.left_m, -view.top_m, view.right_m - view.left_m, view.top_m - view.bottom_m],
        "roads": "".join(_path(ring, closed=True) for area in roads.roads.paved.geometries for ring in _rings(area)),
        "borders": "".join(_path(shapely.get_coordinates(border)) for border in borders),
        "lane_width_m": scene.network.lane_width_m,
        "routes": {
            route.name: _path(shapely.get_coordinates(lane)) for route, lane in zip(scene.routes, lanes, strict=True)
        },
        "way": _path(shapely.get_coordinates(as_line(_part(roads.ego.way, task.start_m, task.goal_m)))),
        "vehicle": {"length_m": scene.vehicle.length_m, "width_m": scene.vehicle.width_m},
        "traits": [profile.name for profile in scene.population.profiles],
        "step_s": scene.step_s,
        "halo_m": HALO_M,
        "least_weight": LEAST_WEIGHT,
    }


def _part(way: Floats, from_m: float, to_m: float) -> Floats:
    part: Floats = way[round(from_m / SPACING_M) : round(to_m / SPACING_M)]
    return part


def _rings(area: shapely.Geometry) -> list[Floats]:
    """Return outlines and holes."""
    polygons = shapely.get_parts(shapely.simplify(area, _TOLERANCE_M))
    rings = [ring for polygon in polygons for ring in (polygon.exterior, *polygon.interiors)]
    return [shapely.get_coordinates(ring) for ring in rings]


def _path(points_m: Floats, *, closed: bool = False) -> str:
    flipped = np.round(points_m * [1.0, -1.0], 2) + 0.0  # no minus zero
    return "M" + "L".join(f"{x:g} {y:g}" for x, y in flipped.tolist()) + ("Z" if closed else "")
