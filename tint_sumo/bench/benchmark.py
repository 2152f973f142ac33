"""Speed of environments, recorder, trait models and policies, beside that of SUMO alone and of sb3-contrib.

Whatever is compared is measured in turns within one run, since other work on a machine slows all of it down; what
comes out is the median of the turns.
"""

import json
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from statistics import median
from typing import Any

import gymnasium
import numpy as np
import psutil
import torch

from tint_sumo import ENV_IDS
from tint_sumo.bench.measuring import Clocks, Turn, turns_apart
from tint_sumo.bench.networks import NetworkSpeed, network_speeds
from tint_sumo.bench.policies import DECISION_METHOD, TrainingSpeed, decision_ms, training_speed
from tint_sumo.config import PPO_BUDGETS, TRAIT_BUDGETS, WINDOW_STEPS, PpoSettings
from tint_sumo.core.determinism import single_threaded
from tint_sumo.core.progress import Progress
from tint_sumo.dataset.windows import Windows
from tint_sumo.envs import TaskSettings
from tint_sumo.envs.batch import LocalBatch
from tint_sumo.envs.sb3 import SceneVecEnv
from tint_sumo.jobs.table import one_job
from tint_sumo.scenes import T_INTERSECTION, find_scene
from tint_sumo.simulation.scene import SceneSimulation
from tint_sumo.simulation.sumo import SUMO_COLLISION_CHECK
from tint_sumo.simulation.timing import StepPart
from tint_sumo.traits import TRAIT_METHODS
from tint_sumo.traits.training import train

BREAKDOWN_METHOD = "clocks around the functions that do these parts, in a separate pass, without the cost of the clocks"

_MIB = 2**20
_WARM_UP_STEPS = 100  # steps of all replicas: their episodes begin together and drift apart
_BARE_STEPS = 10  # steps of SUMO alone: one second, in which few vehicles leave and none would enter
_CORES_TURNS = 3  # turns for each of the others: whether two processes run at once depends on what else runs
_RECORD_WORKERS = 2
_SAMPLING_S = 0.05
_ENCODED = 64 * 12  # windows: all slots of 64 intersections


@dataclass(frozen=True)
class Sizes:
    """Sizes of the measurements; steps are those of all replicas together, unless said otherwise."""

    replicas: int = 64
    turns: int = 9
    turn_steps: int = 100
    gym_turn_steps: int = 1_000  # steps of the single environment
    network_steps: int = 300  # steps of the environment in a SUMO configuration
    windows: int = 100_000
    training_windows: int = 40_000
    ppo: PpoSettings = PPO_BUDGETS["full"]
    paper_ppo: PpoSettings = PPO_BUDGETS["paper"]
    training_turns: int = 3  # each a rollout of a policy's training with its updates, or several short ones
    decisions: int = 1_000  # decisions of one policy with one intersection
    memory_env_steps: tuple[int, int] = (100_000, 2_000_000)  # memory growth is measured between these


QUICK = Sizes(
    turns=3,
    turn_steps=50,
    gym_turn_steps=500,
    network_steps=100,
    windows=10_000,
    training_windows=5_000,
    ppo=replace(PPO_BUDGETS["full"], n_envs=64, n_minibatches=4),  # half a rollout, minibatches as large as ever
    training_turns=2,
    decisions=300,
    memory_env_steps=(20_000, 100_000),
)


@dataclass(frozen=True)
class Cores:
    """Environment steps per second with all replicas in one process, and shared out among two workers."""

    replicas: int
    one: float
    two: float
    ratio: float

    def rows(self) -> list[tuple[str, str]]:
        return [
            (f"{self.replicas} replicas in one process", f"{self.one:,.0f} environment steps/s"),
            ("  in two workers", f"{self.two:,.0f} environment steps/s"),
            ("  their ratio", f"{self.ratio:.2f}"),
        ]


