"""The towns of episodes in infos, and rows of episodes in one town."""

import copy
from contextlib import closing
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from tests.envs.test_workers import assert_infos_equal
from tests.simulation.scenes import T
from tint_sumo.config import POPULATIONS, Towns
from tint_sumo.envs import SceneEnv, SceneVectorEnv, TaskSettings
from tint_sumo.envs.sb3 import SceneVecEnv
from tint_sumo.methods.evaluation import Case, case_seed, evaluate
from tint_sumo.methods.rules import AlwaysGo

ROW = 3
GO = 2


def task(**towns: Any) -> TaskSettings:
    population = replace(POPULATIONS["towns"], members=1, towns=Towns(count=40, **towns))
    return TaskSettings(replace(T, population=population), time_limit_s=0.2)


IN_ROWS = task(episodes=ROW)


def lived(env: SceneEnv, episodes: int, seed: int | None = None) -> list[tuple[int, list[float]]]:
    """Return town and positions at the beginning of episodes."""
    found = []
    for number in range(episodes):
        observation, info = env.reset(seed=seed if number == 0 else None)
        found.append((info["town"], observation["vehicles"].tolist()))
        assert env.step(GO)[-1]["town"] == info["town"]
    return found


def test_so_many_episodes_in_a_row_are_in_one_town() -> None:
    with closing(SceneEnv(IN_ROWS)) as env:
        found = lived(env, 4 * ROW, seed=1)
        towns = [town for town, _ in found]
        assert towns == [town for town in towns[::ROW] for _ in range(ROW)] and len(set(towns)) > 2
        assert len({repr(vehicles) for _, vehicles in found}) == len(found)
        assert lived(env, 2 * ROW, seed=1) == found[: 2 * ROW], "a seed begins a row"
        lived(env, 1)
        assert lived(env, 1, seed=1) == found[:1]


def test_without_rows_each_episode_has_a_town_of_its_own_and_others_have_none() -> None:
    with closing(SceneEnv(task())) as env:
        assert len({town for town, _ in lived(env, 9, seed=1)}) > 5
        assert env.simulation.town.tolist() == [env.step(GO)[-1]["town"]]
    with closing(SceneEnv()) as env:
        _, info = env.reset(seed=0)
        assert "town" not in info and "town" not in env.step(GO)[-1]


@pytest.mark.parametrize("workers", [1, 2])
@pytest.mark.parametrize("mode", ["SameStep", "NextStep"])
def test_each_environment_of_a_vector_has_the_rows_of_a_single_one(workers: int, mode: str) -> None:
    with closing(SceneEnv(IN_ROWS)) as env:
        alone = [[town for town, _ in lived(env, 2 * ROW, seed=seed)] for seed in (5, 6, 7)]
    with closing(SceneVectorEnv(3, IN_ROWS, workers=workers, autoreset_mode=mode)) as vector:
        _, infos = vector.reset(seed=5)
        towns = [infos["town"].tolist()]
        while len(towns) < 2 * ROW:
            *_, truncated, infos = vector.step(np.full(3, GO))
            assert infos["_town"].all()
            if mode == "SameStep" and truncated.all():
                assert infos["final_info"]["town"].tolist() == towns[-1]
            if infos["time_s"][0] == 0.0:
                towns.append(infos["town"].tolist())
    assert np.transpose(towns).tolist() == alone


def test_a_seed_begins_a_row_in_a_vector_too() -> None:
    with closing(SceneVectorEnv(2, IN_ROWS)) as vector:
        _, first = vector.reset(seed=5)
        vector.reset()
        _, again = vector.reset(seed=5)
        towns = [again["town"].tolist()] + [vector.reset()[1]["town"].tolist() for _ in range(ROW)]
    assert first["town"].tolist() == towns[0] == towns[ROW - 1] != towns[ROW]


def test_only_environments_that_are_reset_show_their_town() -> None:
    with closing(SceneVectorEnv(2, IN_ROWS)) as vector:
        vector.reset(seed=0)
        _, infos = vector.reset(options={"reset_mask": np.array([False, True])})
        assert infos["_town"].tolist() == [False, True] and infos["town"][0] == 0


def test_a_copy_goes_on_with_the_row_where_the_original_was() -> None:
    with closing(SceneEnv(IN_ROWS)) as env:
        lived(env, ROW - 1, seed=3)
        with closing(copy.deepcopy(env)) as twin:
            assert lived(twin, ROW) == lived(env, ROW)
    with closing(SceneVectorEnv(2, IN_ROWS, autoreset_mode="SameStep")) as vector:
        vector.reset(seed=3)
        for _ in range(3):  # into the second episode
            vector.step(np.full(2, GO))
        with closing(copy.deepcopy(vector)) as twin:
            for _ in range(8):
                for one, other in zip(vector.step(np.full(2, GO)), twin.step(np.full(2, GO)), strict=True):
                    assert_infos_equal(one, other)


def test_stable_baselines3_s_infos_have_the_town_of_the_step_s_episode() -> None:
    with closing(SceneVecEnv(2, IN_ROWS, seed=5)) as venv:
        venv.reset()
        towns = [info["town"] for info in venv.reset_infos]
        rows = [towns]
        for step in range(1, 2 * ROW * 2):
            *_, infos = venv.step(np.full(2, GO))
            if infos[0]["outcome"]:
                assert [info["town"] for info in infos] == rows[-1]
            elif step % 2:
                rows.append([info["town"] for info in infos])
        assert rows[1:] == [rows[1]] * ROW + [rows[ROW + 1]] * ROW and rows[1] != rows[ROW + 1]
    with closing(SceneVecEnv(1, seed=5)) as venv:
        venv.reset()
        assert "town" not in venv.reset_infos[0] and "town" not in venv.step(np.array([GO]))[-1][0]


def test_cases_have_their_town() -> None:
    cases = evaluate(AlwaysGo(), lambda count: SceneVecEnv(count, IN_ROWS), 3, 0).cases
    with closing(SceneEnv(IN_ROWS)) as env:
        towns = [lived(env, 1, seed=case_seed(0, number))[0][0] for number in range(3)]
    assert [case.town for case in cases] == towns
    assert cases[0].stored() == ("timeout", 0.2, None, None, towns[0])
    assert Case("timeout", 0.2).stored() == ("timeout", 0.2, None, None)
