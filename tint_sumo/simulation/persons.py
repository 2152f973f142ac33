"""The persons on foot around the ego in a SUMO configuration.

They take no slots, since the observation has vehicles alone. But the ego can touch them, its safety check counts
those on the carriageway, and pictures show them.
"""

from collections.abc import Mapping
from typing import Any

import numpy as np
from libsumo import constants

from tint_sumo.scenes.geometry import BOX, NO_VEHICLE, Bools, Boxes, Floats, measure_distances_m, sweep
from tint_sumo.scenes.sumocfg import SumocfgScene
from tint_sumo.simulation.bodies import box_of
from tint_sumo.simulation.connection import Connection
from tint_sumo.simulation.ego import Egos, check_safety
from tint_sumo.simulation.ego_way import EGO

_SEEN = (
    *(constants.VAR_POSITION3D, constants.VAR_ANGLE, constants.VAR_SPEED),
    *(constants.VAR_LANE_ID, constants.VAR_VEHICLE),
)
_SHARED = (constants.VAR_POSITION3D, constants.VAR_ANGLE, constants.VAR_SPEED)  # variables of vehicles, too
_AROUND_M = 40.0  # pictures show no more
_LEVEL_M = 3.0  # persons that are so much higher or lower are on a bridge, or under it
_CROSSING = "_c"  # in ids of a crossing's lanes

Sights = dict[str, Mapping[int, Any]]  # variables of vehicles or persons


class Persons:
    """The persons around the ego in a running simulation.

    ``boxes`` (P,) are records of ``tint_sumo.scenes.geometry.BOX`` in the scene's frame, ``velocity_mps`` (P, 2) their
    velocities, and ``ids`` are their ids.
    """

    def __init__(self, scene: SumocfgScene, connection: Connection, ego: str = EGO) -> None:
        self._connection = connection
        self._ego = ego
        reach_m = max(_AROUND_M, scene.sight_m) if "pedestrians" in scene.perceives else _AROUND_M
        self._around_m = reach_m + scene.controller.desired_speeds_mps[-1] * scene.step_s
        self._pavements: dict[str, bool] = {}  # whether a lane is for pedestrians alone, and no crossing
        self.clear()

    def clear(self) -> None:
        """Forget the persons of an episode."""
        self.ids: tuple[str, ...] = ()
        self.boxes: Boxes = np.zeros(0, BOX)
        self.velocity_mps: Floats = np.zeros((0, 2))
        self._subscribed = False
        self._on_road: Bools = np.zeros(0, bool)
        self._was_box: dict[str, Any] = {}  # a step ago
        self._was_distance_m: dict[str, float] = {}
        self._was_ego: Boxes = np.zeros(0, BOX)

    def take_from(self, seen: Sights) -> Sights:
        """Take persons out of what SUMO says to be around the ego, and return those on foot.

        SUMO mixes the variables of a person and a vehicle with the same id.
        """
        if not self._subscribed:
            if self._connection.person.getIDCount():
                vehicle = self._connection.vehicle
                vehicle.subscribeContext(self._ego, constants.CMD_GET_PERSON_VARIABLE, self._around_m, _SEEN)
                self._subscribed = True
                return self.take_from(seen | vehicle.getContextSubscriptionResults(self._ego))
            return {}
        found = {name: seen[name] for name in seen if constants.VAR_VEHICLE in seen[name]}
        for name, sight in tuple(found.items()):
            if constants.VAR_DISTANCE in sight:
                seen[name] = {**sight, **_ask(self._connection.vehicle, name)}
                found[name] = {**sight, **_ask(self._connection.person, name)}
            else:
                del seen[name]
        return {name: sight for name, sight in found.items() if not sight[constants.VAR_VEHICLE]}

    def follow(self, on_foot: Sights, origin_m: tuple[float, float], ego_z_m: float) -> None:
        """Take over where the persons are that are on the ego's level."""
        if not on_foot and not self.ids:
            return
        near = {
            name: sight
            for name, sight in on_foot.items()
            if abs(sight[constants.VAR_POSITION3D][2] - ego_z_m) < _LEVEL_M
        }
        self.ids = tuple(near)
        self.boxes = np.zeros(len(near), BOX)
        for index, (name, sight) in enumerate(near.items()):
            size_m = (self._connection.person.getLength(name), self._connection.person.getWidth(name))
            self.boxes[index] = box_of(sight, size_m, origin_m)
        speed_mps = np.array([sight[constants.VAR_SPEED] for sight in near.values()])
        self.velocity_mps = np.stack([self.boxes["heading_x"], self.boxes["heading_y"]], axis=1) * speed_mps[:, None]
        self._on_road = np.array([not self._is_pavement(sight[constants.VAR_LANE_ID]) for sight in near.values()], bool)

    def _is_pavement(self, lane: str) -> bool:
        if lane not in self._pavements:
            alone = bool(lane) and tuple(self._connection.lane.getAllowed(lane)) == ("pedestrian",)
            self._pavements[lane] = alone and not (lane.startswith(":") and _CROSSING in lane)
        return self._pavements[lane]

    def look_around(self, egos: Egos) -> str:
        """Add to the safety check of the ego; return the id of a person that it has touched, or an empty one."""
        before = self._was_box
        same = np.array([[name in before for name in self.ids]], bool)
        were = np.array([[before.get(name, box) for name, box in zip(self.ids, self.boxes, strict=True)]], BOX)
        was_m = np.array([[self._was_distance_m.get(name, np.inf) for name in self.ids]])
        boxes, distance_m = self.boxes[None], np.full((1, len(self.ids)), np.inf)
        measure_distances_m(egos.box, np.ones(same.shape, bool), boxes, np.inf, distance_m)
        counts_m = np.where(self._on_road | (distance_m == 0.0), distance_m, np.inf)
        unsafe, hit = np.zeros(1, bool), np.full(1, NO_VEHICLE)
        check_safety(counts_m, was_m, egos.box, boxes, egos.rules, unsafe, hit)
        if egos.parts > 1 and len(self._was_ego):
            sweep(self._was_ego, egos.box, same, were, boxes, egos.parts, hit)
        egos.unsafe |= unsafe
        self._was_box = dict(zip(self.ids, self.boxes, strict=True))
        self._was_distance_m = dict(zip(self.ids, counts_m[0].tolist(), strict=True))
        self._was_ego = egos.box.copy()
        return self.ids[hit[0]] if hit[0] != NO_VEHICLE else ""


def _ask(domain: Any, name: str) -> dict[int, Any]:
    """Return the variables that vehicles and persons have both, of one of them."""
    return dict(zip(_SHARED, (domain.getPosition3D(name), domain.getAngle(name), domain.getSpeed(name)), strict=True))
