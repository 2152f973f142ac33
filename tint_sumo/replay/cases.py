"""The cases of a recording: in whose place an ego can be, or where else it begins, and when."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import shapely

from tint_sumo.config import SpeedMps, TimeS, VehicleShape
from tint_sumo.core.errors import InputError, shown
from tint_sumo.core.ranges import require_ranges
from tint_sumo.replay.recordings import Placed
from tint_sumo.replay.routes import Routes, is_on_edge
from tint_sumo.scenes.geometry import Boxes, Floats, clearance_m, new_boxes
from tint_sumo.scenes.replay import NO_TRACK, Recording, ReplayCase, Way
from tint_sumo.scenes.sumocfg import measure_route, require_on_route
from tint_sumo.tracks.schema import is_on_foot

_LEAST_WAY_M = 10.0  # of an ego
_BEFORE_END_M = 1.0  # who drives just as recorded comes to the goal before the recording ends
_LEAST_S = 1.0
_SPACING_M = 0.5  # of the boxes of a way along lanes
_SOME = 8  # names in a message


@dataclass(frozen=True)
class EgoOnEdges:
    """An ego in nobody's place, on a way that is given."""

    edges: tuple[str, ...]
    start_m: float  # of its front on the route
    goal_m: float
    every_s: TimeS = 5.0  # a case begins all so many seconds, if the ego has room then
    speed_mps: SpeedMps = 0.0  # at its start
    vehicle: VehicleShape = VehicleShape()  # noqa: RUF009 - it is frozen

    def __post_init__(self) -> None:
        require_ranges(self)
        object.__setattr__(self, "edges", tuple(self.edges))


Ego = str | Sequence[str] | EgoOnEdges | None  # what users write


def find_cases(
    ego: Ego, placed: Sequence[Placed], routes: Routes, step_s: float, labels: Sequence[str]
) -> tuple[ReplayCase, ...]:
    """Return all cases for an ego, in the order of recordings and times.

    Raises:
        InputError: no vehicle has the name, the ego has no way, or there is no case.
    """
    recordings = [one.recording for one in placed]
    if isinstance(ego, EgoOnEdges):
        cases = [
            case
            for number, recording in enumerate(recordings)
            for case in _on_edges(ego, number, recording, routes, step_s)
        ]
        if not cases:
            raise InputError("the ego has no room at its start at any time; choose another start_m")
        return tuple(cases)
    names = _names(ego, recordings)
    found, reasons = [], dict[str, str]()
    for number, recording in enumerate(recordings):
        for track, vehicle in enumerate(recording.vehicles):
            if names is None or vehicle in names:
                case = _in_place_of(track, number, placed[number], routes, step_s, labels)
                if isinstance(case, str):
                    reasons.setdefault(vehicle, case)
                else:
                    found.append(case)
    without = set(reasons) - {recordings[case.recording].vehicles[case.track] for case in found}
    if not found or (names and without):
        vehicle = min(without)
        raise InputError(f"the ego cannot take over vehicle {vehicle}, which {reasons[vehicle]}; choose another")
    return tuple(sorted(found, key=lambda case: (case.recording, case.step)))


def _names(ego: Any, recordings: Sequence[Recording]) -> tuple[str, ...] | None:
    """Return the names of the vehicles that are asked for; None for any.

    Raises:
        InputError: there is no such vehicle.
    """
    if ego is None:
        return None
    names = (ego,) if isinstance(ego, str) else tuple(ego) if isinstance(ego, Sequence) else (ego,)
    known = dict.fromkeys(vehicle for recording in recordings for vehicle in recording.vehicles)
    if not names:
        raise InputError("ego names no vehicle; name one, or leave it out for any vehicle")
    for name in names:
        if not isinstance(name, str):
            raise InputError(f"ego must be names of recorded vehicles, an EgoOnEdges or None, not {shown(name)}")
        if name not in known:
            some = ", ".join(list(known)[:_SOME])
            raise InputError(f"no recorded vehicle is called {shown(name)}; choose one of {some}, ...")
    return names


def _in_place_of(
    track: int, number: int, placed: Placed, routes: Routes, step_s: float, labels: Sequence[str]
) -> ReplayCase | str:
    """Return the case of an ego in the place of a vehicle, or the reason why there is none."""
    recording, route = placed.recording, placed.recording.routes[track]
    if is_on_foot(labels[recording.labels[track]]):
        return "is no car"
    if not route:
        return "is on no lane of the network"
    begin = int(recording.first_row[track])
    own = slice(begin, begin + int(recording.rows[track]))
    starts_m, lanes = routes.lane_starts_m(route), placed.lane[own].tolist()
    rows = [row for row, lane in enumerate(lanes) if lane in starts_m]
    on_edges = [row for row in rows if is_on_edge(lanes[row])]
    if not on_edges:
        return "is never before or behind a junction on its route"
    first, last = on_edges[0], rows[-1]
    start_m, end_m = (starts_m[lanes[row]] + float(placed.lane_m[own][row]) for row in (first, last))
    goal_m = end_m - _BEFORE_END_M
    if goal_m - start_m < _LEAST_WAY_M:
        return f"drives less than {_LEAST_WAY_M:g} m"
    step = int(recording.first_step[track]) + first
    if (recording.steps - step) * step_s < _LEAST_S:
        return f"appears in the last {_LEAST_S:g} s"
    boxes, driven_m = recording.box[own][first:], recording.driven_m[own][first:]
    return ReplayCase(
        recording=number,
        track=track,
        left_out=_touching(track, recording),
        step=step,
        route=route,
        route_edge_start_m=routes.edge_starts_m(route),
        start_m=start_m,
        goal_m=goal_m,
        lane=lanes[first],
        lane_m=float(placed.lane_m[own][first]),
        speed_mps=float(recording.speed_mps[own][first]),
        vehicle=VehicleShape(float(boxes[0]["length_m"]), float(boxes[0]["width_m"])),
        way=Way(boxes, driven_m - driven_m[0]),
    )


