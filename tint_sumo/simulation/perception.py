"""The road around the ego in a SUMO configuration, as far as its scene asks for it."""

from collections.abc import Mapping
from dataclasses import dataclass

from tint_sumo.scenes.sumocfg import SumocfgScene
from tint_sumo.simulation.connection import Connection
from tint_sumo.simulation.ego_way import EGO
from tint_sumo.simulation.right_of_way import RightOfWay
from tint_sumo.simulation.traffic_lights import RouteLights, TrafficLight


@dataclass(frozen=True)
class Lane:
    """The lane that the ego is on; on junctions one of those across it."""

    index: int  # 0 at the edge's outer side, to the right in right-hand traffic
    count: int  # lanes of the edge
    speed_limit_mps: float


class Perception:
    """The road around the ego in a running simulation.

    ``traffic_light`` is the next one on its route, None without one. Attributes that the scene does not ask for stay as
    they are in an empty environment.

    Args:
        scene: the scene.
        connection: the running simulation.
        ego: the ego's id.
    """

    def __init__(self, scene: SumocfgScene, connection: Connection, ego: str = EGO) -> None:
        self._connection = connection
        self._ego = ego
        self._watches_lights = scene.red_light != "ignore" or "traffic_light" in scene.perceives
        self._watches_lane = not {"speed_limit", "lane"}.isdisjoint(scene.perceives)
        self._watches_right_of_way = "right_of_way" in scene.perceives
        self.lights = RouteLights(connection, scene.step_s, ego)
        self.right_of_way = RightOfWay(connection, scene.max_vehicles, ego)
        self.clear()

    def clear(self) -> None:
        """Forget an episode."""
        self.lights.clear()
        self.right_of_way.clear()
        self.lane = Lane(0, 0, 0.0)

    def look(self, front_m: float, slot: Mapping[str, int]) -> None:
        """Take over the state after a step, or at an episode's begin.

        Args:
            front_m: position of the ego's front on its route.
            slot: slots of vehicles by their ids.
        """
        if self._watches_right_of_way:
            self.right_of_way.follow(front_m, slot)
        if self._watches_lights:
            self.lights.follow(front_m)
        if self._watches_lane:
            vehicle = self._connection.vehicle
            self.lane = Lane(
                vehicle.getLaneIndex(self._ego),
                self._connection.edge.getLaneNumber(vehicle.getRoadID(self._ego)),
                self._connection.lane.getMaxSpeed(vehicle.getLaneID(self._ego)),
            )

    def end(self, *, arrived: bool) -> None:
        """Take over that SUMO has taken the ego off, which may have arrived at its route's end, in the last step."""
        self.lights.end(arrived=arrived)

    @property
    def traffic_light(self) -> TrafficLight | None:
        return self.lights.ahead[0] if self.lights.ahead else None
