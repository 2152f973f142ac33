"""Pieces of lanelets: stretches that become roads, and stretches with conflicts, which become ways over junctions.

Lanelets conflict where their centre lines come closer to each other than a car is wide, as they cross, fork or merge,
unless they follow or lie beside each other. They are cut there if what remains is long enough for a road.
"""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from itertools import product

import numpy as np
import shapely
from scipy.cluster.hierarchy import DisjointSet

from tint_sumo.maps.lanelets import Lanelet, LaneletMap, Light, Line, between

CAR_WIDTH_M = 2.0
SHORTEST_ROAD_M = 7.5  # between two conflicts: room for a car and the gap to the next
SHORTEST_END_M = (
    15.0  # before the first conflict of a lanelet, or behind its last: else lanes split far from their lines
)
_SHORTEST_CONFLICT_M = 0.5
_TOLERANCE_M = 0.01
_SAME_LENGTH = (0.25, 3.0)  # lanelets beside each other differ by no larger share, or by no more m
_HEAD_ON = -0.95  # cosine of the angle between lanelets that use one strip both ways
Place = tuple[int, int]  # number of a piece, and of a lane in it


@dataclass
class Piece:
    """A stretch of lanelets that lie beside each other, from the side of the road to its middle."""

    lanelets: tuple[str, ...]
    part: tuple[float, float]  # of their lengths
    in_junction: bool
    successors: list[list[Place]] = field(default_factory=list)  # of each lane
    predecessors: list[list[Place]] = field(default_factory=list)

    @property
    def is_last(self) -> bool:
        return self.part[1] == 1.0


@dataclass(frozen=True)
class Pieces:
    """All pieces of a map, and which of those with conflicts belong to one junction."""

    lanelets: Mapping[str, Lanelet]
    pieces: Sequence[Piece]
    junctions: DisjointSet  # of numbers of pieces

    def centre(self, place: Place) -> Line:
        """Return the centre line of one lane of a piece; (points, 2)."""
        piece = self.pieces[place[0]]
        return between(self.lanelets[piece.lanelets[place[1]]].centre, *piece.part)

    def lanelet(self, place: Place) -> str:
        return self.pieces[place[0]].lanelets[place[1]]

    def speed_mps(self, piece: int) -> float | None:
        """Return the lowest limit on a piece."""
        limits = [self.lanelets[name].speed_mps for name in self.pieces[piece].lanelets]
        return min((limit for limit in limits if limit is not None), default=None)

    def light(self, place: Place) -> Light | None:
        """Return the light at the end of one lane of a piece."""
        return self.lanelets[self.lanelet(place)].light if self.pieces[place[0]].is_last else None

    def has_light(self, piece: int) -> bool:
        """Return whether a light stands at the end of a piece."""
        return any(self.light((piece, lane)) is not None for lane in range(len(self.pieces[piece].lanelets)))

    def sign(self, piece: int) -> str | None:
        """Return the sign at the end of a piece."""
        found = self.pieces[piece]
        signs = [self.lanelets[name].sign for name in found.lanelets]
        return next((sign for sign in signs if sign is not None), None) if found.is_last else None


@dataclass(frozen=True)
class _Conflict:
    """Parts of two lanelets that come close to each other, as fractions of their lengths."""

    lanelets: tuple[str, str]
    parts: tuple[tuple[float, float], tuple[float, float]]


def cut_to_pieces(lanelet_map: LaneletMap) -> Pieces:
    """Cut the lanelets of a map, and find its junctions."""
    lanelets = lanelet_map.lanelets
    groups = _groups(lanelet_map)
    conflicts = _conflicts(lanelets, groups)
    pieces = _pieces(lanelets, groups, conflicts)
    _connect(lanelets, pieces)
    return Pieces(lanelets, pieces, _junctions(lanelets, pieces, conflicts))


def _groups(lanelet_map: LaneletMap) -> list[tuple[str, ...]]:
    """Return the lanelets that lie beside each other, in each group from the side of the road to its middle."""
    lanelets = lanelet_map.lanelets
    firsts = [name for name in lanelets if _beside(lanelets, name, "right_neighbour") is None]
    groups = []
    for first in firsts:
        group = [first]
        while (left := _beside(lanelets, group[-1], "left_neighbour")) is not None:
            group.append(left)
        groups.append(tuple(reversed(group) if lanelet_map.left_hand else group))
    grouped = {name for group in groups for name in group}
    return groups + [(name,) for name in lanelets if name not in grouped]  # rings of neighbours are a mistake


def _beside(lanelets: Mapping[str, Lanelet], name: str, side: str) -> str | None:
    """Return the neighbour of a lanelet if both say so, and if it begins and ends beside it."""
    other = lanelets.get(getattr(lanelets[name], side) or "")
    back = "right_neighbour" if side == "left_neighbour" else "left_neighbour"
    if other is None or getattr(other, back) != name:
        return None
    lengths = sorted((lanelets[name].length_m, other.length_m))
    share, most_m = _SAME_LENGTH
    return other.id if lengths[1] - lengths[0] <= max(share * lengths[1], most_m) else None


