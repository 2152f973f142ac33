"""Lanelet2 maps, as the INTERACTION dataset has them: OSM files with relations of type lanelet.

Plain reading of the XML is enough, so that the package lanelet2 is not needed. Lanelets are neighbours where they share
a bound, and follow each other where their bounds do. One that may be driven both ways is read in its bounds' direction.

Format: https://github.com/fzi-forschungszentrum-informatik/Lanelet2, "Lanelet2 Primitives" and "Regulatory Elements".
"""

import re
from collections.abc import Collection, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from xml.etree.ElementTree import Element

import numpy as np

from tint_sumo.core.errors import InputError
from tint_sumo.maps.lanelets import Lanelet, LaneletMap, Light, Line, MapFormat, Origin, bound, by_id
from tint_sumo.maps.xml_files import number, read_elements

_NOT_FOR_CARS = frozenset(
    {"crosswalk", "walkway", "shared_walkway", "stairs", "bicycle_lane", "rail", "pedestrian_lane", "road_shoulder"}
)
_SIGNS = {"205": "yield", "R1-2": "yield", "206": "stop", "R1-1": "stop", "301": "priority", "306": "priority"}
_SPEED = re.compile(r"\s*(\d+(?:\.\d*)?)\s*(km/?h|kmph|kph|mph|m/s|)\s*", re.IGNORECASE)
_UNITS_MPS = {"mph": 0.44704, "m/s": 1.0}  # others are km/h
_NEAR_ZERO_DEG = 2.0  # INTERACTION's maps lie where the equator meets the zero meridian, which is their origin
_ZONE_DEG = 6.0
_MOST_DEG = np.array([180.0, 84.0])  # of longitude and latitude, as far as UTM reaches
_Points = Mapping[str, tuple[float, float]]  # in m, by the ids of nodes


@dataclass(frozen=True)
class _Bound:
    """A bound of a lanelet: its way, and the nodes in the direction of driving."""

    way: str
    nodes: tuple[str, ...]

    @property
    def ends(self) -> tuple[str, str]:
        return self.nodes[0], self.nodes[-1]


@dataclass(frozen=True)
class _Bounds:
    left: _Bound
    right: _Bound


def _read(file: Path, origin: Origin | None) -> LaneletMap:
    found = read_elements(file, frozenset({"node", "way", "relation"}))
    ways = {way.get("id", ""): [node.get("ref", "") for node in way.findall("nd")] for way in found["way"]}
    roads = {
        one.get("id", ""): one for one in found["relation"] if _tag(one, "type") == "lanelet" and _is_for_cars(one)
    }
    pairs = {name: _pair(name, one, ways, file) for name, one in roads.items()}
    used = {node for pair in pairs.values() for way in pair for node in ways[way]}
    points, projection, offset_m = _positions([one for one in found["node"] if one.get("id") in used], file, origin)
    if used - points.keys():
        raise InputError(f"{file} has ways with nodes that it lacks; get the file again")
    bounds = {name: _bounds(pair, ways, points) for name, pair in pairs.items()}
    rules = _rules(found["relation"], found["way"])
    lefts, rights, starts = _index(bounds)
    lanelets = {}
    for name, one in bounds.items():
        own_rules = [rules[ref] for ref in _members(roads[name], "regulatory_element") if ref in rules]
        lanelets[name] = Lanelet(
            name,
            bound([points[node] for node in one.left.nodes], file, name),
            bound([points[node] for node in one.right.nodes], file, name),
            successors=tuple(starts.get((one.left.nodes[-1], one.right.nodes[-1]), ())),
            left_neighbour=rights.get((one.left.way, one.left.ends)),
            right_neighbour=lefts.get((one.right.way, one.right.ends)),
            speed_mps=min(
                [*_speeds(roads[name], "speed_limit"), *(v for rule in own_rules for v in rule.speeds_mps)],
                default=None,
            ),
            sign=next((sign for rule in own_rules if (sign := rule.sign(name)) is not None), None),
            light=Light() if any(rule.is_light for rule in own_rules) else None,
        )
    one_way = [one for name, one in bounds.items() if _tag(roads[name], "one_way") != "no"]
    on_left = sum((one.left.way, one.left.ends[::-1]) in lefts for one in one_way)
    on_right = sum((one.right.way, one.right.ends[::-1]) in rights for one in one_way)
    return LaneletMap(file, by_id(lanelets.values(), file), on_right > on_left, projection, offset_m)


