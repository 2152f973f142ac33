"""The simulation of a SUMO configuration: one episode at a time, with the traffic that the configuration makes.

Each episode loads the configuration anew with a seed of its own, so that it depends on that seed alone. The vehicles
around the ego are asked for with a context subscription, at the same cost however large the network is.
"""

import math
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any

import libsumo
import numpy as np
from libsumo import constants
from traci.exceptions import FatalTraCIError, TraCIException

from tint_sumo.config import NO_LEADER_GAP_M, Backend
from tint_sumo.core.errors import InputError
from tint_sumo.scenes.geometry import POSE, Bools, Floats, Numbers, Poses, measure_unlike_distances_m
from tint_sumo.scenes.scene import Scene
from tint_sumo.scenes.sumocfg import DEFAULT_VTYPE, SumocfgScene, SumoConfig
from tint_sumo.simulation.connection import Connection, connect
from tint_sumo.simulation.ego import Collision, EgoRules, check_safety, drive
from tint_sumo.simulation.simulation import Simulation
from tint_sumo.simulation.slots import EMPTY
from tint_sumo.simulation.sumo import NO_COLLISION_CHECK, SPEED_MODE_OBEY_SETSPEED

EGO = "tint_sumo.ego"  # vehicle, vType and route; no user's id
_ONLY_STRATEGIC_CHANGES = 513  # lane changes: those that the route asks for, where there is room
_ENTRY_PATIENCE_S = 60.0  # the ego waits for room at its start for so long
_SEEN = (constants.VAR_POSITION, constants.VAR_ANGLE, constants.VAR_DISTANCE, constants.VAR_SPEED)
_SEED_BITS = 31

Sight = Mapping[int, Any]  # what SUMO tells of a vehicle, by _SEEN


@dataclass(frozen=True)
class VehicleKind:
    """What the vehicles of a vType have in common."""

    member: int  # number of the vType
    length_m: float
    width_m: float
    min_gap_m: float
    tau_s: float


class Kinds:
    """The kinds of vehicles in a running simulation, looked up once each."""

    def __init__(self, config: SumoConfig, vtypes: tuple[str, ...], connection: Connection) -> None:
        self._config = config
        self._vtypes = vtypes
        self._connection = connection
        self._known: dict[str, VehicleKind] = {}

    def of(self, vehicle_id: str) -> VehicleKind:
        """Raises InputError if the vehicle's vType is in none of the configuration's files."""
        vtype = self._connection.vehicle.getTypeID(vehicle_id)
        if vtype not in self._known:
            self._known[vtype] = self._look_up(vehicle_id, vtype)
        return self._known[vtype]

    def _look_up(self, vehicle_id: str, vtype: str) -> VehicleKind:
        if vtype not in self._vtypes:
            raise InputError(
                f"vehicle {vehicle_id!r} has vType {vtype!r}, which no vehicle or vType of {self._config.file} names; "
                "define it in a route or additional file"
            )
        types = self._connection.vehicletype
        return VehicleKind(
            self._vtypes.index(vtype),
            types.getLength(vtype),
            types.getWidth(vtype),
            types.getMinGap(vtype),
            types.getTau(vtype),
        )


def sumo_options(config: SumoConfig, seed: int | Sequence[int], step_s: float | None = None) -> list[str]:
    """Command-line options that run a configuration with this seed, and let it write none of the files it asks for."""
    draws = np.random.SeedSequence(seed).generate_state(1)
    return [
        *("--configuration-file", str(config.file)),
        *("--seed", str(int(draws[0]) % 2**_SEED_BITS)),
        *("--random", "false"),
        *(() if step_s is None else ("--step-length", str(step_s))),
        *NO_COLLISION_CHECK,
        *("--no-step-log", "true"),
        *("--no-warnings", "true"),
        *("--verbose", "false"),
        *("--duration-log.disable", "true"),
        *(part for option in config.outputs for part in (f"--{option}", "/dev/null")),
    ]


@contextmanager
def refusals(config: SumoConfig) -> Iterator[None]:
    """Tell in one line what SUMO finds fault with."""
    try:
        yield
    except (libsumo.TraCIException, TraCIException, FatalTraCIError) as error:
        reason = " ".join(str(error).split())
        raise InputError(f"SUMO does not run {config.file} ({reason}); try it with: sumo -c {config.file}") from None


