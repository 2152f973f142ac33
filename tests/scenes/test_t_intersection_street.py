"""The street at real speed: who drives on it and how, what is observed, and whether its task can be done."""

from collections.abc import Iterator
from contextlib import closing
from dataclasses import replace

import numpy as np
import pytest

from tint_sumo.config import Mix, Traffic
from tint_sumo.envs import SceneEnv, TaskSettings
from tint_sumo.envs.sb3 import SceneVecEnv
from tint_sumo.methods.evaluation import evaluate
from tint_sumo.methods.registry import Rule, find_method
from tint_sumo.scenes import find_scene
from tint_sumo.simulation import SceneSimulation

STREET = find_scene("t_intersection_street")
KMH = 1.0 / 3.6
GO_MPS = STREET.ego.controller.desired_speeds_mps[-1]
REPLICAS = 40


@pytest.fixture(scope="module")
def driven() -> Iterator[dict[str, np.ndarray]]:
    """Outcomes of episodes in many replicas of the street, whose egos wait for some time and then go."""
    simulation = SceneSimulation(REPLICAS, replace(STREET, traffic=replace(STREET.traffic, p_conservative=Mix(0.7))))
    with closing(simulation):
        for replica in range(REPLICAS):
            simulation.reset(replica, [11, replica])
        waits_s = np.linspace(5.0, 15.0, REPLICAS)
        seen: dict[str, list[np.ndarray]] = {name: [] for name in ("speed", "gap", "count", "ego")}
        hit_by_reacting = np.zeros(REPLICAS, bool)
        for _ in range(200):
            number, front_m = simulation.slots.vehicle_number.copy(), simulation.slots.front_m.copy()
            reacts, was_hit = simulation.yielding.reacts.copy(), simulation.egos.collided.copy()
            simulation.step(np.where(simulation.time_s < waits_s, 0.0, GO_MPS))
            slots, egos = simulation.slots, simulation.egos
            for replica in np.flatnonzero(egos.collided & ~was_hit).tolist():
                collision = egos.collision[replica]
                assert collision is not None
                hit_by_reacting[replica] = reacts[replica, collision.slot]
            stays = slots.present & (number == slots.vehicle_number)
            undisturbed = stays & (simulation.time_s < waits_s)[:, None]
            seen["speed"].append(((slots.front_m - front_m) / STREET.step_s)[undisturbed])
            leader, gap_m = simulation.leaders()
            seen["gap"].append(gap_m[leader >= 0])
            seen["count"].append(slots.present.sum(axis=1))
            seen["ego"].append(egos.speed_mps.copy())
        found = {name: np.concatenate(values) for name, values in seen.items()}
        passed = egos.front_m > STREET.ego.goal_m
        yield {**found, "hit_by_reacting": hit_by_reacting, "collided": egos.collided.copy(), "passed": passed}


def test_traffic_drives_at_30_to_50_km_h_and_there_are_gaps(driven: dict[str, np.ndarray]) -> None:
    limits = [profile.desired_speed_mps for profile in STREET.population.profiles]
    assert np.ravel(limits) == pytest.approx(np.multiply([30.0, 40.0, 40.0, 50.0], KMH))
    assert np.percentile(driven["speed"], 2) > 25.0 * KMH and driven["speed"].max() <= 50.0 * KMH + 1e-6
    assert driven["gap"].min() > 1.0, "nobody comes closer than the smallest minimum gap"
    assert 4.0 < driven["count"].mean() < STREET.max_vehicles - 6
    assert driven["count"].max() < STREET.max_vehicles, "nobody has to wait outside for a slot"
    headway_s = driven["gap"] / (40.0 * KMH)
    assert 0.1 < (headway_s > 4.0).mean() < 0.6


def test_who_yields_stops_clear_of_the_ego_which_reaches_30_km_h(driven: dict[str, np.ndarray]) -> None:
    assert driven["collided"].any() and not driven["hit_by_reacting"].any()
    assert driven["passed"].any() and 0.9 * 30.0 * KMH < driven["ego"].max() <= 30.0 * KMH + 1e-6


def test_observations_are_within_the_bounds_on_the_whole_street() -> None:
    with closing(SceneEnv(TaskSettings(STREET))) as env:
        observation, _ = env.reset(seed=0)
        shown = []
        for _ in range(110):
            assert env.observation_space.contains(observation)
            simulation = env.simulation
            present = simulation.slots.present[0]
            there = simulation.slots.box[0][present]
            ego = simulation.egos.box[0]
            off_m = np.stack([there["x_m"] - ego["x_m"], there["y_m"] - ego["y_m"]], axis=-1)
            assert observation["vehicles"][present] * 100.0 == pytest.approx(off_m, abs=1e-3), "nothing is cut off"
            assert observation["ego"][:2] * 100.0 == pytest.approx([ego["x_m"], ego["y_m"]], abs=1e-3)
            shown.append(np.hypot(*observation["ego"][2:]))
            observation, _, terminated, *_ = env.step(2)
            if terminated:
                break
        assert 0.5 < max(shown) <= 1.0 + 1e-6


def test_always_going_is_dangerous_and_waiting_for_a_gap_is_not() -> None:
    outcomes = {}
    for name in ("always_go", "ttc"):
        method = find_method(name)
        assert isinstance(method, Rule)
        found = evaluate(method.make(STREET), lambda count: SceneVecEnv(count, TaskSettings(STREET)), 30, 0)
        outcomes[name] = {outcome: found.rate(outcome).value for outcome in ("success", "collision")}
    assert outcomes["always_go"]["collision"] > 0.3 and outcomes["always_go"]["success"] > 0.2
    assert outcomes["ttc"]["collision"] < 0.1 and outcomes["ttc"]["success"] > 0.7


def test_the_scale_is_that_of_the_scene_whatever_its_drivers() -> None:
    other = replace(STREET, traffic=Traffic(Mix(0.1), arrivals_per_s=0.1))
    assert (other.position_scale_m, other.ego_scale_m, other.speed_scale_mps) == (100.0, 100.0, GO_MPS)
    assert other.digest == STREET.digest