@dataclass(frozen=True)
class Benchmark:
    """Results of ``run_benchmark``.

    The floor is SUMO's ``simulationStep`` alone, step after step with nothing in between, in the same simulation with
    the same vehicles on the street. It does less than the environment, which sees collisions itself while SUMO does not
    check for them; the checking floor is SUMO alone in such traffic with its check for collisions.
    """

    floor_env_steps_per_s: float
    env_steps_per_s: float
    env_to_floor: float
    checking_floor_env_steps_per_s: float
    env_to_checking_floor: float
    scenes_to_t_intersection: dict[str, float]  # speed of other scenes' environments to the T-intersection's
    gym_env_steps_per_s: float
    cores: tuple[Cores, ...]
    networks: tuple[NetworkSpeed, ...]  # SUMO configurations
    network_workers: float  # two workers to one in such a configuration
    record_windows_per_s: float
    peak_memory_mib: float  # peak of all of the recorder's processes together; what they share counts once
    windows: int
    memory_growth_mib: float
    train_windows_per_s: dict[str, float]  # by trait method, with one thread
    encode_ms: dict[str, float]  # the same, of all 12 slots of 64 intersections
    policy_trainings: tuple[TrainingSpeed, ...]  # as in the study, and with the paper's recipe
    decision_ms: float  # see DECISION_METHOD
    breakdown_us: dict[str, float]  # per environment step

    def to_json(self) -> dict[str, Any]:
        return asdict(self)

    def table(self) -> str:
        total_us = sum(self.breakdown_us.values())
        rows = [
            ("SUMO's simulationStep alone", f"{self.floor_env_steps_per_s:,.0f} environment steps/s"),
            ("  looking for collisions, too", f"{self.checking_floor_env_steps_per_s:,.0f} environment steps/s"),
            ("Stable-Baselines3 environment", f"{self.env_steps_per_s:,.0f} environment steps/s"),
            ("  its speed to SUMO's alone", f"{self.env_to_floor:.2f}"),
            ("  and with its collision check", f"{self.env_to_checking_floor:.2f}"),
            *((f"  {name} to t_intersection", f"{ratio:.2f}") for name, ratio in self.scenes_to_t_intersection.items()),
            ("one gymnasium environment", f"{self.gym_env_steps_per_s:,.0f} steps/s"),
            *(row for cores in self.cores for row in cores.rows()),
            *(row for network in self.networks for row in network.rows()),
            ("  two workers to one", f"{self.network_workers:.2f}"),
            (f"recorder, {_RECORD_WORKERS} workers", f"{self.record_windows_per_s:,.0f} windows/s"),
            ("  its processes' peak memory", f"{self.peak_memory_mib:,.0f} MiB"),
            ("memory growth while stepping", f"{self.memory_growth_mib:+.1f} MiB"),
            *((f"training {method}", f"{speed:,.0f} windows/s") for method, speed in self.train_windows_per_s.items()),
            *(
                (f"encoding {_ENCODED} windows, {method}", f"{one_ms:.2f} ms")
                for method, one_ms in self.encode_ms.items()
            ),
            *(row for training in self.policy_trainings for row in training.rows()),
            ("deciding with streaming traits", f"{self.decision_ms:.2f} ms"),
            ("where an environment step's time goes", f"{total_us:.1f} us"),
            *((f"  {part}", f"{us:.1f} us  {us / total_us:4.0%}") for part, us in self.breakdown_us.items()),
        ]
        lines = [f"{name:38} {value}" for name, value in rows]
        return "\n".join([*lines, f"  ({BREAKDOWN_METHOD})", f"  ({DECISION_METHOD})"])


def run_benchmark(sizes: Sizes | None = None, progress: bool = True) -> Benchmark:
    """Measure everything, one after the other."""
    sizes = sizes or Sizes()
    measurements = (_speed, _scenes, _breakdown, _gym_speed, _cores, _networks, _record, _memory, _traits, _policies)
    found: dict[str, Any] = {}
    with one_job("bench", progress=progress) as report:
        for number, measurement in enumerate(measurements):
            report(Progress(number, len(measurements), "measurement"))
            found |= measurement(sizes)
    return Benchmark(**found)


class _Driven:
    """A Stable-Baselines3 environment with random actions."""

    def __init__(self, sizes: Sizes, workers: int = 1, seed: int = 0, scene: str = T_INTERSECTION) -> None:
        self.env = SceneVecEnv(sizes.replicas, TaskSettings(find_scene(scene)), seed, workers=workers)
        self._actions = np.random.default_rng(0).integers(3, size=(sizes.turn_steps, sizes.replicas))
        self.env.reset()
        for _ in range(_WARM_UP_STEPS):
            self.env.step(self._actions[0])

    @property
    def batch(self) -> LocalBatch:
        batch = self.env.env.batch
        assert isinstance(batch, LocalBatch)
        return batch

    @property
    def simulation(self) -> SceneSimulation:
        simulation = self.batch.episodes.simulation
        assert isinstance(simulation, SceneSimulation)
        return simulation

    def turn(self) -> int:
        """Make a turn's steps and return how many environment steps they were."""
        for actions in self._actions:
            self.env.step(actions)
        return int(self._actions.size)

    def steps_per_s(self) -> float:
        start = time.perf_counter()
        steps = self.turn()
        return steps / (time.perf_counter() - start)


@contextmanager
def _driven(sizes: Sizes, workers: int = 1, seed: int = 0, scene: str = T_INTERSECTION) -> Iterator[_Driven]:
    driven = _Driven(sizes, workers, seed, scene)
    try:
        yield driven
    finally:
        driven.env.close()


