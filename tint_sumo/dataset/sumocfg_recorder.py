"""Record the traffic of a SUMO configuration, in the form of every other dataset.

An episode is a SUMO run of its own, from the configuration's begin, in steps of 0.1 s whatever its step length, because
windows consist of such steps. The labels are the vTypes. Positions are what the odometers show, gaps those to the
leaders that SUMO's drivers see; ``route`` is empty.
"""

from collections.abc import Mapping
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar, NamedTuple

import numpy as np
import pandas as pd

from tint_sumo.config import STEP_S
from tint_sumo.core.errors import InputError
from tint_sumo.dataset.schema import SCHEMA_VERSION, Manifest
from tint_sumo.dataset.shards import EPISODE_STEPS, record_dataset, require_sizes
from tint_sumo.dataset.windows import count_windows
from tint_sumo.scenes.geometry import NO_VEHICLE
from tint_sumo.scenes.sumo_config import SumoConfig, read_config, read_vtypes
from tint_sumo.scenes.sumo_run import SumocfgRun, require_loads
from tint_sumo.scenes.sumocfg import read_net
from tint_sumo.simulation.connection import Connection, connect
from tint_sumo.simulation.refusals import Refusals
from tint_sumo.simulation.sumocfg import Kinds, leader_of

EPISODES_PER_SHARD = 4


@dataclass(frozen=True)
class SumocfgRecording:
    """Settings of a recording: at least ``windows`` windows of a configuration's traffic."""

    config: SumoConfig
    vtypes: tuple[str, ...]
    windows: int
    seed: int = 0

    episodes_per_shard: ClassVar[int] = EPISODES_PER_SHARD
    episode_s: ClassVar[float] = EPISODE_STEPS * STEP_S

    def settings(self) -> dict[str, Any]:
        return {
            "kind": "dataset",
            "schema_version": SCHEMA_VERSION,
            "scene": self.config.name,
            "scene_digest": self.config.digest,
            "windows": self.windows,
            "p_conservative": None,
            "population": list(self.vtypes),
            "seed": self.seed,
        }

    def simulate(self, shard: int) -> tuple[pd.DataFrame, pd.DataFrame]:
        episodes = range(shard * EPISODES_PER_SHARD, (shard + 1) * EPISODES_PER_SHARD)
        tables = [_simulate_episode(self, episode) for episode in episodes]
        trajectories, drivers = (pd.concat(parts, ignore_index=True) for parts in zip(*tables, strict=True))
        if count_windows(trajectories) == 0:
            raise InputError(
                f"{self.config.file}: no vehicle drives in the first {self.episode_s:g} s; let it begin when there is "
                "traffic"
            )
        return trajectories, drivers.astype({"trait": "category"})


def record_sumocfg(
    sumocfg: Path, out: str | Path, windows: int, *, seed: int = 0, workers: int = 1, progress: bool = True
) -> Manifest:
    """Record at least ``windows`` windows of a configuration's traffic and return the manifest.

    They go into ``out``, a folder or a URL. The same call resumes an interrupted recording; a finished one is left as
    it is.

    Raises:
        InputError: bad values, a configuration that does not run or lets nobody drive, or ``out`` holds another run.
    """
    require_sizes(windows, seed)
    config = read_config(sumocfg)
    read_net(config.net_file, with_internal=False)
    require_loads(config)
    recording = SumocfgRecording(config, read_vtypes(config), windows, seed)
    return record_dataset(out, recording, workers=workers, progress=progress)


class _Row(NamedTuple):
    """A vehicle at one time."""

    vehicle: int
    time_s: float
    position_m: float
    speed_mps: float
    leader: int  # NO_VEHICLE without one
    gap_m: float


def _simulate_episode(recording: SumocfgRecording, episode: int) -> tuple[pd.DataFrame, pd.DataFrame]:
    """Return rows of trajectories, by vehicle and time, and of drivers."""
    config = recording.config
    with Refusals(config), closing(SumocfgRun(config)) as run:
        connection = connect(run.options([recording.seed, episode], STEP_S))
        try:
            watch = _Watch(config, recording.vtypes, connection)
            for step in range(EPISODE_STEPS + 1):
                if step > 0:
                    connection.step()
                watch.look(step * STEP_S)
        finally:
            connection.close()
    return watch.trajectories(episode), watch.drivers(episode)


class _Watch:
    """Rows and drivers of a running simulation; vehicles are numbered in order of appearance.

    One that SUMO takes off the road and puts back elsewhere appears anew, and so does one that has parked beside it.
    """

    def __init__(self, config: SumoConfig, vtypes: tuple[str, ...], connection: Connection) -> None:
        self._connection = connection
        self._vtypes = vtypes
        self._kinds = Kinds(config, vtypes, connection)
        self._rows: list[_Row] = []
        self._drivers: list[Mapping[str, Any]] = []
        self._numbers: dict[str, int] = {}  # numbers of the vehicles on the road

    def look(self, time_s: float) -> None:
        vehicle = self._connection.vehicle
        for vehicle_id in self._connection.simulation.getStartingTeleportIDList():
            self._numbers.pop(vehicle_id, None)
        numbers = {}
        for vehicle_id in vehicle.getIDList():
            if vehicle.isStoppedParking(vehicle_id):
                continue
            known = self._numbers.get(vehicle_id)
            numbers[vehicle_id] = self._meet(vehicle_id) if known is None else known
        self._numbers = numbers
        for vehicle_id, number in numbers.items():
            leader_id, gap_m = leader_of(self._connection, vehicle_id, self._kinds.of(vehicle_id))
            leader = numbers.get(leader_id, NO_VEHICLE)
            position_m, speed_mps = vehicle.getDistance(vehicle_id), vehicle.getSpeed(vehicle_id)
            self._rows.append(
                _Row(number, time_s, position_m, speed_mps, leader, gap_m if leader != NO_VEHICLE else np.nan)
            )

    def _meet(self, vehicle_id: str) -> int:
        vehicle, kind = self._connection.vehicle, self._kinds.of(vehicle_id)
        number = len(self._drivers)
        self._drivers.append(
            {
                "vehicle": number,
                "trait": self._vtypes[kind.member],
                "vtype": vehicle.getTypeID(vehicle_id),
                "desired_speed_mps": vehicle.getMaxSpeed(vehicle_id) * vehicle.getSpeedFactor(vehicle_id),
                "min_gap_m": kind.min_gap_m,
                "tau_s": kind.tau_s,
            }
        )
        return number

    def trajectories(self, episode: int) -> pd.DataFrame:
        rows = pd.DataFrame(self._rows, columns=list(_Row._fields))
        rows = rows.sort_values(["vehicle", "time_s"], ignore_index=True)
        leader = rows["leader"].to_numpy(np.int16)
        return rows.assign(
            episode=episode,
            route=pd.Categorical.from_codes(np.zeros(len(rows), np.int8), pd.Index([""])),
            acceleration_mps2=rows.groupby("vehicle")["speed_mps"].diff() / STEP_S,
            leader=pd.arrays.IntegerArray(leader, leader == NO_VEHICLE),
        )

    def drivers(self, episode: int) -> pd.DataFrame:
        columns = ["vehicle", "trait", "vtype", "desired_speed_mps", "min_gap_m", "tau_s"]
        return pd.DataFrame(self._drivers, columns=columns).assign(episode=episode)
