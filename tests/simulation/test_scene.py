from collections.abc import Iterator, Sequence
from dataclasses import replace
from itertools import pairwise
from typing import Any

import numpy as np
import pytest

from tests.simulation.scenes import GO, LOWER, STEP_S, UPPER, T, scene
from tint_sumo.config import AGGRESSIVE, CONSERVATIVE, EgoController, Idm, Mix, Population, Traffic
from tint_sumo.core.errors import InputError
from tint_sumo.scenes import SCENES, Scene, find_scene
from tint_sumo.scenes.geometry import measure_distances_m
from tint_sumo.simulation import SceneSimulation
from tint_sumo.simulation.demand import PlacedVehicle
from tint_sumo.simulation.ego import EgoRules, is_unsafe
from tint_sumo.simulation.sumo import NO_COLLISION_CHECK, SUMO_COLLISION_CHECK

SLOTS = ("present", "route", "front_m", "member", "vehicle_number")
EGOS = ("front_m", "speed_mps", "collided")


def state(simulation: SceneSimulation) -> dict[str, Any]:
    """Return a copy of the state of all replicas; empty slots are alike."""
    slots = {key: np.where(simulation.slots.present, getattr(simulation.slots, key), -1) for key in SLOTS}
    egos = {f"ego_{key}": getattr(simulation.egos, key).copy() for key in EGOS}
    return slots | egos | {"has_claimed": simulation.yielding.has_claimed.copy()}


def in_traffic(p_conservative: float | tuple[float, float], **changes: Any) -> Scene:
    return replace(T, traffic=Traffic(p_conservative=Mix.parse(p_conservative)), **changes)


DESIRED_MPS = np.array([0.0, 0.5, 3.0])


def history(simulation: SceneSimulation, replica: int, seed: int, steps: int = 150) -> list[dict[str, Any]]:
    """Return states of one replica under random actions that depend on the seed alone; other replicas stand."""
    rng = np.random.default_rng(seed)
    simulation.reset(replica, seed)
    states = []
    for step in range(steps):
        desired = np.zeros(simulation.replicas)
        desired[replica] = DESIRED_MPS[rng.integers(3)] if step % 5 else GO
        simulation.step(desired)
        states.append({key: values[replica] for key, values in state(simulation).items()})
    return states


def assert_same(first: list[dict[str, Any]], second: list[dict[str, Any]]) -> None:
    for a, b in zip(first, second, strict=True):
        for key in a:
            np.testing.assert_array_equal(a[key], b[key], err_msg=key)


@pytest.fixture(scope="module")
def batch() -> Iterator[SceneSimulation]:
    simulation = SceneSimulation(20, T)
    for replica in range(20):
        simulation.reset(replica, 1000 + replica)
    yield simulation
    simulation.close()


@pytest.mark.parametrize("seed", range(4))
def test_an_episode_depends_on_its_seed_alone(batch: SceneSimulation, seed: int) -> None:
    """The same in another replica, at another time, beside other episodes, and in a simulation of its own."""
    first = history(batch, 3, seed)
    assert_same(first, history(batch, 19, seed))
    alone = SceneSimulation(1, T)
    try:
        assert alone.backend == "traci"  # libsumo is taken by the batch
        assert_same(first, history(alone, 0, seed))
    finally:
        alone.close()


def test_other_seeds_give_other_episodes(batch: SceneSimulation) -> None:
    with pytest.raises(AssertionError):
        assert_same(history(batch, 0, 1), history(batch, 0, 2))


@pytest.fixture(scope="module")
def crowd() -> Iterator[tuple[SceneSimulation, list[Any]]]:
    """60 intersections with driving egos, and what happened in them."""
    simulation = SceneSimulation(60, in_traffic(0.25))
    rng = np.random.default_rng(0)
    for replica in range(60):
        simulation.reset(replica, [7, replica])
    states = [state(simulation)]
    for step in range(250):
        desired = rng.choice(DESIRED_MPS, 60) if step % 10 else np.full(60, GO)
        simulation.step(desired)
        for replica in range(60):
            if simulation.egos.collision[replica] or simulation.egos.front_m[replica] > T.ego.goal_m:
                simulation.reset(replica, [8, replica, step])
        states.append(state(simulation))
    yield simulation, states
    simulation.close()


