"""Roads, junctions and the ways over them, made of pieces of lanelets. Roads with nothing between them become one."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.cluster.hierarchy import DisjointSet

from tint_sumo.maps.lanelets import LaneletMap, Light, Line, arc_lengths, side_by_side
from tint_sumo.maps.pieces import SHORTEST_END_M, Pieces, Place, cut_to_pieces

_MOST_PIECES = 30  # of a way over a junction
_End = tuple[str, int]  # "start" or "end" and the number of a road; or "piece" and its number


@dataclass(frozen=True)
class Lane:
    """A lane of a road."""

    lanelets: tuple[str, ...]
    centre: Line
    width_m: float


@dataclass(frozen=True)
class Road:
    """An edge of the network; its lanes begin with the one at the side of the road."""

    id: str
    start: str  # node
    end: str
    lanes: tuple[Lane, ...]
    speed_mps: float | None
    sign: str | None  # at its end

    @property
    def centre(self) -> Line:
        """Return the line in the middle of the outer lanes' centres; (points, 2)."""
        first, last = side_by_side(self.lanes[0].centre, self.lanes[-1].centre)
        return (first + last) / 2.0


@dataclass(frozen=True)
class Way:
    """A connection from a lane to another over a junction, with its centre line if lanelets lie between them."""

    start: str  # road
    start_lane: int
    end: str
    end_lane: int
    lanelets: tuple[str, ...]
    centre: Line | None
    light: Light | None  # before it, or on it


@dataclass(frozen=True)
class Node:
    """A junction, or the end of a road."""

    id: str
    x_m: float
    y_m: float
    signs: tuple[str | None, ...]  # at the ends of the roads that lead here
    has_light: bool


@dataclass(frozen=True)
class RoadMap:
    """Roads of a map of lanelets."""

    nodes: tuple[Node, ...]
    roads: tuple[Road, ...]
    ways: tuple[Way, ...]
    left_out: tuple[str, ...]  # lanelets within junctions that come from nowhere or lead nowhere


def build_roads(lanelet_map: LaneletMap) -> RoadMap:
    """Make roads and junctions of lanelets."""
    pieces = cut_to_pieces(lanelet_map)
    plan = _plan(pieces)
    while inside := _inside(plan):
        for k in inside:
            pieces.pieces[k].in_junction = True
        plan = _plan(pieces)
    roads, ways = plan.roads(), plan.ways()
    used = {name for road in roads for lane in road.lanes for name in lane.lanelets}
    used |= {name for way in ways for name in way.lanelets}
    left_out = tuple(name for name in lanelet_map.lanelets if name not in used)
    return RoadMap(plan.nodes(), roads, ways, left_out)


@dataclass(frozen=True)
class _Plan:
    """Pieces that become roads, which of their ends meet, and the ways between them."""

    pieces: Pieces
    chains: list[list[int]]  # numbers of the pieces of each road, one behind the other
    links: list[tuple[Place, list[Place], Place]]  # last place of a road, places on the junction, first place of a road
    meeting: dict[_End, int]  # number of the node of each end
    inside: list[set[int]]  # pieces inside each node

    def point(self, end: _End) -> Line:
        """Return the middle of an end of a road; (2,)."""
        kind, number = end
        k, row = (self.chains[number][-1], -1) if kind == "end" else (self.chains[number][0], 0)
        lanes = range(len(self.pieces.pieces[k].lanelets))
        return np.asarray(np.mean([self.pieces.centre((k, lane))[row] for lane in lanes], axis=0))

    def length_m(self, road: int) -> float:
        """Return the length of a road's lane at the side."""
        return float(sum(arc_lengths(self.pieces.centre((k, 0)))[-1] for k in self.chains[road]))

    def ends_at(self, node: int) -> list[_End]:
        return [end for end, at in self.meeting.items() if at == node]

    def ids(self) -> list[str]:
        """Return the first lanelet's id for each road, with a number behind it if a lanelet is cut to several roads."""
        names = [self.pieces.lanelet((chain[0], 0)) for chain in self.chains]
        numbers = [names[:at].count(name) for at, name in enumerate(names)]
        return [f"{name}.{number}" if number else name for name, number in zip(names, numbers, strict=True)]

    def node_ids(self) -> list[str]:
        """Return a name for each node, after a road that ends or begins there."""
        ids, names = self.ids(), [""] * len(self.inside)
        for (kind, number), node in self.meeting.items():
            names[node] = names[node] or f"{'to' if kind == 'end' else 'from'}_{ids[number]}"
        return names

    def sign(self, road: int) -> str | None:
        """Return the sign at the end of a road, or on a way over the junction there."""
        last = self.chains[road][-1]
        between = [k for (start, _), places, _ in self.links if start == last for k, _ in places]
        return next((sign for k in (last, *between) if (sign := self.pieces.sign(k)) is not None), None)

    def nodes(self) -> tuple[Node, ...]:
        return tuple(self._node(number, name) for number, name in enumerate(self.node_ids()))

    def _node(self, number: int, name: str) -> Node:
        ends = self.ends_at(number)
        x_m, y_m = np.mean([self.point(end) for end in ends], axis=0)
        here = [road for kind, road in ends if kind == "end"]
        lights = [*(self.chains[road][-1] for road in here), *self.inside[number]]
        has_light = any(self.pieces.has_light(k) for k in lights)
        return Node(name, float(x_m), float(y_m), tuple(self.sign(road) for road in here), has_light)

    def roads(self) -> tuple[Road, ...]:
        ids, nodes = self.ids(), self.node_ids()
        return tuple(
            Road(
                ids[number],
                nodes[self.meeting["start", number]],
                nodes[self.meeting["end", number]],
                tuple(self._lane(chain, lane) for lane in range(len(self.pieces.pieces[chain[0]].lanelets))),
                self.pieces.speed_mps(chain[0]),
                self.sign(number),
            )
            for number, chain in enumerate(self.chains)
        )

    def _lane(self, chain: Sequence[int], lane: int) -> Lane:
        centres = [self.pieces.centre((k, lane)) for k in chain]
        names = [self.pieces.lanelet((k, lane)) for k in chain]
        widths_m = [self.pieces.lanelets[name].width_m for name in names]
        lengths_m = [arc_lengths(centre)[-1] for centre in centres]
        return Lane(tuple(dict.fromkeys(names)), _joined(centres), float(np.average(widths_m, weights=lengths_m)))

    def ways(self) -> tuple[Way, ...]:
        ids = self.ids()
        road_of = {k: number for number, chain in enumerate(self.chains) for k in chain}
        return tuple(
            Way(
                *(ids[road_of[start]], start_lane, ids[road_of[end]], end_lane),
                tuple(dict.fromkeys(self.pieces.lanelet(place) for place in between)),
                _joined([self.pieces.centre(place) for place in between]) if between else None,
                next((light for at in ((start, start_lane), *between) if (light := self.pieces.light(at))), None),
            )
            for (start, start_lane), between, (end, end_lane) in self.links
        )