def _is_for_cars(relation: Element) -> bool:
    tags = {tag.get("k", ""): tag.get("v") for tag in relation.findall("tag")}
    participants = {key: value for key, value in tags.items() if key.startswith("participant:")}
    has_vehicles = any(key.startswith("participant:vehicle") and participants[key] == "yes" for key in participants)
    return tags.get("subtype") not in _NOT_FOR_CARS and (has_vehicles or not participants)


def _tag(element: Element, key: str) -> str:
    return next((tag.get("v", "") for tag in element.findall("tag") if tag.get("k") == key), "")


def _members(relation: Element, role: str) -> list[str]:
    return [one.get("ref", "") for one in relation.findall("member") if one.get("role") == role]


def _pair(name: str, relation: Element, ways: Mapping[str, Collection[str]], file: Path) -> tuple[str, str]:
    """Return the ways of the left and the right bound of a lanelet."""
    left, right = (next((ref for ref in _members(relation, role) if ref in ways), None) for role in ("left", "right"))
    if left is None or right is None:
        raise InputError(f"{file}: lanelet {name} has no left or no right bound; get the file again")
    return left, right


def _bounds(pair: tuple[str, str], ways: Mapping[str, list[str]], points: _Points) -> _Bounds:
    """Turn the bounds of a lanelet in the direction of driving, in which the left bound lies to the left."""
    left, right = (tuple(ways[way]) for way in pair)
    ends = [np.array([points[nodes[0]], points[nodes[-1]]]) for nodes in (left, right)]
    if np.linalg.norm(ends[0] - ends[1]) > np.linalg.norm(ends[0] - ends[1][::-1]):
        right = right[::-1]
    outline = np.array([points[node] for node in (*left, *right[::-1])])
    turned = np.roll(outline, -1, axis=0)
    if (outline[:, 0] * turned[:, 1] - turned[:, 0] * outline[:, 1]).sum() > 0.0:  # counter-clockwise
        left, right = left[::-1], right[::-1]
    return _Bounds(_Bound(pair[0], left), _Bound(pair[1], right))


def _index(
    bounds: Mapping[str, _Bounds],
) -> tuple[
    dict[tuple[str, tuple[str, str]], str], dict[tuple[str, tuple[str, str]], str], dict[tuple[str, str], list[str]]
]:
    """Return the lanelets by their left bounds, by their right bounds, and by the nodes at which they begin."""
    lefts = {(one.left.way, one.left.ends): name for name, one in bounds.items()}
    rights = {(one.right.way, one.right.ends): name for name, one in bounds.items()}
    starts: dict[tuple[str, str], list[str]] = {}
    for name, one in bounds.items():
        starts.setdefault((one.left.nodes[0], one.right.nodes[0]), []).append(name)
    return lefts, rights, starts


@dataclass(frozen=True)
class _Rule:
    """Right of way, lights and speed limit that a regulatory element gives the lanelets that name it."""

    kind: str  # subtype
    yields: Collection[str]
    has_priority: Collection[str]
    signs: Collection[str]
    speeds_mps: tuple[float, ...]

    @property
    def is_light(self) -> bool:
        return self.kind == "traffic_light"

    def sign(self, lanelet: str) -> str | None:
        if self.kind == "all_way_stop":
            return "stop"
        if self.kind == "right_of_way":
            return "yield" if lanelet in self.yields else "priority" if lanelet in self.has_priority else None
        return next((sign for sign in self.signs), None)


