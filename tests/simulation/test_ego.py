"""The ego's control and its safety check; nothing is simulated."""

import math
from collections.abc import Callable
from dataclasses import replace
from itertools import count, product

import numpy as np
import pytest

from tests.scenes.networks import UserNetwork
from tint_sumo.config import DRIVER_PROFILES
from tint_sumo.scenes import T_INTERSECTION, find_scene
from tint_sumo.scenes.geometry import BOX, Boxes, clearance_m, place
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


def test_the_rules_are_those_of_the_scene() -> None:
    controller = replace(T.ego.controller, **dict(zip(CONTROLLER, count(2.0), strict=False)), watches_behind=False)
    rules = EgoRules.of(replace(T, ego=replace(T.ego, controller=controller), step_s=0.05))
    assert rules == EgoRules(*(getattr(controller, name) for name in CONTROLLER), False, 0.05)


@pytest.mark.parametrize("step_s", [0.1, 0.5, 1.0])
def test_the_ego_keeps_its_desired_speed_in_steps_of_any_length(step_s: float) -> None:
    rules, speed_mps, speeds_mps = EgoRules.of(replace(T, step_s=step_s)), np.zeros(1), list[float]()
    for _ in range(30):
        drive(np.array([0.5]), np.zeros(1, bool), rules, speed_mps, np.zeros(1))
        speeds_mps.append(float(speed_mps[0]))
    assert max(speeds_mps) <= 0.5
    assert speeds_mps[-1] == pytest.approx(0.5, abs=0.01)


def test_the_ego_does_not_overshoot_in_sumo_configurations(user_network: Callable[[str], UserNetwork]) -> None:
    assert EgoRules.of(user_network("grid").scene()).gain_per_s == 1.0
    assert EgoRules.of(user_network("merge").scene()).gain_per_s == 2.0


def test_egos_move_by_their_new_speed_and_never_backwards() -> None:
    speed_mps, front_m = np.array([0.0, 1.0, 0.2, 3.0]), np.array([5.0, 6.0, 7.0, 8.0])
    unsafe = np.array([False, False, True, False])
    drive(np.array([3.0, 1.0, 3.0, 0.0]), unsafe, RULES._replace(braking_gain_per_s=20.0), speed_mps, front_m)
    np.testing.assert_allclose(speed_mps, [0.3, 1.0, 0.0, 2.7])
    np.testing.assert_allclose(front_m, [5.03, 6.1, 7.0, 8.27])


@pytest.mark.parametrize(("distance_m", "closing_mps"), [(0.8, 0.0), (0.8, 1.0), (1.0, 1.1), (0.9, 1.0)])
def test_at_its_very_limits_the_ego_is_safe(distance_m: float, closing_mps: float) -> None:
    assert not is_unsafe(distance_m, closing_mps, RULES)


def boxes(*values: tuple[float, float, float, float]) -> Boxes:
    """Return boxes of 5 m by 2 m by their centres and headings."""
    return np.array([(*value, 5.0, 2.0) for value in values], BOX)


@pytest.mark.parametrize(
    ("x_m", "y_m", "behind"),
    [(10.0, 17.4, True), (10.0, 17.6, False), (15.0, 17.4, True), (15.0, 17.6, False), (10.0, 25.0, False)],
)
def test_behind_is_what_lies_behind_the_back(x_m: float, y_m: float, behind: bool) -> None:
    ego, vehicle = boxes((10.0, 20.0, 0.0, 1.0), (x_m, y_m, 1.0, 0.0))
    assert is_behind(vehicle, ego) == behind
    ego, vehicle = boxes((20.0, 10.0, -1.0, 0.0), (40.0 - y_m, x_m, 0.0, 1.0))
    assert is_behind(vehicle, ego) == behind


NEAR, FAR, AWAY = 0.5, 5.0, math.inf
AHEAD, BEHIND = (0.0, 5.0, 1.0, 0.0), (0.0, -5.0, 1.0, 0.0)


def checked(
    now_m: list[float], before_m: list[float], vehicles: list[tuple[float, float, float, float]], rules: EgoRules
) -> tuple[bool, bool, int]:
    """Return whether an ego is unsafe, whether it has newly touched a vehicle, and the slot of that vehicle."""
    unsafe, hit = np.array([True]), np.array([-1])
    egos = boxes((0.0, 0.0, 0.0, 1.0))
    new = check_safety(np.array([now_m]), np.array([before_m]), egos, boxes(*vehicles)[None], rules, unsafe, hit)
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
    egos, vehicles = boxes(*[(0.0, 0.0, 0.0, 1.0)] * 2), np.stack([boxes(AHEAD)] * 2)
    assert not check_safety(np.array([[0.0], [FAR]]), np.full((2, 1), FAR), egos, vehicles, RULES, unsafe, hit)
    assert hit.tolist() == [2, -1] and unsafe.tolist() == [True, False]


def test_a_cleared_ego_is_as_new() -> None:
    egos = Egos(2, T)
    assert egos.box["length_m"].tolist() == [5.0, 5.0] and egos.box["width_m"].tolist() == [2.0, 2.0]
    fresh = {name: value.copy() for name, value in vars(egos).items() if isinstance(value, np.ndarray)}
    egos.front_m[1] = egos.speed_mps[1] = egos.distance_m[1] = egos._was_distance_m[1] = 3.0
    egos.unsafe[1] = True
    egos.box[1] = (1.0, 2.0, 1.0, 0.0, 5.0, 2.0)
    egos._hit_slot[1], egos.collision[1] = 4, Collision(4, 0, "lower", 0.0, 0.0)
    assert egos.collided.tolist() == [False, True]
    egos.clear(1)
    assert all(getattr(egos, name).tolist() == value.tolist() for name, value in fresh.items())
    assert egos.collision == [None, None]