def _touching(track: int, recording: Recording) -> tuple[int, ...]:
    """Return the tracks whose boxes touch that of a vehicle at any time: mistakes of the recording."""
    begin, count = int(recording.first_step[track]), int(recording.rows[track])
    own = recording.box[int(recording.first_row[track]) :][:count]
    found = []
    for other, vehicle in enumerate(recording.vehicles):
        first = max(begin, int(recording.first_step[other]))
        end = min(begin + count, int(recording.first_step[other] + recording.rows[other]))
        if vehicle == recording.vehicles[track] or first >= end:
            continue
        row = int(recording.first_row[other] - recording.first_step[other])
        theirs = recording.box[row + first : row + end]
        if _any_touch(own[first - begin : end - begin], theirs):
            found.append(other)
    return tuple(found)


def _any_touch(boxes: Boxes, others: Boxes) -> bool:
    """Return whether any two boxes of the same row touch; (R,) both."""
    reach_m = (np.hypot(boxes["length_m"], boxes["width_m"]) + np.hypot(others["length_m"], others["width_m"])) / 2.0
    near = np.hypot(boxes["x_m"] - others["x_m"], boxes["y_m"] - others["y_m"]) < reach_m
    return any(clearance_m(boxes[row], others[row]) == 0.0 for row in np.flatnonzero(near))


def _on_edges(ego: EgoOnEdges, number: int, recording: Recording, routes: Routes, step_s: float) -> list[ReplayCase]:
    """Return the cases of an ego on given edges in a recording, at whose begin it has room."""
    edge_start_m, spans_m, length_m = measure_route(routes.net, ego.edges)
    require_on_route(ego.start_m, ego.goal_m, spans_m, length_m)
    edge = max(index for index, start_m in enumerate(edge_start_m) if start_m <= ego.start_m)
    lane_m = ego.start_m - edge_start_m[edge]
    lanes = routes.ego_lanes(ego.edges[edge:])
    way = _way_along(ego, lanes, lane_m, routes.net)
    steps = range(0, recording.steps - round(_LEAST_S / step_s) + 1, max(1, round(ego.every_s / step_s)))
    return [
        ReplayCase(
            recording=number,
            track=NO_TRACK,
            left_out=(),
            step=step,
            route=ego.edges,
            route_edge_start_m=edge_start_m,
            start_m=ego.start_m,
            goal_m=ego.goal_m,
            lane=lanes[0][0],
            lane_m=lane_m,
            speed_mps=ego.speed_mps,
            vehicle=ego.vehicle,
            way=way,
        )
        for step in steps
        if _has_room(way.box[0], recording, step)
    ]


def _has_room(box: Any, recording: Recording, step: int) -> bool:
    row = step - recording.first_step
    tracks = np.flatnonzero((row >= 0) & (row < recording.rows))
    rows = recording.first_row[tracks] + row[tracks]
    here = recording.box[rows[recording.on_road[rows]]]
    return all(clearance_m(other, box) > 0.0 for other in here)


def _way_along(ego: EgoOnEdges, lanes: Sequence[tuple[str, Sequence[str]]], lane_m: float, net: Any) -> Way:
    """Return the boxes of an ego along lanes, from its start to its goal.

    Args:
        ego: on its edges.
        lanes: that it takes from its start on, as ``Routes.ego_lanes`` has them.
        lane_m: position of its front on the first of them.
        net: the network.
    """
    points, along_m, end_m = list[tuple[float, float]](), list[float](), ego.start_m - lane_m
    for lane in (net.getLane(name) for on_edge, over in lanes for name in (on_edge, *over)):
        line = shapely.LineString(lane.getShape())
        for share in np.linspace(0.0, 1.0, max(2, int(line.length / _SPACING_M))):
            point = line.interpolate(share, normalized=True)
            points.append((point.x, point.y))
            along_m.append(end_m + share * float(lane.getLength()))
        end_m = along_m[-1]
    line_m, at = np.array(along_m), np.array(points)
    wanted_m: Floats = np.arange(ego.start_m, ego.goal_m, _SPACING_M)
    front, back = (
        np.stack([np.interp(wanted_m + off_m, line_m, at[:, axis]) for axis in range(2)], axis=1)
        for off_m in (0.0, -_SPACING_M)
    )
    heading = front - back
    if len(heading) > 1:
        heading[0] = heading[1] if not heading[0].any() else heading[0]
    heading /= np.maximum(np.hypot(*heading.T), 1e-9)[:, None]
    box = new_boxes(len(wanted_m), ego.vehicle.length_m, ego.vehicle.width_m)
    box["heading_x"], box["heading_y"] = heading.T
    box["x_m"], box["y_m"] = (front - heading * ego.vehicle.length_m / 2.0).T
    return Way(box, wanted_m - ego.start_m)
