"""The simulation of a recording: an ego among recorded vehicles, in one of the scene's cases at a time."""

from collections.abc import Mapping
from typing import Any

from libsumo import constants

from tint_sumo.config import Backend
from tint_sumo.scenes.replay import ReplayCase, ReplayScene
from tint_sumo.simulation.bodies import box_of, record_of
from tint_sumo.simulation.ego_way import EGO
from tint_sumo.simulation.recorded import Faults, RecordedTraffic
from tint_sumo.simulation.sumocfg import Sight, SumocfgSimulation


class ReplaySimulation(SumocfgSimulation):
    """A single replica of a recording; an episode's seed chooses the case, whose scene is in ``scene`` then.

    Raises:
        InputError: more than one replica, or SUMO refuses the network.
    """

    scene: ReplayScene

    def __init__(self, replicas: int, scene: ReplayScene, *, backend: Backend = "auto") -> None:
        super().__init__(replicas, scene, backend=backend)
        self._whole = scene
        self._traffic = RecordedTraffic(self.connection)

    def reset(self, replica: int, seed: int) -> None:
        self.scene = self._whole.of(seed % len(self._whole.cases))
        self._ego_size_m = (self.scene.vehicle.length_m, self.scene.vehicle.width_m)
        super().reset(replica, seed)

    @property
    def faults(self) -> Faults:
        """Faults of the recording in this episode, or between it and the network."""
        return self._traffic.faults()

    @property
    def released(self) -> int:
        """Number of vehicles that have been released in this episode."""
        return self._traffic.released_so_far

    def is_replayed(self, slot: int) -> bool:
        """Whether the vehicle in a slot is where it was recorded."""
        return any(taken == slot and int(known) not in self._traffic.released for known, taken in self.slot.items())

    def _define_ego(self) -> None:
        super()._define_ego()
        fastest_mps = max(*self.scene.controller.desired_speeds_mps, self._case.speed_mps)
        self.connection.vehicletype.setMaxSpeed(EGO, fastest_mps + 1.0)

    def _let_ego_enter(self) -> None:
        """Place the ego, and all that is recorded at this time, and give the ego its speed."""
        vehicle = self.connection.vehicle
        vehicle.add(EGO, EGO, typeID=EGO, departLane="best", departSpeed="0")
        vehicle.moveTo(EGO, self._case.lane, self._case.lane_m)
        self._hold_ego()
        self._traffic.begin(self.scene)
        self.connection.step()
        vehicle.setPreviousSpeed(EGO, self._case.speed_mps)
        if self.scene.ego_control == "sumo":
            self._hand_over_ego()

    @property
    def _case(self) -> ReplayCase:
        return self.scene.cases[self.scene.case]

    def _simulate(self) -> None:
        ego = self.egos.box[:1].copy()
        ego["x_m"] += self.origin_m[0]
        ego["y_m"] += self.origin_m[1]
        driven_m = float(self.egos.front_m[0]) - self.scene.start_m
        self._traffic.advance(ego[0], driven_m, float(self.egos.speed_mps[0]))
        self.connection.step()
        self._traffic.settle()

    def _look_as_far_as_needed(self) -> None:
        """Ask SUMO for nothing: it is known where the vehicles are."""

    def _seen(self) -> dict[str, Sight]:
        vehicle = self.connection.vehicle
        front_m = vehicle.getPosition3D(EGO)
        ego: dict[int, Any] = {
            constants.VAR_POSITION3D: front_m,
            constants.VAR_ANGLE: vehicle.getAngle(EGO),
            constants.VAR_DISTANCE: vehicle.getDistance(EGO),
            constants.VAR_SPEED: vehicle.getSpeed(EGO),
        }
        box = record_of(box_of(ego, self._ego_size_m, (0.0, 0.0)))
        return {EGO: ego, **self._traffic.seen(box, front_m, self.scene.sight_m)}

    def _in_sight(self, seen: Mapping[str, Sight], front_m: tuple[float, float, float]) -> dict[str, Sight]:  # noqa: ARG002 - they are chosen already
        return dict(seen)
