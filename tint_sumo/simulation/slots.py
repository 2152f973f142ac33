"""Which vehicle is in which slot, and where it is."""

import numpy as np

from tint_sumo.scenes.geometry import POSE, Bools, Floats, Numbers, Poses, follow
from tint_sumo.scenes.layout import Layout

EMPTY = -1


class Slots:
    """The vehicles of R replicas in V slots each; arrays are (R, V) where nothing else is said.

    ================== =========================================================================================
    ``present``        which slots hold a vehicle
    ``route``          number of its route
    ``stage``          on which of the route's SUMO lanes it is
    ``front_m``        front bumper's distance along the route
    ``pose``           records of ``tint_sumo.scenes.geometry.POSE``; ``x_m`` and ``y_m`` are its fields
    ``member``         index into the population, -1 in empty slots
    ``vehicle_number`` running number of the vehicle in its replica's episode, -1 in empty slots
    ``newest``         (R, K) slot of the vehicle that entered each route last, -1 if it has left
    ================== =========================================================================================

    A vehicle keeps its slot while it is on the roads, and a slot stays empty for at least a step between two.
    """

    def __init__(self, replicas: int, layout: Layout) -> None:
        self._layout = layout
        shape = (replicas, layout.scene.max_vehicles)
        self.present: Bools = np.zeros(shape, bool)
        self.route: Numbers = np.zeros(shape, np.int64)
        self.stage: Numbers = np.zeros(shape, np.int64)
        self.front_m: Floats = np.zeros(shape)
        self.pose: Poses = np.zeros(shape, POSE)
        self.x_m: Floats = self.pose["x_m"]
        self.y_m: Floats = self.pose["y_m"]
        self.member: Numbers = np.full(shape, EMPTY)
        self.vehicle_number: Numbers = np.full(shape, EMPTY)
        self._lane_pos_m: Floats = np.zeros(shape)
        # A slot that held a vehicle at the previous step takes no new one yet.
        self._was_present: Bools = np.zeros(shape, bool)
        self._newcomer, self._newcomer_pos_m = np.zeros(1, np.int64), np.zeros(1)
        self.newest: Numbers = np.full((replicas, len(layout.routes)), EMPTY)  # slot of each route's last newcomer

    def take(self, replica: int, slot: int, route: int, front_m: float, member: int, number: int) -> None:
        """Take over a vehicle that appears in an empty slot."""
        stage, lane_pos_m = self._layout.routes[route].lane_at(front_m)
        self.present[replica, slot] = True
        self.route[replica, slot] = route
        self.stage[replica, slot] = stage
        self.member[replica, slot] = member
        self.vehicle_number[replica, slot] = number
        self.newest[replica, route] = slot
        self._lane_pos_m[replica, slot] = lane_pos_m
        self._newcomer[0], self._newcomer_pos_m[0] = self.index(replica, slot), lane_pos_m
        self.follow(self._newcomer, self._newcomer_pos_m)

    def leave(self, replica: int, slot: int) -> None:
        """Empty the slot of a vehicle that has left the roads."""
        self.present[replica, slot] = False
        self.member[replica, slot] = EMPTY
        self.vehicle_number[replica, slot] = EMPTY
        route = self.route[replica, slot]
        if self.newest[replica, route] == slot:
            self.newest[replica, route] = EMPTY

    def begin_step(self) -> None:
        np.copyto(self._was_present, self.present)

    def clear(self, replica: int) -> None:
        """Empty all slots of a replica as if they had never held a vehicle; they may be taken at once."""
        for array in (self.present, self.route, self.stage, self.front_m, self._lane_pos_m, self._was_present):
            array[replica] = 0
        self.pose[replica] = np.zeros((), POSE)
        for array in (self.member, self.vehicle_number, self.newest):
            array[replica] = EMPTY

    def free(self, replica: int) -> int:
        """A slot that may be taken, -1 if there is none."""
        free = np.flatnonzero(~(self.present[replica] | self._was_present[replica]))
        return int(free[0]) if len(free) else EMPTY

    def index(self, replica: int, slot: int) -> int:
        """Number of a slot among all replicas' slots."""
        return replica * int(self.present.shape[1]) + slot

    def follow(self, index: Numbers, lane_pos_m: Floats) -> None:
        """Take over from SUMO where the vehicles in some slots (K,) are on their lanes (K,)."""
        layout = self._layout
        follow(
            index,
            lane_pos_m,
            self.route.ravel(),
            layout.lane_start_m,
            layout.ways,
            layout.scene.vehicle.length_m,
            self.stage.ravel(),
            self._lane_pos_m.ravel(),
            self.front_m.ravel(),
            self.pose.ravel(),
        )
