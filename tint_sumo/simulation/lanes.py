"""Positions of vehicles along their routes, from those on SUMO's lanes."""

import numpy as np

from tint_sumo.scenes.geometry import Bools, Floats, Numbers, find_leaders, follow
from tint_sumo.scenes.layout import Layout
from tint_sumo.simulation.slots import Slots


class LanePositions:
    """The lanes on which the vehicles in slots are; both arrays are (R, V).

    Args:
        layout: of the scene.
        slots: of the vehicles; ``front_m`` and ``box`` are written.
    """

    def __init__(self, layout: Layout, slots: Slots) -> None:
        self._layout = layout
        self._slots = slots
        self.stage: Numbers = np.zeros(slots.present.shape, np.int64)  # number of the lane on the vehicle's route
        self._lane_pos_m: Floats = np.zeros(slots.present.shape)
        self._newcomer, self._newcomer_pos_m = np.zeros(1, np.int64), np.zeros(1)

    def enter(self, replica: int, slot: int, front_m: float) -> None:
        """Begin with the vehicle in a slot, whose front is so far along its route."""
        slots = self._slots
        stage, lane_pos_m = self._layout.routes[slots.route[replica, slot]].lane_at(front_m)
        self.stage[replica, slot] = stage
        self._lane_pos_m[replica, slot] = lane_pos_m
        self._newcomer[0], self._newcomer_pos_m[0] = replica * slots.present.shape[1] + slot, lane_pos_m
        self.follow(self._newcomer, self._newcomer_pos_m)

    def follow(self, index: Numbers, lane_pos_m: Floats) -> None:
        """Move vehicles to where SUMO has them on their lanes (N,); numbers (N,) of their slots among all replicas'."""
        layout, slots = self._layout, self._slots
        follow(
            index,
            lane_pos_m,
            slots.route.ravel(),
            layout.lane_start_m,
            layout.ways,
            self.stage.ravel(),
            self._lane_pos_m.ravel(),
            slots.front_m.ravel(),
            slots.box.ravel(),
        )

    def clear(self, replica: int) -> None:
        """Forget the vehicles of a replica."""
        self.stage[replica] = 0
        self._lane_pos_m[replica] = 0.0

    def leaders(self, replicas: slice, among: Bools) -> tuple[Numbers, Floats]:
        """Return the leaders' slots and the gaps to them, as in ``Simulation.leaders``, among some vehicles (R, V)."""
        layout, slots = self._layout, self._slots
        route = slots.route[replicas]
        leader, gap_m = np.empty(route.shape, np.int64), np.empty(route.shape)
        find_leaders(
            among,
            route,
            self.stage[replicas],
            slots.front_m[replicas],
            slots.box[replicas],
            layout.lane_start_m,
            layout.lane_on_route_m,
            leader,
            gap_m,
        )
        return leader, gap_m
