"""The ego's claims, the drivers who react to them, and collisions with the others."""

from dataclasses import replace

import numpy as np
import pytest

from tests.simulation.scenes import CREEP, GO, LOWER, STEM_M, STEP_S, STOP, UPPER, T, scene, speeds, stand_at, until
from tint_sumo.config import AGGRESSIVE, CONSERVATIVE, Mix, Traffic
from tint_sumo.scenes import SCENES, find_scene
from tint_sumo.scenes.drivers import members
from tint_sumo.scenes.geometry import SPACING_M
from tint_sumo.scenes.layout import layout
from tint_sumo.simulation import SceneSimulation
from tint_sumo.simulation.ego import Egos
from tint_sumo.simulation.slots import Slots
from tint_sumo.simulation.yielding import Yielding, update_claims


def test_conservative_lower_lane_driver_stops_for_a_claiming_ego() -> None:
    with scene((LOWER, CONSERVATIVE, 18.0)) as simulation:
        stand_at(simulation, 1.2)  # front past y = 1: in the vehicles' path
        assert simulation.yielding.has_claimed[0].tolist() == [True, False]
        assert min(speeds(simulation, STOP)) < 0.01
        assert simulation.egos.collision[0] is None


def test_conservative_lower_lane_driver_passes_an_ego_that_stands_short_of_its_path() -> None:
    with scene((LOWER, CONSERVATIVE, 18.0)) as simulation:
        stand_at(simulation, 0.7)  # in the lane, but behind y = 1
        assert not simulation.yielding.has_claimed[0].any()
        assert min(speeds(simulation, STOP)) == pytest.approx(2.4)
        assert not simulation.slots.present[0, 0]


def test_conservative_driver_leaves_room_for_the_ego_to_drive_on() -> None:
    with scene((LOWER, CONSERVATIVE, 12.0)) as simulation:
        assert min(speeds(simulation, GO)) < 1.0
        assert simulation.egos.front_m[0] > simulation.scene.ego.goal_m
        assert simulation.egos.collision[0] is None


@pytest.mark.parametrize(("path_m", "reacts"), [(4.2, False), (6.3, True)])
def test_upper_lane_driver_reacts_only_past_y_4(path_m: float, reacts: bool) -> None:
    with scene((UPPER, CONSERVATIVE, -18.0)) as simulation:
        stand_at(simulation, path_m)
        front_m, zones = simulation.egos.front_m[0], simulation.layout.zones
        assert (front_m > zones.inside_m[UPPER]) if reacts else (front_m < zones.enter_m[UPPER])
        slowest_mps = min(speeds(simulation, STOP))
        assert slowest_mps < 0.05 if reacts else slowest_mps == pytest.approx(2.4)
        assert simulation.egos.collision[0] is None


@pytest.mark.parametrize(("lane", "x_m"), [(LOWER, 14.0), (UPPER, -14.0)])
def test_aggressive_driver_hits_an_ego_in_its_way(lane: int, x_m: float) -> None:
    with scene((lane, AGGRESSIVE, x_m)) as simulation:
        assert min(speeds(simulation, GO)) == pytest.approx(3.0)
        collision = simulation.egos.collision[0]
        assert collision is not None
        assert (simulation.population[collision.member].profile, collision.slot) == (AGGRESSIVE, 0)
        assert collision.route == ("lower" if lane == LOWER else "upper")


@pytest.mark.parametrize(("profile", "hits"), [(CONSERVATIVE, False), (AGGRESSIVE, True)])
def test_on_the_exit_lane_only_aggressive_drivers_run_into_a_slow_ego(profile: object, hits: bool) -> None:
    with scene((UPPER, profile, -20.0)) as simulation:  # type: ignore[arg-type]
        until(simulation, GO, lambda: bool(simulation.egos.front_m[0] > STEM_M + 12.5))
        slowest_mps = min(speeds(simulation, CREEP))
        assert slowest_mps < 0.6 if not hits else slowest_mps == pytest.approx(3.0)
        assert (simulation.egos.collision[0] is not None) is hits


