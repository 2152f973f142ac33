"""Record the traffic without the ego (paper III-B) to Parquet, shard by shard."""

from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from tint_sumo.config import STEP_S, AnyMix, Mix, Population
from tint_sumo.core.structures import plain
from tint_sumo.dataset.schema import SCHEMA_VERSION, Manifest
from tint_sumo.dataset.shards import EPISODE_STEPS, record_dataset, require_sizes
from tint_sumo.jobs import Workers
from tint_sumo.scenes import T_INTERSECTION, Scene, described, find_scene, paper_scene, require_trait_steps
from tint_sumo.scenes.drivers import find_population, population_name
from tint_sumo.scenes.geometry import Floats, Numbers
from tint_sumo.simulation.scene import SceneSimulation

EPISODES_PER_SHARD = 16


@dataclass(frozen=True)
class Recording:
    """Settings of a recording: at least ``windows`` windows of traffic with this mix of drivers."""

    windows: int
    p_conservative: Mix
    population: Population | None = None  # the scene's if not given
    seed: int = 0
    scene: Scene = field(default_factory=paper_scene)

    episodes_per_shard: ClassVar[int] = EPISODES_PER_SHARD
    episode_s: ClassVar[float] = EPISODE_STEPS * STEP_S

    def __post_init__(self) -> None:
        require_sizes(self.windows, self.seed)
        require_trait_steps(self.scene)

    def played(self) -> Scene:
        scene = self.scene
        traffic = replace(scene.traffic, p_conservative=self.p_conservative)
        return replace(scene, traffic=traffic, population=self.population or scene.population)

    def settings(self) -> dict[str, Any]:
        played = self.played()
        return {
            "kind": "dataset",
            "schema_version": SCHEMA_VERSION,
            **described([played]),
            "windows": self.windows,
            "p_conservative": self.p_conservative.plain(),
            "population": population_name(played.population) or plain(played.population),
            "seed": self.seed,
        }

    def simulate(self, shard: int) -> tuple[pd.DataFrame, pd.DataFrame]:
        with _kept_simulation(self.played()) as simulation:
            return simulate_episodes(simulation, self.seed, shard * EPISODES_PER_SHARD)


def record(
    out: str | Path,
    windows: int,
    *,
    p_conservative: AnyMix = 0.5,
    population: str | Population | None = None,
    seed: int = 0,
    scene: str | Scene = T_INTERSECTION,
    workers: Workers = 1,
    fcd: bool = False,
    progress: bool = True,
) -> Manifest:
    """Record a dataset of at least ``windows`` windows into ``out``, a folder or a URL, and return its manifest.

    The same call resumes an interrupted recording; a finished one is left as it is. With ``fcd`` the trajectories are
    written as SUMO's floating-car data, too, also those of a dataset that is there already. The population is the
    scene's if not given.

    Raises:
        InputError: bad values, or ``out`` holds another run.
    """
    drivers = find_population(population) if isinstance(population, str) else population
    recording = Recording(windows, Mix.parse(p_conservative), drivers, seed, find_scene(scene))
    try:
        return record_dataset(
            out,
            recording,
            fcd=recording.played() if fcd else None,
            workers=workers,
            progress=progress,
        )
    finally:
        _simulations.clear()  # ends the simulation: libsumo is free again


_simulations: dict[Scene, SceneSimulation] = {}  # of this process, at most one: libsumo runs no more


@contextmanager
def _kept_simulation(scene: Scene) -> Iterator[SceneSimulation]:
    """Give this process's simulation; starting another for every shard would cost more than recording it.

    One that an error or an interrupt may have left half done is closed: a cluster's process goes on to the next shard.
    """
    if scene not in _simulations:
        _simulations.clear()
        _simulations[scene] = SceneSimulation(EPISODES_PER_SHARD, scene, with_ego=False)
    try:
        yield _simulations[scene]
    except BaseException:
        _simulations.pop(scene).close()
        raise


