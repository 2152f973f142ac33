import math
from dataclasses import replace
from itertools import count, product

import numpy as np
import pytest

from tint_sumo.scenes import T_INTERSECTION, find_scene
from tint_sumo.scenes.geometry import POSE, pose_distance_m
from tint_sumo.scenes.layout import layout
from tint_sumo.simulation.ego import (
    Collision,
    EgoRules,
    Egos,
    acceleration_mps2,
    check_safety,
    drive,
    is_behind,
    is_unsafe,
    update_claims,
)
from tint_sumo.simulation.slots import Slots

T = find_scene(T_INTERSECTION)
RULES = EgoRules.of(T)
CONTROLLER = (  # in the order of the rules
    "gain_per_s",
    "accel_limit_mps2",
    "braking_gain_per_s",
    "braking_limit_mps2",
    "unsafe_distance_m",
    "closing_distance_m",
    "closing_speed_mps",
)


@pytest.mark.parametrize(
    ("speed_mps", "desired_mps", "unsafe", "expected"),
    [
        (0.0, 0.5, False, 1.0),  # gain 2 per second
        (2.0, 3.0, False, 2.0),
        (0.0, 3.0, False, 3.0),  # limited to 3
        (3.0, 0.0, False, -3.0),
        (0.5, 3.0, True, -2.5),  # the safety check brakes with gain 5
        (3.0, 3.0, True, -6.0),  # limited to 6
        (0.0, 3.0, True, 0.0),
    ],
)
def test_acceleration(speed_mps: float, desired_mps: float, unsafe: bool, expected: float) -> None:
    assert acceleration_mps2(speed_mps, desired_mps, unsafe, RULES) == pytest.approx(expected)


@pytest.mark.parametrize(
    ("distance_m", "closing_mps", "unsafe"),
    [
        (0.79, -1.0, True),  # too close, even while moving apart
        (0.81, 0.9, False),
        (0.99, 1.1, True),  # close and closing
        (1.01, 3.0, False),
        (math.inf, 0.0, False),  # nobody there
    ],
)
def test_safety_check(distance_m: float, closing_mps: float, unsafe: bool) -> None:
    assert is_unsafe(distance_m, closing_mps, RULES) == unsafe


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
    egos = Egos(1, layout(T))
    egos.front_m[0], egos.speed_mps[0] = layout(T).zones.enter_m[0] + past_m, speed_mps
    assert egos.update_claims() == claimed
    assert egos.has_claimed.tolist() == [[claimed, False]]
    assert not egos.update_claims()


def test_speed_along_a_lane_is_no_claim_on_it() -> None:
    """In its turn the ego comes closer to the second lane by only a part of its speed."""
    zones = layout(T).zones
    egos = Egos(1, layout(T))
    egos.front_m[0] = zones.enter_m[1] + 0.1
    for speed_mps, claimed in ((0.6, False), (0.7, True)):
        egos.speed_mps[0] = speed_mps
        egos.update_claims()
        assert egos.has_claimed.tolist() == [[True, claimed]]


def test_the_rules_are_those_of_the_scene() -> None:
    controller = replace(T.ego.controller, **dict(zip(CONTROLLER, count(2.0), strict=False)), watches_behind=False)
    claim, vehicle = replace(T.claim, approach_speed_mps=0.75), replace(T.vehicle, length_m=4.0)
    changed = replace(T, ego=replace(T.ego, controller=controller), claim=claim, vehicle=vehicle, step_s=0.05)
    rules = EgoRules.of(changed)
    assert rules == EgoRules(*(getattr(controller, name) for name in CONTROLLER), 0.75, False, 2.0, 0.05, 0.02)


def test_egos_move_by_their_new_speed_and_never_backwards() -> None:
    speed_mps, front_m = np.array([0.0, 1.0, 0.2, 3.0]), np.array([5.0, 6.0, 7.0, 8.0])
    unsafe = np.array([False, False, True, False])
    drive(np.array([3.0, 1.0, 3.0, 0.0]), unsafe, RULES._replace(braking_gain_per_s=20.0), speed_mps, front_m)
    np.testing.assert_allclose(speed_mps, [0.3, 1.0, 0.0, 2.7])
    np.testing.assert_allclose(front_m, [5.03, 6.1, 7.0, 8.27])


@pytest.mark.parametrize(("distance_m", "closing_mps"), [(0.8, 0.0), (0.8, 1.0), (1.0, 1.1), (0.9, 1.0)])
def test_at_its_very_limits_the_ego_is_safe(distance_m: float, closing_mps: float) -> None:
    assert not is_unsafe(distance_m, closing_mps, RULES)


