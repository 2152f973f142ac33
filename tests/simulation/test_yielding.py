"""Who reacts to the ego, from when on, and who hits it."""

import numpy as np
import pytest

from tests.simulation.scenes import CREEP, GO, STEM_M, STEP_S, STOP, scene, speeds, stand_at, until
from tint_sumo.config import AGGRESSIVE, CONSERVATIVE, Scenario, Traffic
from tint_sumo.scenario.geometry import LOWER, UPPER
from tint_sumo.simulation.intersections import Intersections


def test_conservative_lower_lane_driver_stops_for_a_claiming_ego() -> None:
    with scene((LOWER, CONSERVATIVE, 18.0)) as simulation:
        stand_at(simulation, 1.2)  # front past y = 1: in the vehicles' path
        assert simulation.has_claimed[0].tolist() == [True, False]
        assert min(speeds(simulation, STOP)) < 0.01
        assert simulation.collision[0] is None


def test_conservative_lower_lane_driver_passes_an_ego_that_stands_short_of_its_path() -> None:
    with scene((LOWER, CONSERVATIVE, 18.0)) as simulation:
        stand_at(simulation, 0.7)  # in the lane, but behind y = 1
        assert not simulation.has_claimed[0].any()
        assert min(speeds(simulation, STOP)) == pytest.approx(2.4)
        assert not simulation.present[0, 0]


def test_conservative_driver_leaves_room_for_the_ego_to_drive_on() -> None:
    with scene((LOWER, CONSERVATIVE, 12.0)) as simulation:
        assert min(speeds(simulation, GO)) < 1.0
        assert simulation.ego_pose["x_m"][0] > 8.0
        assert simulation.collision[0] is None


@pytest.mark.parametrize(("path_m", "reacts"), [(4.2, False), (6.3, True)])
def test_upper_lane_driver_reacts_only_past_y_4(path_m: float, reacts: bool) -> None:
    with scene((UPPER, CONSERVATIVE, -18.0)) as simulation:
        stand_at(simulation, path_m)
        front_y_m = simulation.ego_pose["front_y_m"][0]
        assert (front_y_m > 5.0) if reacts else (3.0 < front_y_m < 4.0)
        slowest_mps = min(speeds(simulation, STOP))
        assert slowest_mps < 0.05 if reacts else slowest_mps == pytest.approx(2.4)
        assert simulation.collision[0] is None


@pytest.mark.parametrize(("lane", "x_m"), [(LOWER, 14.0), (UPPER, -14.0)])
def test_aggressive_driver_hits_an_ego_in_its_way(lane: int, x_m: float) -> None:
    with scene((lane, AGGRESSIVE, x_m)) as simulation:
        assert min(speeds(simulation, GO)) == pytest.approx(3.0)
        collision = simulation.collision[0]
        assert collision is not None
        assert (collision.profile, collision.slot) == ("aggressive", 0)
        assert collision.lane == ("lower" if lane == LOWER else "upper")


@pytest.mark.parametrize(("profile", "hits"), [(CONSERVATIVE, False), (AGGRESSIVE, True)])
def test_on_the_exit_lane_only_aggressive_drivers_run_into_a_slow_ego(profile: object, hits: bool) -> None:
    with scene((UPPER, profile, -20.0)) as simulation:  # type: ignore[arg-type]
        until(simulation, GO, lambda: bool(simulation.ego_front_m[0] > STEM_M + 12.5))
        slowest_mps = min(speeds(simulation, CREEP))
        assert slowest_mps < 0.6 if not hits else slowest_mps == pytest.approx(3.0)
        assert (simulation.collision[0] is not None) is hits


def test_drivers_go_on_when_the_ego_gives_up_its_claim() -> None:
    with scene((LOWER, CONSERVATIVE, 18.0)) as simulation:
        stand_at(simulation, -0.3)
        until(simulation, GO, lambda: bool(simulation.has_claimed[0, LOWER]))
        until(simulation, STOP, lambda: not simulation.has_claimed[0, LOWER])
        assert simulation.ego_pose["front_y_m"][0] < 1.0
        assert speeds(simulation, STOP)[-1] == pytest.approx(2.4, abs=0.01)
        assert simulation.collision[0] is None


def test_only_drivers_that_can_stop_clear_of_the_egos_way_yield() -> None:
    answers = []
    for x_m in np.arange(3.0, 12.0, 0.5):
        with scene((LOWER, CONSERVATIVE, x_m)) as simulation:
            before_m = 0.0
            while not simulation.has_claimed[0, LOWER]:
                before_m = simulation.front_m[0, 0]
                simulation.step(np.array([GO]))
            can_stop = simulation._stop_line_m[LOWER] - before_m >= simulation.scenario.claim.stopping_distance_m(2.4)
            assert simulation.yielding[0, 0] == can_stop
            answers.append(can_stop)
            slowest_mps = min(speeds(simulation, GO))
            assert slowest_mps < 2.3 if can_stop else slowest_mps == pytest.approx(2.4, abs=0.01)
            assert (simulation.collision[0] is None) or not can_stop
    assert {True, False} == set(answers)


@pytest.mark.parametrize("p_conservative", [0.25, 0.4, 0.6, 1.0])
@pytest.mark.parametrize("hesitates", [False, True])
def test_ego_and_driver_never_wait_for_each_other(p_conservative: float, hesitates: bool) -> None:
    """Nobody but standing drivers holds an ego that wants to drive for more than 3 s, at any time in any episode."""
    replicas, rng = 48, np.random.default_rng(7)
    simulation = Intersections(replicas, Scenario(traffic=Traffic(p_conservative=p_conservative)))
    try:
        for replica in range(replicas):
            simulation.reset(replica, replica)
        waited_steps, desired_mps, ended = np.zeros(replicas, int), np.full(replicas, GO), 0
        for step in range(800):
            if hesitates and step % 10 == 0:
                desired_mps = rng.choice([GO, GO, CREEP, STOP], replicas)
            before_m = simulation.x_m.copy()
            simulation.step(desired_mps)
            near = simulation.present & (simulation._distance_m < simulation.scenario.ego.closing_distance_m)
            stands = simulation.present & (np.abs(simulation.x_m - before_m) < 1e-3)
            held = (near & stands & simulation.yields).any(axis=1) & ~(near & ~stands).any(axis=1)
            waits = held & (desired_mps == GO) & (simulation.ego_speed_mps < 1e-2)
            waited_steps = np.where(waits, waited_steps + 1, 0)
            assert waited_steps.max() <= 3.0 / STEP_S
            for replica in np.flatnonzero(simulation.collided | (simulation.ego_pose["x_m"] > 8.0)).tolist():
                ended += 1
                simulation.reset(replica, replicas + ended)
        assert ended > 2 * replicas  # the street is full of encounters
    finally:
        simulation.close()


def test_a_collision_is_latched() -> None:
    with scene((LOWER, AGGRESSIVE, 14.0), (LOWER, AGGRESSIVE, 20.0)) as simulation:
        until(simulation, GO, lambda: simulation.collision[0] is not None)
        first = simulation.collision[0]
        speeds(simulation, STOP, seconds=4.0)
        assert simulation.collision[0] is first
