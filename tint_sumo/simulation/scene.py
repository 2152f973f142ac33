"""Many replicas of a scene in one SUMO simulation, with traffic that this package makes.

Each replica is a copy of the scene in the same network; its episode depends on its seed alone, not on the batch it runs
in. State is kept in arrays, (R,) for egos and (R, V) for vehicle slots; the only per-vehicle call into SUMO each step
reads its lane position.
"""

from collections.abc import Sequence

import numpy as np

from tint_sumo.config import Backend
from tint_sumo.core.errors import InputError
from tint_sumo.scenes.drivers import members
from tint_sumo.scenes.geometry import NO_VEHICLE, Bools, Floats, Numbers, place
from tint_sumo.scenes.layout import layout
from tint_sumo.scenes.roads import Roads
from tint_sumo.scenes.scene import Scene, View
from tint_sumo.simulation.demand import Demand, PlacedVehicle
from tint_sumo.simulation.lanes import LanePositions
from tint_sumo.simulation.simulation import Simulation, Traits
from tint_sumo.simulation.sumo import NO_COLLISION_CHECK, SumoLink
from tint_sumo.simulation.timing import StepPart, does
from tint_sumo.simulation.yielding import Yielding


class SceneSimulation(Simulation):
    """A batch of ``replicas`` of a scene.

    Read-only state beside that of ``Simulation``: ``time_s`` (R,) since the episodes' start, and who yields to the egos
    in ``yielding`` (``tint_sumo.simulation.yielding.Yielding``). At most ``max_vehicles`` of the scene are on its
    roads; further ones wait outside.
    """

    scene: Scene

    def __init__(
        self,
        replicas: int,
        scene: Scene,
        *,
        with_ego: bool = True,
        backend: Backend = "auto",
        collision_options: Sequence[str] = NO_COLLISION_CHECK,
    ) -> None:
        super().__init__(replicas, scene)
        self.layout = layout(scene)
        self.population = members(scene.population)
        profiles = scene.population.profiles
        self.trait_of_member = np.array([profiles.index(member.profile) for member in self.population])
        refusing = (index for index, profile in enumerate(profiles) if not profile.yields)
        self._refusing_trait = np.int16(next(refusing, NO_VEHICLE))  # of drivers who would not yield now
        self.passed_m, self.stop_line_m = self.layout.zones.passed_m, self.layout.zones.stop_line_m
        self._build(scene.buildings)
        self._with_ego = with_ego
        self.link = SumoLink(self.layout, replicas, backend, collision_options)
        self.connection = self.link.connection
        self.lanes = LanePositions(self.layout, self.slots)
        self.yielding = Yielding(self.population, self.layout, self.slots, self.link)
        self.claims = self.yielding.has_claimed
        self._demand = Demand(replicas, self.population, self.layout)
        self.time_s: Floats = np.zeros(replicas)
        self.vehicle_count = [0] * replicas  # vehicles that have appeared in each replica's episode

    @property
    def roads(self) -> Roads:
        return self.layout.roads

    @property
    def town(self) -> Numbers:
        return self._demand.town

    def traits(self, replicas: slice = slice(None)) -> Traits:
        traits = super().traits(replicas)
        if self.scene.population.willingness is None:
            return traits
        return np.where(self.yielding.refuses[replicas], self._refusing_trait, traits)

    def view(self, replica: int) -> View:  # noqa: ARG002 - the same for all
        return self.scene.view

    # Episodes

    @does(StepPart.SPAWNING)
    def reset(self, replica: int, seed: int | Sequence[int] | np.random.SeedSequence) -> None:
        sequence = seed if isinstance(seed, np.random.SeedSequence) else np.random.SeedSequence(seed)
        self.clear(replica)
        placed = self._demand.begin(replica, sequence)
        if len(placed) > self.scene.max_vehicles:  # those who would have come last are not there yet
            placed = sorted(placed, key=lambda vehicle: -vehicle.front_m)[: self.scene.max_vehicles]
        self._populate(replica, placed)

    def reset_to(self, replica: int, vehicles: Sequence[PlacedVehicle]) -> None:
        """Empty a replica and start an episode with exactly these vehicles; no other enters.

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
            self.egos.front_m[replica] = self.scene.ego.start_m
            self._place_egos(slice(replica, replica + 1))

    def clear(self, replica: int) -> None:
        for slot in np.flatnonzero(self.slots.present[replica]).tolist():
            self.link.remove(replica, slot)
            self._forget(replica, slot)
        self.link.remove_ego(replica)
        self.slots.clear(replica)
        self.lanes.clear(replica)
        self.yielding.clear(replica)
        self.egos.clear(replica)
        self._demand.stop(replica)

    def _add(self, replica: int, slot: int, placed: PlacedVehicle) -> None:
        driver, vehicle, number = self.population[placed.member], self.scene.vehicle, self.vehicle_count[replica]
        self.vehicle_count[replica] += 1
        size_m = vehicle.length_m, vehicle.width_m
        self.slots.take(replica, slot, member=placed.member, number=number, size_m=size_m, route=placed.route)
        self.lanes.enter(replica, slot, placed.front_m)
        self._demand.enter(replica, placed.route, slot)
        self.link.add(replica, slot, number, placed.route, placed.front_m, driver)
        self.yielding.enter(replica, slot, driver.desired_speed_mps, placed.seed, float(self.time_s[replica]))

    def _forget(self, replica: int, slot: int) -> None:
        self.slots.leave(replica, slot)
        self._demand.leave(replica, int(self.slots.route[replica, slot]), slot)
        self.yielding.leave(replica, slot)

    # Steps

    def step(self, desired_speed_mps: Floats | None = None) -> None:
        """Advance all replicas by one step; (R,) desired speeds of the egos, none without egos."""
        if desired_speed_mps is not None:
            self.yielding.update(self.egos)
            self.egos.drive(desired_speed_mps)
            self._place_egos(slice(None))
            self.link.drive_egos(self.egos.speed_mps)
        self.slots.begin_step()
        for replica, slot in self.link.step():
            self._forget(replica, slot)
        self.time_s += self.scene.step_s
        self.lanes.follow(*self.link.lane_positions_m())
        if self._with_ego:
            self._look_around()
        self.yielding.follow(self.time_s, self.egos.speed_mps if self._with_ego else None)
        self._admit()

    def _place_egos(self, replicas: slice) -> None:
        place(self.egos.front_m[replicas], self.layout.ego.way, self.egos.box[replicas])

    def _road_of(self, replica: int, slot: int) -> str:
        return self.scene.routes[int(self.slots.route[replica, slot])].name

    @does(StepPart.SPAWNING)
    def _admit(self) -> None:
        """Let the upcoming drivers in where there is room, a free slot, and their time has come."""
        for replica, route in self._demand.admit(self.slots, self.time_s):
            slot = self.slots.free(replica)
            if slot >= 0:
                self._add(replica, slot, self._demand.take(replica, route, float(self.time_s[replica])))

    def leaders(self, replicas: slice = slice(None), seen: Bools | None = None) -> tuple[Numbers, Floats]:
        return self.lanes.leaders(replicas, self.slots.present[replicas] if seen is None else seen)
