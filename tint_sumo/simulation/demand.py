"""The traffic of a scene: which drivers appear when and where, drawn from a generator for each route."""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from tint_sumo.core.compiling import compiled
from tint_sumo.scenes.drivers import NO_TOWN, DriverMember
from tint_sumo.scenes.geometry import NO_VEHICLE, Bools, Floats, Numbers
from tint_sumo.scenes.layout import Layout
from tint_sumo.simulation.slots import Slots

_SEED_LIMIT = 2**63


@dataclass(frozen=True)
class PlacedVehicle:
    """A vehicle of a scene, driving at its driver's desired speed."""

    route: int
    front_m: float  # front bumper's distance along the route, a vehicle's length at the entry
    member: int  # index into the population
    seed: int = 0  # of the driver's state, see ``tint_sumo.simulation.willingness``


@dataclass(frozen=True)
class Driver:
    """A driver about to appear."""

    member: int  # index into the population's members
    gap_m: float  # bumper gap to the vehicle ahead that it waits for
    wait_s: float  # time since the driver before it; 0 in saturated traffic
    seed: int = 0  # of its state


class DriverPool:
    """The drivers that all routes' streams draw from in an episode: those of a town."""

    def __init__(self, population: tuple[DriverMember, ...], layout: Layout, town: int = NO_TOWN) -> None:
        self.population = population
        self.scene = layout.scene
        everybody = [index for index, member in enumerate(population) if member.town == town]
        self.by_trait = {  # where all drivers yield, or none does, all are drawn from
            yields: [index for index in everybody if population[index].profile.yields is yields] or everybody
            for yields in (True, False)
        }
        self.mean_gap_m = float(np.mean([gap for index in everybody for gap in population[index].entry_gap_m]))


class DriverStream:
    """The endless sequence of drivers on one route; its k-th driver depends on the route's seed and the mix alone.

    Args:
        p_conservative: probability that a driver of this episode is conservative.
    """

    def __init__(self, rng: np.random.Generator, pool: DriverPool, p_conservative: float) -> None:
        self._rng = rng
        self._pool = pool
        self._p_conservative = p_conservative
        self.upcoming = self._draw()

    def _draw(self) -> Driver:
        rng, pool, traffic = self._rng, self._pool, self._pool.scene.traffic
        candidates = pool.by_trait[bool(rng.random() < self._p_conservative)]
        member = candidates[int(rng.integers(len(candidates)))]
        low_m, high_m = pool.population[member].entry_gap_m
        gap_m = low_m + (high_m - low_m) * rng.random()
        wait_s = 0.0 if traffic.arrivals_per_s is None else rng.exponential(1.0 / traffic.arrivals_per_s)
        seed = 0 if pool.scene.population.willingness is None else int(rng.integers(_SEED_LIMIT))
        return Driver(member, gap_m, wait_s, seed)

    def take(self) -> Driver:
        """Return the upcoming driver, and draw the next one."""
        driver, self.upcoming = self.upcoming, self._draw()
        return driver

    def placement(self, route_length_m: float) -> Iterator[tuple[Driver, float]]:
        """Yield the drivers on the route as an episode starts, from its exit to its entry, with their ``front_m``."""
        pool, length_m = self._pool, self._pool.scene.vehicle.length_m
        front_m = route_length_m - (length_m + pool.mean_gap_m) * self._rng.random()
        while front_m >= length_m:
            yield self.take(), front_m
            follower = self.upcoming
            waited_m = follower.wait_s * pool.population[follower.member].desired_speed_mps
            front_m -= length_m + follower.gap_m + waited_m