def poses(*values: tuple[float, float, float, float]) -> np.ndarray:
    return np.array(list(values), POSE)


@pytest.mark.parametrize(
    ("x_m", "y_m", "behind"),
    [(10.0, 17.4, True), (10.0, 17.6, False), (15.0, 17.4, True), (15.0, 17.6, False), (10.0, 25.0, False)],
)
def test_behind_is_what_lies_behind_the_back(x_m: float, y_m: float, behind: bool) -> None:
    ego, vehicle = poses((10.0, 20.0, 0.0, 1.0), (x_m, y_m, 1.0, 0.0))
    assert is_behind(vehicle, ego, 2.5) == behind
    ego, vehicle = poses((20.0, 10.0, -1.0, 0.0), (40.0 - y_m, x_m, 0.0, 1.0))
    assert is_behind(vehicle, ego, 2.5) == behind


NEAR, FAR, AWAY = 0.5, 5.0, math.inf
AHEAD, BEHIND = (0.0, 5.0, 1.0, 0.0), (0.0, -5.0, 1.0, 0.0)


def checked(
    now_m: list[float], before_m: list[float], vehicles: list[tuple[float, float, float, float]], rules: EgoRules
) -> tuple[bool, bool, int]:
    """Whether one ego is unsafe, whether it has newly touched a vehicle, and which one."""
    unsafe, hit = np.array([True]), np.array([-1])
    egos = poses((0.0, 0.0, 0.0, 1.0))
    new = check_safety(np.array([now_m]), np.array([before_m]), egos, poses(*vehicles)[None], rules, unsafe, hit)
    return bool(unsafe[0]), bool(new), int(hit[0])


@pytest.mark.parametrize(
    ("now_m", "before_m", "unsafe"),
    [
        (AWAY, AWAY, False),
        (0.95, 1.04, False),  # closing at 0.9 m/s
        (0.95, 1.06, True),  # closing at 1.1 m/s
        (0.95, AWAY, False),  # it has just appeared
        (0.95, 0.5, False),  # moving apart
        (NEAR, AWAY, True),
    ],
)
def test_an_ego_is_unsafe_by_distance_and_by_what_it_closes_in_a_step(
    now_m: float, before_m: float, unsafe: bool
) -> None:
    assert checked([now_m], [before_m], [AHEAD], RULES) == (unsafe, False, -1)
    assert checked([FAR, now_m, FAR], [FAR, before_m, FAR], [AHEAD] * 3, RULES) == (unsafe, False, -1)


@pytest.mark.parametrize(("watches_behind", "unsafe"), [(True, True), (False, False)])
def test_vehicles_behind_count_where_the_ego_watches_them(watches_behind: bool, unsafe: bool) -> None:
    rules = RULES._replace(watches_behind=watches_behind)
    assert checked([NEAR], [NEAR], [BEHIND], rules)[0] == unsafe
    assert checked([NEAR, NEAR], [NEAR, NEAR], [BEHIND, AHEAD], rules)[0]
    assert checked([NEAR, NEAR], [NEAR, NEAR], [AHEAD, BEHIND], rules)[0]


def test_the_first_vehicle_that_is_touched_is_kept() -> None:
    assert checked([FAR, 0.0, 0.0], [FAR, 0.1, 0.1], [AHEAD] * 3, RULES) == (True, True, 1)
    assert checked([0.0], [0.1], [AHEAD], RULES) == (True, True, 0)
    unsafe, hit = np.array([False, False]), np.array([2, -1])
    egos, vehicles = poses(*[(0.0, 0.0, 0.0, 1.0)] * 2), np.stack([poses(AHEAD)] * 2)
    assert not check_safety(np.array([[0.0], [FAR]]), np.full((2, 1), FAR), egos, vehicles, RULES, unsafe, hit)
    assert hit.tolist() == [2, -1] and unsafe.tolist() == [True, False]


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
    assert update_claims(*now, *zones, RULES, before, changed) == claimed
    assert before.tolist() == changed.tolist() == [[claimed, False]]
    assert not update_claims(*now, *zones, RULES, before, changed) and not changed.any()
    assert before.tolist() == [[claimed, False]]
    assert update_claims(np.zeros(1), np.zeros(1), *zones, RULES, before, changed) == claimed
    assert changed.tolist() == [[claimed, False]] and not before.any()


