from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace

import pytest

from tests.simulation.scenes import GO, LOWER, UPPER, T, scene, until
from tint_sumo.config import AGGRESSIVE, CONSERVATIVE, POPULATIONS, DriverProfile, Mix, Willingness
from tint_sumo.scenes import Scene
from tint_sumo.scenes.layout import layout
from tint_sumo.simulation import SceneSimulation
from tint_sumo.simulation.demand import PlacedVehicle
from tint_sumo.study import ceiling as module
from tint_sumo.study.ceiling import _finishes, _openings, ceiling, way_m

WAY_S = way_m(layout(T)) / GO
STOP_LINE_M = layout(T).zones.stop_line_m.tolist()
LENGTH_M = T.vehicle.length_m
Vehicle = tuple[int, DriverProfile, float]  # route, driver, and how far its front is before the ego's way

YIELDS_BELOW, YIELDS_ABOVE = (LOWER, CONSERVATIVE, 12.0), (UPPER, CONSERVATIVE, 12.0)


@contextmanager
def street(*vehicles: Vehicle, played: Scene = T) -> Iterator[SceneSimulation]:
    """Traffic without an ego; nobody else comes."""
    simulation = SceneSimulation(1, played, with_ego=False)
    members = {profile: index for index, profile in enumerate(one.profile for one in simulation.population)}
    placed = [PlacedVehicle(route, STOP_LINE_M[route] - far_m, members[who]) for route, who, far_m in vehicles]
    try:
        simulation.reset_to(0, placed)
        yield simulation
    finally:
        simulation.close()


def openings(*vehicles: Vehicle) -> list[list[tuple[float, float]]]:
    """Of each route."""
    with street(*vehicles) as simulation:
        return _openings(simulation)[0]


def finishes(*vehicles: Vehicle, played: Scene = T) -> bool:
    with street(*vehicles, played=played) as simulation:
        return bool(_finishes(simulation)[0])


def drive_s(metres: float, driver: DriverProfile) -> float:
    return metres / driver.desired_speed_mps[0]


def test_a_lane_is_open_until_a_yielding_driver_has_come() -> None:
    lower, upper = openings((LOWER, CONSERVATIVE, 9.6))
    assert upper == []
    ((opens_s, closes_s),) = lower
    assert opens_s == 0.0
    assert closes_s == pytest.approx(drive_s(9.6, CONSERVATIVE), abs=0.15)


def test_a_lane_opens_when_the_vehicle_before_the_yielding_driver_has_passed() -> None:
    lower, upper = openings((UPPER, AGGRESSIVE, 3.0), (UPPER, CONSERVATIVE, 14.4))
    assert lower == []
    ((opens_s, closes_s),) = upper
    assert opens_s == pytest.approx(drive_s(3.0 + LENGTH_M, AGGRESSIVE), abs=0.15)
    assert closes_s == pytest.approx(drive_s(14.4, CONSERVATIVE), abs=0.3)


@pytest.mark.parametrize("population", ["traits", "gentle"])
def test_a_driver_counts_if_it_would_have_yielded_before_it_came_close(population: str) -> None:
    played = replace(T, population=POPULATIONS[population])
    with street((LOWER, CONSERVATIVE, 9.6), played=played) as simulation:
        (lower, upper) = _openings(simulation)[0]
    assert len(lower) == 1 and upper == []
    unwilling = replace(T, population=replace(T.population, willingness=Willingness(probability=0.0)))
    with street((LOWER, CONSERVATIVE, 9.6), played=unwilling) as simulation:
        assert _openings(simulation)[0] == [[], []]


def test_drivers_that_do_not_yield_or_have_come_already_open_nothing() -> None:
    assert openings((LOWER, AGGRESSIVE, 9.0), (UPPER, CONSERVATIVE, -0.5)) == [[], []]


def test_every_yielding_driver_opens_its_lane_once() -> None:
    lower, _ = openings((LOWER, CONSERVATIVE, 0.5), (LOWER, CONSERVATIVE, 13.0))
    (_, first_closes_s), (second_opens_s, second_closes_s) = lower
    assert first_closes_s < second_opens_s < second_closes_s


def test_an_ego_needs_a_yielding_driver_in_either_lane() -> None:
    assert finishes(YIELDS_BELOW, YIELDS_ABOVE)
    assert not finishes(YIELDS_BELOW)
    assert not finishes(YIELDS_ABOVE)
    assert not finishes((LOWER, AGGRESSIVE, 12.0), YIELDS_ABOVE)


def test_a_yielding_driver_that_comes_before_the_ego_does_not_help() -> None:
    to_lower_s, to_upper_s, _ = WAY_S
    assert drive_s(4.0, CONSERVATIVE) < to_lower_s + to_upper_s < drive_s(8.0, CONSERVATIVE)
    assert not finishes(YIELDS_BELOW, (UPPER, CONSERVATIVE, 4.0))
    assert finishes(YIELDS_BELOW, (UPPER, CONSERVATIVE, 8.0))


def test_the_ego_must_be_through_before_the_time_limit() -> None:
    for margin_s, is_enough in ((-0.2, False), (0.2, True)):
        played = replace(T, time_limit_s=round(WAY_S.sum() + margin_s, 1))
        assert finishes(YIELDS_BELOW, YIELDS_ABOVE, played=played) is is_enough


def test_no_ego_is_faster_through_than_the_ceiling_takes_it_to_be() -> None:
    with scene() as simulation:
        until(simulation, GO, lambda: bool(simulation.egos.front_m[0] > T.ego.goal_m))
        taken_s = simulation.time_s[0]
    assert WAY_S.sum() <= taken_s <= WAY_S.sum() + 1.0  # it starts from standing


def test_nobody_gets_through_where_nobody_yields_and_everybody_where_all_do() -> None:
    assert ceiling(Mix(0.0), 20) == 0.0
    assert ceiling(Mix(1.0), 20) == 1.0


def test_the_ceiling_grows_with_the_share_of_yielding_drivers() -> None:
    found = [ceiling(Mix(p), 60) for p in (0.05, 0.1, 0.25)]
    assert 0.0 < found[0] < found[1] < found[2] < 1.0
    assert found[0] < ceiling(Mix(0.05, 0.25), 60) < 1.0


def test_the_same_cases_have_the_same_ceiling_whatever_the_batch(monkeypatch: pytest.MonkeyPatch) -> None:
    at_once = ceiling(Mix(0.1), 40)
    assert ceiling(Mix(0.1), 40) == at_once
    monkeypatch.setattr(module, "BATCH", 12)
    assert ceiling(Mix(0.1), 40) == at_once


def test_other_cases_have_another_ceiling() -> None:
    assert len({ceiling(Mix(0.1), 40, seed) for seed in range(4)}) > 1