def simulate_episodes(
    simulation: SceneSimulation, seed: int, first_episode: int, steps: int = EPISODE_STEPS
) -> tuple[pd.DataFrame, pd.DataFrame]:
    """Run one episode in every replica; return rows of trajectories (by vehicle and time) and of drivers."""
    replicas = simulation.replicas
    for replica in range(replicas):
        simulation.reset(replica, [seed, first_episode + replica])
    scene = simulation.scene
    shape = (steps + 1, replicas, scene.max_vehicles)
    front_m, gap_m = np.empty(shape), np.empty(shape)
    number, member, route, leader = (np.empty(shape, np.int64) for _ in range(4))
    for step in range(steps + 1):
        if step > 0:
            simulation.step()
        slots = simulation.slots
        front_m[step] = slots.front_m
        number[step], member[step], route[step] = slots.vehicle_number, slots.member, slots.route
        leading, gap_m[step] = simulation.leaders()
        leader[step] = np.where(leading < 0, -1, np.take_along_axis(number[step], leading, axis=1))
    desired_mps = np.array([driver.desired_speed_mps for driver in simulation.population])[member]
    speed_mps = _speeds_mps(front_m, number, desired_mps, scene.step_s)

    when, replica_at, slot = np.nonzero(number >= 0)
    order = np.lexsort((when, number[when, replica_at, slot], replica_at))
    at = (when[order], replica_at[order], slot[order])
    keys = {"episode": first_episode + at[1], "vehicle": number[at]}
    trajectories = pd.DataFrame(
        {
            **keys,
            "time_s": at[0] * scene.step_s,
            "route": pd.Categorical.from_codes(route[at], pd.Index([route.name for route in scene.routes])),
            "position_m": front_m[at],
            "speed_mps": speed_mps[at],
            "acceleration_mps2": _accelerations_mps2(speed_mps, number, scene.step_s)[at],
            "leader": pd.arrays.IntegerArray(leader[at].astype(np.int16), leader[at] < 0),
            "gap_m": np.where(leader[at] < 0, np.nan, gap_m[at]),
        }
    )
    first = ~trajectories.duplicated(["episode", "vehicle"]).to_numpy()
    return trajectories, _driver_rows(simulation, {key: value[first] for key, value in keys.items()}, member[at][first])


def _driver_rows(
    simulation: SceneSimulation, keys: Mapping[str, NDArray[np.int64]], member: NDArray[np.int64]
) -> pd.DataFrame:
    drivers = [simulation.population[index] for index in member]
    return pd.DataFrame(
        {
            **keys,
            "trait": pd.Categorical([driver.profile.name for driver in drivers]),
            "vtype": [driver.type_id for driver in drivers],
            "desired_speed_mps": [driver.desired_speed_mps for driver in drivers],
            "min_gap_m": [driver.min_gap_m for driver in drivers],
            "tau_s": [driver.idm.tau_s for driver in drivers],
        }
    )


def _continues(number: Numbers) -> NDArray[np.bool_]:
    """Return which slots (T, R, V) held the same vehicle a step before."""
    same = np.zeros(number.shape, bool)
    same[1:] = (number[1:] == number[:-1]) & (number[1:] >= 0)
    return same


def _speeds_mps(front_m: Floats, number: Numbers, insertion_mps: Floats, step_s: float) -> Floats:
    """Return speeds (T, R, V): in SUMO's Euler update a step's displacement is exactly its speed times the step."""
    moved_m = np.zeros_like(front_m)
    moved_m[1:] = front_m[1:] - front_m[:-1]
    return np.where(_continues(number), moved_m / step_s, insertion_mps)


def _accelerations_mps2(speed_mps: Floats, number: Numbers, step_s: float) -> Floats:
    change = np.full_like(speed_mps, np.nan)
    change[1:] = (speed_mps[1:] - speed_mps[:-1]) / step_s
    return np.where(_continues(number), change, np.nan)
