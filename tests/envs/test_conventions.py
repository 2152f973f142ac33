"""Conventions of gymnasium and Stable-Baselines3 for environments."""

import warnings
from collections.abc import Callable
from contextlib import closing
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import pytest
import torch
from gymnasium.utils.env_checker import check_env
from gymnasium.vector import AutoresetMode
from stable_baselines3 import PPO
from stable_baselines3.common.callbacks import EvalCallback
from stable_baselines3.common.env_checker import check_env as check_env_sb3
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.vec_env import VecMonitor

from tint_sumo import ENV_IDS, SCENE_ENV_ID
from tint_sumo.core.errors import InputError
from tint_sumo.envs import SceneEnv, TaskSettings
from tint_sumo.envs.sb3 import SceneVecEnv
from tint_sumo.scenes import T_INTERSECTION

ENV_ID = ENV_IDS[T_INTERSECTION]
STOP, CREEP, GO = 0, 1, 2


@pytest.mark.parametrize("env_id", [*ENV_IDS.values(), SCENE_ENV_ID])
def test_the_checkers_find_nothing_wrong_on_a_machine_without_a_display(
    env_id: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.delenv("DISPLAY", raising=False)
    with (
        closing(gymnasium.make(env_id, render_mode="rgb_array", tracks=True, time_limit_s=2.0)) as env,
        warnings.catch_warnings(),
    ):
        warnings.simplefilter("error")
        check_env(env.unwrapped)
        warnings.filterwarnings("ignore", message=".*unconventional shape.*")  # (V, 2): a set of vehicles
        check_env_sb3(env.unwrapped)


@pytest.mark.parametrize(
    ("task", "steps"),
    [({}, 500), ({"time_limit_s": 2.0, "decision_s": 0.3}, 7), ({"time_limit_s": 2.0, "max_episode_steps": 5}, 20)],
)
def test_the_longest_episode_stands_in_the_specification(task: dict[str, Any], steps: int) -> None:
    with closing(gymnasium.make(ENV_ID, **task)) as env:
        limited = "max_episode_steps" in task  # in gymnasium.make it is a wrapper's
        assert ("TimeLimit" in str(env)) is limited
        assert env.unwrapped.spec is not None and env.unwrapped.spec.max_episode_steps == steps
        spec = env.spec
        assert spec is not None and spec.max_episode_steps == (5 if limited else steps)
    with closing(gymnasium.make_vec(spec, num_envs=2, time_limit_s=20.0)) as vector:  # which is passed the steps
        vector.reset(seed=0)
        for step in range(1, spec.max_episode_steps + 1 if steps < 500 else 2):
            *_, truncated, infos = vector.step(np.zeros(2, np.int64))
            assert truncated.all() == (step == spec.max_episode_steps)
        assert steps == 500 or set(infos["outcome"]) == {"timeout"}
    with closing(gymnasium.make(spec)) as again:
        assert again.spec is not None and again.spec.max_episode_steps == spec.max_episode_steps


@pytest.mark.parametrize(
    ("make", "valid"),
    [
        (gymnasium.make, "render_mode, scene, p_conservative"),
        (gymnasium.make_vec, "num_envs, render_mode, workers, autoreset_mode, scene, p_conservative"),
    ],
)
def test_unknown_arguments_are_answered_with_the_valid_ones(make: Callable[..., Any], valid: str) -> None:
    with pytest.raises(InputError) as refused:
        make(ENV_ID, p_conservativ=0.3)
    line = str(refused.value)
    assert "p_conservativ: there is no such setting; did you mean p_conservative?" in line
    assert valid in line and "\n" not in line


def test_an_action_holds_for_a_decision_or_until_the_episode_ends() -> None:
    task: dict[str, Any] = {"scene": "four_way_turn", "p_conservative": 0.5, "time_limit_s": 8.0, "tracks": True}
    plain, decisive = SceneEnv(TaskSettings(**task)), SceneEnv(TaskSettings(decision_s=0.7, backend="traci", **task))
    rng = np.random.default_rng(0)
    outcomes = set()
    with closing(plain), closing(decisive):
        for seed in range(6):
            plain.reset(seed=seed)
            decisive.reset(seed=seed)
            ended = False
            while not ended:
                action = rng.choice(3, p=(0.2, 0.0, 0.8)) if seed else 0  # the first one does not leave
                observation, total, *ends, info = decisive.step(action)
                rewards, terms = [], []
                for _ in range(7):
                    expected, reward, *expected_ends, expected_info = plain.step(action)
                    rewards.append(reward)
                    terms.append(expected_info.pop("reward_terms"))
                    if any(expected_ends):
                        break
                for name, value in info.pop("reward_terms").items():
                    assert value == pytest.approx(sum(term[name] for term in terms))
                assert total == pytest.approx(sum(rewards))
                assert ends == expected_ends
                np.testing.assert_equal(observation, expected)
                np.testing.assert_equal(info, expected_info)
                ended = any(ends)
            outcomes.add(info["outcome"])
    assert outcomes == {"success", "collision", "timeout"}


def test_monitor_reads_successes() -> None:
    env = Monitor(SceneEnv(TaskSettings("on_ramp", p_conservative=0.5)), info_keywords=("is_success",))
    outcomes = set()
    with closing(env):
        for seed in (0, None, None):
            env.reset(seed=seed)
            ended = False
            while not ended:
                *_, terminated, truncated, info = env.step(GO)
                ended = terminated or truncated
                assert info["is_success"] is (info["outcome"] == "success")
            assert info["episode"]["is_success"] is (info["outcome"] == "success")
            outcomes.add(info["outcome"])
    assert outcomes == {"success", "collision"}


@pytest.mark.parametrize("wrapped", [True, False])
def test_an_episode_that_a_wrapper_ends_is_no_success(wrapped: bool) -> None:
    """As the rates of Stable-Baselines3 count it, which leave out episodes that do not say so."""
    limit = {"max_episode_steps": 2} if wrapped else {"time_limit_s": 0.2}
    with closing(Monitor(gymnasium.make(ENV_ID, **limit), info_keywords=("is_success",))) as env:
        env.reset(seed=0)
        env.step(GO)
        *_, truncated, info = env.step(GO)
        assert truncated and info["outcome"] == ("" if wrapped else "timeout")
        assert info["episode"]["is_success"] is False
    with closing(SceneVecEnv(1, TaskSettings(time_limit_s=0.2))) as several:
        several.reset()
        assert [several.step(np.array([GO]))[3][0]["is_success"] for _ in range(2)] == [False, False]


def test_evaluations_read_successes(tmp_path: Path) -> None:
    task = TaskSettings("on_ramp", p_conservative=0.5)
    found: list[str] = []

    class Outcomes(SceneVecEnv):
        """Writes down how its episodes end."""

        def step_wait(self) -> Any:
            *returned, infos = super().step_wait()
            found.extend(info["outcome"] for info in infos if info["outcome"])
            return *returned, infos

    with (
        closing(VecMonitor(Outcomes(1, task, seed=0))) as tested,
        closing(VecMonitor(SceneVecEnv(1, task))) as env,
    ):
        model = PPO("MultiInputPolicy", env, n_steps=4, batch_size=4, seed=0)
        model.policy.action_net.bias.data[GO] = 1000.0
        model.learn(4, EvalCallback(tested, n_eval_episodes=3, eval_freq=4, log_path=str(tmp_path), verbose=0))
    successes = np.load(tmp_path / "evaluations.npz")["successes"].reshape(-1)
    assert successes.tolist() == [outcome == "success" for outcome in found]
    assert successes.tolist() == [True, True, False]


@pytest.mark.parametrize("mode", [AutoresetMode.NEXT_STEP, AutoresetMode.SAME_STEP])
def test_gymnasium_makes_vectors_in_every_way(mode: AutoresetMode) -> None:
    rewards = []
    for way in ("vector_entry_point", "sync", "async"):
        arguments: dict[str, Any] = {"autoreset_mode": mode}
        kwargs = arguments if way == "vector_entry_point" else {"vector_kwargs": arguments}
        with closing(gymnasium.make_vec(ENV_ID, 2, way, time_limit_s=0.3, **kwargs)) as env:
            assert env.autoreset_mode is mode  # type: ignore[attr-defined]  # libraries read it
            env.reset(seed=5)
            rewards.append([env.step(np.full(2, GO))[1].tolist() for _ in range(5)])
    assert rewards[0] == rewards[1] == rewards[2]


@pytest.mark.long  # TorchRL takes seconds to import
def test_torchrl_sees_the_same_episodes() -> None:
    torchrl = pytest.importorskip("torchrl.envs")
    from torchrl.envs.utils import check_env_specs

    task: dict[str, Any] = {"decision_s": 0.4, "time_limit_s": 6.0, "autoreset_mode": "Disabled"}
    with (
        closing(gymnasium.make_vec(ENV_ID, 3, **task)) as ours,
        closing(torchrl.GymWrapper(gymnasium.make_vec(ENV_ID, 3, **task), categorical_action_encoding=True)) as theirs,
    ):
        check_env_specs(theirs)
        theirs.set_seed(4)
        always = torch.tensor([GO, STOP, CREEP])  # so that one episode ends in a collision, and others by time limit
        rollout = theirs.rollout(40, lambda tensordict: tensordict.set("action", always), break_when_any_done=False)
        ours.reset(seed=4)  # as TorchRL does to set a seed, before it begins
        observations, _ = ours.reset()
        for step, actions in enumerate(rollout["action"].T.numpy()):
            np.testing.assert_array_equal(rollout["vehicles"][:, step], observations["vehicles"])
            observations, rewards, terminated, truncated, _ = ours.step(actions)
            now = rollout["next"][:, step]
            np.testing.assert_array_equal(now["vehicles"], observations["vehicles"])
            np.testing.assert_allclose(now["reward"][:, 0], rewards, rtol=1e-6)
            np.testing.assert_array_equal(now["terminated"][:, 0], terminated)
            np.testing.assert_array_equal(now["truncated"][:, 0], truncated)
            if (terminated | truncated).any():
                observations, _ = ours.reset(options={"reset_mask": terminated | truncated})
        assert rollout["next", "truncated"].any() and rollout["next", "terminated"].any()