def test_vehicles_keep_their_slots_and_slots_rest_between_vehicles(crowd: tuple[SceneSimulation, list[Any]]) -> None:
    simulation = SceneSimulation(8, T)
    try:
        for replica in range(8):
            simulation.reset(replica, replica)
        changes = 0
        before = simulation.slots.vehicle_number.copy()
        for _ in range(400):
            simulation.step(np.zeros(8))
            now = simulation.slots.vehicle_number.copy()
            changed = now != before
            assert ((now == -1) | (before == -1))[changed].all()
            changes += int(changed.sum())
            before = now
        assert changes > 200
    finally:
        simulation.close()


def test_vehicles_never_overlap_each_other_and_stay_on_the_street(crowd: tuple[SceneSimulation, list[Any]]) -> None:
    _, states = crowd
    for one in states:
        for lane in (LOWER, UPPER):
            here = (one["present"] > 0) & (one["route"] == lane)
            front_m = np.sort(np.where(here, one["front_m"], np.nan), axis=1)
            assert np.nanmin(np.diff(front_m, axis=1)) > 5.0
            assert np.nanmin(front_m) >= 5.0
            assert np.nanmax(front_m) <= 45.0
        assert (one["present"] > 0).sum(axis=1).max() <= T.max_vehicles


def test_traits_are_drawn_with_their_probability(crowd: tuple[SceneSimulation, list[Any]]) -> None:
    simulation, states = crowd
    yields = np.array([member.profile.yields for member in simulation.population])
    drawn = yields[states[0]["member"][states[0]["present"] > 0]]
    spread = 4 * (0.25 * 0.75 / len(drawn)) ** 0.5
    assert len(drawn) > 400
    assert drawn.mean() == pytest.approx(0.25, abs=spread)


def test_gaps_at_placement_are_those_of_the_follower(crowd: tuple[SceneSimulation, list[Any]]) -> None:
    simulation, states = crowd
    first = states[0]
    gaps: dict[str, list[float]] = {"conservative": [], "aggressive": []}
    for replica in range(60):
        for lane in (LOWER, UPPER):
            slots = np.flatnonzero((first["present"][replica] > 0) & (first["route"][replica] == lane))
            order = slots[np.argsort(-first["front_m"][replica, slots])]
            for leader, follower in pairwise(order):
                profile = simulation.population[first["member"][replica, follower]].profile
                gap_m = first["front_m"][replica, leader] - first["front_m"][replica, follower] - 5.0
                gaps[profile.name].append(float(gap_m))
    for profile in (CONSERVATIVE, AGGRESSIVE):
        low, high = profile.entry_gap_m
        assert low <= min(gaps[profile.name]) <= low + 0.2
        assert high - 0.2 <= max(gaps[profile.name]) <= high
        assert np.mean(gaps[profile.name]) == pytest.approx((low + high) / 2, abs=0.2)


def test_newcomers_find_the_room_they_want() -> None:
    simulation = SceneSimulation(8, T)
    try:
        for replica in range(8):
            simulation.reset(replica, [5, replica])
        entries = 0
        for _ in range(300):
            before = simulation.slots.vehicle_number.copy()
            simulation.step(np.zeros(8))
            for replica, slot in np.argwhere((before == -1) & simulation.slots.present):
                lane = simulation.slots.route[replica, slot]
                others = simulation.slots.present[replica] & (simulation.slots.route[replica] == lane)
                others[slot] = False
                gap_m = simulation.slots.front_m[replica, others].min(initial=np.inf) - 5.0 - 5.0
                low_m, high_m = simulation.population[simulation.slots.member[replica, slot]].profile.entry_gap_m
                assert simulation.slots.front_m[replica, slot] == 5.0
                assert low_m <= gap_m <= high_m + 3.0 * STEP_S  # within a step of finding its room
                entries += 1
        assert entries > 100
    finally:
        simulation.close()


def test_poisson_arrivals_are_sparser_than_saturated_ones_and_have_their_rate() -> None:
    rate_per_s, seconds, replicas = 0.1, 60, 40
    simulation = SceneSimulation(replicas, replace(T, traffic=Traffic(arrivals_per_s=rate_per_s)), with_ego=False)
    try:
        for replica in range(replicas):
            simulation.reset(replica, replica)
        placed = sum(simulation.vehicle_count)
        for _ in range(round(seconds / STEP_S)):
            simulation.step()
        arrived = sum(simulation.vehicle_count) - placed
        expected = rate_per_s * seconds * 2 * replicas
        assert arrived == pytest.approx(expected, abs=4 * expected**0.5)
    finally:
        simulation.close()