class SumocfgSlots:
    """The vehicles around the ego in V slots; arrays are (1, V), as in ``tint_sumo.simulation.slots.Slots``.

    ``member`` is the number of a vehicle's vType, ``front_m`` what its odometer shows, and ``length_m`` and ``width_m``
    are its size. The nearest vehicles in sight have slots. A vehicle keeps its slot while it is one of them, and a slot
    stays empty for at least a step between two.
    """

    def __init__(self, max_vehicles: int) -> None:
        shape = (1, max_vehicles)
        self.present: Bools = np.zeros(shape, bool)
        self.route: Numbers = np.zeros(shape, np.int64)
        self.front_m: Floats = np.zeros(shape)
        self.pose: Poses = np.zeros(shape, POSE)
        self.length_m: Floats = np.zeros(shape)
        self.width_m: Floats = np.zeros(shape)
        self.member: Numbers = np.full(shape, EMPTY)
        self.vehicle_number: Numbers = np.full(shape, EMPTY)
        self.slot: dict[str, int] = {}  # slot of each vehicle, by id
        self._number: dict[str, int] = {}  # number of each vehicle that has been seen

    def clear(self) -> None:
        """Empty all slots as if they had never held a vehicle."""
        for array in (self.present, self.front_m, self.length_m, self.width_m):
            array[:] = 0
        self.pose[:] = np.zeros((), POSE)
        self.member[:] = self.vehicle_number[:] = EMPTY
        self.slot.clear()
        self._number.clear()

    def follow(self, near: Mapping[str, Sight], kinds: Kinds, origin_m: tuple[float, float]) -> None:
        """Take over where the nearest vehicles are, nearest first and no more than there are slots."""
        free = np.flatnonzero(~self.present[0]).tolist()
        for vehicle_id in self.slot.keys() - near.keys():
            self._leave(vehicle_id)
        for vehicle_id, sight in near.items():
            if vehicle_id not in self.slot and free:
                self._take(free.pop(0), vehicle_id, kinds.of(vehicle_id))
            slot = self.slot.get(vehicle_id)
            if slot is not None:
                self.front_m[0, slot] = sight[constants.VAR_DISTANCE]
                self.pose[0, slot] = pose_of(sight, self.length_m[0, slot], origin_m)

    def _take(self, slot: int, vehicle_id: str, kind: VehicleKind) -> None:
        self.slot[vehicle_id] = slot
        self.present[0, slot] = True
        self.member[0, slot] = kind.member
        self.length_m[0, slot], self.width_m[0, slot] = kind.length_m, kind.width_m
        self.vehicle_number[0, slot] = self._number.setdefault(vehicle_id, len(self._number))

    def _leave(self, vehicle_id: str) -> None:
        slot = self.slot.pop(vehicle_id)
        self.present[0, slot] = False
        self.member[0, slot] = self.vehicle_number[0, slot] = EMPTY


def pose_of(sight: Sight, length_m: float, origin_m: tuple[float, float]) -> tuple[float, float, float, float]:
    """The pose of a vehicle's box; SUMO tells its front's position and its angle, clockwise from north."""
    x_m, y_m = sight[constants.VAR_POSITION]
    angle_rad = math.radians(sight[constants.VAR_ANGLE])
    heading_x, heading_y = math.sin(angle_rad), math.cos(angle_rad)
    half_m = length_m / 2
    return x_m - half_m * heading_x - origin_m[0], y_m - half_m * heading_y - origin_m[1], heading_x, heading_y


