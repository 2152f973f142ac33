import io
import zipfile
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import pytest
import torch
from stable_baselines3.common.callbacks import BaseCallback, CallbackList, CheckpointCallback, EvalCallback
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.evaluation import evaluate_policy
from stable_baselines3.common.utils import LinearSchedule
from stable_baselines3.common.vec_env import VecMonitor

from tint_sumo.core.errors import DivergedError, InputError
from tint_sumo.policy.buffer import SequenceBuffer
from tint_sumo.policy.ppo import RecurrentPPO

from .tasks import SMALL, FollowTheLeader, Memory, TinyVecEnv


def make(env: Any, **kwargs: Any) -> RecurrentPPO:
    policy_kwargs = {"settings": SMALL, **kwargs.pop("policy_kwargs", {})}
    settings = {"n_steps": 8, "learning_rate": 5e-3, "gamma": 0.9, "seed": 0, "device": "cpu", **kwargs}
    return RecurrentPPO("GruPolicy", env, policy_kwargs=policy_kwargs, **settings)


def share_right(model: RecurrentPPO, env: TinyVecEnv, steps: int) -> float:
    """Mean reward of an episode in an unseen run of the environment."""
    env.rng = np.random.default_rng(5)
    observation, state, starts, rewards = env.reset(), None, np.ones(env.num_envs, bool), 0.0
    for _ in range(steps):
        actions, state = model.predict(observation, state, starts, deterministic=True)
        observation, reward, starts, _ = env.step(actions)
        rewards += reward.mean()
    return rewards * env.length / steps


def weights(model: RecurrentPPO) -> torch.Tensor:
    return torch.nn.utils.parameters_to_vector(model.policy.parameters()).detach().clone()


@pytest.mark.parametrize("use_bfloat16", [False, True])
def test_learns_what_needs_memory(use_bfloat16: bool) -> None:
    model = make(Memory(32), policy_kwargs={"use_bfloat16": use_bfloat16})
    assert share_right(model, Memory(100), 8) < 0.8
    model.learn(4000)
    assert share_right(model, Memory(100), 8) > 0.95


def test_learns_what_needs_attention() -> None:
    model = make(FollowTheLeader(64))
    assert share_right(model, FollowTheLeader(200), 1) < 0.7
    model.learn(8000)
    assert share_right(model, FollowTheLeader(200), 1) > 0.9


def test_same_seed_same_weights() -> None:
    first, second, other = (make(Memory(4), seed=seed).learn(128) for seed in (1, 1, 2))
    assert torch.equal(weights(first), weights(second))
    assert not torch.equal(weights(first), weights(other))


def test_every_rollout_is_logged() -> None:
    model = make(Memory(4), n_steps=8, n_epochs=1)
    logged: list[int] = []
    model.dump_logs = lambda iteration=0: logged.append(iteration)  # type: ignore[method-assign]
    model.learn(4 * 8 * 4)
    assert logged == [1, 2, 3, 4]


def test_a_training_prints_nothing_by_default(capfd: pytest.CaptureFixture[str]) -> None:
    make(Memory(4)).learn(32)
    assert capfd.readouterr() == ("", "")


def test_the_entropys_weight_may_change_linearly() -> None:
    env = Memory(4)
    model = make(env, n_steps=8, n_epochs=1, ent_coef=LinearSchedule(0.1, 0.0, 1.0))
    assert model.ent_coef == 0.1
    weights_seen: list[float] = []
    update = model.train
    model.train = lambda: (update(), weights_seen.append(model.ent_coef))  # type: ignore[method-assign, assignment, func-returns-value]
    model.learn(4 * 8 * 4)
    np.testing.assert_allclose(weights_seen, [0.075, 0.05, 0.025, 0.0], atol=1e-9)


def test_save_and_load(tmp_path: Path) -> None:
    model = make(FollowTheLeader(4)).learn(64)
    model.save(tmp_path / "model")
    assert [path.name for path in tmp_path.iterdir()] == ["model.zip"]
    loaded = RecurrentPPO.load(tmp_path / "model", device="cpu")
    assert torch.equal(weights(model), weights(loaded))
    observation = FollowTheLeader(50).reset()
    actions, _ = model.predict(observation, deterministic=True)
    loaded_actions, _ = loaded.predict(observation, deterministic=True)
    np.testing.assert_array_equal(actions, loaded_actions)


def test_save_to_memory() -> None:
    model, file = make(Memory(4)), io.BytesIO()
    model.save(file)
    file.seek(0)
    assert torch.equal(weights(RecurrentPPO.load(file, device="cpu")), weights(model))


class StopAt(BaseCallback):
    def __init__(self, steps: int) -> None:
        super().__init__()
        self.steps = steps

    def _on_step(self) -> bool:
        if self.num_timesteps >= self.steps:
            raise KeyboardInterrupt
        return True


