"""The sensor of the egos: which vehicles they see, in which slots of the observation, and the noise on positions."""

import math
from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np

from tint_sumo.config import Sensor
from tint_sumo.core.compiling import compiled
from tint_sumo.envs.rows import Rows, show_earlier, show_earlier_in_networks
from tint_sumo.scenes.geometry import NO_VEHICLE, Bools, Boxes, Floats, Numbers
from tint_sumo.scenes.sight import Sight, find_seen
from tint_sumo.simulation import Simulation

_AHEAD = 16  # steps for which random numbers are drawn at a time
_NOISE, _DROPOUTS = 1, 2  # numbers of an episode's random streams; the traffic has those without a number


class Sensing:
    """The sensors of N egos; arrays are (N, V).

    ============ ==========================================================================================
    ``source``   slot of the simulation whose vehicle each slot of the observation shows, or ``NO_VEHICLE``
    ``track``    number of its track in the episode, or ``NO_VEHICLE``
    ``noise_m``  (N, V, 2) noise on the positions in the simulation's slots
    ``seen``     which vehicles in the simulation's slots the egos perceive
    ============ ==========================================================================================

    A sensor that sees all vehicles shows them in the simulation's slots. One that does not gives them slots by what it
    sees alone, so that slots say nothing about hidden vehicles: a new track takes the first slot that is empty and was
    so at the step before, the nearest first where there are several. All that is random follows from the episode's
    seed.
    """

    def __init__(self, sensor: Sensor, simulation: Simulation, step_s: float) -> None:
        shape = simulation.slots.present.shape
        self.sensor = sensor
        self._simulation = simulation
        self._sight = Sight.of(sensor)
        self._memory = Memory.of(sensor, step_s)
        self._delay = round(sensor.delay_s / step_s)
        self.source: Numbers = np.full(shape, NO_VEHICLE)
        self.track: Numbers = np.full(shape, NO_VEHICLE)
        self.noise_m: Floats = np.zeros((*shape, 2))
        self.seen: Bools = np.zeros(shape, bool) if sensor.hides else simulation.slots.present
        self._lost: Bools = np.zeros(shape, bool)
        self._known: Numbers = np.full(shape, NO_VEHICLE)  # number of the vehicle in each slot of the simulation
        self._shown: Numbers = np.full(shape, NO_VEHICLE)  # number of the vehicle in each slot of the observation
        self._tracks: Numbers = np.zeros(shape[0], np.int64)  # their number in each episode so far
        self._normals, self._uniforms = None, None
        if sensor.noise_m > 0.0:
            self._normals = _Draws((*shape, 2), _NOISE, lambda rng, size: rng.normal(0.0, sensor.noise_m, size))
        if sensor.dropouts_per_s > 0.0:
            self._uniforms = _Draws(shape, _DROPOUTS, lambda rng, size: rng.random(size))
        self._frames: Rows | None = None  # (D + 1, N) rows of the last steps, if there is a delay

    def begin(self, index: int, seed: int) -> None:
        """Begin an episode of this seed in an environment."""
        for array in (self.source, self.track, self._known, self._shown):
            array[index] = NO_VEHICLE
        for nothing in (self.noise_m, self._lost, self._tracks):
            nothing[index] = 0
        for draws in (self._normals, self._uniforms):
            if draws:
                draws.begin(index, seed)

    def look(self, envs: slice) -> None:
        """Perceive the present step in some environments."""
        egos, slots, sensor = self._simulation.egos, self._simulation.slots, self.sensor
        present, number = slots.present[envs], slots.vehicle_number[envs]
        if self._normals:
            follow_noise(number, self._known[envs], *self._normals.ahead(envs), self._memory, self.noise_m[envs])
        if not sensor.hides:
            show_all(present, number, self.source[envs], self.track[envs])
        else:
            find_seen(egos.box[envs], present, slots.box[envs], self._simulation.walls, self._sight, self.seen[envs])
            if self._uniforms:
                drawn, step = self._uniforms.ahead(envs)
                follow_dropouts(number, self._known[envs], drawn, step, self._memory, self._lost[envs], self.seen[envs])
            show_seen(
                egos.box[envs],
                slots.box[envs],
                self.noise_m[envs],
                number,
                self.seen[envs],
                self.source[envs],
                self._shown[envs],
                self.track[envs],
                self._tracks[envs],
            )
        if self._normals or self._uniforms:
            self._known[envs] = number

    def delay(self, steps: Numbers, envs: slice, rows: Rows) -> None:
        """Put in place of what is seen in rows (N,) of some environments what was seen earlier.

        In an episode's first steps that is what was seen at its beginning.
        """
        if not self._delay:
            return
        if self._frames is None:
            self._frames = np.zeros((self._delay + 1, len(self.source)), rows.dtype)
        show_earlier(rows, self._frames[:, envs], steps[envs])
        show_earlier_in_networks(rows, self._frames[:, envs], steps[envs])