def test_drivers_go_on_when_the_ego_gives_up_its_claim() -> None:
    with scene((LOWER, CONSERVATIVE, 18.0)) as simulation:
        stand_at(simulation, -0.3)
        until(simulation, GO, lambda: bool(simulation.yielding.has_claimed[0, LOWER]))
        until(simulation, STOP, lambda: not simulation.yielding.has_claimed[0, LOWER])
        assert simulation.egos.front_m[0] < simulation.layout.zones.inside_m[LOWER]
        assert speeds(simulation, STOP)[-1] == pytest.approx(2.4, abs=0.01)
        assert simulation.egos.collision[0] is None


def test_only_drivers_that_can_stop_clear_of_the_egos_way_yield() -> None:
    answers = []
    for x_m in np.arange(3.0, 12.0, 0.5):
        with scene((LOWER, CONSERVATIVE, x_m)) as simulation:
            before_m = 0.0
            while not simulation.yielding.has_claimed[0, LOWER]:
                before_m = simulation.slots.front_m[0, 0]
                simulation.step(np.array([GO]))
            can_stop = simulation.layout.zones.stop_line_m[
                LOWER
            ] - before_m >= simulation.scene.claim.stopping_distance_m(2.4)
            assert simulation.yielding.reacts[0, 0] == can_stop
            answers.append(can_stop)
            slowest_mps = min(speeds(simulation, GO))
            assert slowest_mps < 2.3 if can_stop else slowest_mps == pytest.approx(2.4, abs=0.01)
            assert (simulation.egos.collision[0] is None) or not can_stop
    assert {True, False} == set(answers)


@pytest.mark.parametrize("p_conservative", [0.25, 0.6, 1.0])
@pytest.mark.parametrize("hesitates", [False, True])
@pytest.mark.parametrize("name", SCENES)
def test_ego_and_driver_never_wait_for_each_other(name: str, p_conservative: float, hesitates: bool) -> None:
    """Nobody but standing drivers holds an ego that wants to drive for more than 3 s, at any time in any episode."""
    replicas, rng = 32, np.random.default_rng(7)
    played = replace(find_scene(name), traffic=Traffic(Mix(p_conservative)))
    simulation = SceneSimulation(replicas, played)
    try:
        for replica in range(replicas):
            simulation.reset(replica, replica)
        waited_steps, desired_mps, ended = np.zeros(replicas, int), np.full(replicas, GO), 0
        for step in range(600):
            if hesitates and step % 10 == 0:
                desired_mps = rng.choice([GO, GO, CREEP, STOP], replicas)
            before_m = simulation.slots.front_m.copy()
            simulation.step(desired_mps)
            near = simulation.slots.present & (
                simulation.egos.distance_m < simulation.scene.ego.controller.closing_distance_m
            )
            stands = simulation.slots.present & (np.abs(simulation.slots.front_m - before_m) < 1e-3)
            held = (near & stands & simulation.yielding.yields).any(axis=1) & ~(near & ~stands).any(axis=1)
            waits = held & (desired_mps == GO) & (simulation.egos.speed_mps < 1e-2)
            waited_steps = np.where(waits, waited_steps + 1, 0)
            assert waited_steps.max() <= 3.0 / STEP_S
            for replica in np.flatnonzero(
                simulation.egos.collided | (simulation.egos.front_m > played.ego.goal_m)
            ).tolist():
                ended += 1
                simulation.reset(replica, replicas + ended)
        assert ended > replicas  # the roads are full of encounters
    finally:
        simulation.close()


def test_a_collision_is_latched() -> None:
    with scene((LOWER, AGGRESSIVE, 14.0), (LOWER, AGGRESSIVE, 20.0)) as simulation:
        until(simulation, GO, lambda: simulation.egos.collision[0] is not None)
        first = simulation.egos.collision[0]
        speeds(simulation, STOP, seconds=4.0)
        assert simulation.egos.collision[0] is first