def _speed(sizes: Sizes) -> dict[str, Any]:
    """Measure in turns the environment, SUMO alone from the state it has reached, and SUMO with collision checks."""
    env, floor, checking = [], [], []
    for turn in range(sizes.turns):
        with _driven(sizes, seed=turn) as driven:
            env.append(driven.steps_per_s())
            floor.append(_bare_steps_per_s(driven.simulation))
        checking.append(_checking_steps_per_s(sizes, seed=turn))
    return {
        "floor_env_steps_per_s": median(floor),
        "env_steps_per_s": median(env),
        "env_to_floor": median(a / b for a, b in zip(env, floor, strict=True)),
        "checking_floor_env_steps_per_s": median(checking),
        "env_to_checking_floor": median(a / b for a, b in zip(env, checking, strict=True)),
    }


def _scenes(sizes: Sizes) -> dict[str, Any]:
    """Measure in turns the environment of each scene, and that of the T-intersection."""
    speeds: dict[str, list[float]] = {scene: [] for scene in ENV_IDS}
    for turn in range(sizes.turns // 2 + 1):
        for scene, found in speeds.items():
            with _driven(sizes, seed=turn, scene=scene) as driven:
                found.append(driven.steps_per_s())
    paper = speeds.pop(T_INTERSECTION)
    return {
        "scenes_to_t_intersection": {
            scene: median(speed / other for speed, other in zip(found, paper, strict=True))
            for scene, found in speeds.items()
        }
    }


def _bare_steps_per_s(simulation: SceneSimulation) -> float:
    """Measure steps of SUMO in a row; the simulation loses track of its vehicles and is of no more use."""
    step = simulation.link.connection.step
    start = time.perf_counter()
    for _ in range(_BARE_STEPS):
        step()
    return _BARE_STEPS * simulation.replicas / (time.perf_counter() - start)


def _checking_steps_per_s(sizes: Sizes, seed: int) -> float:
    """Measure the same where SUMO checks for collisions, after as many steps of random egos."""
    rng = np.random.default_rng(seed)
    scene = find_scene(T_INTERSECTION)
    simulation = SceneSimulation(sizes.replicas, scene, collision_options=SUMO_COLLISION_CHECK)
    try:
        over = np.ones(sizes.replicas, bool)
        for step in range(_WARM_UP_STEPS + sizes.turn_steps):
            for replica in np.flatnonzero(over).tolist():
                simulation.reset(replica, [seed, replica, step])
            simulation.step(rng.choice(scene.ego.controller.desired_speeds_mps, sizes.replicas))
            over = simulation.egos.collided | (simulation.egos.front_m > scene.ego.goal_m)
        return _bare_steps_per_s(simulation)
    finally:
        simulation.close()


def _breakdown(sizes: Sizes) -> dict[str, Any]:
    clocks = Clocks()
    with _driven(sizes) as driven:
        batch, simulation = driven.batch, driven.simulation
        clocks.watch(driven.env, batch, batch.episodes)
        clocks.watch(simulation, simulation.egos, simulation.yielding, simulation.link)
        steps = sum(driven.turn() for _ in range(sizes.turns))
    return {"breakdown_us": {part.value: clocks.spent_s[part] / steps * 1e6 for part in StepPart}}


def _gym_speed(sizes: Sizes) -> dict[str, Any]:
    env = gymnasium.make(ENV_IDS[T_INTERSECTION])
    actions = np.random.default_rng(0).integers(3, size=sizes.gym_turn_steps)
    env.reset(seed=0)

    def turn() -> float:
        start = time.perf_counter()
        for action in actions:
            *_, terminated, truncated, _ = env.step(action)
            if terminated or truncated:
                env.reset()
        return len(actions) / (time.perf_counter() - start)

    try:
        turn()
        return {"gym_env_steps_per_s": median(turn() for _ in range(sizes.turns))}
    finally:
        env.close()


def _cores(sizes: Sizes) -> dict[str, Any]:
    """Measure with the usual number of replicas, and with that number in each worker."""
    return {"cores": tuple(_workers_speed(replace(sizes, replicas=times * sizes.replicas)) for times in (1, 2))}


def _networks(sizes: Sizes) -> dict[str, Any]:
    networks, workers = network_speeds(sizes.turns, sizes.network_steps)
    return {"networks": networks, "network_workers": workers}


def _workers_speed(sizes: Sizes) -> Cores:
    """Measure in turns, each in another process."""
    with turns_apart(_driven_turns, sizes, 1) as single, turns_apart(_driven_turns, sizes, 2) as double:
        speeds = [(single(), double()) for _ in range(_CORES_TURNS * sizes.turns)]
    ratio = median(b / a for a, b in speeds)
    return Cores(sizes.replicas, median(a for a, _ in speeds), median(b for _, b in speeds), ratio)


@contextmanager
def _driven_turns(sizes: Sizes, workers: int) -> Iterator[Turn]:
    with _driven(sizes, workers) as driven:
        yield driven.steps_per_s


def _record(sizes: Sizes) -> dict[str, Any]:
    """Record a dataset with the command, from its start to its end, as a user waits for it."""
    command = [sys.executable, "-m", "tint_sumo.cli", "record", "--json", "--windows", str(sizes.windows)]
    with tempfile.TemporaryDirectory(prefix="tint_sumo.") as folder, tempfile.TemporaryFile() as printed:
        out = ["--out", str(Path(folder) / "dataset"), "--workers", str(_RECORD_WORKERS)]
        start = time.perf_counter()
        process = psutil.Popen([*command, *out], stdout=printed, stderr=subprocess.DEVNULL)
        peak_mib = _peak_memory_mib(process)
        elapsed_s = time.perf_counter() - start
        if process.returncode != 0:
            raise RuntimeError(f"the recorder ended with exit code {process.returncode}")
        printed.seek(0)
        windows = json.loads(printed.read().splitlines()[-1])["windows"]
    return {"record_windows_per_s": windows / elapsed_s, "peak_memory_mib": peak_mib, "windows": windows}


def _memory(sizes: Sizes) -> dict[str, Any]:
    """Measure how this process grows over many environment steps, in which episodes end and begin."""
    first, last = sizes.memory_env_steps
    steps, sizes_mib = 0, []
    with _driven(sizes) as driven:
        for goal in (first, last):
            while steps < goal:
                steps += driven.turn()
            sizes_mib.append(_memory_mib(psutil.Process()))
    return {"memory_growth_mib": sizes_mib[1] - sizes_mib[0]}


def _traits(sizes: Sizes) -> dict[str, Any]:
    """Measure each trait method with the sizes of the full budget and one thread of torch, as in the study's jobs."""
    with single_threaded():
        training = {method: _train_windows_per_s(method, sizes.training_windows) for method in TRAIT_METHODS}
        encoding = {method: _encode_ms(method, sizes.turns) for method in TRAIT_METHODS}
    return {"train_windows_per_s": training, "encode_ms": encoding}


def _policies(sizes: Sizes) -> dict[str, Any]:
    budgets = {"full": sizes.ppo, "paper": sizes.paper_ppo}
    trainings = tuple(training_speed(name, settings, sizes.training_turns) for name, settings in budgets.items())
    return {"policy_trainings": trainings, "decision_ms": decision_ms(sizes.ppo, sizes.decisions)}


def _train_windows_per_s(method: str, windows: int) -> float:
    labels = np.arange(windows) % 2 == 0 if TRAIT_METHODS[method].uses_labels else None
    data = _steady_windows(windows)
    with tempfile.TemporaryDirectory(prefix="tint_sumo.") as folder:
        start = time.perf_counter()
        train(
            data,
            replace(TRAIT_BUDGETS["full"], epochs=1),
            Path(folder),
            method=method,
            conservative=labels,
        )
        return windows / (time.perf_counter() - start)


def _encode_ms(method: str, turns: int) -> float:
    model = TRAIT_METHODS[method](TRAIT_BUDGETS["full"]).eval()
    data = _steady_windows(_ENCODED)
    states, length = torch.from_numpy(data.states), torch.from_numpy(data.length)
    elapsed_ms = []
    with torch.inference_mode():
        for _ in range(10 * turns):
            start = time.perf_counter()
            model.encode(states, length)
            elapsed_ms.append(1e3 * (time.perf_counter() - start))
    return median(elapsed_ms)


def _steady_windows(windows: int) -> Windows:
    """Return full windows of drivers at a steady speed; their content does not change how long they take."""
    rng = np.random.default_rng(0)
    offset_m = rng.uniform(0.2, 0.3, (windows, 1)) * np.arange(WINDOW_STEPS)
    gap_m = np.broadcast_to(rng.uniform(3.0, 20.0, (windows, 1)), offset_m.shape)
    number = np.arange(windows)
    return Windows(
        np.stack((offset_m, gap_m), axis=2).astype(np.float32),
        np.full(windows, WINDOW_STEPS),
        number // 8,
        number // 400,
        np.ones(windows, bool),
    )


def _peak_memory_mib(process: psutil.Popen) -> float:
    """Wait for a process, and return the peak of the memory of it and its descendants together."""
    peak_mib = 0.0
    while True:
        with suppress(psutil.NoSuchProcess):
            tree = (process, *process.children(recursive=True))
            peak_mib = max(peak_mib, sum(map(_memory_mib, tree)))
        with suppress(psutil.TimeoutExpired):
            process.wait(_SAMPLING_S)
            return peak_mib


def _memory_mib(process: psutil.Process) -> float:
    """Return the memory of a process, with its part of what it shares with others (Linux's PSS); 0 if it has ended."""
    try:
        return float(process.memory_full_info().pss / _MIB)
    except psutil.NoSuchProcess:
        return 0.0
