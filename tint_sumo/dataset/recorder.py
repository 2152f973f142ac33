"""Record the traffic without the ego (paper III-B) to Parquet, shard by shard.

A shard is a fixed number of episodes whose seeds follow from the dataset's seed and the shard's number, so that the
dataset does not depend on the number of workers, and an interrupted recording resumes to the very same dataset. No more
than a shard per process is in memory at a time.
"""

import platform
import signal
from collections.abc import Callable, Iterator, Mapping
from concurrent.futures import Future, ProcessPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass, replace
from functools import cache, partial
from importlib.metadata import version
from itertools import count
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pyarrow as pa
import pyarrow.parquet as pq
from numpy.typing import NDArray

from tint_sumo.config import MIN_WINDOW_STEPS, NO_LEADER_GAP_M, POPULATIONS, WINDOW_STEPS, Share, Traffic
from tint_sumo.dataset.fcd import write_fcd
from tint_sumo.dataset.schema import (
    DRIVER_SCHEMA,
    DRIVERS,
    FCD,
    MANIFEST,
    SCHEMA_VERSION,
    TABLES,
    TRAJECTORIES,
    TRAJECTORY_SCHEMA,
    read_shard,
    read_shard_metadata,
    shard_file,
    shard_number,
)
from tint_sumo.errors import InputError
from tint_sumo.files import claim_folder, read_json, whole_file, write_json
from tint_sumo.processes import SPAWN, end_with_parent
from tint_sumo.progress import make_bar
from tint_sumo.scenes import T_INTERSECTION, Scene, find_scene
from tint_sumo.scenes.geometry import Floats, Numbers
from tint_sumo.scenes.layout import layout
from tint_sumo.simulation.simulation import Simulation

EPISODES_PER_SHARD = 16
EPISODE_STEPS = 500
_WINDOWS_KEY = b"tint_sumo.windows"
# Measured on real shards, size and write time relative to pyarrow's defaults (snappy, dictionaries): splitting the
# floats into byte streams halves the file (0.42) and takes a third of the time, as dictionaries of floats that hardly
# repeat are not built in vain. zstd 3 then beats snappy (0.52), lz4 (0.46) and gzip in size; zstd 9 saves 4 % for
# twice the time; delta encodings save nothing. All of them read in about the same time.
_FLOATS = [field.name for field in (*TRAJECTORY_SCHEMA, *DRIVER_SCHEMA) if pa.types.is_floating(field.type)]


@dataclass(frozen=True)
class Recording:
    """What to record: at least ``windows`` windows of traffic with this share of conservative drivers."""

    windows: int
    p_conservative: Share = 0.5
    population: str = "traits"  # a name in POPULATIONS
    seed: int = 0
    scene: str = T_INTERSECTION  # a name in SCENES

    def __post_init__(self) -> None:
        if self.windows < 1:
            raise InputError(f"windows must be at least 1, not {self.windows}")
        if self.seed < 0:
            raise InputError(f"seed must not be negative: {self.seed}")
        if self.population not in POPULATIONS:
            raise InputError(f"unknown population {self.population!r}; choose one of: {', '.join(POPULATIONS)}")
        self.played()

    def played(self) -> Scene:
        traffic, population = Traffic(p_conservative=self.p_conservative), POPULATIONS[self.population]
        return replace(find_scene(self.scene), traffic=traffic, population=population)

    def settings(self) -> dict[str, Any]:
        return {
            "kind": "dataset",
            "schema_version": SCHEMA_VERSION,
            "scene": self.scene,
            "scene_digest": self.played().digest,
            "windows": self.windows,
            "p_conservative": self.p_conservative,
            "population": self.population,
            "seed": self.seed,
        }


def record(
    out: Path,
    windows: int,
    *,
    p_conservative: Share = 0.5,
    population: str = "traits",
    seed: int = 0,
    scene: str = T_INTERSECTION,
    workers: int = 1,
    fcd: bool = False,
    progress: bool = True,
) -> dict[str, Any]:
    """Record a dataset of at least ``windows`` windows into ``out`` and return its manifest.

    The same call resumes an interrupted recording; a finished one is left as it is. With ``fcd`` the trajectories are
    written as SUMO's floating-car data, too, also those of a dataset that is there already.

    Raises:
        InputError: bad values, or ``out`` holds another run.
    """
    recording = Recording(windows, p_conservative, population, seed, scene)
    if workers < 1:
        raise InputError(f"workers must be at least 1, not {workers}")
    with claim_folder(out, recording.settings()):
        finished = _finished(out, fcd)
        return _record(recording, out, fcd, workers, progress) if finished is None else finished


