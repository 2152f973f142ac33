"""The interface of all simulations, and the parts that they share."""

from abc import ABC, abstractmethod
from collections.abc import Iterable, Mapping
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from tint_sumo.scenes.drivers import NO_TOWN
from tint_sumo.scenes.geometry import BOX, NO_VEHICLE, Bools, Boxes, Floats, Numbers
from tint_sumo.scenes.roads import Roads
from tint_sumo.scenes.scene import Building, Scene, View
from tint_sumo.scenes.sight import walls_of
from tint_sumo.scenes.sumocfg import SumocfgScene
from tint_sumo.simulation.connection import Connection
from tint_sumo.simulation.ego import Collision, Egos
from tint_sumo.simulation.slots import Slots

Traits = NDArray[np.int16]  # numbers of traits; labels are these


class Simulation(ABC):
    """R replicas of a scene, each empty until its first ``reset``.

    Read-only state: the vehicles in ``slots`` (``tint_sumo.simulation.slots.Slots``) and the egos in ``egos``
    (``tint_sumo.simulation.ego.Egos``). Subclasses differ in who makes the traffic, and in who yields to the egos.
    """

    scene: Scene | SumocfgScene
    connection: Connection
    trait_of_member: Numbers  # number of the trait of each member of the population
    passed_m: Floats  # (K,) front of an ego that has left each route of the traffic behind
    stop_line_m: Floats  # (K,) where vehicles on each route would wait for the ego; infinite if nowhere
    claims: Bools  # (R, K) which routes each ego claims
    buildings: tuple[Building, ...] = ()  # in the scene's frame
    walls: Floats = np.zeros((0, 4))  # theirs, as ``tint_sumo.scenes.sight.walls_of`` returns them
    origin_m = (0.0, 0.0)  # position of the scene's origin in the network

    def __init__(self, replicas: int, scene: Scene | SumocfgScene) -> None:
        self.scene = scene
        self.replicas = replicas
        self.slots = Slots(replicas, scene.max_vehicles)
        self.egos = Egos(replicas, scene)

    def _build(self, buildings: Iterable[Building]) -> None:
        """Take over the buildings, which may differ between episodes."""
        self.buildings = tuple(buildings)
        self.walls = walls_of(self.buildings)

    @property
    def backend(self) -> str:
        return self.connection.backend

    def close(self) -> None:
        """End the simulation; safe to call twice."""
        self.connection.close()

    @property
    @abstractmethod
    def roads(self) -> Roads:
        """The roads, in the network's frame."""

    @abstractmethod
    def view(self, replica: int) -> View:
        """Return the part of the scene that pictures of a replica show."""

    @property
    def town(self) -> Numbers:
        """Number (R,) of the town of each episode, for ``tint_sumo.scenes.drivers.draw_town``; or ``NO_TOWN``."""
        return np.full(self.replicas, NO_TOWN)

    def traits(self, replicas: slice = slice(None)) -> Traits:
        """Return the numbers of the drivers' traits (R, V) as they are now; ``NO_VEHICLE`` in empty slots."""
        return self._trait_or_none[self.slots.member[replicas]]

    @cached_property
    def _trait_or_none(self) -> Traits:
        return np.array((*self.trait_of_member, NO_VEHICLE), np.int16)

    @property
    def bodies(self) -> Mapping[int, Boxes]:
        """The pieces (P,) of vehicles that bend, by their slots, whose box is the nearest of them; for pictures."""
        return {}

    @property
    def pedestrians(self) -> Boxes:
        """The boxes (P,) of persons on foot around the ego; built-in scenes have none."""
        return np.zeros(0, BOX)

    @abstractmethod
    def reset(self, replica: int, seed: int) -> None:
        """Empty a replica and start a new random episode in it."""

    @abstractmethod
    def clear(self, replica: int) -> None:
        """Empty a replica and leave it so, at next to no cost, until its next reset."""

    @abstractmethod
    def step(self, desired_speed_mps: Floats) -> None:
        """Advance all replicas by one step; (R,) desired speeds of the egos."""

    @abstractmethod
    def leaders(self, replicas: slice = slice(None), seen: Bools | None = None) -> tuple[Numbers, Floats]:
        """Return the slot of the next vehicle ahead of each vehicle, and the gap to it from bumper to bumper.

        Both (R, V) of some replicas: ``NO_VEHICLE`` and infinite where no slot holds one. With ``seen`` (R, V) as if
        no other vehicles were there.
        """

    @abstractmethod
    def _road_of(self, replica: int, slot: int) -> str:
        """Return the name of the road that a vehicle is on, for a collision."""

    def _look_around(self) -> None:
        """Run the egos' safety check, and keep their first collisions."""
        for replica, slot in self.egos.look_around(self.slots):
            ego, trait = self.egos.box[replica], int(self.traits(slice(replica, replica + 1))[0, slot])
            self.egos.collision[replica] = Collision(
                slot, trait, self._road_of(replica, slot), float(ego["x_m"]), float(ego["y_m"])
            )
