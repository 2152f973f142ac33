"""Positions of vehicles on their routes; nothing is simulated."""

import numpy as np
import pytest

from tests.simulation.scenes import LOWER, UPPER, T
from tint_sumo.scenes.layout import layout
from tint_sumo.simulation.lanes import LanePositions
from tint_sumo.simulation.slots import Slots

FRONT_M = 12.0


@pytest.fixture
def slots() -> Slots:
    return Slots(2, T.max_vehicles)


@pytest.fixture
def lanes(slots: Slots) -> LanePositions:
    """Two replicas, with a vehicle in slot 2 of the second one."""
    made = LanePositions(layout(T), slots)
    enter(made, slots, 1, 2, UPPER, FRONT_M)
    return made


def enter(lanes: LanePositions, slots: Slots, replica: int, slot: int, route: int, front_m: float) -> None:
    slots.take(replica, slot, route=route, member=0, number=0, size_m=(5.0, 2.0))
    lanes.enter(replica, slot, front_m)


def test_a_vehicle_enters_where_it_is_on_its_route(lanes: LanePositions, slots: Slots) -> None:
    assert slots.front_m[1, 2] == pytest.approx(FRONT_M)
    assert slots.box[["x_m", "y_m"]][1, 2].tolist() == pytest.approx((FRONT_M - 25.0, 6.0))  # the centre, eastbound
    assert not np.delete(slots.front_m.ravel(), T.max_vehicles + 2).any()


@pytest.mark.parametrize(("route", "front_m"), [(LOWER, 8.0), (UPPER, 30.0), (LOWER, 44.0)])
def test_a_vehicle_is_followed_on_the_lane_that_its_route_has_there(
    lanes: LanePositions, slots: Slots, route: int, front_m: float
) -> None:
    enter(lanes, slots, 0, 11, route, front_m)
    stage, lane_pos_m = layout(T).routes[route].lane_at(front_m)
    assert lanes.stage[0, 11] == stage
    lanes.follow(np.array([11]), np.array([lane_pos_m + 0.25]))
    assert slots.front_m[0, 11] == pytest.approx(front_m + 0.25)
    assert slots.front_m[1, 2] == pytest.approx(FRONT_M)


def test_slots_are_numbered_through_all_replicas(lanes: LanePositions, slots: Slots) -> None:
    _, lane_pos_m = layout(T).routes[UPPER].lane_at(FRONT_M)
    lanes.follow(np.array([T.max_vehicles + 2]), np.array([lane_pos_m + 0.5]))
    assert slots.front_m[1, 2] == pytest.approx(FRONT_M + 0.5)


def test_a_cleared_replica_is_as_new_and_the_other_one_is_left_alone(lanes: LanePositions, slots: Slots) -> None:
    enter(lanes, slots, 0, 3, UPPER, 30.0)
    lanes.clear(1)
    assert not lanes.stage[1].any() and not lanes._lane_pos_m[1].any()
    assert lanes.stage[0, 3] == layout(T).routes[UPPER].lane_at(30.0)[0] > 0
