"""The egos' claims on the traffic's routes, and the drivers who yield to them."""

import numpy as np

from tint_sumo.core.compiling import compiled
from tint_sumo.scenes.drivers import DriverMember
from tint_sumo.scenes.geometry import SPACING_M, Bools, Floats
from tint_sumo.scenes.layout import Layout
from tint_sumo.simulation.ego import Egos
from tint_sumo.simulation.slots import Slots
from tint_sumo.simulation.sumo import SumoLink
from tint_sumo.simulation.timing import StepPart, does


class Yielding:
    """The claims of R egos on K routes, and the reactions of drivers to them; see ``tint_sumo.config.Claim``.

    =============== ======= ==================================================
    ``has_claimed`` (R, K)  which of the traffic's routes the ego claims
    ``reacts``      (R, V)  who reacts to the ego's claim on their route
    ``yields``      (R, V)  which slots hold a driver whose trait it is to yield
    =============== ======= ==================================================
    """

    def __init__(self, population: tuple[DriverMember, ...], layout: Layout, slots: Slots, link: SumoLink) -> None:
        replicas = len(slots.present)
        self._population = population
        self._yields = np.array([*(member.profile.yields for member in population), False])  # the last: empty slots
        self._layout = layout
        self._slots = slots
        self._link = link
        self.has_claimed: Bools = np.zeros((replicas, len(layout.routes)), bool)
        self._claim_changed: Bools = np.zeros((replicas, len(layout.routes)), bool)
        self.reacts: Bools = np.zeros(slots.present.shape, bool)

    @property
    def yields(self) -> Bools:
        return np.asarray(self._yields[self._slots.member])

    @does(StepPart.CLAIMS)
    def update(self, egos: Egos) -> None:
        """Let egos claim routes and give them up, and drivers react to that."""
        zones = self._layout.zones
        if update_claims(
            egos.front_m,
            egos.speed_mps,
            zones.enter_m,
            zones.inside_m,
            zones.towards,
            SPACING_M,
            self._layout.scene.claim.approach_speed_mps,
            self.has_claimed,
            self._claim_changed,
        ):
            self._answer()

    def _answer(self) -> None:
        """Let drivers react to claims that are new, and drive on where a claim was given up."""
        slots, yields = self._slots, self.yields
        for replica, route in np.argwhere(self._claim_changed).tolist():
            on_route = yields[replica] & (slots.route[replica] == route)
            if self.has_claimed[replica, route]:
                for slot in np.flatnonzero(on_route).tolist():
                    self._consider(replica, slot, self._link.speed_mps(replica, slot))
            else:
                for slot in np.flatnonzero(on_route & self.reacts[replica]).tolist():
                    self._set(replica, slot, False)

    def enter(self, replica: int, slot: int, speed_mps: float) -> None:
        """Let a driver who appears react if its route is claimed."""
        if self.has_claimed[replica, self._slots.route[replica, slot]]:
            self._consider(replica, slot, speed_mps)

    def _consider(self, replica: int, slot: int, speed_mps: float) -> None:
        """Let a driver on a claimed route yield, if that is its trait and it can still stop clear of the ego's way."""
        slots, claim = self._slots, self._layout.scene.claim
        stop_line_m = self._layout.zones.stop_line_m[slots.route[replica, slot]]
        can_stop = stop_line_m - slots.front_m[replica, slot] >= claim.stopping_distance_m(speed_mps)
        if self._yields[slots.member[replica, slot]] and can_stop:
            self._set(replica, slot, True)

    def leave(self, replica: int, slot: int) -> None:
        """Forget a driver that has left the roads."""
        self.reacts[replica, slot] = False

    def clear(self, replica: int) -> None:
        """Give up the claims of a replica, whose vehicles have all left."""
        self.has_claimed[replica] = self._claim_changed[replica] = False

    def _set(self, replica: int, slot: int, reacts: bool) -> None:
        self.reacts[replica, slot] = reacts
        courtesy_m = self._layout.scene.claim.courtesy_gap_m if reacts else 0.0
        min_gap_m = self._population[self._slots.member[replica, slot]].min_gap_m
        self._link.react(replica, slot, reacts, min_gap_m + courtesy_m)


@compiled
def update_claims(
    front_m: Floats,
    speed_mps: Floats,
    enter_m: Floats,
    inside_m: Floats,
    towards: Floats,
    spacing_m: float,
    approach_speed_mps: float,
    claimed: Bools,
    changed: Bools,
) -> bool:
    """Write which routes each ego claims and where that changed, both (R, K); return whether any did.

    An ego claims a route once its front has entered the lane and it either moves in or stands in the vehicles' path.
    Without the second condition a standing ego could probe drivers at no risk.

    Args:
        front_m, speed_mps: (R,).
        enter_m, inside_m, towards: (K,), (K,) and (K, P); see ``tint_sumo.scenes.layout.ConflictZones``.
        spacing_m: between the P points of the ego's way.
        approach_speed_mps: of ``tint_sumo.config.Claim``.
    """
    any_changed = False
    for row in range(len(front_m)):
        index = min(max(int(front_m[row] / spacing_m), 0), towards.shape[1] - 1)
        for route in range(len(enter_m)):
            moves_in = speed_mps[row] * towards[route, index] > approach_speed_mps
            now = front_m[row] > enter_m[route] and (moves_in or front_m[row] > inside_m[route])
            changed[row, route] = now != claimed[row, route]
            claimed[row, route] = now
            any_changed = any_changed or changed[row, route]
    return any_changed
