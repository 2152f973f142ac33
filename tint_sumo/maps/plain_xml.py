"""SUMO's plain XML of roads made of lanelets. Format: https://sumo.dlr.de/docs/Networks/PlainXML.html."""

from collections.abc import Iterable
from itertools import pairwise
from xml.sax.saxutils import quoteattr

from tint_sumo.maps.lanelets import LaneletMap, Light, Line
from tint_sumo.maps.roads import Node, Road, RoadMap, Way

DEFAULT_SPEED_MPS = 13.89  # 50 km/h, as netconvert's
_PRIORITIES = {"stop": 1, "yield": 1, None: 2, "priority": 3}
_STATES = {"green": "g", "yellow": "y", "red": "r", "redYellow": "u"}  # others are off
_PROJECTED = "-10000000000.00,-10000000000.00,10000000000.00,10000000000.00"  # anywhere


def plain_xml(lanelet_map: LaneletMap, roads: RoadMap) -> dict[str, str]:
    """Return the texts of nodes, edges, connections and lights, by the parts of their files' names.

    There are no lights if the map has no cycles for them: netconvert makes programs of its own then.
    """
    ends = {way.start for way in roads.ways}
    dead_ends = [f"<connection from={quoteattr(road.id)}/>" for road in roads.roads if road.id not in ends]
    location = _location(lanelet_map)
    programs = list(_programs(roads))
    return {
        "nod": _document("nodes", [*location, *map(_node, roads.nodes)]),
        "edg": _document("edges", (line for road in roads.roads for line in _edge(road))),
        "con": _document("connections", [*map(_connection, roads.ways), *dead_ends]),
        **({"tll": _document("tlLogics", programs)} if programs else {}),
    }


def _document(tag: str, lines: Iterable[str]) -> str:
    return "\n".join([f"<{tag}>", *(f"    {line}" for line in lines), f"</{tag}>", ""])


def _location(lanelet_map: LaneletMap) -> list[str]:
    if lanelet_map.projection is None:
        return []
    x_m, y_m = lanelet_map.offset_m
    return [
        f'<location netOffset="{x_m:.3f},{y_m:.3f}" convBoundary="0,0,0,0" origBoundary="{_PROJECTED}" '
        f"projParameter={quoteattr(lanelet_map.projection)}/>"
    ]


def _node(node: Node) -> str:
    kind = _kind(node)
    # SUMO's stop signs do not go with it.
    right_of_way = ' rightOfWay="edgePriority"' if kind == "priority" and any(node.signs) else ""
    return f'<node id={quoteattr(node.id)} x="{node.x_m:.3f}" y="{node.y_m:.3f}" type="{kind}"{right_of_way}/>'


def _kind(node: Node) -> str:
    if node.has_light:
        return "traffic_light"
    if "stop" in node.signs:
        return "allway_stop" if set(node.signs) == {"stop"} and len(node.signs) > 1 else "priority_stop"
    return "priority"


def _programs(roads: RoadMap) -> Iterable[str]:
    """Yield programs of the lights at nodes where all cycles have the same period."""
    node_of = {road.id: road.end for road in roads.roads}
    ways_at: dict[str, list[Way]] = {}
    for way in roads.ways:
        ways_at.setdefault(node_of[way.start], []).append(way)
    connections = []
    for node, ways in ways_at.items():
        lights = [way.light for way in ways if way.light is not None]
        periods_s = {round(light.period_s, 6) for light in lights}
        if len(periods_s) != 1 or 0.0 in periods_s:
            continue
        begins_s = sorted({0.0, *(at_s for light in lights for at_s in light.switches_s)} - periods_s)
        yield f'<tlLogic id={quoteattr(node)} type="static" programID="0" offset="0">'
        for begin_s, end_s in pairwise([*begins_s, *periods_s]):
            state = "".join(_state(way.light, begin_s) for way in ways)
            yield f'    <phase duration="{end_s - begin_s:g}" state="{state}"/>'
        yield "</tlLogic>"
        connections += [_controlled(way, node, index) for index, way in enumerate(ways)]
    yield from connections


def _state(light: Light | None, time_s: float) -> str:
    """Return SUMO's letter for a light; on green, who turns yields to oncoming traffic as without lights."""
    return "g" if light is None else _STATES.get(light.colour(time_s + 1e-6), "O")


def _controlled(way: Way, node: str, index: int) -> str:
    return (
        f"<connection from={quoteattr(way.start)} to={quoteattr(way.end)} "
        f'fromLane="{way.start_lane}" toLane="{way.end_lane}" tl={quoteattr(node)} linkIndex="{index}"/>'
    )


def _edge(road: Road) -> Iterable[str]:
    yield (
        f"<edge id={quoteattr(road.id)} from={quoteattr(road.start)} to={quoteattr(road.end)} "
        f'numLanes="{len(road.lanes)}" speed="{road.speed_mps or DEFAULT_SPEED_MPS:.3f}" '
        f'priority="{_PRIORITIES[road.sign]}" spreadType="center" shape="{_shape(road.centre)}">'
    )
    for index, lane in enumerate(road.lanes):
        yield f'    <lane index="{index}" width="{lane.width_m:.3f}" shape="{_shape(lane.centre)}">'
        yield f'        <param key="lanelets" value={quoteattr(" ".join(lane.lanelets))}/>'
        yield "    </lane>"
    yield "</edge>"


def _connection(way: Way) -> str:
    shape = "" if way.centre is None else f' shape="{_shape(way.centre)}"'
    return (
        f"<connection from={quoteattr(way.start)} to={quoteattr(way.end)} "
        f'fromLane="{way.start_lane}" toLane="{way.end_lane}"{shape}/>'
    )


def _shape(line: Line) -> str:
    return " ".join(f"{x_m:.3f},{y_m:.3f}" for x_m, y_m in line)