def set_ego(egos: Egos, front_m: float) -> None:
    egos.front_m[0] = front_m
    place(egos.front_m, layout(T).ego.way, egos.box)


def set_vehicle(slots: Slots, slot: int, route: int, front_m: float) -> None:
    slots.take(0, slot, route=route, member=9, number=0, size_m=(5.0, 2.0))
    place(np.array([front_m]), layout(T).routes[route].way, slots.box[0, slot : slot + 1])


def test_looking_around_returns_the_first_collision_once() -> None:
    egos, slots = Egos(1, T), Slots(1, T.max_vehicles)
    set_ego(egos, T.ego.start_m)
    assert not egos.look_around(slots)
    assert np.isinf(egos.distance_m).all() and not egos.unsafe[0]
    set_ego(egos, 25.0)
    set_vehicle(slots, 3, 0, 25.0)  # its centre is at x = 0 on the lower lane, as the ego's is nearly
    assert egos.look_around(slots) == [(0, 3)]
    assert egos.distance_m[0, 3] == 0.0 and np.isinf(np.delete(egos.distance_m[0], 3)).all()
    assert egos.unsafe[0] and egos.collided[0]
    set_vehicle(slots, 5, 0, 25.0)
    assert not egos.look_around(slots)


def test_a_known_collision_is_not_returned_with_that_of_another_ego() -> None:
    egos, slots = Egos(2, T), Slots(2, T.max_vehicles)
    egos.box[1] = egos.box[0] = (0.0, 0.0, 1.0, 0.0, 5.0, 2.0)
    slots.take(0, 1, member=0, number=0, size_m=(5.0, 2.0))
    slots.box[0, 1] = egos.box[0]
    assert egos.look_around(slots) == [(0, 1)]
    egos.collision[0] = Collision(1, 0, "lower", 0.0, 0.0)
    slots.take(1, 2, member=0, number=0, size_m=(5.0, 2.0))
    slots.box[1, 2] = egos.box[1]
    assert egos.look_around(slots) == [(1, 2)]


@pytest.mark.parametrize("step_s", [0.1, 1.0])
def test_vehicles_are_followed_from_so_far_that_closing_is_known(step_s: float) -> None:
    """Up to a step before they are close enough to count, and a step later they are not yet."""
    egos, slots = Egos(1, replace(T, step_s=step_s)), Slots(1, T.max_vehicles)
    fastest_mps = T.ego.controller.desired_speeds_mps[-1] + max(one.desired_speed_mps[1] for one in DRIVER_PROFILES)
    seen_m = []
    for ego_m in (19.1, 24.0, 28.0, 33.0):
        set_ego(egos, ego_m)
        for route, front_m in product((0, 1), np.arange(5.5, 45.0, 0.5)):
            set_vehicle(slots, 0, route, front_m)
            egos.look_around(slots)
            distance_m = clearance_m(egos.box[0], slots.box[0, 0])
            if distance_m < T.ego.controller.closing_distance_m + fastest_mps * step_s:
                assert egos.distance_m[0, 0] == pytest.approx(distance_m)
                seen_m.append(distance_m)
    assert sum(distance_m > 1.0 for distance_m in seen_m) > 15


def test_a_vehicle_that_has_just_appeared_was_infinitely_far() -> None:
    egos, slots = Egos(1, T), Slots(1, T.max_vehicles)
    set_ego(egos, T.ego.start_m)
    egos.look_around(slots)
    set_ego(egos, 19.1)  # 0.9 m short of the lower lane, whose vehicles are 2 m wide and drive in its middle
    set_vehicle(slots, 0, 0, 22.5)
    egos.look_around(slots)
    assert egos.distance_m[0, 0] == pytest.approx(1.9, abs=0.01)
    assert np.isinf(egos._was_distance_m[0, 0])
    egos.look_around(slots)
    assert egos._was_distance_m[0, 0] == egos.distance_m[0, 0]


@pytest.mark.parametrize(
    ("step_s", "number", "hit"),
    [(1.0, 0, True), (0.5, 0, True), (0.1, 0, False), (1.0, 1, False)],
    ids=["long step", "half a second", "short step", "another vehicle"],
)
def test_a_vehicle_cannot_pass_through_an_ego_within_a_long_step(step_s: float, number: int, hit: bool) -> None:
    egos, slots = Egos(1, replace(T, step_s=step_s)), Slots(1, T.max_vehicles)
    egos.box[0] = (0.0, 0.0, 0.0, 1.0, 5.0, 2.0)
    slots.take(0, 2, member=0, number=0, size_m=(5.0, 2.0))
    slots.box[0, 2] = (-6.0, 0.0, 1.0, 0.0, 5.0, 2.0)
    assert not egos.look_around(slots)
    slots.vehicle_number[0, 2] = number
    slots.box[0, 2] = (6.0, 0.0, 1.0, 0.0, 5.0, 2.0)
    assert list(egos.look_around(slots)) == ([(0, 2)] if hit else [])
    assert egos.distance_m[0, 2] == pytest.approx(2.5)
    assert egos.collided[0] == hit


def test_a_vehicle_that_keeps_clear_of_an_ego_in_a_long_step_is_not_hit() -> None:
    egos, slots = Egos(1, replace(T, step_s=1.0)), Slots(1, T.max_vehicles)
    egos.box[0] = (0.0, 0.0, 0.0, 1.0, 5.0, 2.0)
    slots.take(0, 2, member=0, number=0, size_m=(5.0, 2.0))
    for x_m in (-6.0, 6.0):
        slots.box[0, 2] = (x_m, 3.6, 1.0, 0.0, 5.0, 2.0)
        assert not egos.look_around(slots)