def test_interrupted_run_goes_on(tmp_path: Path) -> None:
    env, total = Memory(4), 320
    model = make(env, learning_rate=LinearSchedule(1e-3, 0.0, 1.0))
    with pytest.raises(KeyboardInterrupt):
        model.learn(total, callback=StopAt(160))
    model.save(tmp_path / "model.zip")
    resumed = RecurrentPPO.load(tmp_path / "model.zip", env, device="cpu")
    assert resumed.num_timesteps == 160
    moments = resumed.policy.optimizer.state_dict()["state"]
    assert moments and all(
        torch.equal(state["exp_avg"], model.policy.optimizer.state_dict()["state"][key]["exp_avg"])
        for key, state in moments.items()
    )

    rates = []

    class Watch(BaseCallback):
        def _on_rollout_start(self) -> None:
            rates.append(resumed.policy.optimizer.param_groups[0]["lr"])

        def _on_step(self) -> bool:
            return True

    resumed.learn(total - resumed.num_timesteps, callback=Watch(), reset_num_timesteps=False)
    assert resumed.num_timesteps == total
    # Each rollout of 32 steps is learned from at the rate that belongs to the steps taken by then.
    expected = [1e-3 * (1.0 - steps / total) for steps in (192, 224, 256, 288)]
    np.testing.assert_allclose(rates[1:], expected)
    assert resumed.policy.optimizer.param_groups[0]["lr"] == pytest.approx(0.0)


def test_loaded_model_takes_another_number_of_environments(tmp_path: Path) -> None:
    make(Memory(4)).learn(32).save(tmp_path / "model.zip")
    resumed = RecurrentPPO.load(tmp_path / "model.zip", Memory(6), device="cpu")
    assert resumed.learn(48, reset_num_timesteps=False).num_timesteps == 32 + 48


def test_rollout_matches_the_policy_that_made_it() -> None:
    """Across rollouts and resets, what acting gave is what the sequences give: the hidden states are right."""
    model = make(Memory(6), n_steps=7, n_epochs=0).learn(2 * 42)
    for batch in model.rollout_buffer.sequences(2):
        with torch.no_grad():
            _, log_probs, _ = model.policy.evaluate_actions(
                batch.observations, batch.actions, batch.states, batch.episode_starts
            )
        torch.testing.assert_close(log_probs, batch.log_probs)
    assert model.rollout_buffer.states.abs().sum() > 0.0


class CutOff(Memory):
    """Memory whose first environment's episodes end by time limit; the others' end for good."""

    def step_wait(self) -> Any:
        observation, rewards, done, infos = super().step_wait()
        for i, info in enumerate(infos):
            if done[i]:
                info["TimeLimit.truncated"] = i == 0
        return observation, rewards, done, infos


def test_time_limit_is_bootstrapped_with_the_terminal_observation() -> None:
    env = CutOff(3)
    model = make(env, n_steps=4, n_epochs=0, n_minibatches=1).learn(12)
    buffer: SequenceBuffer = model.rollout_buffer
    policy, states = model.policy, model.policy.initial_states(3)
    starts = torch.zeros(4, 3)
    starts[0] = 1.0
    with torch.no_grad():
        for step in range(4):
            obs, _ = policy.obs_to_tensor(buffer.observations[step])
            states = policy(obs, states, starts[step])[3]
        terminal = policy.predict_values(torch.zeros(3, 1), states, torch.zeros(3)).numpy()[:, 0]
    plain = (buffer.actions[3, :, 0] == (buffer.observations[0, :, 0] > 0)).astype(float)
    assert buffer.rewards[3, 0] == pytest.approx(plain[0] + 0.9 * terminal[0], abs=1e-6)
    np.testing.assert_allclose(buffer.rewards[3, 1:], plain[1:])
    assert abs(terminal[0]) > 1e-4


def test_stable_baselines3_tools_work(tmp_path: Path) -> None:
    """Callbacks, monitor, TensorBoard, evaluation and continuous actions."""
    env = make_vec_env("Pendulum-v1", n_envs=2, seed=0)
    callbacks = CallbackList(
        [
            CheckpointCallback(40, str(tmp_path / "checkpoints")),
            EvalCallback(make_vec_env("Pendulum-v1", n_envs=1), n_eval_episodes=1, eval_freq=40, verbose=0),
        ]
    )
    model = make(env, n_steps=20, tensorboard_log=str(tmp_path / "log")).learn(160, callback=callbacks)
    assert [path.name for path in (tmp_path / "checkpoints").glob("*_160_*")] == ["rl_model_160_steps.zip"]
    assert list((tmp_path / "log").rglob("events.*"))
    mean, _ = evaluate_policy(model, env, n_eval_episodes=2)
    assert mean < 0.0


def test_takes_a_gymnasium_environment() -> None:
    model = make(gymnasium.make("CartPole-v1"), n_steps=16, n_minibatches=1).learn(32)
    assert model.num_timesteps == 32


def test_episodes_are_logged() -> None:
    model = make(VecMonitor(Memory(4))).learn(64)
    assert model.ep_info_buffer is not None
    assert {info["l"] for info in model.ep_info_buffer} == {4}
    assert {"train/value_loss", "train/approx_kl", "train/clip_fraction"} <= set(model.logger.name_to_value)


