"""Speed of environments in SUMO configurations, beside SUMO alone: steps, workers, and resets."""

import subprocess
import tempfile
import time
from collections.abc import Iterator
from contextlib import closing, contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from statistics import median

import numpy as np
import sumo

from tint_sumo.bench.measuring import Turn, turns_apart
from tint_sumo.config import EgoController
from tint_sumo.core.files import write_text
from tint_sumo.envs import TaskSettings
from tint_sumo.envs.scene_env import SceneEnv
from tint_sumo.envs.vector import SceneVectorEnv
from tint_sumo.scenes import SumocfgScene, from_sumocfg
from tint_sumo.scenes.network import sumo_program
from tint_sumo.simulation import SumocfgSimulation
from tint_sumo.simulation.ego_way import EGO

_WARM_UP_S = 100.0
_GO, _STAND = 2, 0  # actions
_GO_STEPS, _STAND_STEPS = 40, 20  # the ego drives and stands in turns, so that it meets others
_GRID = "--grid --grid.number 4 --grid.length 150 --grid.attach-length 150 -L 2 --default-junction-type traffic_light"
_BRAUNSCHWEIG = Path(sumo.SUMO_HOME) / "tools" / "game" / "fokr_bs_demo.sumocfg"


@dataclass(frozen=True)
class NetworkSpeed:
    """Results in one configuration; times are those of the processor."""

    name: str
    vehicles: int  # on the roads when the ego appears
    env_step_us: float
    sumo_step_us: float  # SUMO's step, the ego's speed and the subscription: the same traffic without the environment
    env_to_sumo: float  # ratio of the speeds
    reset_ms: float
    warm_reset_ms: float  # with a warm start that has been made

    def rows(self) -> list[tuple[str, str]]:
        return [
            (f"{self.name}, {self.vehicles} vehicles", f"{self.env_step_us:.0f} us a step"),
            ("  its speed to SUMO's alone", f"{self.env_to_sumo:.2f}"),
            (f"  a reset, {_WARM_UP_S:g} s of traffic", f"{self.reset_ms:.0f} ms"),
            ("  with a warm start", f"{self.warm_reset_ms:.0f} ms"),
        ]


def network_speeds(turns: int, steps: int) -> tuple[tuple[NetworkSpeed, ...], float]:
    """Measure in the streets of Braunschweig that SUMO ships, and in a grid of 4 by 4 crossings with traffic lights.

    Args:
        turns: of each measurement; the median counts.
        steps: of each turn.

    Returns:
        The speed in each of them, and the steps per second of two environments in two workers of the grid, to one.
    """
    with tempfile.TemporaryDirectory(prefix="tint_sumo.") as folder:
        grid = _grid(Path(folder))
        speeds = tuple(_measured(scene, turns, steps) for scene in (_braunschweig(), grid))
        return speeds, _workers_ratio(grid, turns, steps)


def _braunschweig() -> SumocfgScene:
    return _scene(_BRAUNSCHWEIG, ["-5.5", "5", "9", "6", "-6", "-9"], 200.0)


def grid_config(folder: Path, vehicles_per_s: float) -> Path:
    """Write 4 by 4 crossings with traffic lights into a folder; return the SUMO configuration.

    Args:
        folder: of the files.
        vehicles_per_s: mean rate of each of the eight flows, which go straight on.
    """
    net = folder / "grid.net.xml"
    subprocess.run([sumo_program("netgenerate"), *_GRID.split(), "-o", str(net)], check=True, capture_output=True)
    ways = [(f"left{row}A{row}", f"D{row}right{row}") for row in range(4)]
    ways += [(f"bottom{column}{letter}0", f"{letter}3top{column}") for column, letter in enumerate("ABCD")]
    flows = "".join(
        f'<flow id="{start}" from="{start}" to="{end}" begin="0" end="3600" period="exp({vehicles_per_s:g})" '
        'departSpeed="max"/>'
        for start, end in ways
    )
    write_text(folder / "grid.rou.xml", f"<routes>{flows}</routes>")
    sumocfg = folder / "grid.sumocfg"
    write_text(
        sumocfg,
        '<configuration><net-file value="grid.net.xml"/><route-files value="grid.rou.xml"/><step-length value="0.1"/>'
        "</configuration>",
    )
    return sumocfg


