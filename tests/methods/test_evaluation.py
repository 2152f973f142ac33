from functools import partial
from typing import Any

import numpy as np
import pytest
from stable_baselines3.common.vec_env import VecEnv

from tint_sumo.config import STEP_S
from tint_sumo.core.errors import InputError
from tint_sumo.core.progress import Progress
from tint_sumo.envs import TaskSettings
from tint_sumo.envs.sb3 import SceneVecEnv
from tint_sumo.methods.evaluation import CASE_SEED, Case, Evaluation, case_seed, evaluate, require_cases
from tint_sumo.methods.rules import AlwaysGo, TimeToCollision

make_venv = partial(SceneVecEnv, settings=TaskSettings(p_conservative=0.6, time_limit_s=12.0))


@pytest.mark.parametrize("policy", [AlwaysGo(), TimeToCollision(0.5)])
def test_cases_do_not_depend_on_the_batch(policy: Any) -> None:
    at_once, in_parts = (evaluate(policy, make_venv, 24, 0, batch=batch) for batch in (24, 7))
    assert at_once == in_parts
    assert len(at_once.cases) == 24
    assert len({case.outcome for case in at_once.cases}) > 1, "the comparison needs various outcomes"


def test_a_case_is_the_first_episode_of_its_seed() -> None:
    case = evaluate(AlwaysGo(), make_venv, 3, 5).cases[2]
    venv = make_venv(1)
    venv.seed(case_seed(5, 2))
    venv.reset()
    steps, done = 0, np.array([False])
    while not done[0]:
        _, _, done, infos = venv.step(np.array([2]))
        steps += 1
    venv.close()
    assert infos[0]["outcome"] == case.outcome
    assert case.time_s == pytest.approx(steps * STEP_S)


def test_cases_can_begin_anywhere_in_a_set() -> None:
    whole = evaluate(AlwaysGo(), make_venv, 7, 0).cases
    assert evaluate(AlwaysGo(), make_venv, 4, 0, first=3, batch=3).cases == whole[3:]
    assert whole[3:] != whole[:4]


def test_seeds_are_different_cases() -> None:
    one, other = (evaluate(AlwaysGo(), make_venv, 12, seed) for seed in (0, 1))
    assert one != other
    assert case_seed(0, 999_999) < case_seed(1)
    assert case_seed(0) == CASE_SEED


def test_collisions_are_told_by_trait_and_route() -> None:
    found = evaluate(AlwaysGo(), make_venv, 16, 0)
    collisions = [case for case in found.cases if case.outcome == "collision"]
    assert sum(found.collisions.values()) == len(collisions) > 0
    for case in collisions:
        assert f"{case.trait}, {case.route}" in found.collisions
        assert case.trait in ("conservative", "aggressive")
        assert case.route in ("lower", "upper")


class Recorder:
    """A recurrent policy that counts the steps of each episode and checks what it is given."""

    def __init__(self) -> None:
        self.seen: list[tuple[Any, np.ndarray]] = []

    def predict(
        self, observation: Any, state: Any = None, episode_start: Any = None, deterministic: bool = False
    ) -> tuple[np.ndarray, Any]:
        assert deterministic
        steps = np.zeros(len(observation["ego"])) if state is None else state[0]
        steps = np.where(episode_start, 0, steps) + 1
        self.seen.append((steps, episode_start.copy()))
        return np.full(len(steps), 2), (steps,)


def test_the_state_is_carried_and_episode_starts_are_told() -> None:
    policy = Recorder()
    evaluate(policy, make_venv, 4, 0)
    first_starts = policy.seen[0][1]
    assert first_starts.all()
    assert sum(starts.sum() for _, starts in policy.seen[1:]) > 0
    assert max(steps.max() for steps, _ in policy.seen) > 10


def test_the_environment_is_closed_and_progress_told() -> None:
    made: list[VecEnv] = []
    reports: list[Progress] = []

    def make(num_envs: int) -> VecEnv:
        made.append(make_venv(num_envs))
        return made[-1]

    found = evaluate(AlwaysGo(), make, 5, 0, batch=4, report=reports.append)
    evaluate(
        AlwaysGo(), partial(SceneVecEnv, settings=TaskSettings(backend="libsumo")), 1, 0
    )  # refused if libsumo were still busy
    assert [venv.num_envs for venv in made] == [4]
    assert [(one.done, one.total, one.unit) for one in reports] == [(done, 5, "case") for done in range(1, 6)]
    assert all(set(one.measures) == {"success", "collision"} for one in reports)
    assert reports[-1].measures == {name: found.rate(name).value for name in ("success", "collision")}


def test_summary() -> None:
    cases = (Case("success", 10.0), Case("success", 20.0), Case("timeout", 50.0), Case("collision", 5.0, "a", "upper"))
    found = Evaluation(cases).summary()
    assert (found["success"], found["timeout"], found["collision"]) == (0.5, 0.25, 0.25)
    assert found["episodes"] == 4
    assert found["navigation_time_s"] == 15.0
    assert found["collisions"] == {"a, upper": 1}
    assert Evaluation(cases[2:]).summary()["navigation_time_s"] is None


def test_egos_that_were_lost_are_shown_where_there_are_any() -> None:
    cases = (Case("success", 10.0), Case("lost", 20.0))
    assert Evaluation(cases).outcomes == ("success", "timeout", "collision", "lost")
    assert Evaluation(cases).summary()["lost"] == 0.5
    assert Evaluation(cases[:1]).outcomes == ("success", "timeout", "collision")


@pytest.mark.parametrize(("episodes", "seed"), [(0, 0), (-1, 0), (2_000_000, 0), (1, -1), (1, 1001)])
def test_bad_values_are_refused(episodes: int, seed: int) -> None:
    require_cases(1, 1000)
    require_cases(1_000_000, 0)
    with pytest.raises(InputError, match="must lie in"):
        evaluate(AlwaysGo(), make_venv, episodes, seed)
