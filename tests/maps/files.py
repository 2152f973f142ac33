"""Small maps: a street of two lanes to the east that a road to the north crosses, with a turn to the right."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import shapely
from pyproj import Proj

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
    light: int | None = None
    opposite: Mapping[str, int] = field(default_factory=dict)  # adjacentLeft or adjacentRight
    bounds: tuple[np.ndarray, np.ndarray] = field(init=False)

    def __post_init__(self) -> None:
        line = shapely.LineString(self.points)
        sides = (np.array(line.offset_curve(side * WIDTH_M / 2).coords) for side in (1, -1))
        object.__setattr__(self, "bounds", tuple(sides))


def arc(start: tuple[float, float], end: tuple[float, float]) -> list[tuple[float, float]]:
    """Points of a quarter of an ellipse between short straight pieces to the north and to the east."""
    (x, y), (to_x, to_y) = (start[0], start[1] + 0.5), (end[0] - 0.5, end[1])
    angles = np.linspace(0.0, np.pi / 2, 9)
    turn = [(x + (to_x - x) * (1 - np.cos(angle)), y + (to_y - y) * np.sin(angle)) for angle in angles]
    return [start, *turn, end]


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


def commonroad(file: Path, lanelets: Mapping[int, Drawn] = CROSSING, lights: str = "") -> Path:
    signs = sorted({one.sign for one in lanelets.values() if one.sign})
    body = "".join(_commonroad_lanelet(name, one) for name, one in lanelets.items())
    for sign in signs:
        element = f"<trafficSignElement><trafficSignID>{sign}</trafficSignID></trafficSignElement>"
        body += f'<trafficSign id="9{sign}">{element}</trafficSign>'
    write_text(file, f'<?xml version="1.0"?><commonRoad timeStepSize="0.1" benchmarkID="X">{body}{lights}</commonRoad>')
    return file


def traffic_light(name: int, steps: Sequence[tuple[int, str]], offset: int, active: bool = True) -> str:
    """A traffic light of CommonRoad with durations in time steps."""
    cycle = "".join(
        f"<cycleElement><duration>{duration}</duration><color>{colour}</color></cycleElement>"
        for duration, colour in steps
    )
    return (
        f'<trafficLight id="{name}"><cycle>{cycle}<timeOffset>{offset}</timeOffset></cycle>'
        f"<active>{str(active).lower()}</active></trafficLight>"
    )


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
    beside += "".join(f'<{tag} ref="{other}" drivingDir="opposite"/>' for tag, other in one.opposite.items())
    after = "".join(f'<successor ref="{other}"/>' for other in one.successors)
    sign = f'<trafficSignRef ref="9{one.sign}"/>' if one.sign else ""
    light = f'<trafficLightRef ref="{one.light}"/>' if one.light else ""
    return f'<lanelet id="{name}">{left}{right}{after}{beside}<speedLimit>12.5</speedLimit>{sign}{light}</lanelet>'


def lanelet2(file: Path, lanelets: Mapping[int, Drawn] = CROSSING, shift_deg: tuple[float, float] = (0.0, 0.0)) -> Path:
    """Write a lanelet2 map in which lanelets that touch share nodes and ways, some of which run against the lanelets.

    Args:
        file: to write.
        lanelets: x and y in metres; the map has longitudes and latitudes.
        shift_deg: latitude and longitude of x = y = 0.
    """
    nodes: dict[tuple[float, float], int] = {}
    ways: dict[tuple[int, ...], int] = {}
    relations = []
    for name, one in lanelets.items():
        sides = []
        for bound in one.bounds:
            points = [tuple(np.round(point, 2) + 0.0) for point in bound]
            way = tuple(nodes.setdefault(point, -(len(nodes) + 1)) for point in points)
            sides.append(ways.get(way) or ways.get(way[::-1]) or ways.setdefault(way[::-1], len(ways) + 1001))
        members = "".join(
            f'<member type="way" ref="{way}" role="{role}"/>'
            for way, role in zip(sides, ("left", "right"), strict=True)
        )
        rules = {YIELD: (901,), PRIORITY: (901,), None: ()}[one.sign]
        members += "".join(f'<member type="relation" ref="{rule}" role="regulatory_element"/>' for rule in rules)
        tags = {"type": "lanelet", "subtype": "road", "location": "urban", "one_way": "yes", "speed_limit": "45 km/h"}
        relations.append(f'<relation id="{name}">{members}{_tags(tags)}</relation>')
    yields = "".join(
        f'<member type="relation" ref="{name}" role="{"yield" if one.sign == YIELD else "right_of_way"}"/>'
        for name, one in lanelets.items()
        if one.sign
    )
    rule = f'<relation id="901">{yields}{_tags({"type": "regulatory_element", "subtype": "right_of_way"})}</relation>'
    transform = Proj("+proj=utm +zone=31 +datum=WGS84")
    corner = np.array(transform(shift_deg[1], shift_deg[0]))
    texts = []
    for point, number in nodes.items():
        longitude, latitude = transform(*(corner + point), inverse=True)
        texts.append(f'<node id="{number}" lat="{latitude:.10f}" lon="{longitude:.10f}"/>')
    texts += [
        f'<way id="{number}">{"".join(f"<nd ref={chr(34)}{node}{chr(34)}/>" for node in way)}</way>'
        for way, number in ways.items()
    ]
    write_text(file, f'<?xml version="1.0"?><osm version="0.6">{"".join([*texts, *relations, rule])}</osm>')
    return file


def _tags(tags: Mapping[str, str]) -> str:
    return "".join(f'<tag k="{key}" v="{value}"/>' for key, value in tags.items())
