"""Many intersections in one SUMO simulation.

Each replica is an intersection of its own in the same network; its episode depends on its seed alone, not on the batch
it runs in. State is kept in arrays, (R,) for egos and (R, 12) for vehicle slots; the only
per-vehicle call into SUMO each step reads its lane position.
"""

import tempfile
import weakref
from bisect import bisect_right
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from tint_sumo.config import MAX_VEHICLES, Backend, Scenario
from tint_sumo.errors import InputError
from tint_sumo.scenario.build import DRIVERS_FILE, NET_FILE, ROUTES_FILE, scenario_files
from tint_sumo.scenario.drivers import EGO_TYPE, members
from tint_sumo.scenario.geometry import (
    LANE_NAMES,
    LOWER,
    POSE,
    UPPER,
    Bools,
    EgoPath,
    Floats,
    Poses,
    centre_x_m,
    lane_y_m,
    locate,
    measure_distances_m,
    place,
    stage_start_m,
    swept_area_start_m,
)
from tint_sumo.scenario.network import EGO_ROUTE, lane_id, name
from tint_sumo.simulation.connection import Connection, connect
from tint_sumo.simulation.ego import EgoRules, check_safety, drive, update_claims
from tint_sumo.simulation.traffic import DriverPool, DriverStream, admit

_EMPTY = -1
_STEP_MARGIN_M = 1.0  # more than a vehicle and the ego come closer in a step
_STOP_MARGIN_M = 0.05  # more than the ego's modelled path may differ from SUMO's
_EGO_PREFIX = "ego"
_SPEED_MODE_OBEY_SETSPEED = 32  # all of SUMO's own checks off: the ego drives exactly the speed it is given
_IGNORE_ON_JUNCTION = "junctionModel.ignoreTypes"
_IGNORE_AS_LEADER = "carFollowModel.ignoreTypes"


@dataclass(frozen=True)
class Collision:
    """The ego's first collision in an episode."""

    slot: int  # of the other vehicle
    profile: str  # its driver's trait
    lane: str  # its lane
    ego_x_m: float  # the ego's centre
    ego_y_m: float


@dataclass(frozen=True)
class PlacedVehicle:
    """A vehicle of a scene, driving at its driver's desired speed."""

    lane: int  # 0 lower, 1 upper
    front_m: float  # front bumper's distance along the lane, 5 at the entry and 45 at the exit
    member: int  # index into the population


# SUMO need not look for collisions: the distances of the safety check show them, at the same step and with the same
# vehicle, and SUMO's check on junctions costs more than all the rest of its step once egos stand among the traffic.
NO_COLLISION_CHECK = ("--collision.action", "none")
SUMO_COLLISION_CHECK = (
    *("--collision.action", "warn"),
    *("--collision.check-junctions", "true"),
    *("--collision.mingap-factor", "0"),
)


def _sumo_options(folder: Path, step_s: float, collision_options: Sequence[str]) -> list[str]:
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


def _start(replicas: int, scenario: Scenario, backend: Backend, collision_options: Sequence[str]) -> Connection:
    with tempfile.TemporaryDirectory(prefix="tint_sumo.") as folder:
        for file, text in scenario_files(replicas, scenario, spacing_m=0.0).items():
            (Path(folder) / file).write_text(text, encoding="utf-8")
        return connect(_sumo_options(Path(folder), scenario.episode.step_s, collision_options), backend)


def _where(mask: Bools) -> Iterator[tuple[int, int]]:
    """Rows and columns where a matrix is true; faster than np.argwhere where there are few."""
    rows, columns = np.nonzero(mask)
    return zip(rows.tolist(), columns.tolist(), strict=True)


