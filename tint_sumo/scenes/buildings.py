"""Buildings at the corners of a scene's roads, which hide vehicles from the ego."""

from functools import lru_cache

import shapely

from tint_sumo.scenes.layout import layout
from tint_sumo.scenes.scene import Building, Scene

_LEAST_M2 = 4.0  # pieces of ground that are smaller are too small for a building
_ROUNDING_M = 0.05  # outlines have as few points as they can have within this


@lru_cache(maxsize=16)
def corner_buildings(scene: Scene, setback_m: float) -> tuple[Building, ...]:
    """Return a building for each piece of ground between the roads of a scene, which it fills up to the setback.

    The ground ends where the roads do; an island that roads enclose stays empty.

    Args:
        scene: the scene.
        setback_m: distance from the roads.
    """
    paved = shapely.union_all(layout(scene).roads.paved.geometries)
    ground = shapely.box(*paved.bounds)
    pieces = shapely.get_parts(ground.difference(paved.buffer(setback_m, join_style="mitre")))
    built = sorted(
        (piece for piece in pieces if piece.area > _LEAST_M2 and piece.intersects(ground.boundary)),
        key=lambda piece: piece.bounds,
    )
    return tuple(_outline(piece) for piece in built)


def _outline(piece: shapely.Polygon) -> Building:
    """Return the corners of a piece of ground, to the millimetre."""
    corners = piece.simplify(_ROUNDING_M).exterior.coords[:-1]
    return tuple((round(x_m, 3), round(y_m, 3)) for x_m, y_m in corners)
