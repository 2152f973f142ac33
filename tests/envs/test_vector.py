"""The vector environment in every autoreset mode, beside gymnasium's vectors."""

from collections.abc import Iterator
from contextlib import closing
from typing import Any

import gymnasium
import numpy as np
import pytest
from gymnasium.vector import AutoresetMode, SyncVectorEnv, VectorEnv
from gymnasium.wrappers.vector import RecordEpisodeStatistics

from tests.envs.test_workers import assert_infos_equal
from tint_sumo import ENV_IDS
from tint_sumo.core.errors import InputError
from tint_sumo.envs import SceneEnv, SceneVectorEnv, TaskSettings
from tint_sumo.envs.batch import LocalBatch
from tint_sumo.envs.rows import OUTCOMES
from tint_sumo.scenes import T_INTERSECTION
from tint_sumo.simulation.ego import Collision

ENV_ID = ENV_IDS[T_INTERSECTION]
GO, STOP = 2, 0
# Episodes end soon, and in every way.
TASK: dict[str, Any] = {
    "scene": "four_way_turn",
    "p_conservative": 0.5,
    "time_limit_s": 8.0,
    "sensor": "noisy_0.1",
    "tracks": True,
}


def drive(env: VectorEnv[Any, Any, Any], steps: int, seed: int) -> Iterator[tuple[Any, ...]]:
    """Return all that an environment returns in so many steps, and its resets where it does not reset by itself."""
    yield env.reset(seed=seed)
    rng = np.random.default_rng(seed)
    for _ in range(steps):
        actions = np.where(rng.random(env.num_envs) < 0.9, GO, rng.integers(3, size=env.num_envs))
        actions[0] = STOP  # its episodes end by the time limit
        _, _, terminated, truncated, _ = step = env.step(actions)
        yield step
        over = terminated | truncated
        if env.metadata["autoreset_mode"] is AutoresetMode.DISABLED and over.any():
            yield env.reset(options={"reset_mask": over})


@pytest.mark.parametrize(
    ("task", "steps", "outcomes"),
    [
        ({}, 200, {"success", "collision", "timeout"}),
        ({"decision_s": 0.3}, 70, {"success", "collision", "timeout"}),
        ({"time_limit_s": 0.2}, 6, {"timeout"}),  # all end at once
    ],
)
@pytest.mark.parametrize("mode", AutoresetMode)
def test_each_mode_is_as_gymnasiums(mode: AutoresetMode, task: dict[str, Any], steps: int, outcomes: set[str]) -> None:
    """Observations, rewards, ends and infos with their masks, field by field."""
    task = TASK | task
    ours = gymnasium.make_vec(ENV_ID, num_envs=3, autoreset_mode=mode.value, **task)
    theirs = SyncVectorEnv([lambda: SceneEnv(TaskSettings(backend="traci", **task))] * 3, autoreset_mode=mode)
    assert isinstance(ours, SceneVectorEnv)
    assert ours.metadata["autoreset_mode"] is mode
    assert ours.observation_space == theirs.observation_space
    seen: set[str | None] = set()
    with closing(ours), closing(theirs):
        for mine, expected in zip(drive(ours, steps, seed=20), drive(theirs, steps, seed=20), strict=True):
            for value, other in zip(mine, expected, strict=True):
                assert_infos_equal(value, other)
            assert mine[0] in ours.observation_space
            seen |= set(mine[-1].get("final_info", mine[-1])["outcome"])
    assert seen - {"", None} == outcomes


@pytest.mark.parametrize("mode", AutoresetMode)
def test_statistics_of_episodes_are_sums_over_their_steps(mode: AutoresetMode) -> None:
    env = RecordEpisodeStatistics(SceneVectorEnv(3, TaskSettings(**TASK), autoreset_mode=mode))
    lengths, returns = np.zeros(3, int), np.zeros(3)
    recorded = 0
    was_over = np.zeros(3, bool)
    with closing(env):
        for _, *rewards_and_ends, infos in drive(env, 250, seed=1):
            if not rewards_and_ends:  # a reset
                was_over[:] = False
                continue
            rewards, terminated, truncated = rewards_and_ends
            steps = ~was_over  # the step after the end only resets
            assert not rewards[was_over].any()
            lengths[steps] += 1
            returns[steps] += rewards[steps]
            over = terminated | truncated
            for index in np.flatnonzero(over):
                assert infos["episode"]["l"][index] == lengths[index]
                assert infos["episode"]["r"][index] == pytest.approx(returns[index])
                lengths[index] = returns[index] = 0
                recorded += 1
            was_over = over & (mode is AutoresetMode.NEXT_STEP)
    assert recorded > 6


