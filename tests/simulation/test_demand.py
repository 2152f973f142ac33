"""Drivers who appear, and the room that they wait for; nothing is simulated."""

from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest

from tests.simulation.scenes import T
from tint_sumo.config import AGGRESSIVE, CONSERVATIVE, Mix, Population, Traffic
from tint_sumo.scenes import Scene
from tint_sumo.scenes.drivers import members
from tint_sumo.scenes.geometry import NO_VEHICLE
from tint_sumo.scenes.layout import layout
from tint_sumo.simulation.demand import Demand, DriverPool, DriverStream, admit
from tint_sumo.simulation.slots import Slots

LENGTH_M = T.vehicle.length_m
YIELDING, HASTY = 0, 1  # members: one of each profile
POOLED = replace(T, population=replace(T.population, members=1))


def played(mix: Mix | None = None, arrivals_per_s: float | None = None) -> Scene:
    return replace(POOLED, traffic=Traffic(mix or Mix(0.5), arrivals_per_s))


def pool(scene: Scene) -> DriverPool:
    return DriverPool(members(scene.population), layout(scene))


def stream(scene: Scene, p_conservative: float, seed: int = 0) -> DriverStream:
    return DriverStream(np.random.default_rng(seed), pool(scene), p_conservative)


def test_drivers_are_conservative_with_their_probability_and_want_gaps_of_their_profile() -> None:
    assert {stream(played(), 1.0).take().member for _ in range(20)} == {YIELDING}
    assert {stream(played(), 0.0).take().member for _ in range(20)} == {HASTY}
    drivers, mixed = [], stream(played(), 0.3)
    for _ in range(2000):
        drivers.append(mixed.take())
    for member, profile in ((YIELDING, CONSERVATIVE), (HASTY, AGGRESSIVE)):
        gaps_m = [driver.gap_m for driver in drivers if driver.member == member]
        low_m, high_m = profile.entry_gap_m
        assert low_m <= min(gaps_m) < low_m + 0.02 and high_m - 0.02 < max(gaps_m) <= high_m
    assert np.mean([driver.member == YIELDING for driver in drivers]) == pytest.approx(0.3, abs=0.03)
    assert {driver.wait_s for driver in drivers} == {0.0}


def test_all_drivers_of_a_profile_are_drawn() -> None:
    scene = replace(T, population=Population(members=3))
    many = stream(scene, 0.5)
    assert {many.take().member for _ in range(200)} == set(range(6))


def test_all_members_are_drawn_from_where_no_profile_yields() -> None:
    scene = replace(T, population=Population((AGGRESSIVE,), members=2))
    assert pool(scene).by_trait == {True: [0, 1], False: [0, 1]}
    assert pool(played()).by_trait == {True: [YIELDING], False: [HASTY]}
    assert pool(played()).mean_gap_m == pytest.approx(np.mean([*CONSERVATIVE.entry_gap_m, *AGGRESSIVE.entry_gap_m]))


def test_drivers_wait_with_the_rate_of_the_arrivals() -> None:
    waiting = stream(played(arrivals_per_s=0.25), 0.5)
    waits_s = [waiting.take().wait_s for _ in range(4000)]
    assert np.mean(waits_s) == pytest.approx(4.0, rel=0.06) == pytest.approx(np.std(waits_s), rel=0.12)


def test_the_upcoming_driver_is_the_one_that_is_taken() -> None:
    drivers = stream(played(), 0.5)
    for _ in range(5):
        upcoming = drivers.upcoming
        assert drivers.take() is upcoming is not drivers.upcoming


@pytest.mark.parametrize("arrivals_per_s", [None, 0.5])
def test_a_road_is_filled_from_its_exit_with_the_gaps_that_followers_want(arrivals_per_s: float | None) -> None:
    scene, road_m = played(arrivals_per_s=arrivals_per_s), 200.0
    population = members(scene.population)
    starts_m = []
    for seed in range(60):
        drivers = stream(scene, 0.5, seed)
        placed = list(drivers.placement(road_m))
        fronts_m = [front_m for _, front_m in placed]
        starts_m.append(fronts_m[0])
        for (_, ahead_m), (follower, front_m) in pairwise(placed):
            waited_m = follower.wait_s * population[follower.member].desired_speed_mps
            assert ahead_m - LENGTH_M - front_m == pytest.approx(follower.gap_m + waited_m)
        assert fronts_m[-1] >= LENGTH_M
        room_m = fronts_m[-1] - LENGTH_M - drivers.upcoming.gap_m
        room_m -= drivers.upcoming.wait_s * population[drivers.upcoming.member].desired_speed_mps
        assert room_m < LENGTH_M, "there would be room for the next one"
    spread_m = LENGTH_M + pool(scene).mean_gap_m
    assert road_m - spread_m <= min(starts_m) < road_m - 0.8 * spread_m
    assert road_m - 0.2 * spread_m < max(starts_m) <= road_m