class Unbounded(Memory):
    """Memory whose rewards or observations are not finite from some step on."""

    def __init__(self, num_envs: int, broken: str, value: float) -> None:
        self.broken, self.value, self.steps = broken, value, 0
        super().__init__(num_envs)

    def observe(self) -> np.ndarray:
        shown = super().observe()
        return np.full_like(shown, self.value) if self.broken == "observation" and self.steps > 32 else shown

    def reward(self) -> np.ndarray:
        self.steps += self.num_envs
        return np.full(self.num_envs, self.value if self.broken == "reward" and self.steps > 32 else 0.0)


@pytest.mark.parametrize(
    ("broken", "value", "step", "problem"),
    [
        ("reward", np.nan, 64, "loss"),
        ("reward", np.inf, 64, "loss"),
        ("observation", np.nan, 36, "outputs"),
        ("observation", np.inf, 64, "loss"),  # the GRU's gates hide it from the outputs
    ],
)
def test_numbers_that_are_not_finite_stop_the_training_before_they_reach_the_weights(
    broken: str, value: float, step: int, problem: str
) -> None:
    model = make(Unbounded(4, broken, value), n_steps=8)
    with pytest.raises(DivergedError, match=rf"diverged at step {step}: the .*{problem}.* not finite"):
        model.learn(320)
    assert weights(model).isfinite().all()


@pytest.mark.parametrize("work", ["rollout", "update"])
def test_outputs_that_overflow_in_the_last_layer_stop_the_training(work: str) -> None:
    """In a rollout, and in the updates that follow on one: hidden layers are finite there."""
    model = make(Memory(4), n_steps=8)
    model.learn(32)
    with torch.no_grad():
        for parameter in (model.policy.action_net.weight, model.policy.action_net.bias):
            parameter.fill_(3e38)
    with pytest.raises(DivergedError, match="outputs are not finite"):
        model.learn(32, reset_num_timesteps=False) if work == "rollout" else model.train()


def test_a_step_that_leads_to_weights_that_are_not_finite_stops_the_training() -> None:
    model = make(Memory(4), n_steps=8, learning_rate=1e45, n_epochs=1, n_minibatches=1)
    with pytest.raises(DivergedError, match=r"at step 32: the weights are not finite.* \(it is 1e\+45 there\)"):
        model.learn(320)


def test_weights_that_are_not_finite_are_refused() -> None:
    model = make(FollowTheLeader(4))
    before = weights(model)
    parameters = model.get_parameters()
    parameters["policy"]["action_net.bias"] = torch.tensor([0.0, torch.nan])
    with pytest.raises(InputError, match=r"weights action_net\.bias are not finite"):
        model.set_parameters(parameters)
    assert torch.equal(weights(model), before)
    model.set_parameters({**parameters, "policy": model.policy.state_dict()})


@pytest.mark.parametrize("key", ["ego", "vehicles", "traits"])
def test_an_observation_that_is_not_finite_is_refused(key: str) -> None:
    env = FollowTheLeader(4)
    model, observation = make(env), env.reset()
    observation[key][:] = np.nan
    with pytest.raises(InputError, match="not finite: its weights or observations are too large or NaN"):
        model.predict(observation, deterministic=True)


def test_more_minibatches_than_environments_are_refused() -> None:
    with pytest.raises(InputError, match="2 environments"):
        make(Memory(2), n_minibatches=3)


@pytest.mark.parametrize("content", [None, b"", b"not a model"])
def test_missing_or_damaged_file_is_refused(content: bytes | None, tmp_path: Path) -> None:
    path = tmp_path / "model.zip"
    if content is not None:
        path.write_bytes(content)
    with pytest.raises(InputError, match=r"model\.zip"):
        RecurrentPPO.load(path)


@pytest.mark.parametrize("name", ["model.zip", "model"])  # Stable-Baselines3 adds the suffix
def test_a_file_that_unpacks_to_absurdly_much_is_refused_before_it_is_read(name: str, tmp_path: Path) -> None:
    with zipfile.ZipFile(tmp_path / "model.zip", "w", zipfile.ZIP_DEFLATED) as packed:
        packed.writestr("data", bytes(2**26))
    with pytest.raises(InputError, match=r"policy: .*model\.zip unpacks to more than .* or 200 times its size"):
        RecurrentPPO.load(tmp_path / name)


def test_file_cut_short_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "model.zip"
    make(Memory(4)).save(path)
    whole = path.read_bytes()
    path.write_bytes(whole[: len(whole) // 2])
    with pytest.raises(InputError, match="damaged"):
        RecurrentPPO.load(path)


def test_file_with_flipped_bytes_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "model.zip"
    make(Memory(4)).save(path)
    content = bytearray(path.read_bytes())
    middle = len(content) // 2
    content[middle : middle + 64] = bytes(64)
    path.write_bytes(content)
    with pytest.raises(InputError, match="damaged"):
        RecurrentPPO.load(path, device="cpu")


def test_environment_with_other_spaces_is_refused(tmp_path: Path) -> None:
    make(Memory(4)).save(tmp_path / "model.zip")
    with pytest.raises(InputError, match="does not fit"):
        RecurrentPPO.load(tmp_path / "model.zip", FollowTheLeader(4))