class FakeLink:
    """In place of SUMO: drivers at 2 m/s; keeps the reactions that it is given."""

    def __init__(self) -> None:
        self.reactions: list[tuple[int, int, bool, float]] = []

    def speed_mps(self, replica: int, slot: int) -> float:
        return 2.0

    def react(self, replica: int, slot: int, reacts: bool, min_gap_m: float) -> None:
        self.reactions.append((replica, slot, reacts, round(min_gap_m, 6)))


ONE_EACH = members(replace(T.population, members=1))
CLAIMS_LOWER_M = layout(T).zones.inside_m[LOWER] + 0.1  # the ego's front


def unlinked(replicas: int, link: FakeLink | None = None, slots: Slots | None = None) -> Yielding:
    slots = slots or Slots(replicas, T.max_vehicles)
    return Yielding(ONE_EACH, layout(T), slots, link or FakeLink())  # type: ignore[arg-type]


@pytest.fixture
def faked() -> tuple[FakeLink, Yielding, Slots, Egos]:
    """Two replicas; in the second one, slot 0 and 1 hold drivers on the lower lane, of which the first one yields."""
    link, slots = FakeLink(), Slots(2, T.max_vehicles)
    for slot, (route, member) in enumerate([(LOWER, 0), (LOWER, 1), (UPPER, 0)]):
        slots.take(1, slot, route=route, member=member, number=slot, length_m=5.0, width_m=2.0)
        slots.front_m[1, slot] = 8.0
    return link, unlinked(2, link, slots), slots, Egos(2, T)


def test_slots_of_drivers_who_yield(faked: tuple[FakeLink, Yielding, Slots, Egos]) -> None:
    assert faked[1].yields.tolist() == [[False] * T.max_vehicles, [True, False, True] + [False] * (T.max_vehicles - 3)]


def test_the_yielding_drivers_of_a_claimed_route_react(faked: tuple[FakeLink, Yielding, Slots, Egos]) -> None:
    link, yielding, _, egos = faked
    gap_m, zones = ONE_EACH[0].min_gap_m, layout(T).zones
    yielding.update(egos)
    assert not link.reactions
    egos.front_m[1] = CLAIMS_LOWER_M
    yielding.update(egos)
    assert link.reactions == [(1, 0, True, round(gap_m + T.claim.courtesy_gap_m, 6))]
    assert np.argwhere(yielding.reacts).tolist() == [[1, 0]]
    egos.front_m[1] = 0.0
    yielding.update(egos)
    yielding.update(egos)
    assert link.reactions[1:] == [(1, 0, False, round(gap_m, 6))] and not yielding.reacts.any()
    egos.front_m[1] = zones.inside_m[UPPER] + 0.1
    yielding.update(egos)
    assert np.argwhere(yielding.reacts).tolist() == [[1, 0], [1, 2]]
    yielding.leave(1, 2)
    assert np.argwhere(yielding.reacts).tolist() == [[1, 0]] and len(link.reactions) == 4


def test_a_driver_who_enters_a_claimed_route_reacts(faked: tuple[FakeLink, Yielding, Slots, Egos]) -> None:
    link, yielding, slots, egos = faked
    yielding.enter(1, 0, 2.0)
    assert not link.reactions
    slots.leave(1, 0)
    egos.front_m[1] = CLAIMS_LOWER_M
    yielding.update(egos)
    assert not link.reactions
    slots.take(1, 0, route=LOWER, member=0, number=3, length_m=5.0, width_m=2.0)
    yielding.enter(1, 0, 2.0)
    yielding.enter(1, 2, 2.0)
    assert np.argwhere(yielding.reacts).tolist() == [[1, 0]]


