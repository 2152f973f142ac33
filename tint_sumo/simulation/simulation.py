"""Many replicas of a scene in one SUMO simulation.

Each replica is a copy of the scene in the same network; its episode depends on its seed alone, not on the batch it runs
in. State is kept in arrays, (R,) for egos and (R, V) for vehicle slots; the only per-vehicle call into SUMO each step
reads its lane position.
"""

from collections.abc import Sequence

import numpy as np

from tint_sumo.config import Backend
from tint_sumo.core.errors import InputError
from tint_sumo.scenes.drivers import members
from tint_sumo.scenes.geometry import Floats, Numbers, find_leaders
from tint_sumo.scenes.layout import layout
from tint_sumo.scenes.scene import Scene
from tint_sumo.simulation.demand import Demand, PlacedVehicle
from tint_sumo.simulation.ego import Egos
from tint_sumo.simulation.slots import Slots
from tint_sumo.simulation.sumo import NO_COLLISION_CHECK, SumoLink
from tint_sumo.simulation.timing import StepPart, does
from tint_sumo.simulation.yielding import Yielding


class Simulation:
    """A batch of ``replicas`` of a scene, each empty until its first ``reset``.

    Read-only state: ``time_s`` (R,) since the episodes' start, the vehicles in ``slots``
    (``tint_sumo.simulation.slots.Slots``), the egos in ``egos`` (``tint_sumo.simulation.ego.Egos``), and
    who yields to them in ``yielding`` (``tint_sumo.simulation.yielding.Yielding``). At most ``max_vehicles`` of
    the scene are on its roads; further ones wait outside.
    """

    def __init__(
        self,
        replicas: int,
        scene: Scene,
        *,
        with_ego: bool = True,
        backend: Backend = "auto",
        collision_options: Sequence[str] = NO_COLLISION_CHECK,
    ) -> None:
        self.scene = scene
        self.replicas = replicas
        self.layout = layout(scene)
        self.population = members(scene.population)
        profiles = scene.population.profiles
        self.traits = tuple(profile.name for profile in profiles)
        self.trait_of_member: Numbers = np.array([profiles.index(member.profile) for member in self.population])
        self.passed_m = self.layout.zones.passed_m
        self._with_ego = with_ego
        self.link = SumoLink(self.layout, replicas, backend, collision_options)
        self.slots = Slots(replicas, self.layout)
        self.egos = Egos(replicas, self.layout)
        self.yielding = Yielding(replicas, self.population, self.layout, self.slots, self.link)
        self._demand = Demand(replicas, self.population, self.layout)
        self.time_s: Floats = np.zeros(replicas)
        self.vehicle_count = [0] * replicas  # vehicles that have appeared in each replica's episode

    @property
    def backend(self) -> str:
        return self.link.connection.backend

    def close(self) -> None:
        """End the simulation; safe to call twice."""
        self.link.connection.close()

    # Episodes

    @does(StepPart.SPAWNING)
    def reset(self, replica: int, seed: int | Sequence[int] | np.random.SeedSequence) -> None:
        """Empty a replica and start a new random episode in it."""
        sequence = seed if isinstance(seed, np.random.SeedSequence) else np.random.SeedSequence(seed)
        self.clear(replica)
        placed = self._demand.begin(replica, sequence)
        if len(placed) > self.scene.max_vehicles:  # those who would have come last are not there yet
            placed = sorted(placed, key=lambda one: -one.front_m)[: self.scene.max_vehicles]
        self._populate(replica, placed)

    def reset_to(self, replica: int, vehicles: Sequence[PlacedVehicle]) -> None:
        """Empty a replica and start an episode with exactly these vehicles; nobody else enters.

        Raises:
            InputError: more vehicles than the scene has slots.
        """
        if len(vehicles) > self.scene.max_vehicles:
            raise InputError(f"at most {self.scene.max_vehicles} vehicles fit the scene, not {len(vehicles)}")
        self.clear(replica)
        self._populate(replica, vehicles)

    def _populate(self, replica: int, vehicles: Sequence[PlacedVehicle]) -> None:
        self.link.begin_episode(replica)
        self.vehicle_count[replica] = 0
        self.time_s[replica] = 0.0
        for slot, vehicle in enumerate(vehicles):
            self._add(replica, slot, vehicle)
        if self._with_ego:
            self.link.add_ego(replica)
            self.egos.begin(replica)

    def clear(self, replica: int) -> None:
        """Empty a replica and leave it so, at next to no cost, until its next reset."""
        for slot in np.flatnonzero(self.slots.present[replica]).tolist():
            self.link.remove(replica, slot)
            self._forget(replica, slot)
        self.link.remove_ego(replica)
        self.slots.clear(replica)
        self.egos.forget(replica)
        self._demand.stop(replica)

    def _add(self, replica: int, slot: int, placed: PlacedVehicle) -> None:
        slots, driver = self.slots, self.population[placed.member]
        number = self.vehicle_count[replica]
        self.vehicle_count[replica] += 1
        slots.take(replica, slot, placed.route, placed.front_m, placed.member, number)
        self.link.add(replica, slot, number, placed.route, placed.front_m, driver)
        if self.egos.has_claimed[replica, placed.route]:
            self.yielding.consider(replica, slot, driver.desired_speed_mps)

    def _forget(self, replica: int, slot: int) -> None:
        self.slots.leave(replica, slot)
        self.yielding.leave(replica, slot)

    # Steps

    def step(self, desired_speed_mps: Floats | None = None) -> None:
        """Advance all replicas by one step; (R,) desired speeds of the egos, none without egos."""
        if desired_speed_mps is not None:
            if self.egos.update_claims():
                self.yielding.answer(self.egos)
            self.egos.drive(desired_speed_mps)
            self.link.drive_egos(self.egos.speed_mps)
        self.slots.begin_step()
        for replica, slot in self.link.step():
            self._forget(replica, slot)
        self.time_s += self.scene.step_s
        self.slots.follow(*self.link.lane_positions_m())
        if self._with_ego:
            self.egos.look_around(self.slots)
        self._admit()

    @does(StepPart.SPAWNING)
    def _admit(self) -> None:
        """Let the upcoming drivers in where there is room, a free slot, and their time has come."""
        for replica, route in self._demand.admit(self.slots, self.time_s):
            slot = self.slots.free(replica)
            if slot >= 0:
                self._add(replica, slot, self._demand.take(replica, route, float(self.time_s[replica])))

    def leaders(self, replicas: slice = slice(None)) -> tuple[Numbers, Floats]:
        """Slot of the next vehicle ahead on each vehicle's route, -1 if none, and the gap to it, NaN if none.

        Both (R, V) of some replicas.
        """
        slots, layout = self.slots, self.layout
        route = slots.route[replicas]
        leader, gap_m = np.empty(route.shape, np.int64), np.empty(route.shape)
        find_leaders(
            slots.present[replicas],
            route,
            slots.stage[replicas],
            slots.front_m[replicas],
            layout.lane_start_m,
            layout.lane_on_route_m,
            self.scene.vehicle.length_m,
            leader,
            gap_m,
        )
        return leader, gap_m
