"""Several egos in the traffic of one SUMO configuration, each of which is a vehicle to the others."""

from collections.abc import Mapping, Sequence

import numpy as np

from tint_sumo.config import Backend
from tint_sumo.scenes.geometry import Floats
from tint_sumo.scenes.sumocfg import EGO_CLASS, SumocfgScene
from tint_sumo.simulation.ego_way import EGO
from tint_sumo.simulation.sumocfg import SumocfgSimulation
from tint_sumo.simulation.sumocfg_traffic import SumocfgTraffic


class EgoView(SumocfgSimulation):
    """The simulation as one of several egos sees it; the traffic is begun and stepped for all at once.

    ``reset`` takes over where the ego has entered, and ``step`` what has come of the step; the number of another ego's
    trait comes after those of the configuration's vTypes.
    """

    def __init__(self, scene: SumocfgScene, traffic: SumocfgTraffic, number: int) -> None:
        super().__init__(1, scene, traffic=traffic, ego=f"{EGO}.{number}")
        self.trait_of_member = np.arange(len(scene.vtypes) + 1)
        self._waits = False
        self._moved_m = 0.0

    def ask_for_room(self) -> None:
        """Let SUMO insert the ego as soon as there is room."""
        self._waits = True
        self._define_ego()
        self._ask_for_room()

    def waits(self) -> bool:
        """Return whether the ego still waits for room; it stands where it has entered."""
        if self._waits and self._has_entered():
            self._hold_ego()
            self._waits = False
        return self._waits

    def reset(self, replica: int, seed: int) -> None:  # noqa: ARG002 - the traffic has begun with one
        self.clear(replica)
        self._start()

    def drive(self, desired_mps: float) -> None:
        """Choose the ego's speed in the next step."""
        self._moved_m = self._drive(np.array([desired_mps])) * self._step_s

    def step(self, desired_speed_mps: Floats) -> None:  # noqa: ARG002 - it has been driven
        self._take_over(self._moved_m)

    def leave(self) -> None:
        """Take the ego, whose episode has ended, off the roads: SUMO lets it arrive in the next step.

        SUMO 1.28 cannot remove a vehicle that is subscribed to, nor end a subscription.
        """
        if self._drives:
            with self._running.refusals:
                lane = self._last_lane()
                self.connection.vehicle.moveTo(self._ego, lane, self.connection.lane.getLength(lane))
            self._drives = False

    def _last_lane(self) -> str:
        """Return a lane for cars at the end of the ego's route."""
        *_, edge = self.scene.departure[0]
        lanes = [f"{edge}_{index}" for index in range(self.connection.edge.getLaneNumber(edge))]
        return next(lane for lane in lanes if EGO_CLASS not in self.connection.lane.getDisallowed(lane))


class SharedTraffic:
    """Egos in the traffic of one SUMO configuration; ``views`` are the simulations as they see them.

    Args:
        scenes: of the egos; they differ in the egos' tasks alone.
        backend: as in ``SumocfgSimulation``.

    Raises:
        InputError: SUMO refuses the configuration.
    """

    def __init__(self, scenes: Sequence[SumocfgScene], backend: Backend = "auto") -> None:
        self._traffic = SumocfgTraffic(scenes[0], backend)
        self.views = tuple(EgoView(scene, self._traffic, number) for number, scene in enumerate(scenes))

    def begin(self, seed: int) -> None:
        """Start the traffic of an episode, and let all egos enter.

        Raises:
            InputError: SUMO refuses the configuration, or other vehicles leave an ego no room at its start.
        """
        with self._traffic.refusals:
            self._traffic.warm_starts.begin(seed)
            for view in self.views:
                view.ask_for_room()
            for _ in range(self.views[0].patience):
                self._traffic.connection.step()
                waiting = [view for view in self.views if view.waits()]
                if not waiting:
                    return
            raise waiting[0].no_room()

    def step(self, desired_mps: Mapping[int, float]) -> None:
        """Advance by one step; desired speeds of the egos that drive, by their numbers."""
        with self._traffic.refusals:
            for number, one_mps in desired_mps.items():
                self.views[number].drive(one_mps)
            self._traffic.connection.step()

    def close(self) -> None:
        """End the simulation; safe to call twice."""
        self._traffic.close()