def _rules(relations: list[Element], ways: list[Element]) -> dict[str, _Rule]:
    kinds = {way.get("id", ""): _tag(way, "subtype") for way in ways}
    rules = {}
    for one in relations:
        if _tag(one, "type") == "regulatory_element":
            shown = [_tag(one, "sign_type"), *(kinds.get(ref, "") for ref in _members(one, "refers"))]
            rules[one.get("id", "")] = _Rule(
                _tag(one, "subtype"),
                _members(one, "yield"),
                _members(one, "right_of_way"),
                [sign for text in shown for end, sign in _SIGNS.items() if text.endswith(end)],
                tuple(_speeds(one, "sign_type")) if _tag(one, "subtype") == "speed_limit" else (),
            )
    return rules


def _speeds(element: Element, key: str) -> Iterator[float]:
    """Yield the speed limit that a tag holds, such as 50 km/h, in m/s."""
    found = _SPEED.fullmatch(_tag(element, key))
    if found is not None and float(found[1]) > 0.0:
        yield float(found[1]) * _UNITS_MPS.get(found[2].lower(), 1.0 / 3.6)


def _positions(
    nodes: list[Element], file: Path, origin: Origin | None
) -> tuple[_Points, str | None, tuple[float, float]]:
    """Return the positions of nodes, their projection, and their offset in it.

    They are local_x and local_y where all nodes have these. Otherwise longitudes and latitudes are projected to UTM,
    and the origin's position is subtracted, as the readers of INTERACTION and lanelet2 do.
    """
    names = [node.get("id", "") for node in nodes]
    local = [(_tag(node, "local_x"), _tag(node, "local_y")) for node in nodes]
    if local and origin is None and all(x and y for x, y in local):
        found = [(number(x, file, "local_x"), number(y, file, "local_y")) for x, y in local]
        return dict(zip(names, found, strict=True)), None, (0.0, 0.0)
    degrees = np.array([[number(node.get(key), file, key) for key in ("lon", "lat")] for node in nodes]).reshape(-1, 2)
    if not len(degrees):
        return {}, None, (0.0, 0.0)
    if (np.abs(degrees) > _MOST_DEG).any():
        raise InputError(f"{file} has nodes whose latitude or longitude is none; correct them")
    if origin is not None and not (np.abs(origin) <= _MOST_DEG[::-1]).all():
        raise InputError(f"the `origin` {origin} is no latitude and longitude in degrees; correct it")
    is_fictitious = origin is None and np.abs(degrees).max() < _NEAR_ZERO_DEG
    latitude, longitude = (0.0, 0.0) if is_fictitious else origin or tuple(degrees.mean(axis=0)[::-1])
    projection, metres = _utm(degrees, latitude, longitude)
    zero = (
        _utm(np.array([[longitude, latitude]]), latitude, longitude)[1][0] if is_fictitious or origin else np.zeros(2)
    )
    placed = [(float(x), float(y)) for x, y in metres - zero]
    return dict(zip(names, placed, strict=True)), None if is_fictitious else projection, (-zero[0], -zero[1])


def _utm(degrees: Line, latitude: float, longitude: float) -> tuple[str, Line]:
    """Project longitudes and latitudes to the UTM zone of a place; return its PROJ string and x and y in m."""
    try:
        from pyproj import Proj  # noqa: PLC0415 - an extra
    except ModuleNotFoundError:
        raise InputError('maps with longitudes and latitudes need pyproj: pip install "tint_sumo[geo]"') from None
    zone = min(int((longitude + 180.0) // _ZONE_DEG) + 1, 60)
    south = " +south" if latitude < 0.0 else ""
    projection = f"+proj=utm +zone={zone}{south} +datum=WGS84 +units=m +no_defs"
    x_m, y_m = Proj(projection)(*degrees.T)
    return projection, np.stack([x_m, y_m], axis=1)


FORMAT = MapFormat("lanelet2", "lanelet2 (.osm)", _read)
