"""Who drives on the street and where they appear: draws from a lane's own generator."""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from tint_sumo.compiling import compiled
from tint_sumo.config import Scenario
from tint_sumo.scenario.drivers import DriverMember
from tint_sumo.scenario.geometry import Bools, Floats, lane_length_m


@dataclass(frozen=True)
class Driver:
    """A driver about to appear."""

    member: int  # index into the population's members
    gap_m: float  # bumper gap to the vehicle ahead that it waits for
    wait_s: float  # time since the driver before it; 0 in saturated traffic


class DriverPool:
    """Whom all lanes' streams draw from."""

    def __init__(self, population: tuple[DriverMember, ...], scenario: Scenario) -> None:
        self.population = population
        self.scenario = scenario
        everybody = list(range(len(population)))
        self.by_trait = {  # where all are alike, each share is drawn from all
            yields: [index for index in everybody if population[index].profile.yields is yields] or everybody
            for yields in (True, False)
        }
        self.mean_gap_m = float(np.mean([gap for member in population for gap in member.profile.entry_gap_m]))
        self.lane_length_m = lane_length_m(scenario.street, scenario.vehicle)


class DriverStream:
    """The endless sequence of drivers on one lane; its k-th driver depends on the lane's seed and the mix alone.

    Args:
        p_conservative: probability that a driver of this episode is conservative.
    """

    def __init__(self, rng: np.random.Generator, pool: DriverPool, p_conservative: float) -> None:
        self._rng = rng
        self._pool = pool
        self._p_conservative = p_conservative
        self.upcoming = self._draw()

    def _draw(self) -> Driver:
        rng, pool, traffic = self._rng, self._pool, self._pool.scenario.traffic
        candidates = pool.by_trait[bool(rng.random() < self._p_conservative)]
        member = candidates[int(rng.integers(len(candidates)))]
        low_m, high_m = pool.population[member].profile.entry_gap_m
        gap_m = low_m + (high_m - low_m) * rng.random()
        wait_s = 0.0 if traffic.arrivals_per_s is None else rng.exponential(1.0 / traffic.arrivals_per_s)
        return Driver(member, gap_m, wait_s)

    def take(self) -> Driver:
        """The upcoming driver, who is then followed by a new one."""
        driver, self.upcoming = self.upcoming, self._draw()
        return driver

    def placement(self) -> Iterator[tuple[Driver, float]]:
        """Fill the lane as an episode starts, from its exit to its entry: drivers and their ``front_m``."""
        pool, length_m = self._pool, self._pool.scenario.vehicle.length_m
        front_m = pool.lane_length_m - (length_m + pool.mean_gap_m) * self._rng.random()
        while front_m >= length_m:
            yield self.take(), front_m
            follower = self.upcoming
            waited_m = follower.wait_s * pool.population[follower.member].desired_speed_mps
            front_m -= length_m + follower.gap_m + waited_m


@compiled
def admit(
    front_m: Floats,
    last_slot: NDArray[np.int64],
    taken_m: float,
    wanted_gap_m: Floats,
    time_s: Floats,
    wanted_time_s: Floats,
    admitted: Bools,
) -> bool:
    """Tell for whom there is room, and whose time has come.

    Args:
        front_m: (S,) of vehicles along their lanes.
        last_slot: (R, 2) of the vehicle that entered each lane last, index into ``front_m``; -1 for an open road.
        taken_m: of that front's distance by its own vehicle and by the one that would enter.
        wanted_gap_m, wanted_time_s: (R, 2) of the upcoming drivers; an infinite gap keeps a lane closed.
        time_s: (R,).
        admitted: (R, 2) written.

    Returns:
        whether anybody is admitted.
    """
    any_admitted = False
    for row in range(len(time_s)):
        for lane in range(last_slot.shape[1]):
            last = last_slot[row, lane]
            has_room = wanted_gap_m[row, lane] < np.inf and (
                last < 0 or front_m[last] - taken_m >= wanted_gap_m[row, lane]
            )
            admitted[row, lane] = has_room and time_s[row] >= wanted_time_s[row, lane]
            any_admitted = any_admitted or admitted[row, lane]
    return any_admitted