@pytest.mark.parametrize("mode", AutoresetMode)
def test_a_snapshot_may_be_taken_where_an_episode_has_ended(mode: AutoresetMode) -> None:
    """Within a decision, so that the other environments have gone on."""
    task = TaskSettings(**TASK, decision_s=0.7)

    def go_on(env: SceneVectorEnv, over: Any) -> list[Any]:
        returned: list[Any] = [env.reset(options={"reset_mask": over})] if mode is AutoresetMode.DISABLED else []
        return [*returned, *(env.step(np.full(4, GO)) for _ in range(3))]

    with closing(SceneVectorEnv(4, task, autoreset_mode=mode)) as env:
        env.reset(seed=3)
        over = np.zeros(4, bool)
        while not over.any():
            observation, _, terminated, truncated, _ = env.step(np.array([GO, GO, GO, STOP]))
            over = terminated | truncated
        assert not over.all()
        snapshots = env.snapshot()
        went_on = go_on(env, over)
    with closing(SceneVectorEnv(4, task, autoreset_mode=mode)) as other:
        assert_infos_equal(other.restore(snapshots)[0], observation)
        for before, after in zip(went_on, go_on(other, over), strict=True):
            for first, second in zip(before, after, strict=True):
                assert_infos_equal(first, second)


def test_without_autoreset_ended_episodes_take_no_step() -> None:
    with closing(SceneVectorEnv(2, TaskSettings(time_limit_s=0.2), autoreset_mode="Disabled")) as env:
        env.reset(seed=0)
        env.step(np.array([GO, GO]))
        env.step(np.array([GO, GO]))
        with pytest.raises(InputError, match=r"episodes of environments 0, 1 have ended; reset them with .*reset_mask"):
            env.step(np.array([GO, GO]))
        env.reset(options={"reset_mask": np.array([False, True])})
        with pytest.raises(InputError, match="episodes of environments 0 have ended"):
            env.step(np.array([GO, GO]))
        env.reset()
        env.step(np.array([GO, GO]))


def test_an_unknown_mode_is_refused() -> None:
    with pytest.raises(InputError, match="unknown autoreset_mode 'never'; choose one of 'NextStep', 'SameStep', 'Dis"):
        SceneVectorEnv(2, autoreset_mode="never")


@pytest.mark.parametrize("outcome", OUTCOMES)
def test_only_an_episode_that_a_collision_ended_has_its_details(outcome: str) -> None:
    """An ego whose episode has ended otherwise may still be hit while others go on in the same decision."""
    with closing(SceneVectorEnv(1, TaskSettings(time_limit_s=1.0))) as env:
        env.reset(seed=0)
        assert isinstance(env.batch, LocalBatch)
        episodes = env.batch.episodes
        episodes.simulation.egos.collision[0] = Collision(0, 0, "lower", 1.0, 2.0)
        episodes.rows["outcome"] = OUTCOMES.index(outcome) + 1
        assert bool(episodes.collision_info(0)) is (outcome == "collision")


def test_environments_whose_sensors_differ_share_a_simulation_and_are_as_they_are_alone() -> None:
    sensors = ("perfect", "noisy_0.2", "range_15", "delay_0.2")
    several = [TaskSettings(sensor=sensor, tracks=True) for sensor in sensors]
    with closing(SceneVectorEnv(5, several)) as env:
        assert isinstance(env.batch, LocalBatch)
        assert len(set(env.tasks)) == 4 and env.tasks[3] == env.tasks[4]  # 1, 1, 1 and 2 environments
        shown = [env.reset(seed=7)[0]]
        shown += [env.step(np.array([2, 0, 0, 0, 0]))[0] for _ in range(60)]
        snapshots = env.snapshot()
    for index, sensor in enumerate((*sensors, sensors[-1])):
        with closing(SceneEnv(TaskSettings(sensor=sensor))) as alone:
            observations = [alone.reset(seed=7 + index)[0]]
            observations += [alone.step(2 if index == 0 else 0)[0] for _ in range(30)]
        for step, observation in enumerate(observations):
            for key, value in observation.items():
                np.testing.assert_array_equal(shown[step][key][index], value, err_msg=f"{sensor}, step {step}")
    with closing(SceneVectorEnv(5, several)) as env:
        observation, _ = env.restore(snapshots)
        for key, value in observation.items():
            np.testing.assert_array_equal(value, shown[-1][key])
