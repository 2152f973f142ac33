"""Persons on foot around the ego in a SUMO configuration, as its sensor perceives them."""

import numpy as np

from tint_sumo.config import Sensor
from tint_sumo.envs.sensing import Memory
from tint_sumo.scenes.geometry import Bools, Floats
from tint_sumo.scenes.sight import Sight, find_seen
from tint_sumo.simulation import SumocfgSimulation

PEDESTRIANS = 8  # most persons in an observation, the nearest ones
_STREAM = 3  # number of the random stream of an episode


class PedestrianSensing:
    """The persons that the ego perceives in the one environment of a simulation; of P, the nearest come first.

    ================ =================================================================
    ``at_m``         (P, 2) their centres minus the ego's, with noise; 0 without one
    ``velocity_mps`` (P, 2) 0 without one
    ``mask``         (P,) whether there is one
    ================ =================================================================

    Range, field of view, occlusion by vehicles and buildings, dropouts and noise on positions are as for vehicles. All
    that is random follows from the episode's seed.
    """

    def __init__(self, sensor: Sensor, simulation: SumocfgSimulation) -> None:
        self._sensor = sensor
        self._simulation = simulation
        self._sight = Sight.of(sensor)
        self._memory = Memory.of(sensor, simulation.scene.step_s)
        self.at_m: Floats = np.zeros((PEDESTRIANS, 2))
        self.velocity_mps: Floats = np.zeros((PEDESTRIANS, 2))
        self.mask: Bools = np.zeros(PEDESTRIANS, bool)
        self.begin(0)

    def begin(self, seed: int) -> None:
        """Begin an episode of this seed."""
        self._rng = np.random.default_rng([seed, _STREAM])
        self._noise_m: dict[str, Floats] = {}  # by the persons' ids
        self._lost: dict[str, bool] = {}

    def look(self) -> None:
        """Perceive the present step."""
        persons, ego = self._simulation.persons, self._simulation.egos.box[0]
        for part in (self.at_m, self.velocity_mps, self.mask):
            part[:] = 0
        self._go_on()
        if not persons.ids:
            return
        seen, found = self._in_sight(), []
        for index, name in enumerate(persons.ids):
            if seen[index] and not self._lost[name]:
                box = persons.boxes[index]
                at_m = np.array([box["x_m"] - ego["x_m"], box["y_m"] - ego["y_m"]]) + self._noise_m[name]
                found.append((float(np.hypot(*at_m)), name, at_m, persons.velocity_mps[index]))
        found = sorted(found, key=lambda one: one[:2])[:PEDESTRIANS]
        for place, (_, _, at_m, velocity_mps) in enumerate(found):
            self.at_m[place], self.velocity_mps[place], self.mask[place] = at_m, velocity_mps, True

    def _go_on(self) -> None:
        """Go on with the noise and the dropouts of each person by a step; those of new persons begin anew."""
        sensor, memory, noise_m, lost = self._sensor, self._memory, self._noise_m, self._lost
        self._noise_m, self._lost = {}, {}
        for name in sorted(self._simulation.persons.ids):  # in the same order in libsumo and in TraCI
            fresh_m = self._rng.normal(0.0, sensor.noise_m, 2) if sensor.noise_m > 0.0 else np.zeros(2)
            before_m = noise_m.get(name)
            self._noise_m[name] = fresh_m if before_m is None else memory.keep * before_m + memory.renew * fresh_m
            chance = memory.stay_lost if lost.get(name) else memory.lose
            chance = chance if name in lost else memory.lost_share
            self._lost[name] = sensor.dropouts_per_s > 0.0 and bool(self._rng.random() < chance)

    def _in_sight(self) -> Bools:
        """Return which of the simulation's persons are in sight, (P,)."""
        simulation = self._simulation
        persons, slots, ego = simulation.persons.boxes, simulation.slots, simulation.egos.box
        boxes = np.concatenate([persons, slots.box[0]])[None]
        present = np.concatenate([np.ones(len(persons), bool), slots.present[0]])[None]
        seen = np.zeros(present.shape, bool)
        find_seen(ego, present, boxes, simulation.walls, self._sight, seen)
        distance_m = np.hypot(persons["x_m"] - ego["x_m"], persons["y_m"] - ego["y_m"])
        return np.asarray(seen[0, : len(persons)] & (distance_m <= simulation.scene.sight_m))