def test_the_direction_counts_where_the_ego_is() -> None:
    towards = np.zeros((1, 600))
    towards[0, 550] = 1.0  # at 11 m
    zones = np.array([10.0]), np.array([99.0]), towards
    for front_m, claimed in ((11.0001, True), (11.0201, False), (10.9999, False)):
        found = np.zeros((1, 1), bool)
        update_claims(np.array([front_m]), np.array([3.0]), *zones, RULES, found, np.zeros((1, 1), bool))
        assert found[0, 0] == claimed, front_m


def test_an_ego_begins_at_its_start_and_is_forgotten_whole() -> None:
    egos = Egos(2, layout(T))
    egos.begin(1)
    assert egos.front_m.tolist() == [0.0, T.ego.start_m] and not egos.collided.any()
    assert (egos.pose["x_m"][1], egos.pose["y_m"][1]) == pytest.approx((0.0, T.ego.start_m - 22.5))
    fresh = {name: value.copy() for name, value in vars(egos).items() if isinstance(value, np.ndarray)}
    egos.front_m[1] = egos.speed_mps[1] = egos.distance_m[1] = egos._was_distance_m[1] = 3.0
    egos.unsafe[1] = egos.has_claimed[1] = egos.claim_changed[1] = True
    egos._hit_slot[1], egos.collision[1] = 4, Collision(4, 0, "lower", 0.0, 0.0)
    assert egos.collided.tolist() == [False, True]
    egos.begin(1)
    assert all(getattr(egos, name).tolist() == value.tolist() for name, value in fresh.items())
    assert egos.collision == [None, None]


def test_an_ego_looks_around_and_remembers_the_first_collision() -> None:
    egos, slots = Egos(1, layout(T)), Slots(1, layout(T))
    egos.begin(0)
    egos.look_around(slots)
    assert np.isinf(egos.distance_m).all() and not egos.unsafe[0] and egos.collision == [None]
    egos.front_m[0] = 25.0
    egos.drive(np.array([0.0]))
    slots.take(0, 3, 0, 25.0, member=9, number=0)  # its centre is at x = 0 on the lower lane, as the ego's is nearly
    egos.look_around(slots)
    assert egos.distance_m[0, 3] == 0.0 and np.isinf(np.delete(egos.distance_m[0], 3)).all()
    assert egos.unsafe[0] and egos.collided[0]
    hit = egos.collision[0]
    assert hit is not None and (hit.slot, hit.member, hit.route) == (3, 9, "lower")
    assert (hit.ego_x_m, hit.ego_y_m) == (egos.pose["x_m"][0], egos.pose["y_m"][0])
    slots.take(0, 5, 0, 25.0, member=2, number=1)
    egos.look_around(slots)
    assert egos.collision[0] is hit


def test_vehicles_are_followed_from_so_far_that_closing_is_known() -> None:
    """A metre before they are close enough to count, and a step later they are not yet."""
    egos, slots = Egos(1, layout(T)), Slots(1, layout(T))
    seen_m = []
    for ego_m in (19.1, 24.0, 28.0, 33.0):
        egos.front_m[0] = ego_m
        egos.drive(np.array([0.0]))
        for route, front_m in product((0, 1), np.arange(5.5, 45.0, 0.5)):
            slots.take(0, 0, route, front_m, member=0, number=0)
            egos.look_around(slots)
            distance_m = pose_distance_m(egos.pose[0], slots.pose[0, 0], 5.0, 2.0, 5.0, 2.0)
            if distance_m < 2.0:
                assert egos.distance_m[0, 0] == pytest.approx(distance_m)
                seen_m.append(distance_m)
    assert sum(distance_m > 1.0 for distance_m in seen_m) > 20


def test_a_vehicle_that_has_just_appeared_was_infinitely_far() -> None:
    egos, slots = Egos(1, layout(T)), Slots(1, layout(T))
    egos.begin(0)
    egos.look_around(slots)
    egos.front_m[0] = 19.1  # 0.9 m short of the lower lane, whose vehicles are 2 m wide and drive in its middle
    egos.drive(np.array([0.0]))
    slots.take(0, 0, 0, 22.5, member=0, number=0)
    egos.look_around(slots)
    assert egos.distance_m[0, 0] == pytest.approx(1.9, abs=0.01)
    assert np.isinf(egos._was_distance_m[0, 0])
    egos.look_around(slots)
    assert egos._was_distance_m[0, 0] == egos.distance_m[0, 0]