@pytest.mark.parametrize("tau_s", [0.7, 1.5])
def test_followers_obey_the_idm_formula(tau_s: float) -> None:
    """Treiber et al.: a [1 - (v/v0)^delta - (s*/s)^2], s* = s0 + max(0, v T + v dv / (2 sqrt(a b)))."""
    idm = Idm(tau_s=tau_s)
    played = replace(T, population=Population(idm=idm))
    with scene((UPPER, AGGRESSIVE, -19.0), (UPPER, CONSERVATIVE, -10.0), played=played) as simulation:
        follower = simulation.population[simulation.slots.member[0, 0]]
        speed = np.array([3.0, 2.4])
        checked = 0
        for _ in range(90):
            front_m = simulation.slots.front_m[0, :2].copy()
            simulation.step(np.array([0.0]))
            if not simulation.slots.present[0, :2].all():
                break
            now = (simulation.slots.front_m[0, :2] - front_m) / STEP_S
            gap_m, closing = front_m[1] - front_m[0] - 5.0, speed[0] - speed[1]
            braking = speed[0] * closing / (2 * (idm.accel_mps2 * idm.decel_mps2) ** 0.5)
            wanted_m = follower.min_gap_m + max(0.0, speed[0] * idm.tau_s + braking)
            ratio = (speed[0] / follower.desired_speed_mps) ** idm.delta
            accel = idm.accel_mps2 * (1.0 - ratio - (wanted_m / gap_m) ** 2)
            assert (now[0] - speed[0]) / STEP_S == pytest.approx(max(accel, -idm.emergency_decel_mps2), abs=1e-6)
            speed = now
            checked += 1
        assert checked > 50


@pytest.mark.parametrize("name", SCENES)
def test_the_modelled_ego_is_where_sumo_has_it(name: str) -> None:
    played = find_scene(name)
    with scene(played=played) as simulation:
        vehicle, half_m = simulation.link.connection.vehicle, played.vehicle.length_m / 2
        rng = np.random.default_rng(1)
        while simulation.egos.front_m[0] < played.ego.goal_m:
            simulation.step(np.array([rng.choice([0.5, 3.0, 3.0])]))
            ego_id = simulation.link.ego_ids[0]
            pose = simulation.egos.box[0]
            front = (pose["x_m"] + half_m * pose["heading_x"], pose["y_m"] + half_m * pose["heading_y"])
            assert vehicle.getSpeed(ego_id) == pytest.approx(simulation.egos.speed_mps[0], abs=1e-9)
            assert vehicle.getPosition(ego_id) == pytest.approx(front, abs=0.02)
            heading_deg = np.degrees(np.arctan2(pose["heading_x"], pose["heading_y"])) % 360.0
            assert vehicle.getAngle(ego_id) % 360.0 == pytest.approx(heading_deg, abs=0.5)


@pytest.mark.parametrize("name", SCENES)
def test_vehicles_are_where_sumo_has_them(name: str) -> None:
    simulation = SceneSimulation(3, find_scene(name))
    try:
        for replica in range(3):
            simulation.reset(replica, replica)
        vehicle, slots = simulation.link.connection.vehicle, simulation.slots
        half_m = simulation.scene.vehicle.length_m / 2
        for _ in range(20):
            for _ in range(15):
                simulation.step(np.zeros(3))
            for replica, slot in np.argwhere(slots.present):
                vehicle_id, pose = simulation.link.ids[replica][slot], slots.box[replica, slot]
                lanes = simulation.layout.routes[slots.route[replica, slot]].lanes
                front = (pose["x_m"] + half_m * pose["heading_x"], pose["y_m"] + half_m * pose["heading_y"])
                assert vehicle.getLaneID(vehicle_id) == lanes[simulation.lanes.stage[replica, slot]].format(
                    replica=replica
                )
                assert vehicle.getPosition(vehicle_id) == pytest.approx(front, abs=0.02)
    finally:
        simulation.close()


