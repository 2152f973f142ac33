"""SUMO's plain XML of roads made of lanelets. Format: https://sumo.dlr.de/docs/Networks/PlainXML.html."""

from collections.abc import Iterable
from xml.sax.saxutils import quoteattr

from tint_sumo.maps.lanelets import LaneletMap, Line
from tint_sumo.maps.roads import Node, Road, RoadMap, Way

DEFAULT_SPEED_MPS = 13.89  # 50 km/h, as netconvert's
_PRIORITIES = {"stop": 1, "yield": 1, None: 2, "priority": 3}
_PROJECTED = "-10000000000.00,-10000000000.00,10000000000.00,10000000000.00"  # anywhere


def plain_xml(lanelet_map: LaneletMap, roads: RoadMap) -> dict[str, str]:
    """Return the texts of nodes, edges and connections, by the parts of their files' names."""
    ends = {way.start for way in roads.ways}
    dead_ends = [f"<connection from={quoteattr(road.id)}/>" for road in roads.roads if road.id not in ends]
    location = _location(lanelet_map)
    return {
        "nod": _document("nodes", [*location, *map(_node, roads.nodes)]),
        "edg": _document("edges", (line for road in roads.roads for line in _edge(road))),
        "con": _document("connections", [*map(_connection, roads.ways), *dead_ends]),
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
