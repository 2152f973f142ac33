import math

import numpy as np
import pytest

from tests.simulation.scenes import LOWER
from tint_sumo.envs import TaskSettings
from tint_sumo.methods.evaluation import evaluate
from tint_sumo.methods.rules import CREEP, GO, STOP, AlwaysGo, Observation, TimeToCollision
from tint_sumo.policy.wrappers import policy_venv
from tint_sumo.scenes import SCENES, find_scene

LOWER_Y_M, UPPER_Y_M = 2.0, 6.0
AT_LINE_Y_M = -2.6  # of the ego's centre: its front is at y = -0.1, past the line where it waits, at -0.5
STEP_S = 0.1


def scene(*vehicles_m: tuple[float, float], ego_m: tuple[float, float] = (0.0, AT_LINE_Y_M)) -> Observation:
    """The observation of one environment with vehicles at these centres."""
    ego = np.array([[*ego_m, 0.0, 0.0]], np.float32) / 20.0
    vehicles, mask = np.zeros((1, 12, 2), np.float32), np.zeros((1, 12), np.float32)
    for slot, centre_m in enumerate(vehicles_m):
        vehicles[0, slot] = np.subtract(centre_m, ego_m) / 20.0
        mask[0, slot] = 1.0
    return {"ego": ego, "vehicles": vehicles, "mask": mask}


def act(before: Observation, now: Observation, rule: TimeToCollision | None = None) -> int:
    """The action at the second of two observations."""
    rule = rule or TimeToCollision()
    _, state = rule.predict(before, None, np.array([True]))
    actions, _ = rule.predict(now, state, np.array([False]))
    return int(actions[0])


def test_always_go() -> None:
    actions, state = AlwaysGo().predict(scene((0.0, LOWER_Y_M)))
    assert actions.tolist() == [GO]
    assert state is None


def test_goes_on_an_empty_street() -> None:
    assert act(scene(), scene()) == GO


@pytest.mark.parametrize(("y_m", "action"), [(-5.0, CREEP), (-3.1, CREEP), (-2.9, STOP), (AT_LINE_Y_M, STOP)])
def test_creeps_to_the_line_half_a_metre_before_the_lane_and_waits_there(y_m: float, action: int) -> None:
    blocked = scene((2.0, LOWER_Y_M), ego_m=(0.0, y_m))
    assert act(blocked, blocked) == action


@pytest.mark.parametrize(("speed_mps", "action"), [(0.0, GO), (2.0, GO), (3.0, STOP)])
def test_lower_lane_threshold(speed_mps: float, action: int) -> None:
    # Front at x = 4, zone from x = 1: 3 m to go, so 1.5 s at 2 m/s and 1 s at 3 m/s.
    x_m = 6.5
    before = scene((x_m + speed_mps * STEP_S, LOWER_Y_M))
    assert act(before, scene((x_m, LOWER_Y_M))) == action


@pytest.mark.parametrize(("speed_mps", "action"), [(0.0, GO), (2.0, GO), (3.0, STOP)])
def test_upper_lane_threshold(speed_mps: float, action: int) -> None:
    # The ego's front is 1 m inside the lane at x = 1.85. Front at x = -2.15, zone from x = 0.85.
    x_m = -4.65
    before = scene((x_m - speed_mps * STEP_S, UPPER_Y_M))
    assert act(before, scene((x_m, UPPER_Y_M))) == action


def test_a_vehicle_in_the_zone_blocks_though_it_stands() -> None:
    standing = scene((2.0, LOWER_Y_M))
    assert act(standing, standing) == STOP


@pytest.mark.parametrize("centre_m", [(-0.1, LOWER_Y_M), (-8.0, LOWER_Y_M), (1.9, UPPER_Y_M), (12.0, UPPER_Y_M)])
def test_a_vehicle_past_the_path_does_not_block(centre_m: tuple[float, float]) -> None:
    passed = scene(centre_m)
    assert act(passed, passed) == GO


def test_the_threshold_is_a_setting() -> None:
    before, now = scene((6.5 + 0.25, LOWER_Y_M)), scene((6.5, LOWER_Y_M))  # 1.2 s
    assert act(before, now, TimeToCollision(1.1)) == GO
    assert act(before, now, TimeToCollision(1.3)) == STOP


def test_on_the_lower_lane_it_looks_at_the_upper_one_only() -> None:
    before_upper_m = (0.32, 1.22)  # of the ego's centre: its front is at y = 3.7, 0.37 m before the upper lane
    lower, upper = (scene(vehicle, ego_m=before_upper_m) for vehicle in ((2.0, LOWER_Y_M), (0.0, UPPER_Y_M)))
    assert act(lower, lower) == GO
    assert act(upper, upper) == STOP


def test_it_does_not_halt_across_the_lower_lane() -> None:
    crossing = scene((0.0, UPPER_Y_M), ego_m=(0.0, -1.0))
    assert act(crossing, crossing) == GO


def test_an_unknown_vehicle_is_taken_to_drive_at_3_mps() -> None:
    rule = TimeToCollision()
    near, far = scene((3.5 + 3.5, LOWER_Y_M)), scene((3.5 + 3.7, LOWER_Y_M))  # 3.5 and 3.7 m before the zone
    assert rule.predict(near)[0].tolist() == [STOP]
    assert rule.predict(far)[0].tolist() == [GO]
    # The same in a new episode, whose slots say nothing about the last one's vehicles.
    _, state = rule.predict(near)
    assert rule.predict(near, state, np.array([False]))[0].tolist() == [GO]  # it stands
    assert rule.predict(near, state, np.array([True]))[0].tolist() == [STOP]


def test_speed_is_not_taken_from_the_ego_s_motion() -> None:
    before, now = scene((6.4, LOWER_Y_M), ego_m=(0.0, -2.9)), scene((6.4, LOWER_Y_M), ego_m=(0.0, AT_LINE_Y_M))
    assert act(before, now) == GO


def test_times() -> None:
    along_m = 22.5 - np.array([[6.5, 3.0, -1.0, 6.5]])  # of centres at these x
    times_s = TimeToCollision().times_s(np.full((1, 4), LOWER), along_m, np.array([[2.0, 2.0, 2.0, 0.0]]))
    assert times_s[0].tolist() == pytest.approx([1.5, 0.0, math.inf, math.inf])


def test_environments_of_a_batch_do_not_mix() -> None:
    free, blocked = scene(), scene((2.0, LOWER_Y_M))
    both = {key: np.concatenate([free[key], blocked[key], free[key]]) for key in free}
    assert TimeToCollision().predict(both)[0].tolist() == [GO, STOP, GO]


@pytest.mark.parametrize("centre_m", [(2.0, LOWER_Y_M), (-0.1, LOWER_Y_M), (0.0, UPPER_Y_M), (2.1, UPPER_Y_M)])
def test_in_the_mirrored_scene_it_acts_alike(centre_m: tuple[float, float]) -> None:
    seen, mirrored = scene(centre_m), scene((-centre_m[0], centre_m[1]))
    assert act(mirrored, mirrored, TimeToCollision(scene=find_scene("t_intersection_right"))) == act(seen, seen)


@pytest.mark.parametrize("name", SCENES)
def test_it_gets_through_where_there_is_room_in_every_scene(name: str) -> None:
    """Also where it ends among the traffic: it waits for nobody once it is in their path."""
    rule = TimeToCollision(scene=find_scene(name))
    task = TaskSettings(name, p_conservative=1.0)
    found = evaluate(rule, lambda num_envs: policy_venv(num_envs, None, [task]), 12, 0)
    assert found.rate("success").value > 0.15