@pytest.mark.parametrize("name", SCENES)
def test_leaders_and_gaps_are_sumos(name: str) -> None:
    simulation = SceneSimulation(3, find_scene(name), with_ego=False)
    try:
        for replica in range(3):
            simulation.reset(replica, replica)
        vehicle, ids, slots = simulation.link.connection.vehicle, simulation.link.ids, simulation.slots
        seen = 0
        for _ in range(20):
            for _ in range(15):
                simulation.step()
            leader, gap_m = simulation.leaders()
            for replica, slot in np.argwhere(slots.present & (leader >= 0)):
                found = vehicle.getLeader(ids[replica][slot], 100.0)
                if found is None:  # SUMO looks no further than a driver needs to
                    assert gap_m[replica, slot] > 5.0
                    continue
                member = simulation.population[slots.member[replica, slot]]
                assert found[0] == ids[replica][leader[replica, slot]]
                assert found[1] + member.min_gap_m == pytest.approx(gap_m[replica, slot], abs=1e-6)
                seen += 1
        assert seen > 100
    finally:
        simulation.close()


def ego_distances_m(simulation: SceneSimulation) -> Any:
    distance_m, slots = np.empty(simulation.slots.present.shape), simulation.slots
    measure_distances_m(simulation.egos.box, slots.present, slots.box, np.inf, distance_m)
    return distance_m


def careless(replicas: int, collision_options: Sequence[str]) -> SceneSimulation:
    """Egos without a safety check among drivers who mostly do not yield."""
    controller = EgoController(unsafe_distance_m=0.0, closing_distance_m=0.0)
    played = in_traffic(0.2, ego=replace(T.ego, controller=controller))
    simulation = SceneSimulation(replicas, played, collision_options=collision_options)
    for replica in range(replicas):
        simulation.reset(replica, [3, replica])
    return simulation


def hits_by_sumo(simulation: SceneSimulation) -> dict[int, int]:
    """Return the slots of vehicles that collide with an ego according to SUMO, by replica."""
    hits = {}
    for event in simulation.link.connection.simulation.getCollisions():
        pair = {event.collider, event.victim}
        for vehicle_id in pair & simulation.link.index.keys():
            if pair - {vehicle_id} <= set(simulation.link.ego_ids):
                replica, slot = divmod(simulation.link.index[vehicle_id], T.max_vehicles)
                hits.setdefault(replica, slot)
    return hits


def test_collisions_are_those_that_sumo_sees() -> None:
    replicas = 40
    simulation = careless(replicas, SUMO_COLLISION_CHECK)
    try:
        rng = np.random.default_rng(3)
        seen: dict[int, int] = {}  # replica to the step of its collision
        at_once = late = 0
        for step in range(300):
            simulation.step(rng.choice(DESIRED_MPS, replicas) if step % 20 else np.full(replicas, GO))
            hits = hits_by_sumo(simulation)
            assert all(simulation.egos.collided[replica] for replica in hits)  # none that SUMO alone sees
            for replica in np.flatnonzero(simulation.egos.collided).tolist():
                collision = simulation.egos.collision[replica]
                assert collision is not None
                seen.setdefault(replica, step)
                if replica in hits:
                    assert hits[replica] == collision.slot
                    at_once += seen[replica] == step
                    late += seen[replica] < step
                    del seen[replica]
                    simulation.reset(replica, [4, replica, step])
            assert all(step - since < 2 for since in seen.values())  # SUMO sees each of them a step later at most
        assert at_once > 60
        assert late <= 0.02 * at_once  # a grazing contact
    finally:
        simulation.close()


def test_traffic_is_the_same_whether_or_not_sumo_looks_for_collisions() -> None:
    def run(collision_options: Sequence[str]) -> list[np.ndarray]:
        simulation = careless(10, collision_options)
        rng, states = np.random.default_rng(5), []
        try:
            for step in range(200):
                simulation.step(rng.choice(DESIRED_MPS, 10) if step % 20 else np.full(10, GO))
                states += state(simulation).values()
                for replica in np.flatnonzero(simulation.egos.collided).tolist():
                    simulation.reset(replica, [6, replica, step])
        finally:
            simulation.close()
        return states

    for one, other in zip(run(NO_COLLISION_CHECK), run(SUMO_COLLISION_CHECK), strict=True):
        np.testing.assert_array_equal(one, other)


