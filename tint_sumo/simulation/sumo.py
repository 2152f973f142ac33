"""The SUMO simulation of a scene's replicas: vehicles by replica and slot, and the ids SUMO knows them by."""

import tempfile
from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np

from tint_sumo.config import Backend
from tint_sumo.scenes.build import DRIVERS_FILE, NET_FILE, ROUTES_FILE, scene_files
from tint_sumo.scenes.drivers import EGO_TYPE, DriverMember
from tint_sumo.scenes.geometry import Floats, Numbers
from tint_sumo.scenes.layout import EGO, Layout
from tint_sumo.scenes.network import name
from tint_sumo.simulation.connection import Connection, connect
from tint_sumo.simulation.timing import StepPart, does

SPEED_MODE_OBEY_SETSPEED = 32  # all of SUMO's own checks off: the ego drives exactly the speed it is given
_IGNORE_ON_JUNCTION = "junctionModel.ignoreTypes"
_IGNORE_AS_LEADER = "carFollowModel.ignoreTypes"

# SUMO need not look for collisions: the distances of the safety check show them, at the same step and with the same
# vehicle, and SUMO's check on junctions costs more than all the rest of its step once egos stand among the traffic.
NO_COLLISION_CHECK = ("--collision.action", "none")
SUMO_COLLISION_CHECK = (
    *("--collision.action", "warn"),
    *("--collision.check-junctions", "true"),
    *("--collision.mingap-factor", "0"),
)


class SumoLink:
    """A running simulation. No two episodes share ids of vehicles and egos."""

    def __init__(self, layout: Layout, replicas: int, backend: Backend, collision_options: Sequence[str]) -> None:
        self._layout = layout
        self._slots = layout.scene.max_vehicles
        self.connection = _start(layout, replicas, backend, collision_options)
        self._vehicle = self.connection.vehicle
        self.ids = [[""] * self._slots for _ in range(replicas)]
        self.ego_ids = [""] * replicas
        self.index: dict[str, int] = {}  # number of each vehicle's slot among all replicas' slots
        self._episodes = [0] * replicas

    def begin_episode(self, replica: int) -> None:
        self._episodes[replica] += 1

    def add(self, replica: int, slot: int, number: int, route: int, front_m: float, driver: DriverMember) -> None:
        """Insert a vehicle; it drives at its desired speed, and reacts to no ego until ``react``."""
        path = self._layout.routes[route]
        stage, lane_pos_m = path.lane_at(front_m)
        vehicle, vehicle_id = self._vehicle, f"{replica}.{self._episodes[replica]}.{number}"
        vehicle.add(
            vehicle_id,
            name(self._layout.scene.routes[route].name, replica),
            typeID=driver.type_id,
            departPos="base",
            departSpeed=str(driver.desired_speed_mps),
        )
        vehicle.moveTo(vehicle_id, path.lanes[stage].format(replica=replica), lane_pos_m)
        if not driver.profile.yields:
            vehicle.setParameter(vehicle_id, _IGNORE_AS_LEADER, EGO_TYPE)
        vehicle.setParameter(vehicle_id, _IGNORE_ON_JUNCTION, EGO_TYPE)
        self.ids[replica][slot] = vehicle_id
        self.index[vehicle_id] = replica * self._slots + slot

    def remove(self, replica: int, slot: int) -> None:
        self._vehicle.remove(self.ids[replica][slot])
        self._forget(replica, slot)

    def _forget(self, replica: int, slot: int) -> None:
        del self.index[self.ids[replica][slot]]
        self.ids[replica][slot] = ""

    def add_ego(self, replica: int) -> None:
        """Insert an ego that stands at its start."""
        vehicle, ego_id = self._vehicle, f"{EGO}.{replica}.{self._episodes[replica]}"
        path = self._layout.ego
        stage, lane_pos_m = path.lane_at(self._layout.scene.ego.start_m)
        vehicle.add(ego_id, name(EGO, replica), typeID=EGO_TYPE, departPos=str(lane_pos_m), departSpeed="0")
        vehicle.moveTo(ego_id, path.lanes[stage].format(replica=replica), lane_pos_m)
        vehicle.setSpeedMode(ego_id, SPEED_MODE_OBEY_SETSPEED)
        vehicle.setSpeed(ego_id, 0.0)
        self.ego_ids[replica] = ego_id

    def remove_ego(self, replica: int) -> None:
        if self.ego_ids[replica]:
            self._vehicle.remove(self.ego_ids[replica])
            self.ego_ids[replica] = ""

    def drive_egos(self, speed_mps: Floats) -> None:
        """Give the egos (R,) the speeds of the next step."""
        set_speed = self._vehicle.setSpeed
        for ego_id, one_mps in zip(self.ego_ids, speed_mps.tolist(), strict=True):
            if ego_id:
                set_speed(ego_id, one_mps)

    def step(self) -> Iterator[tuple[int, int]]:
        """Simulate a step; yield replica and slot of each vehicle that has left the network."""
        self._simulate()
        for vehicle_id in self.connection.simulation.getArrivedIDList():
            if vehicle_id in self.index:
                replica, slot = divmod(self.index[vehicle_id], self._slots)
                self._forget(replica, slot)
                yield replica, slot
            elif vehicle_id in self.ego_ids:
                self.ego_ids[self.ego_ids.index(vehicle_id)] = ""

    @does(StepPart.SUMO)
    def _simulate(self) -> None:
        self.connection.step()

    @does(StepPart.GETTERS)
    def lane_positions_m(self) -> tuple[Numbers, Floats]:
        """Return the numbers (N,) of the vehicles' slots, and the positions (N,) of their fronts on SUMO's lanes."""
        count = len(self.index)
        index = np.fromiter(self.index.values(), np.int64, count)
        return index, np.fromiter(map(self.connection.lane_position_m, self.index), float, count)

    def speed_mps(self, replica: int, slot: int) -> float:
        return float(self._vehicle.getSpeed(self.ids[replica][slot]))

    def react(self, replica: int, slot: int, reacts: bool, min_gap_m: float) -> None:
        """Let a driver see egos on junctions or not, and keep this gap."""
        vehicle_id = self.ids[replica][slot]
        self._vehicle.setParameter(vehicle_id, _IGNORE_ON_JUNCTION, "" if reacts else EGO_TYPE)
        self._vehicle.setMinGap(vehicle_id, min_gap_m)


def _start(layout: Layout, replicas: int, backend: Backend, collision_options: Sequence[str]) -> Connection:
    with tempfile.TemporaryDirectory(prefix="tint_sumo.") as folder:
        for file, text in scene_files(layout.scene, replicas, spacing_m=0.0).items():
            (Path(folder) / file).write_text(text, encoding="utf-8")
        return connect(_options(Path(folder), layout.scene.step_s, collision_options), backend)


def _options(folder: Path, step_s: float, collision_options: Sequence[str]) -> list[str]:
    return [
        *("--net-file", str(folder / NET_FILE)),
        *("--additional-files", f"{folder / DRIVERS_FILE},{folder / ROUTES_FILE}"),
        *("--step-length", str(step_s)),
        *collision_options,
        *("--time-to-teleport", "-1"),
        *("--no-step-log", "true"),
        *("--no-warnings", "true"),
        *("--seed", "0"),
    ]