class Memory(NamedTuple):
    """Factors and probabilities of a step for noise and dropouts, whose statistics are the same at any step length."""

    keep: float  # part of the noise that stays
    renew: float  # times a new draw, so that the variance stays as it is
    lose: float  # probability that the sensor loses a vehicle that it has
    stay_lost: float  # probability that a lost vehicle is lost at the next step, too
    lost_share: float  # share of the time for which a vehicle is lost

    @classmethod
    def of(cls, sensor: Sensor, step_s: float) -> "Memory":
        keep = math.exp(-step_s / sensor.noise_time_s) if sensor.noise_time_s > 0.0 else 0.0
        find_per_s = 1.0 / sensor.dropout_s
        both_per_s = sensor.dropouts_per_s + find_per_s  # a Markov process with these two rates
        share, change = sensor.dropouts_per_s / both_per_s, 1.0 - math.exp(-both_per_s * step_s)
        return cls(keep, math.sqrt(1.0 - keep**2), share * change, 1.0 - (1.0 - share) * change, share)


class _Draws:
    """Random numbers for each step of N environments, each from a generator of its own, drawn some steps ahead."""

    def __init__(
        self,
        shape: tuple[int, ...],
        stream: int,
        draw: Callable[[np.random.Generator, tuple[int, ...]], Floats],
    ) -> None:
        num_envs, *per_step = shape
        self._block = (_AHEAD, *per_step)
        self._stream = stream
        self._draw = draw
        self._ahead: Floats = np.zeros((num_envs, _AHEAD, *per_step))
        self._next: Numbers = np.zeros(num_envs, np.int64)
        self._generators: list[np.random.Generator | None] = [None] * num_envs

    def begin(self, index: int, seed: int) -> None:
        self._generators[index] = np.random.default_rng([seed, self._stream])
        self._next[index] = _AHEAD

    def ahead(self, envs: slice) -> tuple[Floats, Numbers]:
        """Return numbers (N, A, ...) for some environments, and which of A is next (N,), to be counted on by the user.

        They are 0 where no episode has begun.
        """
        for index in (envs.start + np.flatnonzero(self._next[envs] == _AHEAD)).tolist():
            generator = self._generators[index]
            if generator is not None:
                self._ahead[index] = self._draw(generator, self._block)
            self._next[index] = 0
        return self._ahead[envs], self._next[envs]


@compiled
def follow_noise(
    number: Numbers, known: Numbers, drawn: Floats, step: Numbers, memory: Memory, noise_m: Floats
) -> None:
    """Go on with the noise of each vehicle by a step; that of a new vehicle begins anew.

    Args:
        number, known: (N, V) numbers of the vehicles in the slots, now and a step ago.
        drawn, step: (N, A, V, 2) of the stationary distribution, and which of A is next (N,), counted on.
        noise_m: (N, V, 2) changed in place.
    """
    for index in range(number.shape[0]):
        for slot in range(number.shape[1]):
            stays = number[index, slot] == known[index, slot]
            keep, renew = (memory.keep, memory.renew) if stays else (0.0, 1.0)
            for axis in range(2):
                fresh_m = drawn[index, step[index], slot, axis]
                noise_m[index, slot, axis] = keep * noise_m[index, slot, axis] + renew * fresh_m
        step[index] += 1