def _conflicts(lanelets: Mapping[str, Lanelet], groups: Sequence[tuple[str, ...]]) -> list[_Conflict]:
    """Find lanelets whose centre lines come closer than a car is wide, and neither follow nor lie beside each other."""
    names = list(lanelets)
    group_of = {name: number for number, group in enumerate(groups) for name in group}
    lines = [shapely.LineString(lanelets[name].centre) for name in names]
    strips = [line.buffer(CAR_WIDTH_M, cap_style="flat") for line in lines]
    first, second = shapely.STRtree(strips).query(lines, predicate="intersects")
    found = []
    for i, j in zip(first, second, strict=True):
        a, b = names[i], names[j]
        if i >= j or group_of[a] == group_of[b] or b in lanelets[a].successors or a in lanelets[b].successors:
            continue
        for part, other in product(_parts(lines[i], strips[j]), _parts(lines[j], strips[i])):
            near = part.distance(other) <= CAR_WIDTH_M + _TOLERANCE_M
            if near and not _is_head_on(lines[i], lines[j], part):
                found.append(_Conflict((a, b), (_fractions(lines[i], part), _fractions(lines[j], other))))
    return found


def _parts(line: shapely.LineString, strip: shapely.Polygon) -> list[shapely.LineString]:
    parts = shapely.get_parts(line.intersection(strip))
    return [part for part in parts if part.length >= _SHORTEST_CONFLICT_M]


def _fractions(line: shapely.LineString, part: shapely.LineString) -> tuple[float, float]:
    ends = [line.project(shapely.Point(point), normalized=True) for point in (part.coords[0], part.coords[-1])]
    return min(ends), max(ends)


def _is_head_on(line: shapely.LineString, other: shapely.LineString, part: shapely.LineString) -> bool:
    """Return whether two lanelets use one strip in opposite directions, which is no conflict of a junction."""
    middle = part.interpolate(0.5, normalized=True)
    directions = []
    for way in (line, other):
        at_m = way.project(middle)
        ends = [way.interpolate(min(max(at_m + step_m, 0.0), way.length)) for step_m in (-0.5, 0.5)]
        along = np.array([ends[1].x - ends[0].x, ends[1].y - ends[0].y])
        directions.append(along / np.linalg.norm(along))
    return bool(directions[0] @ directions[1] < _HEAD_ON)


def _pieces(
    lanelets: Mapping[str, Lanelet], groups: Sequence[tuple[str, ...]], conflicts: Sequence[_Conflict]
) -> list[Piece]:
    """Cut lanelets where conflicts begin and end, those beside each other at the same fraction of their lengths."""
    parts: dict[str, list[tuple[float, float]]] = {name: [] for name in lanelets}
    for conflict in conflicts:
        for name, part in zip(conflict.lanelets, conflict.parts, strict=True):
            parts[name].append(part)
    pieces = []
    for group in groups:
        length_m = float(np.mean([lanelets[name].length_m for name in group]))
        touched = [part for name in group for part in parts[name]]
        cuts = _cuts(touched, SHORTEST_ROAD_M / length_m, SHORTEST_END_M / length_m)
        pieces += [Piece(group, (begin, end), is_conflict) for begin, end, is_conflict in cuts]
    return pieces


def _cuts(
    parts: Sequence[tuple[float, float]], shortest: float, shortest_end: float
) -> list[tuple[float, float, bool]]:
    """Return the parts of 0 to 1 with and without conflicts; what is without and too short goes to those with."""
    if not parts:
        return [(0.0, 1.0, False)]
    merged: list[list[float]] = []
    for begin, end in sorted(parts):
        if merged and begin - merged[-1][1] < shortest:
            merged[-1][1] = max(merged[-1][1], end)
        else:
            merged.append([begin, end])
    if merged[0][0] < shortest_end:
        merged[0][0] = 0.0
    if 1.0 - merged[-1][1] < shortest_end:
        merged[-1][1] = 1.0
    cuts = [0.0, *(at for part in merged for at in part), 1.0]
    found = [(cuts[k], cuts[k + 1], k % 2 == 1) for k in range(len(cuts) - 1)]
    return [part for part in found if part[1] > part[0]]


def _connect(lanelets: Mapping[str, Lanelet], pieces: Sequence[Piece]) -> None:
    """Find the lanes behind and before each lane of each piece."""
    first = {name: (k, lane) for k, piece in enumerate(pieces) if piece.part[0] == 0.0 for lane, name in _lanes(piece)}
    for k, piece in enumerate(pieces):
        for lane, name in _lanes(piece):
            after = [first[other] for other in lanelets[name].successors if other in first]
            piece.successors.append(after if piece.is_last else [(k + 1, lane)])
            piece.predecessors.append([])
    for k, piece in enumerate(pieces):
        for lane, after in enumerate(piece.successors):
            for other, other_lane in after:
                pieces[other].predecessors[other_lane].append((k, lane))


def _lanes(piece: Piece) -> Iterator[tuple[int, str]]:
    yield from enumerate(piece.lanelets)


def _junctions(lanelets: Mapping[str, Lanelet], pieces: Sequence[Piece], conflicts: Sequence[_Conflict]) -> DisjointSet:
    """Join pieces with conflicts to junctions; returns sets of pieces' numbers."""
    sets = DisjointSet(range(len(pieces)))
    of_lanelet: dict[str, list[int]] = {name: [] for name in lanelets}
    for k, piece in enumerate(pieces):
        for name in piece.lanelets:
            of_lanelet[name].append(k)
    for conflict in conflicts:
        touched = [
            k
            for name, (begin, end) in zip(conflict.lanelets, conflict.parts, strict=True)
            for k in of_lanelet[name]
            if pieces[k].in_junction and pieces[k].part[0] <= end and pieces[k].part[1] >= begin
        ]
        for k in touched[1:]:
            sets.merge(touched[0], k)
    for k, piece in enumerate(pieces):
        for other in {other for after in piece.successors for other, _ in after}:
            if piece.in_junction and pieces[other].in_junction:
                sets.merge(k, other)
    return sets
