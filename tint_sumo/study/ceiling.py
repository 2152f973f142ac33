"""How many cases a careful driver can finish in time at best, whatever it knows."""

import numpy as np
from gymnasium.utils import seeding
from numpy.typing import NDArray

from tint_sumo.config import Scenario, Share, Traffic
from tint_sumo.envs.episodes import episode_seed
from tint_sumo.scenario.geometry import LOWER, UPPER, EgoPath, swept_area_start_m
from tint_sumo.simulation.intersections import Intersections
from tint_sumo.study.evaluation import BATCH, case_seed

_LANES = (LOWER, UPPER)


def ceiling(p_conservative: Share, episodes: int, seed: int = 0) -> float:
    """Share of the cases in which enough yielding drivers come in time.

    A careful ego enters a lane only before a driver that yields. It knows all traits, never brakes on its way and needs
    no room to the vehicle that passes before the yielding driver, so that no careful policy does better. One that takes
    risks can: it may slip through before an aggressive driver.

    Args:
        p_conservative, episodes, seed: of the cases, see :func:`tint_sumo.study.evaluation.evaluate`.
    """
    scenario = Scenario(Traffic(p_conservative))
    finished = 0
    simulation = Intersections(min(BATCH, episodes), scenario, with_ego=False)
    try:
        for first in range(0, episodes, simulation.replicas):
            count = min(simulation.replicas, episodes - first)
            for replica in range(count):
                rng, _ = seeding.np_random(case_seed(seed, first + replica))
                simulation.reset(replica, episode_seed(rng))
            finished += int(_finishes(simulation, scenario)[:count].sum())
    finally:
        simulation.close()
    return finished / episodes


def _finishes(simulation: Intersections, scenario: Scenario) -> NDArray[np.bool_]:
    """Which replicas let a careful ego through before the time limit; (R,)."""
    rules, top_mps = scenario.episode, max(scenario.ego.desired_speeds_mps)
    way_s = _way_m(scenario) / top_mps
    openings = _openings(simulation, scenario)
    done = np.zeros(simulation.replicas, bool)
    for replica in range(simulation.replicas):
        time_s = 0.0
        for lane, approach_s in zip(_LANES, way_s, strict=False):
            time_s += approach_s
            usable = [max(time_s, opens_s) for opens_s, closes_s in openings[replica][lane] if closes_s >= time_s]
            time_s = min(usable, default=np.inf)
        done[replica] = time_s + way_s[-1] <= rules.time_limit_s
    return done


def _way_m(scenario: Scenario) -> NDArray[np.float64]:
    """Lengths of the ego's way to the lower lane, from there to the upper lane, and from there to the goal."""
    street, vehicle, rules = scenario.street, scenario.vehicle, scenario.episode
    path = EgoPath.of(street, vehicle)
    goal_m = path.turn_end_m + rules.goal_x_m + vehicle.length_m / 2 - path.end_x_m
    half_m = street.lane_width_m / 2
    borders_m = (path.crossing_m(street.lower_y_m - half_m), path.crossing_m(street.upper_y_m - half_m))
    return np.diff([path.start_m(rules.ego_start_y_m), *borders_m, goal_m])


def _openings(simulation: Intersections, scenario: Scenario) -> list[list[list[tuple[float, float]]]]:
    """Of each replica and lane: from when to when the next driver to reach the ego's way is one that yields.

    The replicas are driven to their time limit.
    """
    rules, length_m = scenario.episode, scenario.vehicle.length_m
    stop_line_m = swept_area_start_m(scenario.street, scenario.vehicle, scenario.ego.unsafe_distance_m)
    openings: list[list[list[tuple[float, float]]]] = [[[] for _ in _LANES] for _ in range(simulation.replicas)]
    free_since_s = np.zeros((simulation.replicas, len(_LANES)))  # when the last vehicle had passed
    for step in range(round(rules.time_limit_s / rules.step_s)):
        number, past_m = simulation.vehicle_number.copy(), simulation.front_m - stop_line_m[simulation.lane]
        time_s = (step + 1) * rules.step_s
        simulation.step()
        same = simulation.present & (number == simulation.vehicle_number)
        now_past_m = simulation.front_m - stop_line_m[simulation.lane]
        for replica, slot in np.argwhere(same & (past_m < length_m) & (now_past_m >= length_m)).tolist():
            free_since_s[replica, simulation.lane[replica, slot]] = time_s
        for replica, slot in np.argwhere(same & (past_m < 0.0) & (now_past_m >= 0.0)).tolist():
            if simulation.yields[replica, slot]:
                lane = simulation.lane[replica, slot]
                openings[replica][lane].append((float(free_since_s[replica, lane]), time_s))
    return openings
