"""Vehicles in slots; nothing is simulated."""

import numpy as np
import pytest

from tests.simulation.scenes import LOWER, UPPER, T
from tint_sumo.scenes.layout import layout
from tint_sumo.simulation.slots import EMPTY, Slots

LAYOUT = layout(T)
FRONT_M = 12.0


@pytest.fixture
def slots() -> Slots:
    """Two replicas, with a vehicle in slot 2 of the second one."""
    made = Slots(2, LAYOUT)
    made.take(1, 2, UPPER, FRONT_M, member=7, number=5)
    return made


def test_a_new_simulation_holds_nobody() -> None:
    slots = Slots(2, LAYOUT)
    assert slots.present.shape == slots.member.shape == (2, T.max_vehicles) and slots.newest.shape == (2, 2)
    for array in (slots.present, slots.route, slots.stage, slots.front_m, slots.x_m, slots.y_m):
        assert not array.any()
    for array in (slots.member, slots.vehicle_number, slots.newest):
        assert (array == EMPTY).all() and (array == -1).all()


def test_a_slot_tells_of_its_vehicle_and_of_no_other(slots: Slots) -> None:
    assert np.argwhere(slots.present).tolist() == [[1, 2]]
    assert (slots.route[1, 2], slots.member[1, 2], slots.vehicle_number[1, 2]) == (UPPER, 7, 5)
    assert slots.newest.tolist() == [[EMPTY, EMPTY], [EMPTY, 2]]
    assert slots.front_m[1, 2] == pytest.approx(FRONT_M)
    assert (slots.x_m[1, 2], slots.y_m[1, 2]) == pytest.approx((FRONT_M - 25.0, 6.0))  # the centre, eastbound
    for array in (slots.member, slots.vehicle_number):
        assert (np.delete(array.ravel(), T.max_vehicles + 2) == EMPTY).all()


@pytest.mark.parametrize(("route", "front_m"), [(LOWER, 8.0), (UPPER, 30.0), (LOWER, 44.0)])
def test_a_vehicle_is_on_the_lane_that_its_route_has_there(slots: Slots, route: int, front_m: float) -> None:
    slots.take(0, 11, route, front_m, member=0, number=0)
    stage, lane_pos_m = LAYOUT.routes[route].lane_at(front_m)
    assert slots.stage[0, 11] == stage
    slots.follow(np.array([slots.index(0, 11)]), np.array([lane_pos_m + 0.25]))
    assert slots.front_m[0, 11] == pytest.approx(front_m + 0.25)
    assert slots.front_m[1, 2] == pytest.approx(FRONT_M)


def test_slots_are_numbered_through_all_replicas(slots: Slots) -> None:
    assert [slots.index(0, 3), slots.index(1, 0), slots.index(1, 5)] == [3, 12, 17]


def test_a_slot_rests_for_a_step(slots: Slots) -> None:
    slots.take(1, 0, LOWER, 8.0, member=1, number=6)
    assert (slots.free(0), slots.free(1)) == (0, 1)
    slots.begin_step()
    slots.leave(1, 0)
    assert not slots.present[1, 0] and slots.member[1, 0] == slots.vehicle_number[1, 0] == EMPTY
    assert slots.free(1) == 1, "slot 0 was taken at the step before"
    slots.begin_step()
    assert slots.free(1) == 0


def test_where_all_slots_are_taken_none_is_free(slots: Slots) -> None:
    for slot in range(T.max_vehicles):
        slots.take(0, slot, LOWER, 8.0, member=0, number=slot)
    assert (slots.free(0), slots.free(1)) == (EMPTY, 0)


def test_only_the_newest_vehicle_leaves_its_route_without_one(slots: Slots) -> None:
    slots.take(1, 4, UPPER, 8.0, member=1, number=6)
    slots.leave(1, 2)
    assert slots.newest[1].tolist() == [EMPTY, 4]
    slots.leave(1, 4)
    assert slots.newest[1].tolist() == [EMPTY, EMPTY]


def test_a_cleared_replica_is_as_new_and_the_other_one_is_left_alone(slots: Slots) -> None:
    slots.take(0, 2, LOWER, 8.0, member=3, number=1)
    slots.begin_step()
    fresh = Slots(2, LAYOUT)
    slots.clear(1)
    for name, array in vars(fresh).items():
        if isinstance(array, np.ndarray) and len(array) == 2:
            assert getattr(slots, name)[1].tolist() == array[1].tolist(), name
    assert slots.free(1) == 0
    assert slots.present[0].tolist().index(True) == 2 and slots.newest[0, LOWER] == 2