class SumocfgEgos:
    """The one ego; arrays are (1,), as in ``tint_sumo.simulation.ego.Egos``."""

    def __init__(self, scene: SumocfgScene) -> None:
        self._scene = scene
        self._rules = EgoRules.of(scene)
        self.front_m: Floats = np.zeros(1)
        self.speed_mps: Floats = np.zeros(1)
        self.pose: Poses = np.zeros(1, POSE)
        self.distance_m: Floats = np.full((1, scene.max_vehicles), np.inf)
        self._was_distance_m: Floats = np.full((1, scene.max_vehicles), np.inf)  # distances one step ago
        self.unsafe: Bools = np.zeros(1, bool)
        self._hit_slot: Numbers = np.full(1, EMPTY)
        self.collision: list[Collision | None] = [None]

    @property
    def collided(self) -> Bools:
        """Whether the ego has had a collision in the episode; (1,)."""
        return np.asarray(self._hit_slot != EMPTY)

    def forget(self) -> None:
        """Forget what happened in the episode."""
        self.front_m[:] = self.speed_mps[:] = 0.0
        self.pose[:] = np.zeros((), POSE)
        self.distance_m[:] = np.inf
        self._was_distance_m[:] = np.inf
        self.unsafe[:] = False
        self._hit_slot[:] = EMPTY
        self.collision[0] = None

    def wish(self, desired_mps: Floats) -> float:
        """The speed of the next step."""
        drive(desired_mps, self.unsafe, self._rules, self.speed_mps, self.front_m)
        return float(self.speed_mps[0])

    def follow(self, sight: Sight, origin_m: tuple[float, float]) -> None:
        """Take over where SUMO has it."""
        self.front_m[0] = self._scene.start_m + sight[constants.VAR_DISTANCE]
        self.speed_mps[0] = sight[constants.VAR_SPEED]
        self.pose[0] = pose_of(sight, self._scene.vehicle.length_m, origin_m)

    def arrive(self) -> None:
        """It has come to its route's end, past any goal."""
        self.front_m[0] = np.inf

    def look_around(self, slots: SumocfgSlots) -> int:
        """Run the safety check for the next step; the slot of a vehicle that it has newly touched, else -1."""
        shape = self._scene.vehicle
        self.distance_m, self._was_distance_m = self._was_distance_m, self.distance_m
        measure_unlike_distances_m(
            self.pose[0],
            slots.present[0],
            slots.pose[0],
            shape.length_m,
            shape.width_m,
            slots.length_m[0],
            slots.width_m[0],
            self.distance_m[0],
        )
        touched = check_safety(
            self.distance_m, self._was_distance_m, self.pose, slots.pose, self._rules, self.unsafe, self._hit_slot
        )
        return int(self._hit_slot[0]) if touched else EMPTY


