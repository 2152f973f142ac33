"""The recorded vehicles of an episode in a running simulation.

They follow their recording: before each step of SUMO, each is moved to where it was recorded after that step. In a
reactive scene a vehicle is released once the ego matters to it, and SUMO drives it from there on. A vehicle that is on
no lane is not there for SUMO, nor for the ego.
"""

import math
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import dataclass
from typing import Any

import numpy as np
from libsumo import constants

from tint_sumo.scenes.geometry import Bools, Boxes, Floats, Numbers, clearance_m, find_meetings, find_overlaps
from tint_sumo.scenes.replay import NO_TRACK, ReplayScene
from tint_sumo.simulation.bodies import box_of, record_of
from tint_sumo.simulation.connection import SUMO_ERRORS, Connection
from tint_sumo.simulation.ego_way import EGO

_KEEP_ROUTE, _IGNORE_PERMISSIONS = 1, 4  # of moveToXY
_NO_LANE_CHANGES, _SUMO_LANE_CHANGES = 0, 1621
_AHEAD_S = 0.2  # positions that are looked at ahead are so far apart
_CENTRED_S = 1.0  # time constant in which a released vehicle comes to the middle of its lane
_IGNORED_BY = ("junctionModel.ignoreTypes", "carFollowModel.ignoreTypes")
_ADDED_AT = "base"  # departPos of vehicles, which are moved before they depart

Point = tuple[float, float]


@dataclass
class Released:
    """A vehicle that SUMO drives."""

    way_m: float  # how far along its recorded way it was released
    odometer_m: float  # then
    step: int  # then
    beside_m: Point | None = None  # vector from its lane's middle to where it was recorded, known a step later


@dataclass(frozen=True)
class Faults:
    """Numbers of what is wrong in an episode so far, and is none of the ego's doing."""

    left_out: int = 0  # vehicles that would have appeared on the ego, or on one that SUMO drives
    off_road: int = 0  # vehicles that are on no lane now
    overlaps: int = 0  # pairs of recorded vehicles whose boxes have overlapped
    map_contacts: int = 0  # vehicles on no lane that the ego's box has touched