def _plan(pieces: Pieces) -> _Plan:
    chains = _chains(pieces)
    links = list(_links(pieces, chains))
    return _Plan(pieces, chains, links, *_meeting(pieces, chains, links))


def _inside(plan: _Plan) -> list[int]:
    """Return the pieces of roads that lie inside a junction.

    They lead back to it, or lead in a few metres from it to where lanes join without a conflict.
    """
    found = []
    for number, chain in enumerate(plan.chains):
        start, end = plan.meeting["start", number], plan.meeting["end", number]
        joins = sum(kind == "end" for kind, _ in plan.ends_at(end)) > 1 and not plan.inside[end]
        is_short = plan.length_m(number) < SHORTEST_END_M and bool(plan.inside[start])
        if start == end or (joins and is_short):
            found += chain
    return found


def _chains(pieces: Pieces) -> list[list[int]]:
    """Return the numbers of the pieces of each road, one behind the other."""
    roads = [k for k, piece in enumerate(pieces.pieces) if not piece.in_junction]
    after = {k: other for k in roads if (other := _only_successor(pieces, k)) is not None}
    followers = set(after.values())
    chains = []
    for first in roads:
        if first not in followers:
            chains.append([first])
            while (following := after.get(chains[-1][-1])) is not None:
                chains[-1].append(following)
    in_chains = {k for chain in chains for k in chain}
    return chains + [[k] for k in roads if k not in in_chains]  # of rings without junctions


def _only_successor(pieces: Pieces, k: int) -> int | None:
    """Return the piece that goes on with all lanes of a piece, and with these alone; not over a sign or light."""
    piece = pieces.pieces[k]
    if any(len(after) != 1 for after in piece.successors) or pieces.has_light(k) or pieces.sign(k) is not None:
        return None
    other = piece.successors[0][0][0]
    following = pieces.pieces[other]
    goes_on = [after[0] for after in piece.successors] == [(other, lane) for lane in range(len(following.lanelets))]
    comes_from = following.predecessors == [[(k, lane)] for lane in range(len(piece.lanelets))]
    is_road = other != k and not following.in_junction and pieces.speed_mps(k) == pieces.speed_mps(other)
    return other if goes_on and comes_from and is_road else None


def _links(pieces: Pieces, chains: Sequence[Sequence[int]]) -> Iterator[tuple[Place, list[Place], Place]]:
    """Yield the last place of a road, the places on the junction behind it, and the first place of the next road."""
    for chain in chains:
        for lane, successors in enumerate(pieces.pieces[chain[-1]].successors):
            reached = set()
            ways = [[place] for place in successors]
            for way in ways:  # it grows meanwhile
                *between, last = way
                if not pieces.pieces[last[0]].in_junction:
                    if last not in reached:
                        reached.add(last)
                        yield (chain[-1], lane), between, last
                elif len(way) < _MOST_PIECES:
                    ways += [[*way, place] for place in pieces.pieces[last[0]].successors[last[1]] if place not in way]


def _meeting(
    pieces: Pieces, chains: Sequence[Sequence[int]], links: Sequence[tuple[Place, list[Place], Place]]
) -> tuple[dict[_End, int], list[set[int]]]:
    """Find which ends of roads meet; return the number of the node of each, and the pieces inside each node."""
    ends: list[_End] = [(kind, number) for kind in ("end", "start") for number in range(len(chains))]
    joined = DisjointSet([*ends, *(("piece", k) for k in range(len(pieces.pieces)))])
    for subset in pieces.junctions.subsets():
        for k in subset:
            joined.merge(("piece", min(subset)), ("piece", k))
    road_of = {k: number for number, chain in enumerate(chains) for k in chain}
    for (first, _), between, (last, _) in links:
        for one in (("start", road_of[last]), *(("piece", k) for k, _ in between)):
            joined.merge(("end", road_of[first]), one)
    numbers: dict[_End, int] = {}
    for end in ends:
        numbers.setdefault(joined[end], len(numbers))
    inside: list[set[int]] = [set() for _ in numbers]
    for k, piece in enumerate(pieces.pieces):
        if piece.in_junction and joined["piece", k] in numbers:
            inside[numbers[joined["piece", k]]].add(k)
    return {end: numbers[joined[end]] for end in ends}, inside


def _joined(lines: Sequence[Line]) -> Line:
    """Return lines that lie one behind the other as one, without points that are there twice."""
    points = np.concatenate(lines)
    return points[np.r_[True, np.linalg.norm(np.diff(points, axis=0), axis=1) > 0.0]]
