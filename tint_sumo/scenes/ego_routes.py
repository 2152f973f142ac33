"""Ways for the ego through a SUMO network: short ones, across a junction where it meets the traffic that there is."""

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from tint_sumo.scenes.sumocfg import EGO_CLASS, measure_route

BEFORE_M, AFTER_M = 30.0, 20.0  # of the junction: the ego's start, and its goal
_LEAST_START_M = 5.1  # room for the ego behind its front
_TURNS = {"s": "straight on", "l": "left", "r": "right", "L": "partly left", "R": "partly right", "t": "back"}

Turn = tuple[str, str]  # an edge and the one that follows it


@dataclass(frozen=True)
class EgoRoute:
    """A way across one junction, with the ego's start and goal on it."""

    edges: tuple[str, ...]
    start_m: float
    goal_m: float
    junction: str
    junction_type: str
    turn: str  # in words
    streams: int  # turns of others that cross its way or join it
    vehicles: int  # that were seen on these


def suggest_routes(net: Any, driven: Mapping[Turn, int], most: int = 3) -> tuple[EgoRoute, ...]:
    """Return routes across junctions, those first on whose way most vehicles are met; if possible each another one.

    Args:
        net: a network, as sumolib reads it.
        driven: number of vehicles on each turn.
        most: number of routes.
    """
    crossings = sorted(_crossings(net), key=lambda crossing: (-_met(crossing[2], driven), -len(crossing[2])))
    places = [(junction.getID(), way.getFrom().getID()) for junction, way, _ in crossings]
    first = {junction: number for number, (junction, _) in reversed(list(enumerate(places)))}
    others = {place: number for number, place in reversed(list(enumerate(places)))}
    chosen = list(dict.fromkeys([*sorted(first.values()), *sorted(others.values())]))[:most]
    return tuple(
        _route(net, driven, junction, way, len(foes), _met(foes, driven))
        for junction, way, foes in (crossings[number] for number in sorted(chosen))
    )


def _met(foes: frozenset[Turn], driven: Mapping[Turn, int]) -> int:
    return sum(driven.get(turn, 0) for turn in foes)


def _crossings(net: Any) -> Iterator[tuple[Any, Any, frozenset[Turn]]]:
    """Yield junctions, ways over them for the ego, and the turns of others that are in conflict with these."""
    for junction in net.getNodes():
        ways = [
            way for way in junction.getConnections() if "" == way.getFrom().getFunction() == way.getTo().getFunction()
        ]
        links = [junction.getLinkIndex(way) for way in ways]
        if min(links, default=-1) < 0 or not junction.hasFoes():
            continue
        for link, way in zip(links, ways, strict=True):
            if not _is_open(way) or way.getDirection() == "t":
                continue
            foes = {_turn(other) for number, other in zip(links, ways, strict=True) if junction.areFoes(link, number)}
            foes.discard(_turn(way))
            if foes:
                yield junction, way, frozenset(foes)


def _turn(way: Any) -> Turn:
    return way.getFrom().getID(), way.getTo().getID()


def _is_road(edge: Any) -> bool:
    return bool(edge.getFunction() == "")  # no junction, crossing or connector


def _is_open(way: Any) -> bool:
    return bool(way.getFromLane().allows(EGO_CLASS) and way.getToLane().allows(EGO_CLASS))


def _route(net: Any, driven: Mapping[Turn, int], junction: Any, way: Any, foes: int, met: int) -> EgoRoute:
    """Return the route over a junction, so long at both of its ends as the network allows."""
    edges = [way.getFrom(), way.getTo()]
    while sum(edge.getLength() for edge in edges[:-1]) < BEFORE_M + _LEAST_START_M:
        before = _busiest(edges[0].getIncoming(), edges, lambda edge: driven.get((edge.getID(), edges[0].getID()), 0))
        if before is None:
            break
        edges.insert(0, before)
    crossed = len(edges) - 1  # the edge behind the junction
    while sum(edge.getLength() for edge in edges[crossed:]) < AFTER_M:
        after = _busiest(edges[-1].getOutgoing(), edges, lambda edge: driven.get((edges[-1].getID(), edge.getID()), 0))
        if after is None:
            break
        edges.append(after)
    names = tuple(edge.getID() for edge in edges)
    starts_m, spans_m, length_m = measure_route(net, names)
    first_m = spans_m[0][1]
    start_m = min(max(spans_m[crossed - 1][1] - BEFORE_M, min(_LEAST_START_M, first_m)), first_m)
    return EgoRoute(
        edges=names,
        start_m=round(start_m, 1) if round(start_m, 1) <= first_m else start_m,
        goal_m=min(float(int(starts_m[crossed] + AFTER_M)), length_m),
        junction=junction.getID(),
        junction_type=junction.getType(),
        turn=_TURNS.get(way.getDirection(), "on"),
        streams=foes,
        vehicles=met,
    )


def _busiest(ways: Mapping[Any, Sequence[Any]], edges: Sequence[Any], count: Callable[[Any], int]) -> Any | None:
    """Return the neighbouring edge over which most vehicles come or go; None if there is none for the ego."""
    found = [
        edge
        for edge, connections in ways.items()
        if edge not in edges and _is_road(edge) and any(map(_is_open, connections))
    ]
    return max(found, key=lambda edge: (count(edge), edge.getID()), default=None)
