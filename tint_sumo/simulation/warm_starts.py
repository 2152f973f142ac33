"""The traffic of a SUMO configuration before the ego appears: warmed up anew, or loaded as it was saved.

A warm-up can take seconds. So a scene may have a number of warm starts: the traffic of so many seeds is warmed up and
saved once each, and an episode begins with the one that its seed chooses, and goes on with random numbers of its own.

SUMO loads a saved state into a network that it loads anew, too. It could load one into the simulation that runs, which
takes less time. But what comes then depends on what ran before, even with the states of its random numbers saved, and
with persons, parking areas and calibrators SUMO 1.28 can end with a segmentation fault.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from tint_sumo.core.errors import InputError
from tint_sumo.scenes.sumo_run import SumocfgRun
from tint_sumo.scenes.sumocfg import SumocfgScene
from tint_sumo.simulation.connection import LOAD_STATE, SUMO_ERRORS, Connection
from tint_sumo.simulation.refusals import one_line

# What is drawn from a seed: the number of a state, and the time of a warm-up. From the number of a state: its traffic.
_CHOICE, _STATE, _TIME = 2, 3, 4
_SAME_M = 0.01  # vehicles and persons of a loaded state are at most so far from where they were
_SAVING = {
    "save-state.rng": "false",  # whoever loads it has other random numbers
    "save-state.transportables": "true",
    "save-state.constraints": "true",  # of rail signals
    "save-state.precision": "16",
}
_LOADING = {
    "load-state.offset": "0",  # the user's options are for a state of the user's
    "load-state.remove-vehicles": "",
    "begin": None,  # with one, SUMO's clock starts there, and not at the state's time: departures come too late
}


@dataclass(frozen=True)
class _Traffic:
    """The vehicles and persons of a simulation."""

    time_s: float
    positions_m: dict[tuple[str, str], tuple[float, ...]]  # by kind and id

    def is_same(self, other: "_Traffic") -> bool:
        return (
            self.time_s == other.time_s
            and self.positions_m.keys() == other.positions_m.keys()
            and all(
                math.dist(position_m, other.positions_m[name]) < _SAME_M
                for name, position_m in self.positions_m.items()
            )
        )


@dataclass(frozen=True)
class WarmStarts:
    """Begins the traffic of episodes in a running simulation.

    States lie in the run's temporary folder, at most as many as the scene has warm starts. They follow from the scene
    and their number alone, so that it does not matter which process has made them, and for which episode.
    """

    scene: SumocfgScene
    connection: Connection
    run: SumocfgRun
    states: dict[int, Path | None] = field(
        default_factory=dict
    )  # by number; None where a loaded state is not the saved

    def begin(self, seed: int) -> None:
        """Load the simulation of an episode, up to the time at which the ego appears.

        Raises:
            InputError: SUMO does not load a state.
        """
        state = self._state_of(seed) if self.scene.warm_starts else None
        if state is None:
            self._warm_up(seed, self.run.options(seed))
        else:
            self._load_state(seed, state)

    def _state_of(self, seed: int) -> Path | None:
        """Return the state that an episode begins with; None if its traffic is to be warmed up anew."""
        draw = np.random.SeedSequence([seed, _CHOICE]).generate_state(1)
        number = int(draw[0]) % self.scene.warm_starts
        if number not in self.states:
            self.states[number] = self._save(number)
        return self.states[number]

    def _save(self, number: int) -> Path | None:
        """Save a state; return its file, or None if SUMO does not load what it has saved."""
        file = self.run.output / f"{number}.xml"
        seed = (number, _STATE)
        self._warm_up(seed, self.run.options(seed, more=_SAVING))
        self.connection.simulation.saveState(file.name)  # SUMO puts it into the folder for output
        saved = self._traffic()
        self._load_state(seed, file)
        return file if saved.is_same(self._traffic()) else None

    def _warm_up(self, seed: int | tuple[int, ...], options: list[str]) -> None:
        seeds = (seed, _TIME) if isinstance(seed, int) else (*seed, _TIME)
        longer_s = np.random.default_rng(seeds).uniform(0.0, self.scene.warm_up_spread_s)
        self.connection.load(options)
        self.connection.step(self.connection.simulation.getTime() + self.scene.warm_up_s + longer_s)

    def _load_state(self, seed: int | Sequence[int], file: Path) -> None:
        try:
            self.connection.load(self.run.options(seed, more={LOAD_STATE: str(file), **_LOADING}))
        except SUMO_ERRORS as error:
            raise InputError(
                f"SUMO does not load a state of {self.scene.config.file} that it has saved itself "
                f"({one_line(error)}); set warm_starts to 0"
            ) from None

    def _traffic(self) -> _Traffic:
        domains = (("vehicle", self.connection.vehicle), ("person", self.connection.person))
        positions_m = {
            (kind, name): domain.getPosition(name) for kind, domain in domains for name in domain.getIDList()
        }
        return _Traffic(self.connection.simulation.getTime(), positions_m)
