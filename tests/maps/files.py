"""Small maps: a street of two lanes to the east that a road to the north crosses, with a turn to the right."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import shapely

from tint_sumo.core.files import write_text

WIDTH_M = 3.5
YIELD, STOP, PRIORITY = "205", "206", "306"


@dataclass(frozen=True)
class Drawn:
    """A lanelet by its centre line."""

    points: Sequence[tuple[float, float]]
    successors: Sequence[int] = ()
    left: int | None = None
    right: int | None = None
    sign: str | None = None
    has_light: bool = False
    bounds: tuple[np.ndarray, np.ndarray] = field(init=False)

    def __post_init__(self) -> None:
        line = shapely.LineString(self.points)
        sides = (np.array(line.offset_curve(side * WIDTH_M / 2).coords) for side in (1, -1))
        object.__setattr__(self, "bounds", tuple(sides))


def arc(start: tuple[float, float], end: tuple[float, float]) -> list[tuple[float, float]]:
    """Points of a quarter of an ellipse that begins to the north and ends to the east."""
    (x, y), (to_x, to_y) = start, end
    angles = np.linspace(0.0, np.pi / 2, 9)
    return [(x + (to_x - x) * (1 - np.cos(angle)), y + (to_y - y) * np.sin(angle)) for angle in angles]


CROSSING = {
    1: Drawn([(-60, -1.75), (-10, -1.75)], [11], left=2),
    2: Drawn([(-60, 1.75), (-10, 1.75)], [12], right=1),
    3: Drawn([(0, -60), (0, -10)], [13, 14]),
    11: Drawn([(-10, -1.75), (10, -1.75)], [21], left=12),
    12: Drawn([(-10, 1.75), (10, 1.75)], [22], right=11),
    13: Drawn([(0, -10), (0, 10)], [23]),
    14: Drawn(arc((0, -10), (10, -1.75)), [21]),
    21: Drawn([(10, -1.75), (40, -1.75)], [31], left=22),
    22: Drawn([(10, 1.75), (40, 1.75)], [32], right=21),
    23: Drawn([(0, 10), (0, 60)]),
    31: Drawn([(40, -1.75), (60, -1.75)], left=32),
    32: Drawn([(40, 1.75), (60, 1.75)], right=31),
}


def commonroad(file: Path, lanelets: Mapping[int, Drawn] = CROSSING) -> Path:
    signs = sorted({one.sign for one in lanelets.values() if one.sign})
    body = "".join(_commonroad_lanelet(name, one) for name, one in lanelets.items())
    for sign in signs:
        element = f"<trafficSignElement><trafficSignID>{sign}</trafficSignID></trafficSignElement>"
        body += f'<trafficSign id="9{sign}">{element}</trafficSign>'
    write_text(file, f'<?xml version="1.0"?><commonRoad timeStepSize="0.1" benchmarkID="X">{body}</commonRoad>')
    return file


def _commonroad_lanelet(name: int, one: Drawn) -> str:
    left, right = (
        f"<{tag}>{''.join(f'<point><x>{x:.4f}</x><y>{y:.4f}</y></point>' for x, y in bound)}</{tag}>"
        for tag, bound in zip(("leftBound", "rightBound"), one.bounds, strict=True)
    )
    beside = "".join(
        f'<{tag} ref="{other}" drivingDir="same"/>'
        for tag, other in (("adjacentLeft", one.left), ("adjacentRight", one.right))
        if other is not None
    )
    after = "".join(f'<successor ref="{other}"/>' for other in one.successors)
    sign = f'<trafficSignRef ref="9{one.sign}"/>' if one.sign else ""
    light = '<trafficLightRef ref="7"/>' if one.has_light else ""
    return f'<lanelet id="{name}">{left}{right}{after}{beside}<speedLimit>12.5</speedLimit>{sign}{light}</lanelet>'
