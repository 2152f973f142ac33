"""The ego's claims, and the drivers who react to them; nothing is simulated."""

from dataclasses import replace

import numpy as np
import pytest

from tests.simulation.scenes import LOWER, UPPER, T
from tint_sumo.scenes.drivers import members
from tint_sumo.scenes.geometry import SPACING_M
from tint_sumo.scenes.layout import layout
from tint_sumo.simulation.ego import Egos
from tint_sumo.simulation.slots import Slots
from tint_sumo.simulation.yielding import Yielding, update_claims


class FakeLink:
    """A link without SUMO: drivers at 2 m/s; it keeps the reactions that it is given."""

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
        slots.take(1, slot, route=route, member=member, number=slot, size_m=(5.0, 2.0))
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
    slots.take(1, 0, route=LOWER, member=0, number=3, size_m=(5.0, 2.0))
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
