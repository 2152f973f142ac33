"""The share of cases that a careful driver can finish in time at best, whatever it knows."""

from dataclasses import replace

import numpy as np
from gymnasium.utils import seeding
from numpy.typing import NDArray

from tint_sumo.config import Mix
from tint_sumo.envs.episodes import episode_seed
from tint_sumo.methods.evaluation import BATCH, case_seed
from tint_sumo.scenes import Scene, paper_scene
from tint_sumo.scenes.layout import Layout
from tint_sumo.simulation.scene import SceneSimulation


def ceiling(p_conservative: Mix, episodes: int, case_set: int = 0, scene: Scene | None = None) -> float:
    """Return the share of the cases that ``finishable`` finds, whose arguments these are."""
    return float(finishable(p_conservative, episodes, case_set, scene).mean())


def finishable(p_conservative: Mix, episodes: int, case_set: int = 0, scene: Scene | None = None) -> NDArray[np.bool_]:
    """Return the cases (episodes,) in which enough yielding drivers come in time.

    A careful ego enters a route only before a driver that yields. It knows all traits, never brakes on its way and
    needs no room to the vehicle that passes before the yielding driver, so that no careful policy does better. One that
    takes risks can: it may slip through before an aggressive driver.

    Args:
        p_conservative, episodes, case_set: of the cases, see ``tint_sumo.methods.evaluation.evaluate``.
        scene: where; the paper's if not given.
    """
    played = scene or paper_scene()
    played = replace(played, traffic=replace(played.traffic, p_conservative=p_conservative))
    finished: list[NDArray[np.bool_]] = []
    simulation = SceneSimulation(min(BATCH, episodes), played, with_ego=False)
    try:
        for first in range(0, episodes, simulation.replicas):
            count = min(simulation.replicas, episodes - first)
            for replica in range(count):
                simulation.reset(replica, traffic_seed(played, case_set, first + replica))
            finished.append(_finishes(simulation)[:count])
    finally:
        simulation.close()
    return np.concatenate(finished)


def traffic_seed(scene: Scene, case_set: int, case: int) -> int:
    """Return the seed of the traffic of a case, as environments draw it from the case's own seed."""
    rng, _ = seeding.np_random(case_seed(case_set, case))
    return episode_seed(rng, scene.population.episodes_per_town)


def _finishes(simulation: SceneSimulation) -> NDArray[np.bool_]:
    """Return which replicas let a careful ego through before the time limit; (R,)."""
    scene, layout = simulation.scene, simulation.layout
    way_s = way_m(layout) / max(scene.ego.controller.desired_speeds_mps)
    openings = _openings(simulation)
    done = np.zeros(simulation.replicas, bool)
    for replica in range(simulation.replicas):
        time_s = 0.0
        for route, approach_s in zip(np.argsort(layout.zones.enter_m).tolist(), way_s, strict=False):
            time_s += approach_s
            usable = [max(time_s, opens_s) for opens_s, closes_s in openings[replica][route] if closes_s >= time_s]
            time_s = min(usable, default=np.inf)
        done[replica] = time_s + way_s[-1] <= scene.time_limit_s
    return done


def way_m(layout: Layout) -> NDArray[np.float64]:
    """Return the lengths of the ego's way to the first route's lane, from there to the next, and on to the goal."""
    task = layout.scene.ego
    return np.diff([task.start_m, *np.sort(layout.zones.enter_m), task.goal_m])


def _openings(simulation: SceneSimulation) -> list[list[list[tuple[float, float]]]]:
    """Find for each replica and route from when to when the next driver at the ego's way is one that yields.

    A driver whose willingness changes counts if it would have yielded to an ego at any time.
    The replicas are driven to their time limit.
    """
    scene, slots, stop_line_m = simulation.scene, simulation.slots, simulation.layout.zones.stop_line_m
    routes, length_m = range(len(stop_line_m)), scene.vehicle.length_m
    openings: list[list[list[tuple[float, float]]]] = [[[] for _ in routes] for _ in range(simulation.replicas)]
    would = simulation.yielding.yields
    free_since_s = np.zeros((simulation.replicas, len(routes)))  # time at which the last vehicle had passed
    for step in range(round(scene.time_limit_s / scene.step_s)):
        number, past_m = slots.vehicle_number.copy(), slots.front_m - stop_line_m[slots.route]
        time_s = (step + 1) * scene.step_s
        simulation.step()
        same = slots.present & (number == slots.vehicle_number)
        now_past_m = slots.front_m - stop_line_m[slots.route]
        for replica, slot in np.argwhere(same & (past_m < length_m) & (now_past_m >= length_m)).tolist():
            free_since_s[replica, slots.route[replica, slot]] = time_s
        would = simulation.yielding.yields | (would & same)
        for replica, slot in np.argwhere(same & (past_m < 0.0) & (now_past_m >= 0.0)).tolist():
            if would[replica, slot]:
                route = slots.route[replica, slot]
                openings[replica][route].append((float(free_since_s[replica, route]), time_s))
    return openings