def test_the_safety_check_misses_no_vehicle() -> None:
    """It measures distances of near vehicles alone; those of all vehicles give the same result."""
    replicas = 20
    simulation = SceneSimulation(replicas, T)
    try:
        for replica in range(replicas):
            simulation.reset(replica, [6, replica])
        rules = EgoRules.of(simulation.scene)
        rng = np.random.default_rng(6)
        found, before_m = [], np.full((replicas, T.max_vehicles), np.inf)
        for step in range(300):
            now_m = ego_distances_m(simulation)
            known = np.isfinite(before_m) & np.isfinite(now_m)
            approach_m = np.subtract(before_m, now_m, out=np.zeros_like(now_m), where=known)
            found.append(simulation.egos.unsafe.copy())
            expected = [
                any(is_unsafe(now, approach / STEP_S, rules) for now, approach in zip(*pair, strict=True))
                for pair in zip(now_m, approach_m, strict=True)
            ]
            np.testing.assert_array_equal(found[-1], expected)
            simulation.step(rng.choice(DESIRED_MPS, replicas) if step % 20 else np.full(replicas, GO))
            before_m = now_m
            for replica in np.flatnonzero(simulation.egos.collided | (simulation.egos.front_m > T.ego.goal_m)).tolist():
                simulation.reset(replica, [6, replica, step])
                before_m[replica] = np.inf
        assert 0.1 < np.mean(found) < 0.9
    finally:
        simulation.close()


def test_a_cleared_replica_is_empty_and_stays_so() -> None:
    simulation = SceneSimulation(2, T)
    try:
        for replica in range(2):
            simulation.reset(replica, replica)
        simulation.clear(0)
        for _ in range(50):
            simulation.step(np.full(2, GO))
        assert not simulation.slots.present[0].any()
        assert simulation.slots.present[1].any()
        simulation.reset(0, 0)
        assert simulation.slots.present[0].any()
    finally:
        simulation.close()


def test_an_ego_may_drive_off_the_street() -> None:
    with scene() as simulation:
        for _ in range(200):
            simulation.step(np.array([GO]))
        assert simulation.egos.collision[0] is None


def test_a_scene_holds_at_most_twelve_vehicles() -> None:
    with scene() as simulation, pytest.raises(InputError, match="at most 12 vehicles"):
        simulation.reset_to(0, [PlacedVehicle(0, 5.0, 0)] * 13)


def test_a_range_gives_each_episode_another_mix() -> None:
    replicas = 60
    simulation = SceneSimulation(replicas, in_traffic((0.1, 0.9)), with_ego=False)
    try:
        for replica in range(replicas):
            simulation.reset(replica, replica)
        shares = [simulation.yielding.yields[row][simulation.slots.present[row]].mean() for row in range(replicas)]
        # With one mix for all, shares of 10 drivers would vary by no more than sqrt(0.25 / 10) = 0.16.
        assert np.mean(shares) == pytest.approx(0.5, abs=0.1)
        assert np.std(shares) > 0.22
    finally:
        simulation.close()


def test_a_range_of_one_number_is_that_number(batch: SceneSimulation) -> None:
    single = SceneSimulation(1, in_traffic((0.4, 0.4)), backend="traci")
    try:
        assert_same(history(single, 0, seed=3), history(batch, 1, seed=3))
    finally:
        single.close()


@pytest.mark.parametrize("p", [-0.1, 1.1, float("nan")])
def test_probabilities_outside_the_unit_interval_are_refused(p: float) -> None:
    with pytest.raises(InputError, match=r"must be a probability in \[0, 1\]"):
        Traffic(p_conservative=Mix.parse(p))


def test_a_scene_of_few_slots_begins_with_those_who_have_come_furthest() -> None:
    few, all_of_them = (_fronts_at_the_beginning(slots) for slots in (4, 12))
    assert few == [fronts_m[-4:] for fronts_m in all_of_them]


def _fronts_at_the_beginning(slots: int) -> list[list[float]]:
    """Return the fronts of vehicles at the beginning of some episodes, sorted."""
    simulation = SceneSimulation(1, replace(T, max_vehicles=slots), with_ego=False)
    fronts_m = []
    for seed in range(5):
        simulation.reset(0, seed)
        fronts_m.append(sorted(simulation.slots.front_m[0][simulation.slots.present[0]].tolist()))
        simulation.step()
    simulation.close()
    return fronts_m