class SumocfgSimulation:
    """One replica of a scene from a SUMO configuration; empty until its first ``reset``.

    Read-only state: the vehicles in ``slots`` (``SumocfgSlots``) and the ego in ``egos`` (``SumocfgEgos``), both in a
    frame with the network's axes, whose origin is where the ego's centre is at the episode's start.
    """

    replicas = 1
    passed_m: Floats = np.array([np.inf])  # no vehicle's way is ever left behind

    def __init__(self, scene: SumocfgScene, backend: Backend = "auto") -> None:
        self.scene = scene
        self.traits = scene.vtypes
        self.trait_of_member: Numbers = np.arange(len(scene.vtypes))
        with refusals(scene.config):
            self.connection = connect(sumo_options(scene.config, seed=0), backend)
        self._kinds = Kinds(scene.config, scene.vtypes, self.connection)
        self._drives = False
        self.slots = SumocfgSlots(scene.max_vehicles)
        self.egos = SumocfgEgos(scene)
        self.origin_m = (0.0, 0.0)  # position of the scene's origin in the network

    @property
    def backend(self) -> str:
        return self.connection.backend

    def close(self) -> None:
        """End the simulation; safe to call twice."""
        self.connection.close()

    def reset(self, replica: int, seed: int) -> None:
        """Start a new random episode.

        Raises:
            InputError: SUMO refuses the configuration, or other vehicles leave the ego no room at its start.
        """
        self.clear(replica)
        with refusals(self.scene.config):
            self.connection.load(sumo_options(self.scene.config, seed))
            self._define_ego()
            self.connection.step(self.connection.simulation.getTime() + self.scene.warm_up_s)
            self._let_ego_enter()
            self.connection.vehicle.subscribeContext(EGO, constants.CMD_GET_VEHICLE_VARIABLE, self.scene.sight_m, _SEEN)
            sight = self.connection.vehicle.getContextSubscriptionResults(EGO)[EGO]
        self._drives = True
        self.origin_m = pose_of(sight, self.scene.vehicle.length_m, (0.0, 0.0))[:2]
        self._look()

    def clear(self, replica: int) -> None:  # noqa: ARG002 - there is but one
        """Let time stand still until the next reset."""
        self._drives = False
        self.slots.clear()
        self.egos.forget()
        self.origin_m = (0.0, 0.0)

    def _define_ego(self) -> None:
        types, scene = self.connection.vehicletype, self.scene
        types.copy(DEFAULT_VTYPE, EGO)
        types.setVehicleClass(EGO, "passenger")
        types.setLength(EGO, scene.vehicle.length_m)
        types.setWidth(EGO, scene.vehicle.width_m)
        types.setMinGap(EGO, 0.0)
        types.setMaxSpeed(EGO, max(scene.controller.desired_speeds_mps) + 1.0)
        types.setSpeedDeviation(EGO, 0.0)
        self.connection.route.add(EGO, list(scene.departure[0]))

    def _let_ego_enter(self) -> None:
        """The ego enters where it would hinder nobody who could not brake in time; before, it waits."""
        vehicle, scene = self.connection.vehicle, self.scene
        _, lane_pos_m = scene.departure
        vehicle.add(EGO, EGO, typeID=EGO, departLane="best", departPos=str(lane_pos_m), departSpeed="0")
        for _ in range(math.ceil(_ENTRY_PATIENCE_S / scene.step_s)):
            self.connection.step()
            if EGO in self.connection.simulation.getDepartedIDList():
                vehicle.setSpeedMode(EGO, SPEED_MODE_OBEY_SETSPEED)
                vehicle.setLaneChangeMode(EGO, _ONLY_STRATEGIC_CHANGES)
                vehicle.setSpeed(EGO, 0.0)
                return
        raise InputError(
            f"the ego found no room at its start ({scene.start_m:g} m) for {_ENTRY_PATIENCE_S:g} s: vehicles stand or "
            "enter there; choose another start_m or warm_up_s"
        )

    def step(self, desired_speed_mps: Floats) -> None:
        """Advance by one step; (1,) desired speed of the ego.

        Raises:
            InputError: SUMO finds fault with the demand, or teleports the ego.
        """
        if not self._drives:
            return
        with refusals(self.scene.config):
            self.connection.vehicle.setSpeed(EGO, self.egos.wish(desired_speed_mps))
            self.connection.step()
        self._look()

    def _look(self) -> None:
        """See where everybody is."""
        self._require_ego_on_road()
        seen = dict(self.connection.vehicle.getContextSubscriptionResults(EGO))
        own = seen.pop(EGO, None)
        if own is None:
            self._drives = False
            self.egos.arrive()
            return
        self.egos.follow(own, self.origin_m)
        front_m = own[constants.VAR_POSITION]
        nearest = sorted(seen, key=lambda vehicle_id: math.dist(seen[vehicle_id][constants.VAR_POSITION], front_m))
        near = {vehicle_id: seen[vehicle_id] for vehicle_id in nearest[: self.scene.max_vehicles]}
        self.slots.follow(near, self._kinds, self.origin_m)
        hit_slot = self.egos.look_around(self.slots)
        if hit_slot != EMPTY:
            self.egos.collision[0] = self._collision(hit_slot)

    def _require_ego_on_road(self) -> None:
        """SUMO puts vehicles that have waited for long elsewhere: whoever stands still would get ahead."""
        simulation = self.connection.simulation
        if EGO in simulation.getStartingTeleportIDList():
            raise InputError(
                f"SUMO teleports the ego at {simulation.getTime():g} s, because it has waited for long; set "
                f'time-to-teleport to "-1" in {self.scene.config.file}, or to more than the episodes take'
            )

    def _collision(self, slot: int) -> Collision:
        vehicle_id = next(one for one, its in self.slots.slot.items() if its == slot)
        edge, pose = self.connection.vehicle.getRoadID(vehicle_id), self.egos.pose[0]
        return Collision(slot, int(self.slots.member[0, slot]), edge, float(pose["x_m"]), float(pose["y_m"]))

    def leaders(self, replicas: slice = slice(None)) -> tuple[Numbers, Floats]:  # noqa: ARG002 - there is but one
        """Slot of the next vehicle ahead of each vehicle, -1 if it is not in one, and the gap to it, NaN without."""
        slots = self.slots
        leader, gap_m = np.full(slots.present.shape, EMPTY), np.full(slots.present.shape, np.nan)
        for vehicle_id, slot in slots.slot.items():
            ahead_id, ahead_m = leader_of(self.connection, vehicle_id, self._kinds.of(vehicle_id))
            if ahead_id in slots.slot:
                leader[0, slot], gap_m[0, slot] = slots.slot[ahead_id], ahead_m
        return leader, gap_m


def leader_of(connection: Connection, vehicle_id: str, kind: VehicleKind) -> tuple[str, float]:
    """The vehicle ahead as SUMO sees it, "" if none, and the gap from bumper to bumper; SUMO leaves minGap out."""
    found = connection.vehicle.getLeader(vehicle_id, NO_LEADER_GAP_M)
    return (found[0], found[1] + kind.min_gap_m) if found else ("", math.nan)


def make_simulation(
    replicas: int, scene: Scene | SumocfgScene, backend: Backend = "auto"
) -> Simulation | SumocfgSimulation:
    """The simulation that plays a scene.

    Raises:
        InputError: more than one replica of a SUMO configuration.
    """
    if isinstance(scene, Scene):
        return Simulation(replicas, scene, backend=backend)
    if replicas != 1:
        raise InputError(
            f"a scene from a .sumocfg is one simulation per process, not {replicas}; set workers to num_envs"
        )
    return SumocfgSimulation(scene, backend)