@pytest.mark.parametrize(
    ("front_m", "newest", "time_s", "admitted"),
    [
        (0.0, -1, 7.0, True),  # an open road
        (0.0, -1, 6.9, False),  # before its time
        (13.9, 0, 7.0, False),  # the one before is too close
        (14.0, 0, 7.0, True),
        (14.0, 0, 6.9, False),
        (0.0, 0, 7.0, False),
    ],
)
def test_drivers_come_when_there_is_room_and_their_time_has_come(
    front_m: float, newest: int, time_s: float, admitted: bool
) -> None:
    found = np.array([[not admitted]])
    wanted = np.array([[4.0]]), np.array([time_s]), np.array([[7.0]])
    assert admit(np.array([[front_m, 99.0]]), np.array([[newest]]), 10.0, *wanted, found) == admitted
    assert found.tolist() == [[admitted]]


def test_each_route_of_each_replica_is_looked_at() -> None:
    found = np.zeros((2, 2), bool)
    front_m, newest = np.array([[20.0, 5.0], [5.0, 20.0]]), np.array([[0, 1], [0, 1]])
    wanted_m, no_time_s = np.full((2, 2), 4.0), np.zeros((2, 2))
    assert admit(front_m, newest, 10.0, wanted_m, np.zeros(2), no_time_s, found)
    assert found.tolist() == [[True, False], [False, True]]
    wanted_m[0, 0] = wanted_m[1, 1] = np.inf
    assert not admit(front_m, np.full((2, 2), -1), 10.0, np.full((2, 2), np.inf), np.zeros(2), no_time_s, found)
    assert not found.any()


def test_an_episode_begins_with_vehicles_on_all_routes_and_goes_on_with_the_next_drivers() -> None:
    scene = played()
    demand = Demand(2, members(scene.population), layout(scene))
    assert demand.entry_m == LENGTH_M
    placed = demand.begin(1, np.random.SeedSequence(3))
    assert {one.route for one in placed} == {0, 1}
    again = demand.begin(0, np.random.SeedSequence(3))
    assert again == placed != demand.begin(0, np.random.SeedSequence(4))
    slots = Slots(2, scene.max_vehicles)
    for route in (0, 1):
        demand.enter(1, route, slot=0)
    assert list(demand.admit(slots, np.zeros(2))) == [(0, 0), (0, 1)]  # the other's roads are full
    upcoming = demand._streams[0][1].upcoming
    newcomer = demand.take(0, 1, 2.0)
    assert (newcomer.route, newcomer.front_m, newcomer.member) == (1, LENGTH_M, upcoming.member)
    assert demand._wanted_gap_m[0, 1] == demand._streams[0][1].upcoming.gap_m
    demand.enter(0, 0, slot=1)
    demand.stop(0)
    assert (demand._newest[0] == NO_VEHICLE).all()
    assert list(demand.admit(slots, np.full(2, 99.0))) == []
    assert not demand._wanted_time_s[0].any() and not demand._admitted.any() and demand._streams[0] == ()


def test_drivers_who_wait_come_after_their_time() -> None:
    scene = played(arrivals_per_s=0.1)
    demand = Demand(1, members(scene.population), layout(scene))
    demand.begin(0, np.random.SeedSequence(0))
    slots = Slots(1, scene.max_vehicles)
    due_s = demand._streams[0][0].upcoming.wait_s
    assert (0, 0) not in list(demand.admit(slots, np.array([due_s - 1e-6])))
    assert (0, 0) in list(demand.admit(slots, np.array([due_s])))
    demand.take(0, 0, 50.0)
    assert demand._wanted_time_s[0, 0] == 50.0 + demand._streams[0][0].upcoming.wait_s > 50.0


def test_a_newcomer_keeps_its_gap_to_the_back_of_the_one_before() -> None:
    scene = played()
    demand, slots = Demand(1, members(scene.population), layout(scene)), Slots(1, scene.max_vehicles)
    demand.begin(0, np.random.SeedSequence(0))
    demand.enter(0, 0, slot=3)
    demand.enter(0, 1, slot=4)
    slots.front_m[0, 4] = 0.0
    for more_m, admitted in ((-1e-6, []), (1e-6, [(0, 0)])):
        slots.front_m[0, 3] = 2 * LENGTH_M + demand._streams[0][0].upcoming.gap_m + more_m
        assert list(demand.admit(slots, np.zeros(1))) == admitted
    slots.front_m[0, 3] = 0.0
    demand.leave(0, 0, slot=5)  # an older one
    assert not list(demand.admit(slots, np.zeros(1)))
    demand.leave(0, 0, slot=3)
    assert list(demand.admit(slots, np.zeros(1))) == [(0, 0)]


def test_mixes_are_drawn_from_the_range_of_the_traffic() -> None:
    scene = played(Mix(0.2, 0.8))
    demand = Demand(1, members(scene.population), layout(scene))
    drawn = []
    for seed in range(40):
        demand.begin(0, np.random.SeedSequence(seed))
        drawn.append({one._p_conservative for one in demand._streams[0]})
    assert all(len(one) == 1 for one in drawn)
    mixes = [one.pop() for one in drawn]
    assert 0.2 <= min(mixes) < 0.3 and 0.7 < max(mixes) <= 0.8
