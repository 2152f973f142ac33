"""The simulation of a SUMO configuration: one episode at a time, with the traffic that the configuration makes.

Each episode loads the network anew with a seed of its own, so that it depends on that seed alone. The vehicles
around the ego are asked for with a context subscription, at the same cost however large the network is.
"""

import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from libsumo import constants

from tint_sumo.config import NO_LEADER_GAP_M, Backend
from tint_sumo.core.errors import InputError
from tint_sumo.scenes.geometry import NO_VEHICLE, Bools, Boxes, Floats, Numbers, place_seen
from tint_sumo.scenes.roads import Roads
from tint_sumo.scenes.scene import BUILDING, Building, View
from tint_sumo.scenes.sumo_config import DEFAULT_VTYPE, SumoConfig, base_vtype
from tint_sumo.scenes.sumocfg import SumocfgScene, network_roads
from tint_sumo.simulation.bodies import LONG_M, Bodies, Body, box_of
from tint_sumo.simulation.connection import Connection
from tint_sumo.simulation.ego import Collision
from tint_sumo.simulation.ego_way import EGO, EgoWay, Fate
from tint_sumo.simulation.perception import Perception
from tint_sumo.simulation.persons import Persons
from tint_sumo.simulation.simulation import Simulation
from tint_sumo.simulation.sumo import SPEED_MODE_OBEY_SETSPEED
from tint_sumo.simulation.sumocfg_traffic import SumocfgTraffic

_ONLY_STRATEGIC_CHANGES = 513  # lane changes: those that the route asks for, where there is room
_SUMO_DRIVES = -1.0  # in place of a speed
_SUMO_SPEED_MODE, _SUMO_LANE_CHANGE_MODE = 31, 1621  # SUMO's defaults: all its rules
_REROUTING = "has.rerouting.device"
_ENTRY_PATIENCE_S = 60.0  # the ego waits for room at its start for so long
_SEEN = (
    *(constants.VAR_POSITION3D, constants.VAR_ANGLE, constants.VAR_DISTANCE, constants.VAR_SPEED),
    constants.VAR_STOPSTATE,
)
_PARKS = 2  # bit of the stop state
# Vehicles on a bridge, or under it, are so much higher or lower than the ego: a storey and, since roads may climb, a
# share of their distance.
_LEVEL_M, _SLOPE = 3.0, 0.1
_AROUND_M = (30.0, 20.0)  # pictures show so much to each side of the ego

Sight = Mapping[int, Any]  # a vehicle's variables of _SEEN


@dataclass(frozen=True)
class VehicleKind:
    """The numbers that all vehicles of a vType have."""

    member: int  # number of the vType
    size_m: tuple[float, float]  # length and width
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
        """Return the kind of a vehicle; InputError if its vType is in none of the configuration's files."""
        vtype = self._connection.vehicle.getTypeID(vehicle_id)
        if vtype not in self._known:
            self._known[vtype] = self._look_up(vehicle_id, vtype)
        return self._known[vtype]

    def _look_up(self, vehicle_id: str, vtype: str) -> VehicleKind:
        if vtype.startswith(EGO):  # another ego, whose number comes after those of all vTypes
            return self._kind(len(self._vtypes), vtype)
        label = base_vtype(vtype, self._vtypes)
        if label not in self._vtypes:
            raise InputError(
                f"vehicle {vehicle_id!r} has vType {vtype!r}, which no vehicle or vType of {self._config.file} names; "
                "define it in a route or additional file"
            )
        return self._kind(self._vtypes.index(label), vtype)

    def _kind(self, member: int, vtype: str) -> VehicleKind:
        types = self._connection.vehicletype
        size_m = (types.getLength(vtype), types.getWidth(vtype))
        return VehicleKind(member, size_m, types.getMinGap(vtype), types.getTau(vtype))


