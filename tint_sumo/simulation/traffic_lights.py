"""The traffic lights on the ego's route in a SUMO configuration."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from tint_sumo.simulation.connection import Connection
from tint_sumo.simulation.ego_way import EGO

# SUMO's letters of signal states (https://sumo.dlr.de/docs/Simulation/Traffic_Lights.html#signal_state_definitions).
RED = frozenset("ru")  # red, and red with yellow
_STATIC = 0  # type of programs whose phases last as long as they say
_SAME_LINE_M = 0.01  # stop lines that are nearer to each other are one


@dataclass(frozen=True)
class TrafficLight:
    """A signal on the ego's route.

    The signal's ``index`` in the traffic light ``name`` is that of the link that the ego takes over the junction. The
    stop line is where the link's lane ends.
    """

    name: str
    index: int
    line_m: float  # position of the stop line on the ego's route
    state: str  # SUMO's letter
    since_s: float  # time of the simulation from which on it has had this state


class RouteLights:
    """Follows the traffic lights on the ego's route.

    ``ahead`` are those to come, the nearest first, and ``passed_red`` is the number of stop lines that the ego's front
    has driven over in the last step while their signal was red.
    """

    def __init__(self, connection: Connection, step_s: float, ego: str = EGO) -> None:
        self._connection = connection
        self._ego = ego
        self._step_s = step_s
        self.clear()

    def clear(self) -> None:
        """Forget the lights of an episode."""
        self.ahead: tuple[TrafficLight, ...] = ()
        self.passed_red = 0
        self.time_s = 0.0  # of the simulation

    def follow(self, front_m: float) -> None:
        """Take over the state after a step, or at an episode's begin; ``front_m`` is where the ego's front is."""
        self.time_s = self._connection.simulation.getTime()
        known = {(light.name, light.index): light for light in self.ahead}
        ahead = []
        for name, index, distance_m, state in self._connection.vehicle.getNextTLS(self._ego):
            since_s = self._since_s(known.get((name, index)), name, index, state)
            ahead.append(TrafficLight(name, index, front_m + distance_m, state, since_s))
        self.passed_red = self._count_red(front_m, ahead)
        self.ahead = tuple(ahead)

    def end(self, *, arrived: bool) -> None:
        """Take over that SUMO has taken the ego off, which may have arrived at its route's end, in the last step."""
        self.passed_red = self._count_red(math.inf, ()) if arrived else 0
        self.ahead = ()

    def _count_red(self, front_m: float, ahead: Sequence[TrafficLight]) -> int:
        """Return how many of the lines that were ahead the front has passed at red; SUMO lists those still ahead."""
        return sum(
            self._state_of(light) in RED
            for light in self.ahead
            if light.line_m < front_m + _SAME_LINE_M
            and all(abs(light.line_m - other.line_m) > _SAME_LINE_M for other in ahead)
        )

    def _state_of(self, light: TrafficLight) -> str:
        """Return the state in the step just made: SUMO switches signals before it moves vehicles."""
        return str(self._connection.trafficlight.getRedYellowGreenState(light.name)[light.index])

    def _since_s(self, known: TrafficLight | None, name: str, index: int, state: str) -> float:
        """Return the time from which on a signal has had its present state."""
        if known is None:
            return self.time_s - self._age_s(name, index, state)
        return known.since_s if known.state == state else self.time_s - self._step_s

    def _age_s(self, name: str, index: int, state: str) -> float:
        """Return for how long a signal has had its state: in this phase, and in those before it by their program.

        Phases of programs that react to traffic have lasted at least for so long.
        """
        lights = self._connection.trafficlight
        program = lights.getProgram(name)
        logic = next((logic for logic in lights.getAllProgramLogics(name) if logic.programID == program), None)
        is_static = logic is not None and logic.type == _STATIC
        if is_static:  # SUMO forgets when a phase began where it loads a state
            age_s = lights.getPhaseDuration(name) - (lights.getNextSwitch(name) - self.time_s)
        else:
            age_s = lights.getSpentDuration(name)
        phases: Sequence[Any] = () if logic is None else logic.phases
        present = lights.getPhase(name)
        for back in range(1, len(phases)):
            earlier = phases[present - back]
            if earlier.state[index] != state:
                break
            age_s += earlier.duration if is_static else earlier.minDur
        return float(age_s)
