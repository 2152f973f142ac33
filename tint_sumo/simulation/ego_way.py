"""The ego's way through a SUMO configuration: it keeps its route, and is lost where SUMO takes it off.

SUMO can remove or teleport a vehicle that has waited for long, and calibrators, for example, remove vehicles, too. All
of them vanish like one that has come to the end of its route. Rerouters and rerouting devices give vehicles other
routes.
"""

import math
from collections.abc import Mapping, Sequence
from enum import Enum, auto
from typing import Any

import numpy as np
from libsumo import constants

from tint_sumo.simulation.connection import SUMO_ERRORS, Connection

EGO = "tint_sumo.ego"  # vehicle, vType and route; no user's id
# SUMO takes a vehicle for arrived within 0.1 m; a position that it gives can be rounded.
_ARRIVAL_M = 0.2
JUNCTION = ":"  # edges on junctions begin so


class Fate(Enum):
    """State of the ego after a step."""

    DRIVES = auto()
    ARRIVED = auto()  # at the end of its route
    LOST = auto()  # removed, teleported, or without a way back to its route


class EgoWay:
    """Watches the ego in a running simulation; made when it has departed on its route.

    Args:
        connection: the simulation.
        edges: the ego's route.
        most_m: it drives no further in a step.
        ego: the ego's id.
    """

    def __init__(self, connection: Connection, edges: Sequence[str], most_m: float, ego: str = EGO) -> None:
        self._connection = connection
        self._ego = ego
        self._edges = tuple(edges)
        *_, self._end_m = lengths_m = [float(connection.lane.getLength(f"{edge}_0")) for edge in edges]
        # The route's end can be reached in a step from the edges after which so little is left.
        left_m = np.cumsum(lengths_m[::-1])[::-1] - lengths_m
        self._near_end = int(np.argmax(left_m <= most_m + _ARRIVAL_M))
        connection.vehicle.subscribe(ego, (constants.VAR_ROUTE_ID, constants.VAR_ROAD_ID))
        found = connection.vehicle.getSubscriptionResults(ego)
        self._route_id = ego
        self._number = 0  # of the edge that the ego has come to
        self._left_m = math.inf  # from there to the route's end
        self._is_on(found)

    def look(self, moved_m: float) -> Fate:
        """Return the ego's state after a step of at most this length; put it back on its route if it was rerouted."""
        found = self._connection.vehicle.getSubscriptionResults(self._ego)
        if self._ego in self._connection.simulation.getStartingTeleportIDList():
            return Fate.LOST
        if not found:
            return Fate.ARRIVED if moved_m >= self._left_m - _ARRIVAL_M else Fate.LOST
        return Fate.DRIVES if self._is_on(found) else Fate.LOST

    def _is_on(self, found: Mapping[int, Any]) -> bool:
        """Return whether the ego is on its route, and goes on there."""
        edge = found[constants.VAR_ROAD_ID]
        if edge != self._edges[self._number] and not edge.startswith(JUNCTION):
            if edge not in self._edges[self._number :]:
                return False
            self._number = self._edges.index(edge, self._number)
        vehicle = self._connection.vehicle
        if found[constants.VAR_ROUTE_ID] != self._route_id:
            try:
                vehicle.setRoute(self._ego, self._edges[self._number :])
            except SUMO_ERRORS:  # such as an edge ahead that a rerouter has closed
                return False
            self._route_id = vehicle.getRouteID(self._ego)
        if self._number >= self._near_end:
            left_m = vehicle.getDrivingDistance(self._ego, self._edges[-1], self._end_m)
            self._left_m = left_m if left_m >= 0.0 else math.inf
        return True
