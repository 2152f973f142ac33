"""The right of way at the junction that the ego comes to next in a SUMO configuration."""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from tint_sumo.scenes.geometry import Bools
from tint_sumo.simulation.connection import Connection
from tint_sumo.simulation.ego_way import EGO, JUNCTION
from tint_sumo.simulation.traffic_lights import RED

# SUMO's letters of links with priority: on the main road, at green, with lights that are off, and at yellow.
_FIRST = frozenset("MGOY")


@dataclass(frozen=True)
class Crossing:
    """The ego's link over a junction.

    ``foe_lanes`` lead to the junction, and their vehicles have priority over the ego where their ways meet its;
    ``across`` are the lanes on the junction that meet the ego's way. Both are SUMO's.
    """

    lane: str  # before the junction
    line_m: float  # position of the lane's end on the ego's route
    foe_lanes: frozenset[str]
    across: frozenset[str]


class RightOfWay:
    """Follows the right of way at the ego's next junction, or at the one that it is on.

    ``crossing`` is the ego's link there, None without a junction to come. ``must_yield`` is whether the link has no
    priority, as by signs, at red, or where the right goes before the left. ``has_priority`` (V,) is which of the
    vehicles in slots have priority over the ego there.
    """

    def __init__(self, connection: Connection, slots: int, ego: str = EGO) -> None:
        self._connection = connection
        self._ego = ego
        self._known: dict[tuple[str, str, str], tuple[frozenset[str], frozenset[str]]] = {}  # by lanes of the link
        self.has_priority: Bools = np.zeros(slots, bool)
        self.clear()

    def clear(self) -> None:
        """Forget an episode."""
        self.crossing: Crossing | None = None
        self.must_yield = False
        self.has_priority[:] = False

    def follow(self, front_m: float, slot: Mapping[str, int]) -> None:
        """Take over the state after a step, or at an episode's begin.

        Args:
            front_m: position of the ego's front on its route.
            slot: slots of vehicles by their ids.
        """
        vehicle = self._connection.vehicle
        lane = vehicle.getLaneID(self._ego)
        if not lane.startswith(JUNCTION):
            self.crossing, self.must_yield = None, False
            for after, _, _, _, via, state, *_ in vehicle.getNextLinks(self._ego)[:1]:
                left_m = self._connection.lane.getLength(lane) - vehicle.getLanePosition(self._ego)
                self.crossing = Crossing(lane, front_m + left_m, *self._foes(lane, after, via))
                self.must_yield = state not in _FIRST
        self.has_priority[:] = False
        if self.crossing is not None and self.crossing.foe_lanes:
            for vehicle_id, number in slot.items():
                self.has_priority[number] = self._goes_before(vehicle_id, self.crossing)

    def _foes(self, lane: str, after: str, via: str) -> tuple[frozenset[str], frozenset[str]]:
        """Return ``foe_lanes`` and ``across`` of a link; networks can lack the lanes on junctions."""
        key = (lane, after, via)
        if key not in self._known:
            lanes = self._connection.lane
            across = lanes.getInternalFoes(via) if via else ()
            self._known[key] = (frozenset(lanes.getFoes(lane, after)), frozenset(across))
        return self._known[key]

    def _goes_before(self, vehicle_id: str, crossing: Crossing) -> bool:
        """Return whether a vehicle on a foe's way to the junction, or across it, has priority over the ego."""
        vehicle = self._connection.vehicle
        lane = vehicle.getLaneID(vehicle_id)
        if lane in crossing.across:
            came_from = vehicle.getRoute(vehicle_id)[vehicle.getRouteIndex(vehicle_id)]
            return any(foe.rpartition("_")[0] == came_from for foe in crossing.foe_lanes)
        for after, _, _, _, via, state, *_ in vehicle.getNextLinks(vehicle_id):
            if lane in crossing.foe_lanes and (via in crossing.across or not via):
                return state not in RED
            lane = after
        return False
