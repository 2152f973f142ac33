"""Environments in worker processes: the same episodes, and nothing left behind."""

import multiprocessing
import os
import signal
import subprocess
import sys
from collections.abc import Iterator
from contextlib import closing
from dataclasses import replace
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import pytest

from tests.envs.test_environments import ENV_ID, assert_equal
from tests.waiting import PATIENCE_S, is_alive, wait_until
from tint_sumo.config import SENSORS
from tint_sumo.core.errors import InputError
from tint_sumo.envs import TaskSettings
from tint_sumo.envs.sb3 import SceneVecEnv
from tint_sumo.envs.vector import SceneVectorEnv


@pytest.fixture
def vector() -> Iterator[SceneVectorEnv]:
    vector = SceneVectorEnv(3, workers=3)
    yield vector
    vector.close()


def worker_ids() -> list[int]:
    return [process.pid for process in multiprocessing.active_children() if process.pid is not None]


def wait_until_ended(process_ids: list[int]) -> None:
    wait_until(lambda: not any(map(is_alive, process_ids)))


@pytest.mark.parametrize(("workers", "mode"), [(2, "SameStep"), (3, "NextStep")])
def test_results_do_not_depend_on_the_number_of_workers(workers: int, mode: str) -> None:
    task = TaskSettings(time_limit_s=6.0, sensor=SENSORS["noisy_0.1"], p_conservative=0.6, tracks=True)
    one = SceneVectorEnv(5, task, autoreset_mode=mode)
    many = SceneVectorEnv(5, task, workers=workers, autoreset_mode=mode)
    try:
        assert_equal(one.reset(seed=7)[0], many.reset(seed=7)[0])
        rng = np.random.default_rng(0)
        ended = 0
        for _ in range(150):
            actions = rng.integers(3, size=5)
            step = one.step(actions)
            for first, second in zip(step, many.step(actions), strict=True):
                assert_infos_equal(first, second)
            ended += int((step[2] | step[3]).any())
        mask = {"reset_mask": np.array([True, False, False, True, False])}
        for first, second in zip(one.reset(options=mask), many.reset(options=mask), strict=True):
            assert_infos_equal(first, second)
        assert ended >= 2
    finally:
        one.close()
        many.close()


def assert_infos_equal(first: Any, second: Any) -> None:
    """Also within arrays of objects, such as the last observations."""
    if isinstance(first, dict):
        assert first.keys() == second.keys()
        for key in first:
            assert_infos_equal(first[key], second[key])
    elif isinstance(first, np.ndarray) and first.dtype == object:
        for a, b in zip(first, second, strict=True):
            assert_infos_equal(a, b)
    else:
        assert np.asarray(first).dtype == np.asarray(second).dtype
        assert_equal(first, second)


def test_the_truth_is_shown_beside_a_perfect_sensor_where_another_scene_has_one_that_is_not() -> None:
    with closing(SceneVectorEnv(2, [TaskSettings("four_way"), TaskSettings("on_ramp", sensor="range_15")])) as vector:
        _, infos = vector.reset(seed=3)
        for _ in range(3):
            np.testing.assert_array_equal(infos["true_traits"][0], infos["traits"][0])
            assert infos["true_mask"][0].sum() == (infos["traits"][0] >= 0).sum() > 0
            *_, infos = vector.step(np.zeros(2, np.int64))


def test_tracks_are_shown_in_all_scenes_of_a_vector_or_in_none() -> None:
    with pytest.raises(InputError, match="must have the same `tracks`"):
        SceneVectorEnv(2, [TaskSettings("four_way", tracks=True), TaskSettings("on_ramp")])


def test_the_stable_baselines3_adapter_takes_workers() -> None:
    one, two = (
        SceneVecEnv(4, TaskSettings(time_limit_s=2.0), seed=3),
        SceneVecEnv(4, TaskSettings(time_limit_s=2.0), seed=3, workers=2),
    )
    try:
        assert_equal(one.reset(), two.reset())
        kept: Any = None
        for step in range(45):
            actions = np.full(4, step % 3)
            first, second = one.step(actions), two.step(actions)
            for a, b in zip(first[:3], second[:3], strict=True):
                assert_equal(a, b)
            for a, b in zip(first[3], second[3], strict=True):
                assert_infos_equal(a, b)
            if kept is not None:
                assert_equal(*kept)  # returned arrays are not reused
            kept = (second[0], {key: value.copy() for key, value in second[0].items()})
    finally:
        one.close()
        two.close()