def _finished(out: Path, fcd: bool) -> dict[str, Any] | None:
    """The manifest of a complete dataset."""
    if not (out / MANIFEST).exists():
        return None
    manifest = read_json(out / MANIFEST, "dataset manifest")
    parts = (*TABLES, FCD) if fcd else TABLES
    shards = range(int(manifest.get("shards", 0)))
    return manifest if all(shard_file(out, part, shard).exists() for part in parts for shard in shards) else None


def _record(recording: Recording, out: Path, fcd: bool, workers: int, progress: bool) -> dict[str, Any]:
    windows = recording.windows
    record_shard = partial(_record_shard, recording, out, fcd)
    counts: list[int] = []
    with (
        make_bar(total=windows, desc="record", unit=" windows", disable=not progress) as bar,
        _shards(record_shard, workers) as shards,
    ):
        for found in shards:
            counts.append(found)
            bar.update(min(found, windows - bar.n))
            if sum(counts) >= windows:
                break
    _remove_shards_from(out, len(counts))
    manifest = _manifest(out, recording, counts)
    write_json(out / MANIFEST, manifest)
    return manifest


@contextmanager
def _shards(record_shard: Callable[[int], int], workers: int) -> Iterator[Iterator[int]]:
    """Window counts of shards 0, 1, ..., recorded here or, ahead of their use, in worker processes."""
    if workers == 1:
        try:
            yield map(record_shard, count())
        finally:
            _simulation.cache_clear()  # ends the simulation: libsumo is free again
        return
    with ProcessPoolExecutor(workers, SPAWN, initializer=_start_worker) as pool:
        try:
            yield _ahead(pool, record_shard, workers)
        finally:
            pool.shutdown(cancel_futures=True)


def _ahead(pool: ProcessPoolExecutor, record_shard: Callable[[int], int], workers: int) -> Iterator[int]:
    pending: list[Future[int]] = []
    for shard in count():
        pending.append(pool.submit(record_shard, shard))
        if len(pending) > workers:
            yield pending.pop(0).result()


def _start_worker() -> None:
    """Leave Ctrl-C to the main process, and go with it."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    end_with_parent()


def _remove_shards_from(out: Path, first: int) -> None:
    """Workers run ahead: drop what they recorded beyond the last shard needed."""
    for part in (*TABLES, FCD):
        for file in (out / part).glob("shard-*"):
            if shard_number(file) >= first:
                file.unlink()


def _manifest(out: Path, recording: Recording, counts: list[int]) -> dict[str, Any]:
    rows = {
        part: sum(read_shard_metadata(shard_file(out, part, shard)).num_rows for shard in range(len(counts)))
        for part in TABLES
    }
    return {
        **recording.settings(),
        "windows": sum(counts),
        "windows_asked_for": recording.windows,
        "window_steps": WINDOW_STEPS,
        "no_leader_gap_m": NO_LEADER_GAP_M,
        "rows": rows[TRAJECTORIES],
        "drivers": rows[DRIVERS],
        "shards": len(counts),
        "episodes": len(counts) * EPISODES_PER_SHARD,
        "episode_s": EPISODE_STEPS * recording.played().step_s,
        "versions": {name: version(name) for name in ("tint_sumo", "libsumo", "numpy", "pandas", "pyarrow")}
        | {"python": platform.python_version()},
    }


def _record_shard(recording: Recording, out: Path, fcd: bool, shard: int) -> int:
    """Record one shard, as far as it is not there already, and return its number of windows."""
    file = shard_file(out, TRAJECTORIES, shard)
    if not (file.exists() and shard_file(out, DRIVERS, shard).exists()):
        _record_tables(recording, out, shard)
    if fcd and not shard_file(out, FCD, shard).exists():
        write_fcd(read_shard(file), shard_file(out, FCD, shard), layout(recording.played()))
    return int(read_shard_metadata(file).metadata[_WINDOWS_KEY])


def _record_tables(recording: Recording, out: Path, shard: int) -> None:
    trajectories, drivers = simulate_episodes(
        _simulation(recording.played()), recording.seed, first_episode=shard * EPISODES_PER_SHARD
    )
    windows = str(count_windows(trajectories)).encode()
    # The trajectories come last: where they are, the shard's tables are complete.
    _write(shard_file(out, DRIVERS, shard), drivers, DRIVER_SCHEMA, {})
    _write(shard_file(out, TRAJECTORIES, shard), trajectories, TRAJECTORY_SCHEMA, {_WINDOWS_KEY: windows})


@cache
def _simulation(scene: Scene) -> Simulation:
    """This process's simulation; starting one for every shard would cost more than recording it."""
    return Simulation(EPISODES_PER_SHARD, scene, with_ego=False)