class Intersections:
    """A batch of ``replicas`` intersections, each empty until its first :meth:`reset`.

    Read-only state, all arrays of this batch (do not write to them):

    ================== ======== ==================================================================
    ``present``        (R, 12)  which slots hold a vehicle
    ``lane``           (R, 12)  0 lower (west), 1 upper (east)
    ``front_m``        (R, 12)  front bumper's distance along the lane
    ``member``         (R, 12)  index into :attr:`population`, -1 in empty slots
    ``vehicle_number`` (R, 12)  running number of the vehicle in its replica's episode, -1 in empty slots
    ``x_m``, ``y_m``   (R, 12)  vehicle centres
    ``ego_front_m``    (R,)     front bumper's distance along the ego's path
    ``ego_speed_mps``  (R,)
    ``ego_pose``       (R,)     records of :data:`~tint_sumo.scenario.geometry.POSE`
    ``time_s``         (R,)     since the episode's start
    ``has_claimed``    (R, 2)   which lanes (lower, upper) the ego claims
    ``yielding``       (R, 12)  which drivers react to the ego's claim on their lane
    ``collision``      R items  the ego's first collision in the episode, or None
    ================== ======== ==================================================================

    A vehicle keeps its slot while it is on the street, and a slot stays empty for at least one step between two
    vehicles. At most 12 vehicles are on a street; further ones wait outside.
    """

    def __init__(
        self,
        replicas: int,
        scenario: Scenario | None = None,
        *,
        with_ego: bool = True,
        backend: Backend = "auto",
        collision_options: Sequence[str] = NO_COLLISION_CHECK,
    ) -> None:
        self.scenario = scenario = scenario or Scenario()
        self.replicas = replicas
        self.population = members(scenario.population)
        self.path = EgoPath.of(scenario.street, scenario.vehicle)
        self._ego_rules = EgoRules.of(scenario)
        self._with_ego = with_ego
        self._pool = DriverPool(self.population, scenario)
        self._yields = np.array([*(member.profile.yields for member in self.population), False])  # the last: empty
        self._lane_y_m = lane_y_m(scenario.street)
        self._stage_start_m = stage_start_m(scenario.street, scenario.vehicle)
        self._stop_line_m = swept_area_start_m(
            scenario.street, scenario.vehicle, scenario.ego.unsafe_distance_m + _STOP_MARGIN_M
        )
        self._lengths_m = (scenario.street.half_length_m, scenario.vehicle.length_m)

        # Of the safety check, which needs to know how far away a vehicle was a step before.
        self._reach_m = max(scenario.ego.closing_distance_m, scenario.ego.unsafe_distance_m) + _STEP_MARGIN_M

        slots = (replicas, MAX_VEHICLES)
        self.present: Bools = np.zeros(slots, bool)
        self.lane = np.zeros(slots, np.int64)
        self.front_m: Floats = np.zeros(slots)
        self.member = np.full(slots, _EMPTY)
        self.vehicle_number = np.full(slots, _EMPTY)
        self.x_m: Floats = np.zeros(slots)
        self.y_m: Floats = np.zeros(slots)
        self.ego_front_m: Floats = np.zeros(replicas)
        self.ego_speed_mps: Floats = np.zeros(replicas)
        self.ego_pose: Poses = np.zeros(replicas, POSE)
        self.time_s: Floats = np.zeros(replicas)
        self.has_claimed: Bools = np.zeros((replicas, 2), bool)
        self.yielding: Bools = np.zeros(slots, bool)
        self.collision: list[Collision | None] = [None] * replicas
        self._index: dict[str, int] = {}  # of each vehicle's slot: replica * 12 + slot; so numbered are also these:
        self._stage = np.zeros(replicas * MAX_VEHICLES, np.int64)  # which of its lane's three SUMO lanes it is on
        self._lane_pos_m: Floats = np.zeros(replicas * MAX_VEHICLES)
        self._last_slot = np.full((replicas, 2), _EMPTY)  # of the vehicle that entered each lane last
        self._was_present: Bools = np.zeros(slots, bool)  # at the previous step; such a slot takes no new vehicle yet
        self._distance_m: Floats = np.full(slots, np.inf)  # from the ego; infinite if far
        self._was_distance_m: Floats = np.full(slots, np.inf)  # a step ago
        self._unsafe: Bools = np.zeros(replicas, bool)  # what the safety check says for the next step
        self._hit_slot = np.full(replicas, _EMPTY)  # of the vehicle the ego collided with
        self._claim_changed: Bools = np.zeros((replicas, 2), bool)
        self._ids: list[list[str]] = [[""] * MAX_VEHICLES for _ in range(replicas)]
        self._ego_ids = [""] * replicas
        self._episodes = [0] * replicas
        self._vehicle_count = [0] * replicas
        self._streams: list[tuple[DriverStream, ...]] = [() for _ in range(replicas)]
        self._wanted_gap_m: Floats = np.full((replicas, 2), np.inf)
        self._wanted_time_s: Floats = np.zeros((replicas, 2))
        self._admitted: Bools = np.zeros((replicas, 2), bool)

        self._connection = _start(replicas, scenario, backend, collision_options)
        self._finalizer = weakref.finalize(self, self._connection.close)

    @property
    def backend(self) -> str:
        return self._connection.backend

    @property
    def yields(self) -> Bools:
        """Which slots hold a yielding (conservative) driver; (R, 12)."""
        return np.asarray(self._yields[self.member])

    @property
    def collided(self) -> Bools:
        """Whether the ego has had a collision in the episode; (R,)."""
        return np.asarray(self._hit_slot != _EMPTY)

    def close(self) -> None:
        """End the simulation; safe to call twice."""
        self._finalizer()

    # Episodes

    def reset(self, replica: int, seed: int | Sequence[int] | np.random.SeedSequence) -> None:
        """Empty a replica and start a new random episode in it."""
        sequence = seed if isinstance(seed, np.random.SeedSequence) else np.random.SeedSequence(seed)
        p_conservative = np.random.default_rng(sequence).uniform(*self.scenario.traffic.p_conservative_range)
        streams = tuple(
            DriverStream(np.random.default_rng(child), self._pool, p_conservative) for child in sequence.spawn(2)
        )
        placed = [
            PlacedVehicle(lane, front_m, driver.member)
            for lane, stream in enumerate(streams)
            for driver, front_m in stream.placement()
        ]
        self.reset_to(replica, placed)
        self._streams[replica] = streams
        for lane in (LOWER, UPPER):
            self._expect(replica, lane)

    def reset_to(self, replica: int, vehicles: Sequence[PlacedVehicle]) -> None:
        """Empty a replica and start an episode with exactly these vehicles; nobody else enters.

        Raises:
            InputError: more than 12 vehicles.
        """
        if len(vehicles) > MAX_VEHICLES:
            raise InputError(f"at most {MAX_VEHICLES} vehicles fit a scene, not {len(vehicles)}")
        self.clear(replica)
        self._episodes[replica] += 1
        self._vehicle_count[replica] = 0
        self.time_s[replica] = 0.0
        self.collision[replica] = None
        self._hit_slot[replica] = _EMPTY
        self.has_claimed[replica] = False
        for slot, vehicle in enumerate(vehicles):
            self._add(replica, slot, vehicle)
        if self._with_ego:
            self._add_ego(replica)

    def clear(self, replica: int) -> None:
        """Empty a replica and leave it so, at next to no cost, until its next reset."""
        vehicle = self._connection.vehicle
        for slot in np.flatnonzero(self.present[replica]):
            vehicle.remove(self._ids[replica][slot])
            self._forget(self._ids[replica][slot])
        if self._ego_ids[replica]:
            vehicle.remove(self._ego_ids[replica])
            self._ego_ids[replica] = ""
        self._was_present[replica] = False
        self._wanted_gap_m[replica] = np.inf
        self._distance_m[replica] = np.inf
        self._unsafe[replica] = False

    def _add_ego(self, replica: int) -> None:
        ego_id = f"{_EGO_PREFIX}.{replica}.{self._episodes[replica]}"
        front_m = self.path.start_m(self.scenario.episode.ego_start_y_m)
        vehicle = self._connection.vehicle
        vehicle.add(ego_id, name("ego", replica), typeID=EGO_TYPE, departPos=str(front_m), departSpeed="0")
        vehicle.moveTo(ego_id, f"{name(EGO_ROUTE[0], replica)}_0", front_m)
        vehicle.setSpeedMode(ego_id, _SPEED_MODE_OBEY_SETSPEED)
        vehicle.setSpeed(ego_id, 0.0)
        self._ego_ids[replica] = ego_id
        self.ego_front_m[replica] = front_m
        self.ego_speed_mps[replica] = 0.0
        this = slice(replica, replica + 1)
        place(self.ego_front_m[this], self.path, self.ego_pose[this])

    def _add(self, replica: int, slot: int, placed: PlacedVehicle) -> None:
        lane, member = placed.lane, self.population[placed.member]
        number = self._vehicle_count[replica]
        self._vehicle_count[replica] += 1
        vehicle_id = f"{replica}.{self._episodes[replica]}.{number}"
        starts_m = self._stage_start_m[lane].tolist()
        stage = bisect_right(starts_m, placed.front_m) - 1
        position_m = placed.front_m - starts_m[stage]
        vehicle = self._connection.vehicle
        vehicle.add(
            vehicle_id,
            name(LANE_NAMES[lane], replica),
            typeID=member.type_id,
            departPos="base",
            departSpeed=str(member.desired_speed_mps),
        )
        vehicle.moveTo(vehicle_id, lane_id(lane, stage, replica), position_m)
        if not member.profile.yields:
            vehicle.setParameter(vehicle_id, _IGNORE_AS_LEADER, EGO_TYPE)
        vehicle.setParameter(vehicle_id, _IGNORE_ON_JUNCTION, EGO_TYPE)
        self._ids[replica][slot] = vehicle_id
        index = replica * MAX_VEHICLES + slot
        self._index[vehicle_id] = index
        self.present[replica, slot] = True
        self.lane[replica, slot] = lane
        self.member[replica, slot] = placed.member
        self.vehicle_number[replica, slot] = number
        self._stage[index] = stage
        self._lane_pos_m[index] = position_m
        self.front_m[replica, slot] = placed.front_m
        self.x_m[replica, slot] = centre_x_m(placed.front_m, lane, *self._lengths_m)
        self.y_m[replica, slot] = self._lane_y_m[lane]
        self._last_slot[replica, lane] = index
        if self.has_claimed[replica, lane]:
            self._answer_claim(replica, slot, member.desired_speed_mps)

    def _forget(self, vehicle_id: str) -> None:
        index = self._index.pop(vehicle_id)
        replica, slot = divmod(index, MAX_VEHICLES)
        self._ids[replica][slot] = ""
        self.present[replica, slot] = False
        self.yielding[replica, slot] = False
        self.member[replica, slot] = _EMPTY
        self.vehicle_number[replica, slot] = _EMPTY
        lane = self.lane[replica, slot]
        if self._last_slot[replica, lane] == index:
            self._last_slot[replica, lane] = _EMPTY

    # Steps

    def step(self, desired_speed_mps: Floats | None = None) -> None:
        """Advance all replicas by one step; (R,) desired speeds of the egos, none without egos."""
        if desired_speed_mps is not None:
            self._drive_egos(desired_speed_mps)
        np.copyto(self._was_present, self.present)
        self._connection.step()
        self.time_s += self.scenario.episode.step_s
        for vehicle_id in self._connection.simulation.getArrivedIDList():
            if vehicle_id in self._index:
                self._forget(vehicle_id)
            elif vehicle_id in self._ego_ids:
                self._ego_ids[self._ego_ids.index(vehicle_id)] = ""
        self._read_positions()
        if self._with_ego:
            self._check_safety()
        self._admit()

    def _drive_egos(self, desired_speed_mps: Floats) -> None:
        self._update_claims()
        drive(desired_speed_mps, self._unsafe, self._ego_rules, self.ego_speed_mps, self.ego_front_m)
        place(self.ego_front_m, self.path, self.ego_pose)
        set_speed = self._connection.vehicle.setSpeed
        for ego_id, speed_mps in zip(self._ego_ids, self.ego_speed_mps.tolist(), strict=True):
            if ego_id:
                set_speed(ego_id, speed_mps)

    def _check_safety(self) -> None:
        """Run the safety check for the next step, and latch collisions."""
        shape = self.scenario.vehicle
        self._distance_m, self._was_distance_m = self._was_distance_m, self._distance_m
        measure_distances_m(
            self.ego_pose,
            self.present,
            self.x_m,
            self.y_m,
            self._reach_m,
            shape.length_m,
            shape.width_m,
            self._distance_m,
        )
        if check_safety(self._distance_m, self._was_distance_m, self._ego_rules, self._unsafe, self._hit_slot):
            for replica in np.flatnonzero(self.collided).tolist():
                self._latch_collision(replica, int(self._hit_slot[replica]))

    def _latch_collision(self, replica: int, slot: int) -> None:
        if self.collision[replica] is None:
            self.collision[replica] = Collision(
                slot,
                self.population[self.member[replica, slot]].profile.name,
                LANE_NAMES[self.lane[replica, slot]],
                float(self.ego_pose["x_m"][replica]),
                float(self.ego_pose["y_m"][replica]),
            )

    def _update_claims(self) -> None:
        changed = self._claim_changed
        if not update_claims(self.ego_pose, self.ego_speed_mps, self._ego_rules, self.has_claimed, changed):
            return
        get_speed = self._connection.vehicle.getSpeed
        for replica, lane in _where(changed):
            on_lane = self.yields[replica] & (self.lane[replica] == lane)
            if self.has_claimed[replica, lane]:
                for slot in np.flatnonzero(on_lane).tolist():
                    self._answer_claim(replica, slot, get_speed(self._ids[replica][slot]))
            else:
                for slot in np.flatnonzero(on_lane & self.yielding[replica]).tolist():
                    self._set_yielding(replica, slot, False)

    def _answer_claim(self, replica: int, slot: int, speed_mps: float) -> None:
        """Let a driver on a claimed lane yield, if that is its trait and it can still stop clear of the ego's way."""
        room_m = self._stop_line_m[self.lane[replica, slot]] - self.front_m[replica, slot]
        can_stop = room_m >= self.scenario.claim.stopping_distance_m(speed_mps)
        if self._yields[self.member[replica, slot]] and can_stop:
            self._set_yielding(replica, slot, True)

    def _set_yielding(self, replica: int, slot: int, yielding: bool) -> None:
        self.yielding[replica, slot] = yielding
        vehicle, vehicle_id = self._connection.vehicle, self._ids[replica][slot]
        vehicle.setParameter(vehicle_id, _IGNORE_ON_JUNCTION, "" if yielding else EGO_TYPE)
        courtesy_m = self.scenario.claim.courtesy_gap_m if yielding else 0.0
        vehicle.setMinGap(vehicle_id, self.population[self.member[replica, slot]].min_gap_m + courtesy_m)

    def _read_positions(self) -> None:
        count = len(self._index)
        slots = np.fromiter(self._index.values(), np.int64, count)
        position_m = np.fromiter(map(self._connection.vehicle.getLanePosition, self._index), float, count)
        locate(
            slots,
            position_m,
            self.lane.reshape(-1),
            self._stage_start_m,
            *self._lengths_m,
            self._stage,
            self._lane_pos_m,
            self.front_m.reshape(-1),
            self.x_m.reshape(-1),
        )

    def _admit(self) -> None:
        """Let the upcoming drivers in where there is room, a free slot, and their time has come."""
        entry_m = self.scenario.vehicle.length_m
        if not admit(
            self.front_m.reshape(-1),
            self._last_slot,
            2 * entry_m,
            self._wanted_gap_m,
            self.time_s,
            self._wanted_time_s,
            self._admitted,
        ):
            return
        for replica, lane in _where(self._admitted):
            free = np.flatnonzero(~(self.present[replica] | self._was_present[replica]))
            if len(free):
                driver = self._streams[replica][lane].take()
                self._add(replica, int(free[0]), PlacedVehicle(lane, entry_m, driver.member))
                self._expect(replica, lane)

    def _expect(self, replica: int, lane: int) -> None:
        upcoming = self._streams[replica][lane].upcoming
        self._wanted_gap_m[replica, lane] = upcoming.gap_m
        self._wanted_time_s[replica, lane] = self.time_s[replica] + upcoming.wait_s