def _grid(folder: Path) -> SumocfgScene:
    return _scene(grid_config(folder, 0.25), ["bottom1B0", "B0B1", "B1C1", "C1D1"], 450.0)


def _scene(sumocfg: Path, route: list[str], goal_m: float) -> SumocfgScene:
    controller = EgoController((0.0, 1.0, 3.0))  # it is long on its way
    return from_sumocfg(sumocfg, route, 5.0, goal_m, warm_up_s=_WARM_UP_S, controller=controller, time_limit_s=600.0)


def _measured(scene: SumocfgScene, turns: int, steps: int) -> NetworkSpeed:
    pairs, resets_ms = [], []
    with closing(SceneEnv(TaskSettings(scene))) as env:
        for turn in range(turns):
            start = time.process_time()
            env.reset(seed=turn)
            resets_ms.append(1e3 * (time.process_time() - start))
            vehicles = int(env.simulation.connection.vehicle.getIDCount()) - 1
            pairs.append(_step_times_us(env, turn, steps))
    env_us, sumo_us = (median(times_us) for times_us in zip(*pairs, strict=True))
    return NetworkSpeed(
        scene.name,
        vehicles,
        env_us,
        sumo_us,
        median(bare / whole for whole, bare in pairs),
        median(resets_ms),
        _warm_reset_ms(scene, turns),
    )


def _step_times_us(env: SceneEnv, seed: int, steps: int) -> tuple[float, float]:
    """Return times of a step of the environment, whose episode has begun, and of SUMO with the same ego."""
    speeds_mps = []
    egos = env.simulation.egos
    start = time.process_time()
    for step in range(steps):
        *_, terminated, _, _ = env.step(_action(step))
        speeds_mps.append(float(egos.speed_mps[0]))
        if terminated:
            break
    env_s = time.process_time() - start
    env.reset(seed=seed)
    connection = env.simulation.connection
    vehicle, sumo_step = connection.vehicle, connection.step
    start = time.process_time()
    for speed_mps in speeds_mps:
        vehicle.setSpeed(EGO, speed_mps)
        sumo_step()
        vehicle.getContextSubscriptionResults(EGO)
    sumo_s = time.process_time() - start
    return 1e6 * env_s / len(speeds_mps), 1e6 * sumo_s / len(speeds_mps)


def _action(step: int) -> np.int64:
    return np.int64(_GO if step % (_GO_STEPS + _STAND_STEPS) < _GO_STEPS else _STAND)


def _warm_reset_ms(scene: SumocfgScene, turns: int) -> float:
    simulation = SumocfgSimulation(1, replace(scene, warm_starts=1))
    with closing(simulation):
        times_ms = []
        for seed in range(turns + 1):
            start = time.process_time()
            simulation.reset(0, seed)
            times_ms.append(1e3 * (time.process_time() - start))
    return median(times_ms[1:])  # the first one has made the state


def _workers_ratio(scene: SumocfgScene, turns: int, steps: int) -> float:
    with turns_apart(_vector_turns, scene, 1, steps) as one, turns_apart(_vector_turns, scene, 2, steps) as two:
        return median(two() / one() for _ in range(turns))


@contextmanager
def _vector_turns(scene: SumocfgScene, workers: int, steps: int) -> Iterator[Turn]:
    """Give turns that measure steps per second of so many environments, each in a worker."""
    with closing(SceneVectorEnv(workers, TaskSettings(scene), workers=workers)) as vector:

        def turn() -> float:
            vector.reset(seed=0)
            start = time.perf_counter()
            for step in range(steps):
                vector.step(np.full(workers, _action(step)))
            return workers * steps / (time.perf_counter() - start)

        yield turn
