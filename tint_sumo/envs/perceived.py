"""The ego's road in a SUMO configuration: further keys of the observation, and the costs of red lights.

``tint_sumo.envs.scene_env.SceneEnv`` describes the keys. A new one is an entry of ``PERCEIVED``, and its name in
``tint_sumo.config.Perceivable``.
"""

from collections.abc import Callable, Container, Iterable, Mapping
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from gymnasium import spaces

from tint_sumo.config import POSITION_SCALE_M, Perceivable
from tint_sumo.envs.pedestrians import PEDESTRIANS, PedestrianSensing
from tint_sumo.envs.rows import BOUND, COST, RED_LIGHT, RED_LIGHT_TERM, Rows
from tint_sumo.scenes.geometry import Floats, Numbers
from tint_sumo.scenes.registry import AnyScene
from tint_sumo.scenes.sumocfg import SumocfgScene
from tint_sumo.simulation import SumocfgSimulation

_FARTHEST = 5.0  # bound of distances ahead: 100 m
_TIME_SCALE_S, _LONGEST = 10.0, 10.0  # times are observed divided by the first, up to the second: 100 s
_SIGNALS = ("ru", "yY", "G", "g", "s", "oO")  # letters of SUMO's signal states, by entry of the observation
_MOST_LANES = 64


class Road(NamedTuple):
    """Sources of the values of the observation's keys."""

    simulation: SumocfgSimulation
    source: Numbers  # (V,) slot of the simulation whose vehicle each slot of the observation shows, or negative
    pedestrians: PedestrianSensing


@dataclass(frozen=True)
class Perceived:
    """Keys of the observation that belong together."""

    spaces: Callable[[int], Mapping[str, spaces.Box]]  # of each key, with so many vehicle slots
    read: Callable[[Road], Mapping[str, Floats]]  # returns the present value of each key


def _from_zero(*high: float) -> spaces.Box:
    return spaces.Box(np.zeros(len(high), np.float32), np.array(high, np.float32))


def _ahead(road: Road, line_m: float) -> float:
    """Return the distance from the ego's front to a line on its route, in units of the observation."""
    return float(min(max((line_m - road.simulation.egos.front_m[0]) / POSITION_SCALE_M, 0.0), _FARTHEST))


def _read_traffic_light(road: Road) -> dict[str, Floats]:
    perception = road.simulation.perception
    light = perception.traffic_light
    if light is None:
        return {"traffic_light": np.array([*(0.0 for _ in _SIGNALS), _FARTHEST, 0.0])}
    time = (perception.lights.time_s - light.since_s) / _TIME_SCALE_S
    state = [float(light.state in letters) for letters in _SIGNALS]
    return {"traffic_light": np.array([*state, _ahead(road, light.line_m), min(time, _LONGEST)])}


def _read_right_of_way(road: Road) -> dict[str, Floats]:
    right_of_way = road.simulation.perception.right_of_way
    crossing = right_of_way.crossing
    distance = _FARTHEST if crossing is None else _ahead(road, crossing.line_m)
    priority = right_of_way.has_priority[road.source] & (road.source >= 0)
    return {
        "right_of_way": np.array([float(right_of_way.must_yield), distance]),
        "priority": priority.astype(np.float64),
    }


def _read_speed_limit(road: Road) -> dict[str, Floats]:
    limit = road.simulation.perception.lane.speed_limit_mps / road.simulation.scene.speed_scale_mps
    return {"speed_limit": np.array([min(limit, BOUND)])}


def _read_lane(road: Road) -> dict[str, Floats]:
    lane = road.simulation.perception.lane
    return {"lane": np.minimum([lane.index, lane.count], float(_MOST_LANES))}


def _read_pedestrians(road: Road) -> dict[str, Floats]:
    seen, scene = road.pedestrians, road.simulation.scene
    seen.look()
    values = np.hstack([seen.at_m / scene.position_scale_m, seen.velocity_mps / scene.speed_scale_mps])
    return {"pedestrians": np.clip(values, -BOUND, BOUND), "pedestrian_mask": seen.mask.astype(np.float64)}


PERCEIVED: dict[Perceivable, Perceived] = {
    "traffic_light": Perceived(
        lambda _: {"traffic_light": _from_zero(*(1.0 for _ in _SIGNALS), _FARTHEST, _LONGEST)}, _read_traffic_light
    ),
    "right_of_way": Perceived(
        lambda slots: {"right_of_way": _from_zero(1.0, _FARTHEST), "priority": _from_zero(*[1.0] * slots)},
        _read_right_of_way,
    ),
    "speed_limit": Perceived(lambda _: {"speed_limit": _from_zero(BOUND)}, _read_speed_limit),
    "lane": Perceived(lambda _: {"lane": _from_zero(_MOST_LANES, _MOST_LANES)}, _read_lane),
    "pedestrians": Perceived(
        lambda _: {
            "pedestrians": spaces.Box(-BOUND, BOUND, (PEDESTRIANS, 4), np.float32),
            "pedestrian_mask": _from_zero(*[1.0] * PEDESTRIANS),
        },
        _read_pedestrians,
    ),
}


def perceived_spaces(perceives: Iterable[Perceivable], max_vehicles: int) -> dict[str, spaces.Box]:
    """Return the spaces of the keys that such names add to the observation, with so many vehicle slots."""
    return {key: space for name in perceives for key, space in PERCEIVED[name].spaces(max_vehicles).items()}


def perceived_in(keys: Container[str]) -> tuple[Perceivable, ...]:
    """Return the names whose keys are all among those of an observation."""
    return tuple(name for name in PERCEIVED if all(key in keys for key in perceived_spaces([name], 1)))


def perceived_fields(scene: AnyScene) -> list[tuple[str, Any, tuple[int, ...]]]:
    """Return the fields that rows have for these keys and costs.

    A scene has all of them if it has one: code is compiled once for each type of rows.
    """
    if not isinstance(scene, SumocfgScene) or not (scene.perceives or scene.red_light != "ignore"):
        return []
    known = perceived_spaces(PERCEIVED, scene.max_vehicles)
    keys = ((key, np.float32, space.shape) for key, space in known.items())
    return [*keys, (RED_LIGHT_TERM, np.float64, ()), (COST, np.float64, ())]


def observe_road(road: Road, rows: Rows) -> None:
    """Write the present values of the keys of a simulation's scene into the row of its environment."""
    for name in road.simulation.scene.perceives:
        for key, value in PERCEIVED[name].read(road).items():
            rows[key] = value


def judge_red_lights(simulation: SumocfgSimulation, collision_reward: float, rows: Rows) -> None:
    """Add to the row (1,) of a step, which has been judged, the consequence of stop lines driven over at red in it."""
    scene, passed = simulation.scene, simulation.perception.lights.passed_red
    if scene.red_light == "cost":
        rows[COST] = passed
        rows[RED_LIGHT_TERM] = -scene.red_light_penalty * passed
    else:
        rows[RED_LIGHT_TERM] = np.where(rows["outcome"] == RED_LIGHT, collision_reward, 0.0)
    rows["reward"] += rows[RED_LIGHT_TERM]


def add_up_red_lights(before: Rows, rows: Rows) -> None:
    """Add the consequences of red lights in a decision's earlier steps to those of this step; see ``rows.add_up``."""
    for field in (RED_LIGHT_TERM, COST):
        rows[field] += before[field]