class SumocfgSimulation(Simulation):
    """A single replica of a scene from a SUMO configuration.

    Slots and ego are in a frame with the network's axes, whose origin is where the ego's centre is at the episode's
    start. ``slot`` has the slot of each vehicle by its id.

    Raises:
        InputError: more than one replica, or SUMO refuses the configuration.
    """

    scene: SumocfgScene

    def __init__(
        self,
        replicas: int,
        scene: SumocfgScene,
        *,
        backend: Backend = "auto",
        traffic: SumocfgTraffic | None = None,
        ego: str = EGO,
    ) -> None:
        if replicas != 1:
            raise InputError(
                f"a scene from a .sumocfg is one simulation per process, not {replicas}; set workers to num_envs"
            )
        super().__init__(replicas, scene)
        self.trait_of_member = np.arange(len(scene.vtypes))
        self._ego = ego
        self._ego_size_m = (scene.vehicle.length_m, scene.vehicle.width_m)
        self.passed_m = self.stop_line_m = np.array([np.inf])  # no way is ever left behind, and none is waited at
        self.claims = np.zeros((replicas, 1), bool)
        self._running = SumocfgTraffic(scene, backend) if traffic is None else traffic
        self.connection, self.warm_starts = self._running.connection, self._running.warm_starts
        self._kinds = Kinds(scene.config, scene.vtypes, self.connection)
        self._bodies = Bodies(self.connection)
        self._long: dict[str, Body] = {}  # those around the ego
        self._known_vtypes = 0
        self._any_long = False
        self.persons = Persons(scene, self.connection, ego)
        self.perception = Perception(scene, self.connection, ego)
        self._step_s = scene.step_s  # which is looked up in the configuration
        self._drives = False
        self._accel_mps2 = 0.0  # of the ego, where SUMO drives it
        self.slot: dict[str, int] = {}
        self._number: dict[str, int] = {}  # number of each vehicle that has been seen

    @property
    def roads(self) -> Roads:
        return network_roads(self.scene.config.net_file)

    def view(self, replica: int) -> View:
        ego, (across_m, up_m) = self.egos.box[replica], _AROUND_M
        return View(-across_m, -up_m, across_m, up_m).moved(float(ego["x_m"]), float(ego["y_m"]))

    def close(self) -> None:
        self._running.close()

    # Episodes

    def reset(self, replica: int, seed: int) -> None:
        """Start a new random episode.

        Raises:
            InputError: SUMO refuses the configuration, or other vehicles leave the ego no room at its start.
        """
        self.clear(replica)
        with self._running.refusals:
            self.warm_starts.begin(seed)
            self._define_ego()
            self._let_ego_enter()
        self._start()

    def _start(self) -> None:
        """Take over where the ego is that has entered, and what is around it."""
        with self._running.refusals:
            self._look_as_far_as_needed()
            most_m = self.connection.vehicle.getMaxSpeed(self._ego) * self._step_s
            self._way = EgoWay(self.connection, self.scene.departure[0], most_m, self._ego)
            seen = self._seen()
        if self._ego not in seen:
            raise self._taken_at_start()
        sight = seen[self._ego]
        self._drives = True
        x_m, y_m, *_ = box_of(sight, self._ego_size_m, (0.0, 0.0))
        self.origin_m = (x_m, y_m)
        self._build(self._find_buildings())
        self._look()

    def _find_buildings(self) -> Iterator[Building]:
        """Yield the polygons of the configuration's additional files whose type is building, or begins with it."""
        left_m, low_m = self.origin_m
        polygons = self.connection.polygon
        for polygon in polygons.getIDList():
            if polygons.getType(polygon).startswith(BUILDING):
                yield tuple((x_m - left_m, y_m - low_m) for x_m, y_m, *_ in polygons.getShape(polygon))

    def clear(self, replica: int) -> None:
        self._drives = False
        self.slots.clear(replica)
        self.egos.clear(replica)
        self.slot.clear()
        self._number.clear()
        self.persons.clear()
        self.perception.clear()
        self._long.clear()
        self.origin_m = (0.0, 0.0)

    def _define_ego(self) -> None:
        types, scene = self.connection.vehicletype, self.scene
        types.copy(DEFAULT_VTYPE, self._ego)
        types.setVehicleClass(self._ego, "passenger")
        types.setLength(self._ego, scene.vehicle.length_m)
        types.setWidth(self._ego, scene.vehicle.width_m)
        types.setMinGap(self._ego, 0.0)
        types.setMaxSpeed(self._ego, max(scene.controller.desired_speeds_mps) + 1.0)
        types.setSpeedDeviation(self._ego, 0.0)
        types.setParameter(self._ego, _REROUTING, "false")
        self.connection.route.add(self._ego, list(scene.departure[0]))

    def _let_ego_enter(self) -> None:
        """Insert the ego once all vehicles near its start could brake in time."""
        self._ask_for_room()
        for _ in range(self.patience):
            self.connection.step()
            if self._has_entered():
                if self.scene.ego_control == "sumo":
                    self._hand_over_ego()
                else:
                    self._hold_ego()
                return
        raise self.no_room()

    def _ask_for_room(self) -> None:
        """Let SUMO insert the ego as soon as there is room."""
        ego, (_, lane_pos_m) = self._ego, self.scene.departure
        self.connection.vehicle.add(ego, ego, typeID=ego, departLane="best", departPos=str(lane_pos_m), departSpeed="0")

    @property
    def patience(self) -> int:
        """Steps for which the ego waits for room."""
        return math.ceil(_ENTRY_PATIENCE_S / self.scene.step_s)

    def _has_entered(self) -> bool:
        """Return whether SUMO has inserted the ego in the last step."""
        if self._ego in self.connection.simulation.getArrivedIDList():
            raise self._taken_at_start()
        return self._ego in self.connection.simulation.getDepartedIDList()

    def no_room(self) -> InputError:
        """Return the error of an ego that has waited for room in vain."""
        return InputError(
            f"the ego found no room at its start ({self.scene.start_m:g} m) for {_ENTRY_PATIENCE_S:g} s: vehicles "
            "stand or enter there, or a vaporizer lets none in; choose another start_m or warm_up_s"
        )

    def _hold_ego(self) -> None:
        """Let the ego stand until it is given a speed."""
        vehicle = self.connection.vehicle
        vehicle.setSpeedMode(self._ego, SPEED_MODE_OBEY_SETSPEED)
        vehicle.setLaneChangeMode(self._ego, _ONLY_STRATEGIC_CHANGES)
        vehicle.setSpeed(self._ego, 0.0)

    def _hand_over_ego(self) -> None:
        """Let SUMO's driver of a default passenger car drive the ego, which has entered as in all other episodes."""
        types, vehicle = self.connection.vehicletype, self.connection.vehicle
        types.setMinGap(self._ego, types.getMinGap(DEFAULT_VTYPE))
        types.setMaxSpeed(self._ego, max(self.scene.controller.desired_speeds_mps))
        vehicle.setSpeedMode(self._ego, _SUMO_SPEED_MODE)
        vehicle.setLaneChangeMode(self._ego, _SUMO_LANE_CHANGE_MODE)
        vehicle.setSpeed(self._ego, _SUMO_DRIVES)
        self._accel_mps2 = float(types.getAccel(self._ego))

    def _taken_at_start(self) -> InputError:
        return InputError(
            f"SUMO takes the ego off the road where it starts ({self.scene.start_m:g} m), as calibrators do; "
            "choose another start_m"
        )

    # Steps

    def step(self, desired_speed_mps: Floats) -> None:
        """Advance by one step; (1,) desired speed of the ego.

        Raises:
            InputError: SUMO finds fault with the demand.
        """
        if not self._drives:
            self.perception.end(arrived=False)
            return
        with self._running.refusals:
            moved_m = self._drive(desired_speed_mps) * self._step_s
            self._simulate()
        self._take_over(moved_m)

    def _take_over(self, moved_m: float) -> None:
        """Take over from SUMO what has come of a step in which the ego has moved by at most so much."""
        with self._running.refusals:
            fate = self._way.look(moved_m)
        if fate is Fate.DRIVES:
            self._look()
        else:
            self._end(fate)
        self.egos.ran_red[0] |= self.scene.red_light == "end" and self.perception.lights.passed_red > 0

    def _simulate(self) -> None:
        """Let SUMO do a step."""
        self.connection.step()

    def _drive(self, desired_speed_mps: Floats) -> float:
        """Choose the ego's speed in this step, if SUMO does not; return the highest that it may have in the step."""
        before_mps = float(self.egos.speed_mps[0])
        if self.scene.ego_control == "sumo":
            return before_mps + self._accel_mps2 * self._step_s
        self.egos.drive(desired_speed_mps)
        speed_mps = float(self.egos.speed_mps[0])
        self.connection.vehicle.setSpeed(self._ego, speed_mps)
        return max(before_mps, speed_mps)  # step-method.ballistic moves it at their mean

    def _end(self, fate: Fate) -> None:
        """Leave all as it was at last: the ego has come to its route's end, or SUMO has taken it away."""
        self._drives = False
        self.perception.end(arrived=fate is Fate.ARRIVED)
        if fate is Fate.ARRIVED:
            self.egos.front_m[0] = np.inf
        else:
            self.egos.lost[0] = True

    def _look(self) -> None:
        """Take over from SUMO where the ego and the vehicles in its sight are."""
        if self.connection.vehicletype.getIDCount() > self._known_vtypes:
            self._look_as_far_as_needed()  # from the next step on
        seen = self._seen()
        ego = seen.pop(self._ego)
        self.egos.front_m[0] = self.scene.start_m + ego[constants.VAR_DISTANCE]
        self.egos.speed_mps[0] = ego[constants.VAR_SPEED]
        self.egos.box[0] = box_of(ego, self._ego_size_m, self.origin_m)
        self.persons.follow(self.persons.take_from(seen), self.origin_m, ego[constants.VAR_POSITION3D][2])
        seen = self._in_sight(seen, ego[constants.VAR_POSITION3D])
        self._follow(seen if seen.keys() <= self.slot.keys() else self._nearest(seen, ego[constants.VAR_POSITION3D]))
        self.perception.look(float(self.egos.front_m[0]), self.slot)
        self._look_around()

    def _seen(self) -> dict[str, Sight]:
        """Return the ego and what is around it, by their ids."""
        return dict(self.connection.vehicle.getContextSubscriptionResults(self._ego))

    def _look_around(self) -> None:
        super()._look_around()
        touched = self.persons.look_around(self.egos) if self.persons.ids else ""
        if touched and not self.egos.collided[0]:
            ego, road = self.egos.box[0], str(self.connection.person.getRoadID(touched))
            self.egos.hit_person[0] = True
            self.egos.collision[0] = Collision(NO_VEHICLE, NO_VEHICLE, road, float(ego["x_m"]), float(ego["y_m"]))

    @property
    def pedestrians(self) -> Boxes:
        return self.persons.boxes

    @property
    def bodies(self) -> dict[int, Boxes]:
        return {self.slot[vehicle_id]: body.boxes for vehicle_id, body in self._long.items() if vehicle_id in self.slot}

    def _look_as_far_as_needed(self) -> None:
        """Ask SUMO for the vehicles whose front is in sight, or may be beyond it while their back is."""
        types = self.connection.vehicletype
        vtypes = types.getIDList()
        self._known_vtypes = len(vtypes)
        # SUMO always has types that no vehicle needs to have, such as one of trains.
        labels = self.scene.vtypes
        lengths_m = (types.getLength(vtype) for vtype in vtypes if base_vtype(vtype, labels) in labels)
        longest_m = max(lengths_m, default=0.0)
        self._any_long = longest_m > LONG_M
        reach_m = self.scene.sight_m + (longest_m if self._any_long else 0.0)
        self.connection.vehicle.subscribeContext(self._ego, constants.CMD_GET_VEHICLE_VARIABLE, reach_m, _SEEN)

    def _in_sight(self, seen: Mapping[str, Sight], front_m: tuple[float, float, float]) -> dict[str, Sight]:
        """Return the vehicles that are on the ego's level, not parked beside the road, and in sight."""
        self._long.clear()
        z_m = front_m[2]
        return {
            vehicle_id: sight
            for vehicle_id, sight in seen.items()
            if not sight[constants.VAR_STOPSTATE] & _PARKS
            and (
                # Nearly all vehicles are as high as the ego.
                (not self._any_long and abs(sight[constants.VAR_POSITION3D][2] - z_m) <= _LEVEL_M)
                or self._meets(vehicle_id, sight, front_m)
            )
        }

    def _meets(self, vehicle_id: str, sight: Sight, front_m: tuple[float, float, float]) -> bool:
        """Whether a vehicle is on the ego's level and in sight."""
        x_m, y_m, z_m = sight[constants.VAR_POSITION3D]
        distance_m = math.hypot(x_m - front_m[0], y_m - front_m[1])
        if self._any_long:
            size_m = self._kinds.of(vehicle_id).size_m
            if size_m[0] > LONG_M:
                pieces = self._bodies.pieces(vehicle_id, size_m, math.radians(sight[constants.VAR_ANGLE]))
                body = Body.of(pieces, self.origin_m, self.egos.box)
                z_m = self._bodies.height_m(vehicle_id, size_m[0] * (body.nearest + 0.5) / len(pieces))
                distance_m = body.distance_m
                self._long[vehicle_id] = body
            if distance_m > self.scene.sight_m:
                return False
        return bool(abs(z_m - front_m[2]) <= _LEVEL_M + _SLOPE * distance_m)

    def _nearest(self, seen: Mapping[str, Sight], front_m: tuple[float, float, float]) -> dict[str, Sight]:
        """Return as many vehicles as there are slots, nearest first."""
        ego_x_m, ego_y_m, _ = front_m
        away_m = {}
        for vehicle_id, sight in seen.items():
            x_m, y_m, _ = sight[constants.VAR_POSITION3D]
            long = self._long.get(vehicle_id)
            away_m[vehicle_id] = long.distance_m if long else math.hypot(x_m - ego_x_m, y_m - ego_y_m)
        nearest = sorted(away_m, key=away_m.__getitem__)
        return {vehicle_id: seen[vehicle_id] for vehicle_id in nearest[: self.scene.max_vehicles]}

    def _follow(self, near: Mapping[str, Sight]) -> None:
        """Take over where vehicles are: those that have slots, or the nearest of all, nearest first."""
        slots = self.slots
        slots.begin_step()
        for vehicle_id in self.slot.keys() - near.keys():
            slots.leave(0, self.slot.pop(vehicle_id))
        placed, seen = [], []
        for vehicle_id, sight in near.items():
            slot = self.slot[vehicle_id] if vehicle_id in self.slot else self._take(vehicle_id)
            if slot != NO_VEHICLE:
                x_m, y_m, _ = sight[constants.VAR_POSITION3D]
                placed.append(slot)
                seen.append((x_m, y_m, sight[constants.VAR_ANGLE], sight[constants.VAR_DISTANCE]))
        if placed:
            place_seen(np.array(placed), np.array(seen), *self.origin_m, slots.front_m[0], slots.box[0])
        for vehicle_id, body in self._long.items():
            if vehicle_id in self.slot:
                slots.box[0, self.slot[vehicle_id]] = body.nearest_box

    def _take(self, vehicle_id: str) -> int:
        """Return the slot that a vehicle takes; ``NO_VEHICLE`` if none is free."""
        slot = self.slots.free(0)
        if slot != NO_VEHICLE:
            kind = self._kinds.of(vehicle_id)
            number = self._number.setdefault(vehicle_id, len(self._number))
            self.slots.take(0, slot, member=kind.member, number=number, size_m=kind.size_m)
            self.slot[vehicle_id] = slot
        return slot

    def _road_of(self, replica: int, slot: int) -> str:  # noqa: ARG002 - there is but one
        vehicle_id = next(known for known, taken in self.slot.items() if taken == slot)
        return str(self.connection.vehicle.getRoadID(vehicle_id))

    def leaders(self, replicas: slice = slice(None), seen: Bools | None = None) -> tuple[Numbers, Floats]:
        shape = self.slots.present.shape
        known = self.slots.present if seen is None else seen
        leader, gap_m = np.full(shape, NO_VEHICLE), np.full(shape, np.inf)
        for vehicle_id, slot in self.slot.items():
            ahead_id, ahead_m = leader_of(self.connection, vehicle_id, self._kinds.of(vehicle_id))
            while ahead_id in self.slot and not known[0, self.slot[ahead_id]] and ahead_m < NO_LEADER_GAP_M:
                hidden = self._kinds.of(ahead_id)
                ahead_id, further_m = leader_of(self.connection, ahead_id, hidden)
                ahead_m += hidden.size_m[0] + further_m
            if ahead_id in self.slot and known[0, self.slot[ahead_id]]:
                leader[0, slot], gap_m[0, slot] = self.slot[ahead_id], ahead_m
        return leader[replicas], gap_m[replicas]


def leader_of(connection: Connection, vehicle_id: str, kind: VehicleKind) -> tuple[str, float]:
    """Return the id of the vehicle ahead as SUMO has it, and the gap from bumper to bumper; "" and infinite if none."""
    found = connection.vehicle.getLeader(vehicle_id, NO_LEADER_GAP_M)  # less minGap
    return (found[0], found[1] + kind.min_gap_m) if found else ("", math.inf)