class RecordedTraffic:
    """Moves the recorded vehicles; ``begin`` starts an episode. Ids of vehicles are numbers of their tracks."""

    def __init__(self, connection: Connection) -> None:
        self._connection = connection
        self.released: dict[int, Released] = {}
        self._follow: set[int] = set()  # those that are where they were recorded
        self.step = 0

    def begin(self, scene: ReplayScene) -> None:
        """Place the vehicles that are there at the begin of an episode in a simulation that was loaded anew."""
        self._scene = scene
        self._case = scene.cases[scene.case]
        recording = self._recording = scene.recording
        self.step = self._case.step
        self.released.clear()
        self._follow.clear()
        self._left_out, self._touched = set(self._case.left_out), set[int]()
        self._overlapped: set[tuple[int, int]] = set()
        self._waits: Bools = np.ones(len(recording.vehicles), bool)  # tracks that may still appear, or follow
        self._waits[list(self._case.left_out)] = False
        if self._case.track != NO_TRACK:  # whose vehicle can have other tracks, if it was lost for a while
            own = recording.vehicles[self._case.track]
            self._waits[[vehicle == own for vehicle in recording.vehicles]] = False
        self._types, self._routes = set[str](), set[str]()
        self._step_s = scene.step_s
        self._horizon = round(scene.release_s / scene.step_s)
        self._every = max(1, round(_AHEAD_S / scene.step_s))
        self.released_so_far = 0
        self._place(self._case.way.box[0])

    def advance(self, ego: Any, driven_m: float, speed_mps: float) -> None:
        """Go on by a step, which SUMO does not simulate yet.

        Args:
            ego: its box in the network's frame, a record of ``tint_sumo.scenes.geometry.BOX``.
            driven_m: of the ego since its start.
            speed_mps: of the ego.
        """
        if self._scene.reactive:
            self._release(driven_m, speed_mps)
        self.step += 1
        self._place(ego)

    def settle(self) -> None:
        """Forget vehicles that SUMO has taken off in the step just made, or that are past the end of their way."""
        for vehicle_id in self._connection.simulation.getArrivedIDList():
            if vehicle_id != EGO:
                self._forget(int(vehicle_id))
        for track in [track for track in self.released if self._way_m(track) >= self._length_m(track)]:
            self._connection.vehicle.remove(str(track))
            self._forget(track)

    def _forget(self, track: int) -> None:
        self._follow.discard(track)
        self.released.pop(track, None)
        self._waits[track] = False

    def seen(self, ego: Any, front_m: tuple[float, float, float], sight_m: float) -> dict[str, dict[int, Any]]:
        """Return the vehicles in sight; variables as SUMO would give them, but for those that it drives not.

        Args:
            ego: its box in the network's frame.
            front_m: of the ego.
            sight_m: from the ego's front to that of a vehicle.
        """
        now = self._now
        self._count_faults(ego, now)
        near = np.hypot(now.x_m - front_m[0], now.y_m - front_m[1]) <= sight_m
        found = {
            str(track): _sight((x_m, y_m, front_m[2]), angle_deg, driven_m)
            for track, x_m, y_m, angle_deg, driven_m in now.places(near)
            if track in self._follow
        }
        for track in self.released:
            sight = self._sight_of(track)
            if math.dist(sight[constants.VAR_POSITION3D][:2], front_m[:2]) <= sight_m:
                found[str(track)] = sight
        return found

    def faults(self) -> Faults:
        """Return the faults of the episode so far."""
        return Faults(len(self._left_out), self._off_road, len(self._overlapped), len(self._touched))

    # Following

    def _moment(self) -> "_Moment":
        """Return the vehicles that are recorded at this step and are not released."""
        recording, row = self._recording, self.step - self._recording.first_step
        tracks = np.flatnonzero((row >= 0) & (row < recording.rows) & self._waits)
        rows = recording.first_row[tracks] + row[tracks]
        boxes = recording.box[rows]
        half_m = boxes["length_m"] / 2
        return _Moment(
            tracks,
            boxes,
            recording.on_road[rows],
            boxes["x_m"] + half_m * boxes["heading_x"],
            boxes["y_m"] + half_m * boxes["heading_y"],
            np.degrees(np.arctan2(boxes["heading_x"], boxes["heading_y"])) % 360.0,
            recording.driven_m[rows],
        )

    def _place(self, ego: Any) -> None:
        """Move the vehicles that follow their recording to where they are at this step."""
        now = self._now = self._moment()
        here = set(now.tracks[now.on_road].tolist())
        for track in self._follow - here:
            self._connection.vehicle.remove(str(track))
        self._follow &= here
        for place, (track, x_m, y_m, angle_deg, _) in enumerate(now.places(now.on_road)):
            if track in self._follow or self._appears(track, now.boxes[now.on_road][place], ego):
                self._move(track, x_m, y_m, angle_deg)

    def _move(self, track: int, x_m: float, y_m: float, angle_deg: float) -> None:
        mode = _IGNORE_PERMISSIONS | (_KEEP_ROUTE if self._recording.keeps_route[track] else 0)
        try:
            self._connection.vehicle.moveToXY(str(track), "", -1, x_m, y_m, angle_deg, mode)
        except SUMO_ERRORS:  # SUMO finds no lane for it
            self._connection.vehicle.remove(str(track))
            self._forget(track)

    def _appears(self, track: int, box: Any, ego: Any) -> bool:
        """Insert a vehicle, unless it would appear on the ego or on a vehicle that SUMO drives."""
        others = [ego, *(self._box_of(other) for other in self.released)]
        if any(clearance_m(box, other) == 0.0 for other in others):
            self._left_out.add(track)
            self._waits[track] = False
            return False
        vehicle, recording = self._connection.vehicle, self._recording
        vehicle.add(str(track), self._route_of(track), self._type_of(track), departPos=_ADDED_AT, departSpeed="0")
        vehicle.setLaneChangeMode(str(track), _NO_LANE_CHANGES)
        if not recording.yields[track]:
            for parameter in _IGNORED_BY:
                vehicle.setParameter(str(track), parameter, EGO)
        self._follow.add(track)
        return True

    def _route_of(self, track: int) -> str:
        """Return the id of a vehicle's route, which is made when it is first needed."""
        name = f"recorded.{track}"
        if name not in self._routes:
            self._connection.route.add(name, list(self._recording.routes[track]))
            self._routes.add(name)
        return name

    def _type_of(self, track: int) -> str:
        """Return the vType of a vehicle, which is made when it is first needed: its label's with its own numbers."""
        recording, types = self._recording, self._connection.vehicletype
        label = self._scene.vtypes[recording.labels[track]]
        name = f"{label}@{self._case.recording}.{track}"
        if name not in self._types:
            types.copy(label, name)
            box = recording.box[recording.first_row[track]]
            types.setLength(name, float(box["length_m"]))
            types.setWidth(name, float(box["width_m"]))
            for attribute, value in recording.attributes[track].items():
                getattr(types, f"set{attribute[0].upper()}{attribute[1:]}")(name, value)
            self._types.add(name)
        return name

    # Release

    def _release(self, driven_m: float, speed_mps: float) -> None:
        """Release the vehicles to which the ego matters, or a vehicle that is released."""
        recording = self._recording
        tracks = np.fromiter(sorted(self._follow), np.int64, len(self._follow))
        tracks = tracks[recording.drives_on[tracks]]
        meets = np.zeros(len(tracks), bool)
        vehicle = self._connection.vehicle
        ways = [(self._case.way.box, self._case.way.driven_m, driven_m, speed_mps)]
        for track in self.released:
            rows = self._rows_of(track)
            own_mps = vehicle.getSpeed(str(track))
            ways.append((recording.box[rows], recording.driven_m[rows], self._way_m(track), own_mps))
        for way, way_m, along_m, along_mps in ways:
            find_meetings(
                way,
                way_m,
                along_m,
                along_mps,
                self.step,
                self._horizon,
                self._every,
                self._step_s,
                tracks,
                recording.first_step,
                recording.first_row,
                recording.rows,
                recording.box,
                self._scene.release_m,
                meets,
            )
        for track in tracks[meets].tolist():
            row = self._row_of(track)
            if not recording.keeps_route[track]:
                self._come_back(track)
            vehicle.setPreviousSpeed(str(track), float(recording.speed_mps[row]))
            vehicle.setLaneChangeMode(str(track), _SUMO_LANE_CHANGES)
            odometer_m = vehicle.getDistance(str(track))
            self.released[track] = Released(float(recording.driven_m[row]), odometer_m, self.step)
            self._follow.discard(track)
            self._waits[track] = False
            self.released_so_far += 1

    def _come_back(self, track: int) -> None:
        """Give a vehicle the rest of its route, if it is on it; otherwise it drives to the end of its edge."""
        vehicle, route = self._connection.vehicle, self._recording.routes[track]
        edge = vehicle.getRoute(str(track))[vehicle.getRouteIndex(str(track))]
        if edge in route:
            with suppress(*SUMO_ERRORS):
                vehicle.setRoute(str(track), route[route.index(edge) :])

    def _rows_of(self, track: int) -> slice:
        first = int(self._recording.first_row[track])
        return slice(first, first + int(self._recording.rows[track]))

    def _row_of(self, track: int, step: int | None = None) -> int:
        """Return the row of a track at a step, or at the present one."""
        at = self.step if step is None else step
        return int(self._recording.first_row[track] + at - self._recording.first_step[track])

    def _length_m(self, track: int) -> float:
        return float(self._recording.driven_m[self._rows_of(track).stop - 1])

    def _way_m(self, track: int) -> float:
        """Return how far along its recorded way a released vehicle is."""
        state = self.released[track]
        return state.way_m + float(self._connection.vehicle.getDistance(str(track))) - state.odometer_m

    def _sight_of(self, track: int) -> dict[int, Any]:
        """Return where a released vehicle is; it comes to its lane's middle, where SUMO has it, little by little."""
        vehicle, vehicle_id, state = self._connection.vehicle, str(track), self.released[track]
        x_m, y_m, z_m = vehicle.getPosition3D(vehicle_id)
        angle_deg, odometer_m = vehicle.getAngle(vehicle_id), vehicle.getDistance(vehicle_id)
        if state.beside_m is None:
            moved_m = odometer_m - state.odometer_m
            state.beside_m = self._beside_m(self._row_of(track, state.step), moved_m, (x_m, y_m), angle_deg)
        share = math.exp(-(self.step - state.step) * self._step_s / _CENTRED_S)
        at_m = (x_m + share * state.beside_m[0], y_m + share * state.beside_m[1], z_m)
        return _sight(at_m, angle_deg, state.way_m + odometer_m - state.odometer_m)

    def _beside_m(self, row: int, moved_m: float, front_m: Point, angle_deg: float) -> Point:
        """Return the vector across a vehicle's heading from its front to where it would be without its lane."""
        box = self._recording.box[row]
        ahead_m = box["length_m"] / 2 + moved_m
        dx_m = float(box["x_m"] + ahead_m * box["heading_x"] - front_m[0])
        dy_m = float(box["y_m"] + ahead_m * box["heading_y"] - front_m[1])
        left_x, left_y = -math.cos(math.radians(angle_deg)), math.sin(math.radians(angle_deg))
        across_m = dx_m * left_x + dy_m * left_y
        return across_m * left_x, across_m * left_y

    def _box_of(self, track: int) -> Any:
        """Return the box of a released vehicle in the network's frame, a record."""
        recorded = self._recording.box[self._recording.first_row[track]]
        size_m = float(recorded["length_m"]), float(recorded["width_m"])
        return record_of(box_of(self._sight_of(track), size_m, (0.0, 0.0)))

    # Faults

    def _count_faults(self, ego: Any, now: "_Moment") -> None:
        """Count what is wrong among the recorded vehicles at this step."""
        off_road = np.flatnonzero(~now.on_road).tolist()
        self._off_road = len(off_road)
        for index in off_road:
            if now.tracks[index] not in self._touched and clearance_m(now.boxes[index], ego) == 0.0:
                self._touched.add(int(now.tracks[index]))
        overlaps = np.zeros((len(now.tracks), len(now.tracks)), bool)
        if len(now.tracks) and find_overlaps(now.boxes, overlaps):
            self._overlapped |= {(int(now.tracks[a]), int(now.tracks[b])) for a, b in np.argwhere(overlaps)}


@dataclass(frozen=True, eq=False)
class _Moment:
    """The M vehicles that are recorded at a step, and are not released."""

    tracks: Numbers  # (M,)
    boxes: Boxes  # (M,)
    on_road: Bools  # (M,)
    x_m: Floats  # (M,) of their fronts
    y_m: Floats  # (M,)
    angle_deg: Floats  # (M,) clockwise from north
    driven_m: Floats  # (M,)

    def places(self, chosen: Bools) -> Iterator[tuple[int, float, float, float, float]]:
        """Yield track, x, y, angle and distance driven of the chosen vehicles."""
        columns = (self.tracks, self.x_m, self.y_m, self.angle_deg, self.driven_m)
        return zip(*(column[chosen].tolist() for column in columns), strict=True)


def _sight(front_m: tuple[float, float, float], angle_deg: float, driven_m: float) -> dict[int, Any]:
    return {
        constants.VAR_POSITION3D: front_m,
        constants.VAR_ANGLE: angle_deg,
        constants.VAR_DISTANCE: driven_m,
        constants.VAR_STOPSTATE: 0,
    }
