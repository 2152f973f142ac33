"""Maps of lanelets, whatever their format: pieces of lanes between two bounds, and what is behind and beside them."""

import re
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path

import numpy as np
import shapely
from numpy.typing import NDArray
from shapely.ops import substring

from tint_sumo.core.errors import InputError, shown

Line = NDArray[np.float64]  # (points, 2) in m
Origin = tuple[float, float]  # latitude and longitude of x = y = 0
_ID = r"[\w-]+"
_SAME_POINT_M = 1e-3
_MOST_M = 1e8  # of any coordinate; the Earth's circumference is 4e7 m
_NARROWEST_M = 0.1


@dataclass(frozen=True)
class Light:
    """A traffic light. Its cycle has durations in s and colours, and is empty if the map does not have it."""

    cycle: tuple[tuple[float, str], ...] = ()
    begin_s: float = 0.0  # when a cycle begins

    @property
    def period_s(self) -> float:
        return sum(duration_s for duration_s, _ in self.cycle)

    @property
    def switches_s(self) -> list[float]:
        """Return when the light changes, from 0 to its period."""
        ends_s = np.cumsum([duration_s for duration_s, _ in self.cycle])
        return sorted(float(at_s) for at_s in np.round((self.begin_s + ends_s) % self.period_s, 6))

    def colour(self, time_s: float) -> str:
        """Return the colour at a time."""
        ends_s = np.cumsum([duration_s for duration_s, _ in self.cycle])
        return self.cycle[int(np.searchsorted(ends_s, (time_s - self.begin_s) % self.period_s, side="right"))][1]


@dataclass(frozen=True)
class Lanelet:
    """A piece of a lane. Its bounds run in the direction of driving."""

    id: str
    left: Line
    right: Line
    successors: tuple[str, ...] = ()
    left_neighbour: str | None = None  # of the same direction
    right_neighbour: str | None = None
    speed_mps: float | None = None  # limit, if the map has one
    sign: str | None = None  # at its end: yield, stop or priority
    light: Light | None = None  # at its end

    @cached_property
    def centre(self) -> Line:
        """Return the line in the middle of the bounds; (points, 2)."""
        left, right = self._sampled
        return (left + right) / 2.0

    @property
    def width_m(self) -> float:
        """Return the median distance of the bounds."""
        left, right = self._sampled
        return float(np.median(np.linalg.norm(left - right, axis=1)))

    @property
    def length_m(self) -> float:
        return float(arc_lengths(self.centre)[-1])

    @cached_property
    def _sampled(self) -> tuple[Line, Line]:
        return side_by_side(self.left, self.right)


@dataclass(frozen=True)
class LaneletMap:
    """All lanelets of a map, and how its coordinates lie on Earth if it says so."""

    file: Path
    lanelets: Mapping[str, Lanelet]
    left_hand: bool = False
    projection: str | None = None  # PROJ string of the plane
    offset_m: tuple[float, float] = (0.0, 0.0)  # from coordinates of the projection to those of the map


def by_id(lanelets: Iterable[Lanelet], file: Path) -> dict[str, Lanelet]:
    """Return lanelets by their ids.

    Raises:
        InputError: an id is there twice, or none that SUMO takes, or a lanelet has no width.
    """
    found: dict[str, Lanelet] = {}
    for lanelet in lanelets:
        if not re.fullmatch(_ID, lanelet.id):
            raise InputError(f"{file}: {shown(lanelet.id)} is no id that SUMO takes for a lanelet; give it a number")
        if lanelet.id in found:
            raise InputError(f"{file} has lanelet {lanelet.id} twice; keep one of them")
        if lanelet.width_m < _NARROWEST_M:
            raise InputError(f"{file}: lanelet {lanelet.id} is {lanelet.width_m:.2f} m wide; correct its bounds")
        found[lanelet.id] = lanelet
    return found


@dataclass(frozen=True)
class MapFormat:
    """File format of maps of lanelets."""

    name: str
    title: str  # for people
    read: Callable[[Path, Origin | None], LaneletMap] = field(repr=False)


def bound(points: Sequence[Sequence[float]], file: Path, lanelet: str) -> Line:
    """Return a bound without points that are there twice in a row.

    Raises:
        InputError: fewer than two points are left, or they lie beyond all places on Earth.
    """
    line = np.asarray(points, np.float64).reshape(-1, 2)
    if not (np.abs(line) <= _MOST_M).all():  # NaN, too
        raise InputError(f"{file}: a bound of lanelet {lanelet} lies more than {_MOST_M:g} m away; correct it")
    line = line[np.r_[True, np.linalg.norm(np.diff(line, axis=0), axis=1) > _SAME_POINT_M]] if len(line) else line
    if len(line) < 2:
        raise InputError(f"{file}: a bound of lanelet {lanelet} has fewer than two points; get the file again")
    return line


def arc_lengths(line: Line) -> NDArray[np.float64]:
    """Return the distance along a line from its beginning to each of its points; (points,)."""
    return np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(line, axis=0), axis=1))])


def side_by_side(first: Line, second: Line) -> tuple[Line, Line]:
    """Return two lines with points at the same fractions of their lengths, those of both; (points, 2) each."""
    lengths = [arc_lengths(line) for line in (first, second)]
    fractions = [length / length[-1] for length in lengths]
    both = np.unique(np.round(np.concatenate(fractions), 6))
    sampled = [
        np.stack([np.interp(both, at, line[:, axis]) for axis in (0, 1)], axis=1)
        for at, line in zip(fractions, (first, second), strict=True)
    ]
    return sampled[0], sampled[1]


def between(line: Line, begin: float, end: float) -> Line:
    """Return the part of a line between two fractions of its length; (points, 2)."""
    if (begin, end) == (0.0, 1.0):
        return line
    return np.asarray(substring(shapely.LineString(line), begin, end, normalized=True).coords)