def _write(file: Path, frame: pd.DataFrame, schema: pa.Schema, metadata: Mapping[bytes, bytes]) -> None:
    table = pa.Table.from_pandas(frame, schema, preserve_index=False)
    table = table.replace_schema_metadata({**(table.schema.metadata or {}), **metadata})
    with whole_file(file) as partial:
        pq.write_table(
            table,
            partial,
            compression="zstd",
            compression_level=3,
            use_dictionary=[name for name in table.column_names if name not in _FLOATS],
            use_byte_stream_split=[name for name in table.column_names if name in _FLOATS],
        )


def count_windows(trajectories: pd.DataFrame) -> int:
    """Number of windows in whole tracks: pieces of 20 steps, and remainders of at least 2."""
    steps = trajectories.groupby(["episode", "vehicle"]).size().to_numpy()
    return int((steps // WINDOW_STEPS + (steps % WINDOW_STEPS >= MIN_WINDOW_STEPS)).sum())


def simulate_episodes(
    simulation: Simulation, seed: int, first_episode: int, steps: int = EPISODE_STEPS
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
    desired_mps = np.array([one.desired_speed_mps for one in simulation.population])[member]
    speed_mps = _speeds_mps(front_m, number, desired_mps, scene.step_s)

    when, replica_at, slot = np.nonzero(number >= 0)
    order = np.lexsort((when, number[when, replica_at, slot], replica_at))
    at = (when[order], replica_at[order], slot[order])
    keys = {"episode": first_episode + at[1], "vehicle": number[at]}
    trajectories = pd.DataFrame(
        {
            **keys,
            "time_s": at[0] * scene.step_s,
            "route": pd.Categorical.from_codes(route[at], pd.Index([one.name for one in scene.routes])),
            "position_m": front_m[at],
            "speed_mps": speed_mps[at],
            "acceleration_mps2": _accelerations_mps2(speed_mps, number, scene.step_s)[at],
            "leader": pd.arrays.IntegerArray(leader[at].astype(np.int16), leader[at] < 0),
            "gap_m": gap_m[at],
        }
    )
    first = ~trajectories.duplicated(["episode", "vehicle"]).to_numpy()
    return trajectories, _driver_rows(simulation, {key: value[first] for key, value in keys.items()}, member[at][first])


def _driver_rows(
    simulation: Simulation, keys: Mapping[str, NDArray[np.int64]], member: NDArray[np.int64]
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
    """(T, R, V): the slot held the same vehicle one step before."""
    same = np.zeros(number.shape, bool)
    same[1:] = (number[1:] == number[:-1]) & (number[1:] >= 0)
    return same


def _speeds_mps(front_m: Floats, number: Numbers, insertion_mps: Floats, step_s: float) -> Floats:
    """SUMO's Euler update makes the displacement of a step exactly its speed times the step."""
    moved_m = np.zeros_like(front_m)
    moved_m[1:] = front_m[1:] - front_m[:-1]
    return np.where(_continues(number), moved_m / step_s, insertion_mps)


def _accelerations_mps2(speed_mps: Floats, number: Numbers, step_s: float) -> Floats:
    change = np.full_like(speed_mps, np.nan)
    change[1:] = (speed_mps[1:] - speed_mps[:-1]) / step_s
    return np.where(_continues(number), change, np.nan)
