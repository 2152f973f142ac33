"""Which drivers react to an ego that claims their route, and how SUMO is told."""

import numpy as np

from tint_sumo.scenes.drivers import DriverMember
from tint_sumo.scenes.geometry import Bools
from tint_sumo.scenes.layout import Layout
from tint_sumo.simulation.ego import Egos
from tint_sumo.simulation.slots import Slots
from tint_sumo.simulation.sumo import SumoLink
from tint_sumo.simulation.timing import StepPart, does


class Yielding:
    """``reacts`` (R, V): who reacts to the ego's claim on their route; see ``tint_sumo.config.Claim``."""

    def __init__(
        self, replicas: int, population: tuple[DriverMember, ...], layout: Layout, slots: Slots, link: SumoLink
    ) -> None:
        self._population = population
        self._yields = np.array([*(member.profile.yields for member in population), False])  # the last: empty slots
        self._layout = layout
        self._slots = slots
        self._link = link
        self.reacts: Bools = np.zeros((replicas, layout.scene.max_vehicles), bool)

    @property
    def yields(self) -> Bools:
        """Which slots hold a driver whose trait it is to yield; (R, V)."""
        return np.asarray(self._yields[self._slots.member])

    @does(StepPart.CLAIMS)
    def answer(self, egos: Egos) -> None:
        """Let drivers react to claims that are new, and drive on where a claim was given up."""
        slots = self._slots
        yields = self.yields
        for replica, route in np.argwhere(egos.claim_changed).tolist():
            on_route = yields[replica] & (slots.route[replica] == route)
            if egos.has_claimed[replica, route]:
                for slot in np.flatnonzero(on_route).tolist():
                    self.consider(replica, slot, self._link.speed_mps(replica, slot))
            else:
                for slot in np.flatnonzero(on_route & self.reacts[replica]).tolist():
                    self._set(replica, slot, False)

    def consider(self, replica: int, slot: int, speed_mps: float) -> None:
        """Let a driver on a claimed route yield, if that is its trait and it can still stop clear of the ego's way."""
        slots, claim = self._slots, self._layout.scene.claim
        stop_line_m = self._layout.zones.stop_line_m[slots.route[replica, slot]]
        can_stop = stop_line_m - slots.front_m[replica, slot] >= claim.stopping_distance_m(speed_mps)
        if self._yields[slots.member[replica, slot]] and can_stop:
            self._set(replica, slot, True)

    def leave(self, replica: int, slot: int) -> None:
        """Forget a driver that has left the roads."""
        self.reacts[replica, slot] = False

    def _set(self, replica: int, slot: int, reacts: bool) -> None:
        self.reacts[replica, slot] = reacts
        courtesy_m = self._layout.scene.claim.courtesy_gap_m if reacts else 0.0
        min_gap_m = self._population[self._slots.member[replica, slot]].min_gap_m
        self._link.react(replica, slot, reacts, min_gap_m + courtesy_m)
