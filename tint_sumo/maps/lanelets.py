"""Maps of lanelets, whatever their format: pieces of lanes between two bounds, and what is behind and beside them."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path

import numpy as np
import shapely
from numpy.typing import NDArray
from shapely.ops import substring

from tint_sumo.core.errors import InputError

Line = NDArray[np.float64]  # (points, 2) in m
Origin = tuple[float, float]  # latitude and longitude of x = y = 0
_SAME_POINT_M = 1e-3


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
    has_light: bool = False  # at its end

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


@dataclass(frozen=True)
class MapFormat:
    """File format of maps of lanelets."""

    name: str
    title: str  # for people
    read: Callable[[Path, Origin | None], LaneletMap] = field(repr=False)


def bound(points: Sequence[Sequence[float]], file: Path, lanelet: str) -> Line:
    """Return a bound without points that are there twice in a row.

    Raises:
        InputError: fewer than two points are left.
    """
    line = np.asarray(points, np.float64).reshape(-1, 2)
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
