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
from tint_sumo.simulation.willingness import DriverStates


class Yielding:
    """The claims of R egos on K routes, and the reactions of drivers to them; see ``tint_sumo.config.Claim``.

    =============== ======= ==================================================
    ``has_claimed`` (R, K)  which of the traffic's routes the ego claims
    ``reacts``      (R, V)  who reacts to the ego's claim on their route
    ``yields``      (R, V)  which slots hold a driver who would yield now
    ``refuses``     (R, V)  whose trait it is to yield, but who would not now
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
        willingness = layout.scene.population.willingness
        self._states = None if willingness is None else DriverStates(willingness, layout, slots)

    @property
    def yields(self) -> Bools:
        return np.asarray(self._yields[self._slots.member] & ~self.refuses)

    @property
    def refuses(self) -> Bools:
        if self._states is None:
            return np.zeros(self.reacts.shape, bool)
        return np.asarray(self._yields[self._slots.member] & ~(self._states.willing | self.reacts))

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
        slots, yields = self._slots, self._yields[self._slots.member]
        for replica, route in np.argwhere(self._claim_changed).tolist():
            on_route = np.flatnonzero(yields[replica] & (slots.route[replica] == route)).tolist()
            if self.has_claimed[replica, route]:
                for slot in on_route:
                    self._consider(replica, slot)
            else:
                for slot in on_route:
                    if self.reacts[replica, slot]:
                        self._set(replica, slot, False)

    def follow(self, time_s: Floats, egos_mps: Floats | None) -> None:
        """Take a step of the drivers' states, and let those react who have become willing to.

        Args:
            time_s: (R,) since the episodes' start.
            egos_mps: (R,) speeds of the egos; without egos, drivers are as if one waited.
        """
        settings = self._layout.scene.population.willingness
        if self._states is None or settings is None:
            return
        waits = np.ones(len(time_s), bool) if egos_mps is None else egos_mps <= settings.waiting_speed_mps
        woke = self._states.follow(time_s, waits)
        for replica, slot in np.argwhere(woke & self._claimed() & ~self.reacts).tolist():
            self._consider(replica, slot)

    def _claimed(self) -> Bools:
        """Return the slots (R, V) whose route is claimed."""
        return np.take_along_axis(self.has_claimed, self._slots.route, axis=1)

    def enter(self, replica: int, slot: int, speed_mps: float, seed: int = 0, time_s: float = 0.0) -> None:
        """Let a driver who appears react if its route is claimed; seed and time are those of its state."""
        if self._states is not None:
            self._states.enter(replica, slot, seed, speed_mps, time_s)
        if self.has_claimed[replica, self._slots.route[replica, slot]]:
            self._consider(replica, slot, speed_mps)

    def _consider(self, replica: int, slot: int, speed_mps: float | None = None) -> None:
        """Let a driver on a claimed route yield, if it would and can still stop clear of the ego's way."""
        slots, claim = self._slots, self._layout.scene.claim
        would = self._states is None or bool(self._states.willing[replica, slot])
        if not would or not self._yields[slots.member[replica, slot]]:
            return
        speed_mps = self._link.speed_mps(replica, slot) if speed_mps is None else speed_mps
        stop_line_m = self._layout.zones.stop_line_m[slots.route[replica, slot]]
        if stop_line_m - slots.front_m[replica, slot] >= claim.stopping_distance_m(speed_mps):
            self._set(replica, slot, True)

    def leave(self, replica: int, slot: int) -> None:
        """Forget a driver that has left the roads."""
        self.reacts[replica, slot] = False
        if self._states is not None:
            self._states.leave(replica, slot)

    def clear(self, replica: int) -> None:
        """Give up the claims of a replica, whose vehicles have all left."""
        self.has_claimed[replica] = self._claim_changed[replica] = False
        if self._states is not None:
            self._states.clear(replica)

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