@pytest.mark.parametrize(("past_m", "reacts"), [(-1e-6, True), (1e-6, False)])
def test_a_driver_reacts_if_it_can_still_stop(
    faked: tuple[FakeLink, Yielding, Slots, Egos], past_m: float, reacts: bool
) -> None:
    link, yielding, slots, egos = faked
    stopping_m = 2.0 * T.claim.reaction_time_s + 2.0**2 / (2.0 * T.claim.braking_mps2)
    slots.front_m[1, 0] = layout(T).zones.stop_line_m[LOWER] - stopping_m + past_m
    egos.front_m[1] = CLAIMS_LOWER_M
    yielding.update(egos)
    assert yielding.reacts[1, 0] == bool(link.reactions) == reacts


@pytest.mark.parametrize(
    ("past_m", "speed_mps", "claimed"),
    [
        (-0.1, 3.0, False),
        (0.1, 0.6, True),
        (0.1, 0.5, False),  # creeping is no claim
        (0.9, 0.0, False),  # nor is standing short of the vehicles' path
        (1.1, 0.0, True),
    ],
)
def test_claims_on_the_first_lane(past_m: float, speed_mps: float, claimed: bool) -> None:
    yielding, egos = unlinked(1), Egos(1, T)
    egos.front_m[0], egos.speed_mps[0] = layout(T).zones.enter_m[0] + past_m, speed_mps
    yielding.update(egos)
    assert yielding.has_claimed.tolist() == [[claimed, False]]
    yielding.clear(0)
    assert not yielding.has_claimed.any()


def test_speed_along_a_lane_is_no_claim_on_it() -> None:
    """In its turn the ego comes closer to the second lane by only a part of its speed."""
    zones = layout(T).zones
    yielding, egos = unlinked(1), Egos(1, T)
    egos.front_m[0] = zones.enter_m[1] + 0.1
    for speed_mps, claimed in ((0.6, False), (0.7, True)):
        egos.speed_mps[0] = speed_mps
        yielding.update(egos)
        assert yielding.has_claimed.tolist() == [[True, claimed]]


@pytest.mark.parametrize(
    ("front_m", "speed_mps", "claimed"),
    [
        (10.0, 3.0, False),  # not yet past the border
        (10.01, 0.51, True),
        (10.01, 0.5, False),
        (11.0, 0.0, False),
        (11.01, 0.0, True),
        (19.0, 0.6, True),  # beyond its way's last point, that one counts
        (-1.0, 3.0, False),
    ],
)
def test_a_claim_is_an_ego_past_the_border_that_moves_in_or_stands_in_the_path(
    front_m: float, speed_mps: float, claimed: bool
) -> None:
    towards = np.array([[1.0] * 600, [0.0] * 600])
    zones = np.array([10.0, 10.0]), np.array([11.0, 99.0]), towards
    before, changed = np.zeros((1, 2), bool), np.ones((1, 2), bool)
    now = np.array([front_m]), np.array([speed_mps])
    assert update_claims(*now, *zones, SPACING_M, 0.5, before, changed) == claimed
    assert before.tolist() == changed.tolist() == [[claimed, False]]
    assert not update_claims(*now, *zones, SPACING_M, 0.5, before, changed) and not changed.any()
    assert before.tolist() == [[claimed, False]]
    assert update_claims(np.zeros(1), np.zeros(1), *zones, SPACING_M, 0.5, before, changed) == claimed
    assert changed.tolist() == [[claimed, False]] and not before.any()


def test_the_direction_counts_where_the_ego_is() -> None:
    towards = np.zeros((1, 600))
    towards[0, 550] = 1.0  # at 11 m
    zones = np.array([10.0]), np.array([99.0]), towards
    for front_m, claimed in ((11.0001, True), (11.0201, False), (10.9999, False)):
        found = np.zeros((1, 1), bool)
        update_claims(np.array([front_m]), np.array([3.0]), *zones, SPACING_M, 0.5, found, np.zeros((1, 1), bool))
        assert found[0, 0] == claimed, front_m