class Demand:
    """The next driver on each of the K routes of R replicas, and when there is room and time for it."""

    def __init__(self, replicas: int, population: tuple[DriverMember, ...], layout: Layout) -> None:
        shape = (replicas, len(layout.routes))
        self._layout = layout
        towns = sorted({member.town for member in population})
        self.town: Numbers = np.full(replicas, towns[0])  # of each replica's episode
        self._towns, self._pools = towns, [DriverPool(population, layout, town) for town in towns]
        self._streams: list[tuple[DriverStream, ...]] = [() for _ in range(replicas)]
        self._wanted_gap_m: Floats = np.full(shape, np.inf)
        self._wanted_time_s: Floats = np.zeros(shape)
        self._admitted: Bools = np.zeros(shape, bool)
        self._newest: Numbers = np.full(shape, NO_VEHICLE)  # slot of the vehicle that entered each route last

    @property
    def entry_m(self) -> float:
        """Position of a newcomer's front on its route."""
        return self._layout.scene.vehicle.length_m

    def begin(self, replica: int, seed: np.random.SeedSequence) -> list[PlacedVehicle]:
        """Start an episode; return the vehicles that are on the roads already."""
        p_conservative, _ = self._draw(seed)
        _, drawn = self._draw(first_of_row(seed, self._layout.scene.population.episodes_per_town))
        pool, self.town[replica] = self._pools[drawn], self._towns[drawn]
        streams = tuple(
            DriverStream(np.random.default_rng(child), pool, p_conservative)
            for child in seed.spawn(len(self._layout.routes))
        )
        self._streams[replica] = streams
        placed = [
            PlacedVehicle(route, front_m, driver.member, driver.seed)
            for route, stream in enumerate(streams)
            for driver, front_m in stream.placement(self._layout.routes[route].length_m)
        ]
        for route in range(len(streams)):
            self._expect(replica, route, 0.0)
        return placed

    def _draw(self, seed: np.random.SeedSequence) -> tuple[float, int]:
        """Return an episode's P(conservative), and the position of its town among the towns."""
        mix, rng = self._layout.scene.traffic.p_conservative, np.random.default_rng(seed)
        return rng.uniform(mix.low, mix.high), int(rng.integers(len(self._pools)))

    def stop(self, replica: int) -> None:
        """Let no driver appear any more."""
        self._streams[replica] = ()
        self._wanted_gap_m[replica] = np.inf
        self._wanted_time_s[replica] = 0.0
        self._admitted[replica] = False
        self._newest[replica] = NO_VEHICLE

    def enter(self, replica: int, route: int, slot: int) -> None:
        """Note that the vehicle in a slot is now the last on its route."""
        self._newest[replica, route] = slot

    def leave(self, replica: int, route: int, slot: int) -> None:
        """Note that the vehicle in a slot has left its route."""
        if self._newest[replica, route] == slot:
            self._newest[replica, route] = NO_VEHICLE

    def admit(self, slots: Slots, time_s: Floats) -> Iterator[tuple[int, int]]:
        """Yield replica and route of the drivers for whom there is room, and whose time has come; (R,) times."""
        if admit(
            slots.front_m,
            self._newest,
            2 * self.entry_m,
            self._wanted_gap_m,
            time_s,
            self._wanted_time_s,
            self._admitted,
        ):
            rows, routes = np.nonzero(self._admitted)
            yield from zip(rows.tolist(), routes.tolist(), strict=True)

    def take(self, replica: int, route: int, time_s: float) -> PlacedVehicle:
        """Return the driver that enters a route now."""
        driver = self._streams[replica][route].take()
        self._expect(replica, route, time_s)
        return PlacedVehicle(route, self.entry_m, driver.member, driver.seed)

    def _expect(self, replica: int, route: int, time_s: float) -> None:
        upcoming = self._streams[replica][route].upcoming
        self._wanted_gap_m[replica, route] = upcoming.gap_m
        self._wanted_time_s[replica, route] = time_s + upcoming.wait_s


def first_of_row(seed: np.random.SeedSequence, episodes: int) -> np.random.SeedSequence:
    """Return the seed of the first episode of a row of ``episodes`` in one town.

    The seeds of a row are whole numbers one after the other, from a multiple of ``episodes`` on. A seed of several
    numbers is counted by its last one.
    """
    entropy = seed.entropy
    if isinstance(entropy, int | np.integer):
        first: int | list[int] = int(entropy) // episodes * episodes
    else:
        *others, last = entropy or [0]
        first = [*others, int(last) // episodes * episodes]
    return np.random.SeedSequence(first, spawn_key=seed.spawn_key)


@compiled
def admit(
    front_m: Floats,
    newest: Numbers,
    taken_m: float,
    wanted_gap_m: Floats,
    time_s: Floats,
    wanted_time_s: Floats,
    admitted: Bools,
) -> bool:
    """Write for which routes' upcoming drivers there is room, and whose time has come.

    Args:
        front_m: (R, V) of vehicles along their routes.
        newest: (R, K) slot of the vehicle that entered each route last; negative if it has left.
        taken_m: length of two vehicles, the last one and the one that would enter.
        wanted_gap_m, wanted_time_s: (R, K) of the upcoming drivers; an infinite gap keeps a route closed.
        time_s: (R,).
        admitted: (R, K) written.

    Returns:
        whether any driver is admitted.
    """
    any_admitted = False
    for row in range(len(time_s)):
        for route in range(newest.shape[1]):
            last = newest[row, route]
            has_room = wanted_gap_m[row, route] < np.inf and (
                last < 0 or front_m[row, last] - taken_m >= wanted_gap_m[row, route]
            )
            admitted[row, route] = has_room and time_s[row] >= wanted_time_s[row, route]
            any_admitted = any_admitted or admitted[row, route]
    return any_admitted
