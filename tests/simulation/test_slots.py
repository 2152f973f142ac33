"""Vehicles in slots; nothing is simulated."""

import numpy as np
import pytest

from tint_sumo.scenes.geometry import NO_VEHICLE
from tint_sumo.simulation.slots import Slots

V = 12  # slots
CAR = (5.0, 2.0)


@pytest.fixture
def slots() -> Slots:
    """Two replicas, with a vehicle in slot 2 of the second one."""
    made = Slots(2, V)
    made.take(1, 2, route=1, member=7, number=5, size_m=CAR)
    return made


def test_new_slots_are_empty() -> None:
    slots = Slots(2, V)
    assert slots.present.shape == slots.member.shape == slots.box.shape == (2, V)
    for array in (slots.present, slots.route, slots.front_m, slots.length_m, slots.width_m):
        assert not array.any()
    for array in (slots.member, slots.vehicle_number):
        assert (array == NO_VEHICLE).all() and (array == -1).all()


def test_a_slot_has_the_numbers_and_the_size_of_its_vehicle(slots: Slots) -> None:
    assert np.argwhere(slots.present).tolist() == [[1, 2]]
    assert (slots.route[1, 2], slots.member[1, 2], slots.vehicle_number[1, 2]) == (1, 7, 5)
    assert (slots.box["length_m"][1, 2], slots.box["width_m"][1, 2]) == (5.0, 2.0)
    for array in (slots.member, slots.vehicle_number):
        assert (np.delete(array.ravel(), V + 2) == NO_VEHICLE).all()


def test_a_slot_stays_empty_for_a_step(slots: Slots) -> None:
    slots.take(1, 0, member=1, number=6, size_m=CAR)
    assert (slots.free(0), slots.free(1)) == (0, 1)
    slots.begin_step()
    slots.leave(1, 0)
    assert not slots.present[1, 0] and slots.member[1, 0] == slots.vehicle_number[1, 0] == NO_VEHICLE
    assert slots.free(1) == 1, "slot 0 was taken at the step before"
    slots.begin_step()
    assert slots.free(1) == 0


def test_where_all_slots_are_taken_none_is_free(slots: Slots) -> None:
    for slot in range(V):
        slots.take(0, slot, member=0, number=slot, size_m=CAR)
    assert (slots.free(0), slots.free(1)) == (NO_VEHICLE, 0)


def test_a_cleared_replica_is_as_new_and_the_other_one_is_left_alone(slots: Slots) -> None:
    slots.take(0, 2, member=3, number=1, size_m=CAR)
    slots.front_m[:] = 1.0
    slots.begin_step()
    fresh = Slots(2, V)
    slots.clear(1)
    for name, array in vars(fresh).items():
        assert getattr(slots, name)[1].tolist() == array[1].tolist(), name
    assert slots.free(1) == 0
    assert slots.present[0].tolist().index(True) == 2 and slots.front_m[0, 2] == 1.0
