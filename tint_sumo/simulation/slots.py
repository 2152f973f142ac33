"""The vehicle slots of a simulation: which vehicle is in which slot, and where it is."""

import numpy as np

from tint_sumo.scenes.geometry import BOX, NO_VEHICLE, Bools, Boxes, Floats, Numbers


class Slots:
    """The vehicles of R replicas in V slots each; arrays are (R, V).

    ================== =========================================================================================
    ``present``        which slots hold a vehicle
    ``route``          number of its route; 0 where SUMO's demand gives the routes
    ``front_m``        front bumper's distance along the route; where SUMO gives the routes, its odometer
    ``box``            records of ``tint_sumo.scenes.geometry.BOX``
    ``member``         number of its driver in the population, or of its vType; ``NO_VEHICLE`` in empty slots
    ``vehicle_number`` running number of the vehicle in its replica's episode; ``NO_VEHICLE`` in empty slots
    ================== =========================================================================================

    A vehicle keeps its slot while it is on the roads or, of a SUMO configuration, one of the nearest in sight. A slot
    stays empty for at least a step between two vehicles.
    """

    def __init__(self, replicas: int, max_vehicles: int) -> None:
        shape = (replicas, max_vehicles)
        self.present: Bools = np.zeros(shape, bool)
        self.route: Numbers = np.zeros(shape, np.int64)
        self.front_m: Floats = np.zeros(shape)
        self.box: Boxes = np.zeros(shape, BOX)
        self.length_m: Floats = self.box["length_m"]
        self.width_m: Floats = self.box["width_m"]
        self.member: Numbers = np.full(shape, NO_VEHICLE)
        self.vehicle_number: Numbers = np.full(shape, NO_VEHICLE)
        # A slot that held a vehicle at the previous step takes no new one yet.
        self._was_present: Bools = np.zeros(shape, bool)

    def take(
        self, replica: int, slot: int, *, member: int, number: int, size_m: tuple[float, float], route: int = 0
    ) -> None:
        """Put a vehicle into an empty slot; where it is follows."""
        self.present[replica, slot] = True
        self.route[replica, slot] = route
        self.member[replica, slot] = member
        self.vehicle_number[replica, slot] = number
        self.length_m[replica, slot], self.width_m[replica, slot] = size_m

    def leave(self, replica: int, slot: int) -> None:
        """Empty the slot of a vehicle that has left."""
        self.present[replica, slot] = False
        self.member[replica, slot] = self.vehicle_number[replica, slot] = NO_VEHICLE

    def begin_step(self) -> None:
        """Remember which slots are taken; those that become empty in this step stay so until the next one."""
        np.copyto(self._was_present, self.present)

    def clear(self, replica: int) -> None:
        """Empty all slots of a replica as if they had never held a vehicle; they may be taken at once."""
        for array in (self.present, self.route, self.front_m, self._was_present):
            array[replica] = 0
        self.box[replica] = np.zeros((), BOX)
        self.member[replica] = self.vehicle_number[replica] = NO_VEHICLE

    def free(self, replica: int) -> int:
        """Return the first slot that may be taken; ``NO_VEHICLE`` if there is none."""
        free = np.flatnonzero(~(self.present[replica] | self._was_present[replica]))
        return int(free[0]) if len(free) else NO_VEHICLE
