"""The states of drivers on which it depends whether they would yield now: chance, attention, politeness."""

import math

import numpy as np

from tint_sumo.config import Willingness
from tint_sumo.core.compiling import compiled
from tint_sumo.scenes.geometry import Bools, Floats
from tint_sumo.scenes.layout import Layout
from tint_sumo.simulation.slots import Slots

_NEVER_S = math.inf


class DriverStates:
    """The states of the drivers of R replicas in V slots; see ``tint_sumo.config.Willingness``.

    All that is random in a driver follows from its seed alone.

    ============== ======= ===============================================================================
    ``willing``    (R, V)  who would yield now, if yielding is its trait at all; False in empty slots
    ``waited_s``   (R,)    for how long the ego has waited in the episode
    ============== ======= ===============================================================================
    """

    def __init__(self, settings: Willingness, layout: Layout, slots: Slots) -> None:
        shape = slots.present.shape
        self._settings = settings
        self._layout = layout
        self._slots = slots
        self._patience_s = _NEVER_S if settings.patience_s is None else settings.patience_s
        self._rngs: list[list[np.random.Generator | None]] = [[None] * shape[1] for _ in range(shape[0])]
        self.willing: Bools = np.zeros(shape, bool)
        self.waited_s: Floats = np.zeros(shape[0])
        self._woke: Bools = np.zeros(shape, bool)
        self._braking_mps2: Floats = np.zeros(shape)  # infinite without a limit
        self._chance: Floats = np.ones(shape)  # a driver is willing where the probability is above it
        self._attentive: Bools = np.zeros(shape, bool)
        self._until_s: Floats = np.full(shape, _NEVER_S)  # end of the present period of attention or of its lapse
        self._was_m: Floats = np.zeros(shape)  # fronts one step ago

    def enter(self, replica: int, slot: int, seed: int, speed_mps: float, time_s: float) -> None:
        """Draw the state of a driver who appears at a time since the episode's start."""
        settings, rng, at = self._settings, np.random.default_rng(seed), (replica, slot)
        self._rngs[replica][slot] = rng
        self._braking_mps2[at] = math.inf if settings.braking_mps2 is None else rng.uniform(*settings.braking_mps2)
        self._chance[at] = rng.random()
        self._attentive[at], self._until_s[at] = True, _NEVER_S
        if settings.attentive_s is not None:
            self._attentive[at] = rng.random() * (settings.attentive_s + settings.lapse_s) < settings.attentive_s
            self._until_s[at] = time_s + self._period_s(rng, bool(self._attentive[at]))
        self._was_m[at] = self._slots.front_m[at] - speed_mps * self._layout.scene.step_s
        self._follow(slice(replica, replica + 1), slice(slot, slot + 1))

    def _period_s(self, rng: np.random.Generator, attentive: bool) -> float:
        mean_s = self._settings.attentive_s if attentive else self._settings.lapse_s
        assert mean_s is not None
        return rng.exponential(mean_s)

    def leave(self, replica: int, slot: int) -> None:
        """Forget a driver that has left the roads."""
        self._rngs[replica][slot] = None
        self.willing[replica, slot] = False
        self._until_s[replica, slot] = _NEVER_S

    def clear(self, replica: int) -> None:
        """Forget the episode of a replica, whose vehicles have all left."""
        self.waited_s[replica] = 0.0

    def follow(self, time_s: Floats, waits: Bools) -> Bools:
        """Take a step; return who (R, V) has become willing in it.

        Args:
            time_s: (R,) since the episodes' start.
            waits: (R,) where the ego waits.
        """
        self.waited_s[waits] += self._layout.scene.step_s
        for replica, slot in np.argwhere(self._until_s <= time_s[:, None]).tolist():
            rng = self._rngs[replica][slot]
            assert rng is not None
            while self._until_s[replica, slot] <= time_s[replica]:
                self._attentive[replica, slot] ^= True
                self._until_s[replica, slot] += self._period_s(rng, bool(self._attentive[replica, slot]))
        self._follow(slice(None), slice(None))
        return self._woke

    def _follow(self, replicas: slice, of_slots: slice) -> None:
        slots, scene, at = self._slots, self._layout.scene, (replicas, of_slots)
        follow_willingness(
            slots.present[at],
            slots.front_m[at],
            self._was_m[at],
            self._layout.zones.stop_line_m[slots.route[at]],
            self._attentive[at],
            self._chance[at],
            self._braking_mps2[at],
            self.waited_s[replicas],
            self._settings.probability,
            self._patience_s,
            scene.claim.reaction_time_s,
            scene.step_s,
            self.willing[at],
            self._woke[at],
        )


@compiled
def follow_willingness(
    present: Bools,
    front_m: Floats,
    was_m: Floats,
    stop_line_m: Floats,
    attentive: Bools,
    chance: Floats,
    braking_mps2: Floats,
    waited_s: Floats,
    probability: float,
    patience_s: float,
    reaction_time_s: float,
    step_s: float,
    willing: Bools,
    woke: Bools,
) -> None:
    """Write who would yield now, and who would not have done so one step ago; arrays are (R, V), or (R,) of egos.

    Args:
        present: which slots hold a vehicle.
        front_m, was_m: fronts of vehicles along their routes, now and one step ago; ``was_m`` is brought up to date.
        stop_line_m: of their routes.
        attentive, chance, braking_mps2: states; a limit to braking is infinite if there is none.
        waited_s: (R,) for how long egos have waited.
        probability: that a driver is willing while the ego has not waited.
        patience_s: time constant in which it grows to 1; infinite if it does not.
        reaction_time_s, step_s: of the claim and of the simulation.
        willing, woke: written.
    """
    for row in range(present.shape[0]):
        now_probability = 1.0 - (1.0 - probability) * math.exp(-waited_s[row] / patience_s)
        for slot in range(present.shape[1]):
            if not present[row, slot]:
                willing[row, slot] = woke[row, slot] = False
                continue
            speed_mps = (front_m[row, slot] - was_m[row, slot]) / step_s
            was_m[row, slot] = front_m[row, slot]
            limit_mps2 = braking_mps2[row, slot]
            room_m = stop_line_m[row, slot] - front_m[row, slot] - speed_mps * reaction_time_s
            now = attentive[row, slot] and chance[row, slot] < now_probability
            if limit_mps2 < math.inf:
                now = now and room_m >= speed_mps**2 / (2.0 * limit_mps2)
            woke[row, slot] = now and not willing[row, slot]
            willing[row, slot] = now
