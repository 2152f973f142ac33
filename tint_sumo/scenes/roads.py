"""The roads of a network as areas, for pictures."""

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
import shapely
from shapely.ops import substring

from tint_sumo.scenes.geometry import SPACING_M, Floats

_DASH_M, _LINE_M = 1.0, 0.12
_STRIPE_M = 0.5  # of a crossing, and so wide are the gaps between them


@dataclass(frozen=True, eq=False)
class Roads:
    """Areas in the network's frame, to be looked up by where they are."""

    paved: shapely.STRtree
    marks: shapely.STRtree  # white lines on them


def paved_areas(net: Any, *, seam_m: float, gap_m: float = 0.0) -> list[shapely.Geometry]:
    """Return the areas of all lanes and junctions of a network that sumolib has read.

    Args:
        net: the network.
        seam_m: junctions reach so far into their roads, which rounding could part from them.
        gap_m: width that lanes lack on each side, so that they can be told apart.
    """
    lanes = [lane for edge in net.getEdges(withInternal=False) for lane in edge.getLanes()]
    paved = [
        shapely.LineString(lane.getShape()).buffer(max(lane.getWidth() / 2 - gap_m, gap_m), cap_style="flat")
        for lane in lanes
    ]
    outlines = [node.getShape() for node in net.getNodes() if len(node.getShape()) > 2]
    return [*paved, *(shapely.Polygon(outline).buffer(seam_m) for outline in outlines)]


def crossing_marks(net: Any) -> Iterator[shapely.Geometry]:
    """Yield the stripes of all crossings of a network that sumolib has read with its internal lanes."""
    for edge in net.getEdges():
        if edge.getFunction() == "crossing":
            for lane in edge.getLanes():
                middle = shapely.LineString(lane.getShape())
                for start_m in np.arange(_STRIPE_M / 2, middle.length, 2 * _STRIPE_M):
                    stripe = substring(middle, start_m, start_m + _STRIPE_M)
                    yield stripe.buffer(lane.getWidth() / 2, cap_style="flat")


def border_marks(way: Floats, width_m: float) -> Iterator[shapely.Geometry]:
    """Yield the dashes at both borders of a lane of this width, whose middle is a way (P, 2)."""
    dash = round(_DASH_M / SPACING_M)
    step = np.gradient(way, axis=0)
    across = np.stack([-step[:, 1], step[:, 0]], axis=-1) / np.hypot(*step.T)[:, None] * (width_m / 2)
    for border in (way + across, way - across):
        for start in range(0, len(border) - dash, 2 * dash):
            line = shapely.linestrings(border[start : start + dash + 1 : 10])
            yield shapely.buffer(line, _LINE_M / 2, cap_style="flat")
