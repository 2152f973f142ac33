"""The ego's road in a SUMO configuration: further keys of the observation, and the costs of red lights.

``tint_sumo.envs.scene_env.SceneEnv`` describes the keys. A new one is an entry of ``PERCEIVED``, and its name in
``tint_sumo.config.Perceivable``.
"""

from collections.abc import Callable, Container, Iterable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from gymnasium import spaces

from tint_sumo.config import POSITION_SCALE_M, Perceivable
from tint_sumo.envs.rows import BOUND, COST, RED_LIGHT, RED_LIGHT_TERM, Rows
from tint_sumo.scenes.geometry import Floats
from tint_sumo.scenes.registry import AnyScene
from tint_sumo.scenes.sumocfg import SumocfgScene
from tint_sumo.simulation import SumocfgSimulation

_FARTHEST = 5.0  # bound of distances ahead: 100 m
_TIME_SCALE_S, _LONGEST = 10.0, 10.0  # times are observed divided by the first, up to the second: 100 s
_SIGNALS = ("ru", "yY", "G", "g", "s", "oO")  # SUMO's letters for the states that are told apart
_MOST_LANES = 64


@dataclass(frozen=True)
class Perceived:
    """Keys of the observation that belong together."""

    spaces: Mapping[str, spaces.Box]
    read: Callable[[SumocfgSimulation], Mapping[str, Floats]]  # returns the present value of each key


def _from_zero(*high: float) -> spaces.Box:
    return spaces.Box(np.zeros(len(high), np.float32), np.array(high, np.float32))


def _read_traffic_light(simulation: SumocfgSimulation) -> dict[str, Floats]:
    light, lights = simulation.perception.traffic_light, simulation.perception.lights
    if light is None:
        return {"traffic_light": np.array([*(0.0 for _ in _SIGNALS), _FARTHEST, 0.0])}
    distance = (light.line_m - simulation.egos.front_m[0]) / POSITION_SCALE_M
    time = (lights.time_s - light.since_s) / _TIME_SCALE_S
    state = [float(light.state in letters) for letters in _SIGNALS]
    return {"traffic_light": np.array([*state, min(max(distance, 0.0), _FARTHEST), min(time, _LONGEST)])}


def _read_speed_limit(simulation: SumocfgSimulation) -> dict[str, Floats]:
    limit = simulation.perception.lane.speed_limit_mps / simulation.scene.speed_scale_mps
    return {"speed_limit": np.array([min(limit, BOUND)])}


def _read_lane(simulation: SumocfgSimulation) -> dict[str, Floats]:
    lane = simulation.perception.lane
    return {"lane": np.minimum([lane.index, lane.count], float(_MOST_LANES))}


PERCEIVED: dict[Perceivable, Perceived] = {
    "traffic_light": Perceived(
        {"traffic_light": _from_zero(*(1.0 for _ in _SIGNALS), _FARTHEST, _LONGEST)}, _read_traffic_light
    ),
    "speed_limit": Perceived({"speed_limit": _from_zero(BOUND)}, _read_speed_limit),
    "lane": Perceived({"lane": _from_zero(_MOST_LANES, _MOST_LANES)}, _read_lane),
}


def perceived_spaces(perceives: Iterable[Perceivable]) -> dict[str, spaces.Box]:
    """Return the spaces of the keys that such names add to the observation."""
    return {key: space for name in perceives for key, space in PERCEIVED[name].spaces.items()}


def perceived_in(keys: Container[str]) -> tuple[Perceivable, ...]:
    """Return the names whose keys are all among those of an observation."""
    return tuple(name for name, known in PERCEIVED.items() if all(key in keys for key in known.spaces))


def perceived_fields(scene: AnyScene) -> list[tuple[str, Any, tuple[int, ...]]]:
    """Return the fields that rows have for these keys and costs.

    A scene has all of them if it has one: code is compiled once for each type of rows.
    """
    if not isinstance(scene, SumocfgScene) or not (scene.perceives or scene.red_light != "ignore"):
        return []
    keys = ((key, np.float32, space.shape) for key, space in perceived_spaces(PERCEIVED).items())
    return [*keys, (RED_LIGHT_TERM, np.float64, ()), (COST, np.float64, ())]


def observe_road(simulation: SumocfgSimulation, rows: Rows) -> None:
    """Write the present values of the keys of a simulation's scene into the row of its environment."""
    for name in simulation.scene.perceives:
        for key, value in PERCEIVED[name].read(simulation).items():
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