@compiled
def follow_dropouts(
    number: Numbers, known: Numbers, drawn: Floats, step: Numbers, memory: Memory, lost: Bools, seen: Bools
) -> None:
    """Go on with the dropouts of each vehicle by a step, and take from those that are seen the lost ones.

    Args:
        number, known: (N, V) numbers of the vehicles in the slots, now and a step ago.
        drawn, step: (N, A, V) uniform in [0, 1), and which of A is next (N,), counted on.
        lost, seen: (N, V) changed in place.
    """
    for index in range(number.shape[0]):
        for slot in range(number.shape[1]):
            if number[index, slot] != known[index, slot]:
                chance = memory.lost_share
            else:
                chance = memory.stay_lost if lost[index, slot] else memory.lose
            lost[index, slot] = drawn[index, step[index], slot] < chance
            seen[index, slot] = seen[index, slot] and not lost[index, slot]
        step[index] += 1


@compiled
def show_all(present: Bools, number: Numbers, source: Numbers, track: Numbers) -> None:
    """Show all vehicles in the slots that they have; arguments as in ``show_seen``."""
    for index in range(present.shape[0]):
        for slot in range(present.shape[1]):
            source[index, slot] = slot if present[index, slot] else -1
            track[index, slot] = number[index, slot]


@compiled
def show_seen(
    egos: Boxes,
    vehicles: Boxes,
    noise_m: Floats,
    number: Numbers,
    seen: Bools,
    source: Numbers,
    shown: Numbers,
    track: Numbers,
    tracks: Numbers,
) -> None:
    """Give slots of the observation to the vehicles that are seen: their former ones, or empty ones to new tracks.

    Args:
        egos: (N,).
        vehicles, number, seen: (N, V) of the simulation's slots.
        noise_m: (N, V, 2) of the same.
        source, shown, track: (N, V) of the observation's slots, changed in place: slot in the simulation, number of the
            vehicle, and number of the track.
        tracks: (N,) number of tracks so far, changed in place.
    """
    slots = seen.shape[1]
    waits, free = np.empty(slots, np.bool_), np.empty(slots, np.bool_)
    for index in range(len(egos)):
        _end_tracks(number[index], seen[index], source[index], shown[index], track[index], waits, free)
        place = 0
        while True:
            slot = _nearest(egos[index], vehicles[index], noise_m[index], waits)
            while place < slots and not free[place]:
                place += 1
            if slot < 0 or place == slots:
                break
            source[index, place], shown[index, place] = slot, number[index, slot]
            track[index, place] = tracks[index]
            tracks[index] += 1
            waits[slot] = free[place] = False
        for slot in range(slots):
            seen[index, slot] = seen[index, slot] and not waits[slot]  # what no slot is free for is not there yet


@compiled
def _end_tracks(
    number: Numbers, seen: Bools, source: Numbers, shown: Numbers, track: Numbers, waits: Bools, free: Bools
) -> None:
    """Empty the slots of vehicles that are seen no longer, in one environment; arguments as in ``show_seen``, (V,).

    Args:
        waits: written: which vehicles are seen that have no slot.
        free: written: which slots of the observation were empty before.
    """
    waits[:] = seen
    for place in range(len(source)):
        slot = source[place]
        free[place] = slot < 0
        if slot >= 0:
            if seen[slot] and number[slot] == shown[place]:
                waits[slot] = False
            else:
                source[place] = shown[place] = track[place] = -1


@compiled
def _nearest(ego: Any, vehicles: Boxes, noise_m: Floats, waits: Bools) -> int:
    """Return the slot of the vehicle that is perceived nearest to an ego, among those that wait; negative if none."""
    nearest, nearest_m = -1, math.inf
    for slot in range(len(waits)):
        if waits[slot]:
            dx_m = vehicles[slot].x_m + noise_m[slot, 0] - ego.x_m
            dy_m = vehicles[slot].y_m + noise_m[slot, 1] - ego.y_m
            distance_m = math.hypot(dx_m, dy_m)
            if distance_m < nearest_m:
                nearest, nearest_m = slot, distance_m
    return nearest
