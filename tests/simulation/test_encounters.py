"""Encounters of egos and drivers in SUMO: yielding, driving on, and collisions."""

from dataclasses import replace

import numpy as np
import pytest

from tests.simulation.scenes import CREEP, GO, LOWER, STEM_M, STEP_S, STOP, UPPER, scene, speeds, stand_at, until
from tint_sumo.config import AGGRESSIVE, CONSERVATIVE, Mix, Traffic
from tint_sumo.scenes import SCENES, find_scene
from tint_sumo.simulation import SceneSimulation


def test_conservative_lower_lane_driver_stops_for_a_claiming_ego() -> None:
    with scene((LOWER, CONSERVATIVE, 18.0)) as simulation:
        stand_at(simulation, 1.2)  # front past y = 1: in the vehicles' path
        assert simulation.yielding.has_claimed[0].tolist() == [True, False]
        assert min(speeds(simulation, STOP)) < 0.01
        assert simulation.egos.collision[0] is None


def test_conservative_lower_lane_driver_passes_an_ego_that_stands_short_of_its_path() -> None:
    with scene((LOWER, CONSERVATIVE, 18.0)) as simulation:
        stand_at(simulation, 0.7)  # in the lane, but behind y = 1
        assert not simulation.yielding.has_claimed[0].any()
        assert min(speeds(simulation, STOP)) == pytest.approx(2.4)
        assert not simulation.slots.present[0, 0]


def test_conservative_driver_leaves_room_for_the_ego_to_drive_on() -> None:
    with scene((LOWER, CONSERVATIVE, 12.0)) as simulation:
        assert min(speeds(simulation, GO)) < 1.0
        assert simulation.egos.front_m[0] > simulation.scene.ego.goal_m
        assert simulation.egos.collision[0] is None


@pytest.mark.parametrize(("path_m", "reacts"), [(4.2, False), (6.3, True)])
def test_upper_lane_driver_reacts_only_past_y_4(path_m: float, reacts: bool) -> None:
    with scene((UPPER, CONSERVATIVE, -18.0)) as simulation:
        stand_at(simulation, path_m)
        front_m, zones = simulation.egos.front_m[0], simulation.layout.zones
        assert (front_m > zones.inside_m[UPPER]) if reacts else (front_m < zones.enter_m[UPPER])
        slowest_mps = min(speeds(simulation, STOP))
        assert slowest_mps < 0.05 if reacts else slowest_mps == pytest.approx(2.4)
        assert simulation.egos.collision[0] is None


@pytest.mark.parametrize(("lane", "x_m"), [(LOWER, 14.0), (UPPER, -14.0)])
def test_aggressive_driver_hits_an_ego_in_its_way(lane: int, x_m: float) -> None:
    with scene((lane, AGGRESSIVE, x_m)) as simulation:
        assert min(speeds(simulation, GO)) == pytest.approx(3.0)
        collision = simulation.egos.collision[0]
        assert collision is not None
        assert (simulation.scene.population.profiles[collision.trait], collision.slot) == (AGGRESSIVE, 0)
        assert collision.route == ("lower" if lane == LOWER else "upper")


@pytest.mark.parametrize(("profile", "hits"), [(CONSERVATIVE, False), (AGGRESSIVE, True)])
def test_on_the_exit_lane_only_aggressive_drivers_run_into_a_slow_ego(profile: object, hits: bool) -> None:
    with scene((UPPER, profile, -20.0)) as simulation:  # type: ignore[arg-type]
        until(simulation, GO, lambda: bool(simulation.egos.front_m[0] > STEM_M + 12.5))
        slowest_mps = min(speeds(simulation, CREEP))
        assert slowest_mps < 0.6 if not hits else slowest_mps == pytest.approx(3.0)
        assert (simulation.egos.collision[0] is not None) is hits


def test_drivers_go_on_when_the_ego_gives_up_its_claim() -> None:
    with scene((LOWER, CONSERVATIVE, 18.0)) as simulation:
        stand_at(simulation, -0.3)
        until(simulation, GO, lambda: bool(simulation.yielding.has_claimed[0, LOWER]))
        until(simulation, STOP, lambda: not simulation.yielding.has_claimed[0, LOWER])
        assert simulation.egos.front_m[0] < simulation.layout.zones.inside_m[LOWER]
        assert speeds(simulation, STOP)[-1] == pytest.approx(2.4, abs=0.01)
        assert simulation.egos.collision[0] is None


def test_only_drivers_that_can_stop_clear_of_the_egos_way_yield() -> None:
    answers = []
    for x_m in np.arange(3.0, 12.0, 0.5):
        with scene((LOWER, CONSERVATIVE, x_m)) as simulation:
            before_m = 0.0
            while not simulation.yielding.has_claimed[0, LOWER]:
                before_m = simulation.slots.front_m[0, 0]
                simulation.step(np.array([GO]))
            can_stop = simulation.layout.zones.stop_line_m[
                LOWER
            ] - before_m >= simulation.scene.claim.stopping_distance_m(2.4)
            assert simulation.yielding.reacts[0, 0] == can_stop
            answers.append(can_stop)
            slowest_mps = min(speeds(simulation, GO))
            assert slowest_mps < 2.3 if can_stop else slowest_mps == pytest.approx(2.4, abs=0.01)
            assert (simulation.egos.collision[0] is None) or not can_stop
    assert {True, False} == set(answers)


@pytest.mark.parametrize("p_conservative", [0.25, 0.6, 1.0])
@pytest.mark.parametrize("hesitates", [False, True])
@pytest.mark.parametrize("name", SCENES)
def test_ego_and_driver_never_wait_for_each_other(name: str, p_conservative: float, hesitates: bool) -> None:
    """No standing driver holds an ego that wants to drive for more than 3 s, at any time in any episode."""
    replicas, rng = 32, np.random.default_rng(7)
    played = replace(find_scene(name), traffic=Traffic(Mix(p_conservative)))
    simulation = SceneSimulation(replicas, played)
    try:
        for replica in range(replicas):
            simulation.reset(replica, replica)
        waited_steps, desired_mps, ended = np.zeros(replicas, int), np.full(replicas, GO), 0
        for step in range(600):
            if hesitates and step % 10 == 0:
                desired_mps = rng.choice([GO, GO, CREEP, STOP], replicas)
            before_m = simulation.slots.front_m.copy()
            simulation.step(desired_mps)
            near = simulation.slots.present & (
                simulation.egos.distance_m < simulation.scene.ego.controller.closing_distance_m
            )
            stands = simulation.slots.present & (np.abs(simulation.slots.front_m - before_m) < 1e-3)
            held = (near & stands & simulation.yielding.yields).any(axis=1) & ~(near & ~stands).any(axis=1)
            waits = held & (desired_mps == GO) & (simulation.egos.speed_mps < 1e-2)
            waited_steps = np.where(waits, waited_steps + 1, 0)
            assert waited_steps.max() <= 3.0 / STEP_S
            for replica in np.flatnonzero(
                simulation.egos.collided | (simulation.egos.front_m > played.ego.goal_m)
            ).tolist():
                ended += 1
                simulation.reset(replica, replicas + ended)
        assert ended > replicas  # the roads are full of encounters
    finally:
        simulation.close()


def test_a_collision_is_latched() -> None:
    with scene((LOWER, AGGRESSIVE, 14.0), (LOWER, AGGRESSIVE, 20.0)) as simulation:
        until(simulation, GO, lambda: simulation.egos.collision[0] is not None)
        first = simulation.egos.collision[0]
        speeds(simulation, STOP, seconds=4.0)
        assert simulation.egos.collision[0] is first
