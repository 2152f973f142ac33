"""The planner: plans that finish a case when they are driven in the environment."""

from dataclasses import replace

import numpy as np
import pytest
from gymnasium.vector import AutoresetMode

from tint_sumo.core.errors import InputError
from tint_sumo.envs import TaskSettings
from tint_sumo.envs.batch import LocalBatch
from tint_sumo.methods.evaluation import case_seed
from tint_sumo.scenes import find_scene
from tint_sumo.study.planner import Plan, find_plan

GO = 2  # number of the fastest action


def drive(plan: Plan, case: int, task: TaskSettings) -> str:
    """Drive by a plan in an environment, and return the outcome."""
    batch = LocalBatch(1, [task], AutoresetMode.DISABLED)
    try:
        batch.reset([case_seed(0, case)], np.ones(1, bool))
        for decision in range(task.decisions_per_episode):
            front_m = float(batch.episodes.simulation.egos.front_m[0])
            for end in batch.step(np.array([0 if plan.waits(front_m, 0.4 * decision) else GO])):
                return end.outcome
    finally:
        batch.close()
    return "none"


def test_a_plan_finishes_its_case() -> None:
    task = TaskSettings(p_conservative=1.0, decision_s=0.4)
    plan = find_plan(task, 0, 1)
    assert plan is not None
    assert drive(plan, 1, task) == "success"
    hasty = Plan(np.inf, 0.0, np.inf, 0.0)
    assert drive(hasty, 1, replace(task, p_conservative=0.0)) == "collision"


@pytest.mark.slow
def test_a_plan_with_a_wait_on_the_first_lane_finishes_its_case() -> None:
    task = TaskSettings(p_conservative=0.25, decision_s=0.4, time_limit_s=24.0)
    plan = find_plan(task, 0, 8)
    assert plan is not None and plan.second_until_s > plan.first_until_s
    assert drive(plan, 8, task) == "success"
    for until_s in (0.0, np.inf):
        assert drive(plan._replace(second_until_s=until_s), 8, task) in ("collision", "timeout")


def test_there_is_no_plan_without_time() -> None:
    assert find_plan(TaskSettings(p_conservative=1.0, decision_s=0.4, time_limit_s=3.2), 0, 0) is None


def test_waits_are_from_a_position_on_until_a_time() -> None:
    plan = Plan(5.0, 10.0, 8.0, 20.0)
    assert [plan.waits(front_m, 9.0) for front_m in (4.9, 5.0, 8.0)] == [False, True, True]
    assert [plan.waits(6.0, time_s) for time_s in (9.9, 10.0)] == [True, False]
    assert [plan.waits(8.0, time_s) for time_s in (10.0, 19.9, 20.0)] == [True, True, False]


def test_other_scenes_are_refused() -> None:
    with pytest.raises(InputError, match="meets two lanes"):
        find_plan(TaskSettings(find_scene("on_ramp"), 0.4, decision_s=0.4), 0, 0)