def test_gymnasium_makes_it_with_workers() -> None:
    vector = gymnasium.make_vec(
        ENV_ID, num_envs=2, vectorization_mode="vector_entry_point", workers=2, render_mode="rgb_array"
    )
    try:
        observation, _ = vector.reset(seed=0)
        assert observation in vector.observation_space
        images = vector.render()
        assert images is not None and [image.shape for image in images] == [(320, 736, 3)] * 2
    finally:
        vector.close()


def test_closing_ends_the_workers(vector: SceneVectorEnv) -> None:
    ids = worker_ids()
    assert len(ids) == 2
    vector.reset(seed=0)
    vector.close()
    vector.close()
    assert not any(map(is_alive, ids))
    with pytest.raises(InputError, match="closed; make a new one"):
        vector.step(np.zeros(3, np.int64))


def test_a_killed_worker_is_reported_and_ends_the_others(vector: SceneVectorEnv) -> None:
    vector.reset(seed=0)
    ids = worker_ids()
    os.kill(ids[0], signal.SIGKILL)
    with pytest.raises(RuntimeError, match="died with exit code -9; reset all environments"):
        for _ in range(3):
            vector.step(np.zeros(3, np.int64))
    assert not any(map(is_alive, ids))


@pytest.mark.parametrize("broken", [0, 2])  # in this process, and in another one
def test_an_error_reaches_the_caller_and_ends_all_workers_until_the_next_reset(
    broken: int, vector: SceneVectorEnv
) -> None:
    first = vector.reset(seed=0)[0]
    snapshots = vector.snapshot()
    snapshots[broken] = replace(snapshots[broken], began={})
    with pytest.raises(ValueError if broken == 0 else RuntimeError, match="state must be for a PCG64"):
        vector.restore(snapshots)
    assert not worker_ids()
    with pytest.raises(InputError, match="an earlier call has failed or was interrupted; reset the environment first"):
        vector.step(np.zeros(3, np.int64))
    with pytest.raises(InputError, match="reset the environment first"):
        vector.reset(options={"reset_mask": np.array([True, False, False])})
    assert_equal(vector.reset(seed=0)[0], first)
    assert len(worker_ids()) == 2


def test_this_process_takes_part_unless_its_libsumo_is_taken() -> None:
    first = SceneVectorEnv(2, workers=2)
    try:
        assert len(worker_ids()) == 1
        second = SceneVectorEnv(2, workers=2)
        try:
            assert len(worker_ids()) == 3
            assert_equal(first.reset(seed=0)[0], second.reset(seed=0)[0])
        finally:
            second.close()
        assert len(worker_ids()) == 1
        *_, infos = first.step(np.array([0, 1]))
        assert infos["time_s"].tolist() == [0.1, 0.1]
    finally:
        first.close()


@pytest.mark.parametrize("workers", [0, 3])
def test_the_number_of_workers_must_fit(workers: int) -> None:
    with pytest.raises(InputError, match=f"workers must lie in 1 to 2, not {workers}"):
        SceneVectorEnv(2, workers=workers)


@pytest.mark.parametrize("ending", [signal.SIGKILL, signal.SIGINT])
def test_workers_never_outlive_the_main_process(tmp_path: Path, ending: signal.Signals) -> None:
    script = tmp_path / "main.py"
    script.write_text("""
import multiprocessing
import numpy as np
from tint_sumo.envs.vector import SceneVectorEnv

if __name__ == "__main__":
    vector = SceneVectorEnv(4, workers=3)
    vector.reset(seed=0)
    vector.step(np.zeros(4, np.int64))
    print(*(process.pid for process in multiprocessing.active_children()), flush=True)
    while True:
        vector.step(np.zeros(4, np.int64))
""")
    main = subprocess.Popen([sys.executable, str(script)], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
    assert main.stdout is not None and main.stderr is not None
    ids = [int(word) for word in main.stdout.readline().split()]
    assert len(ids) == 2
    main.send_signal(ending)
    assert main.wait(PATIENCE_S) != 0
    wait_until_ended(ids)
    assert main.stderr.read().count("Traceback") == (0 if ending == signal.SIGKILL else 1)  # the workers say nothing
