"""Proximal policy optimisation of recurrent policies, as a Stable-Baselines3 algorithm."""

import io
import math
import pathlib
import pickle
import zipfile
import zlib
from collections import defaultdict
from collections.abc import Iterable, Mapping
from typing import Any, ClassVar, Self

import numpy as np
import torch
from gymnasium import spaces
from stable_baselines3.common.buffers import RolloutBuffer
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.on_policy_algorithm import OnPolicyAlgorithm
from stable_baselines3.common.policies import BasePolicy
from stable_baselines3.common.type_aliases import GymEnv, MaybeCallback, Schedule, TensorDict
from stable_baselines3.common.utils import FloatSchedule, LinearSchedule, explained_variance, obs_as_tensor
from stable_baselines3.common.vec_env import VecEnv
from torch import Tensor, nn

from tint_sumo.config import PpoSettings
from tint_sumo.core.errors import DivergedError, InputError
from tint_sumo.core.fast_torch import keep_freed_memory, wide_products
from tint_sumo.core.files import whole_file
from tint_sumo.core.reading import WEIGHTS_BYTES, require_zip
from tint_sumo.policy.buffer import SequenceBuffer, Sequences, buffer_class
from tint_sumo.policy.loss import Decisions, ppo_loss
from tint_sumo.policy.network import GruPolicy

_DEFAULTS = PpoSettings()
# Exceptions of Stable-Baselines3, torch and pickle for damaged files and for files of other models.
_UNREADABLE = (
    *(ValueError, LookupError, TypeError, AttributeError, ImportError, RuntimeError, AssertionError, EOFError),
    *(zipfile.BadZipFile, zlib.error, pickle.UnpicklingError),
)
_LINEAR = LinearSchedule(_DEFAULTS.learning_rate, 0.0, 1.0)


class RecurrentPPO(OnPolicyAlgorithm):
    """PPO (Schulman et al., 2017) for policies with a hidden state.

    ``learn``, ``predict``, ``save``, ``load``, callbacks, logging and ``set_parameters`` are Stable-Baselines3's.
    Minibatches hold the whole sequences of some environments, so gradients reach back to the rollout's start. Episodes
    that end by time limit are bootstrapped with the value of their terminal observation. An interrupted run goes on
    with ``load(path, env).learn(remaining, reset_num_timesteps=False)``, schedules included. ``learn`` raises
    DivergedError as soon as a loss, a gradient, a weight or an output of the policy is not finite.

    Args:
        policy: ``"GruPolicy"`` or a class with its methods.
        env: environment to learn from.
        learning_rate: constant, or a function of the progress remaining (1 to 0).
        n_steps: steps per environment and rollout.
        n_minibatches: groups of environments per epoch.
        n_epochs: passes over a rollout.
        gamma: discount per step.
        gae_lambda: trade-off of bias and variance in the advantages.
        clip_range: of the probability ratio.
        ent_coef: weight of the entropy; constant, or a function of the progress remaining (1 to 0).
        vf_coef: weight of the values' squared error.
        max_grad_norm: longer gradients are scaled down to this.
        policy_kwargs: further arguments of the policy.
        stats_window_size: as in Stable-Baselines3, like all that follow.
        tensorboard_log: folder of the TensorBoard log.
        verbose: 1 prints what is logged.
        seed: of weights, actions and environments.
        device: of the network.

    Raises:
        InputError: more minibatches than environments.
    """

    policy: GruPolicy
    policy_aliases: ClassVar[dict[str, type[BasePolicy]]] = {"GruPolicy": GruPolicy}
    rollout_buffer: SequenceBuffer
    hidden_states: Tensor  # of the policy before the next step, (n_envs, hidden_size)

    def __init__(
        self,
        policy: str | type[GruPolicy],
        env: GymEnv | str,
        *,
        learning_rate: float | Schedule = _LINEAR,
        n_steps: int = _DEFAULTS.n_steps,
        n_minibatches: int = _DEFAULTS.n_minibatches,
        n_epochs: int = _DEFAULTS.n_epochs,
        gamma: float = _DEFAULTS.gamma,
        gae_lambda: float = _DEFAULTS.gae_lambda,
        clip_range: float = _DEFAULTS.clip_range,
        ent_coef: float | Schedule = _DEFAULTS.ent_coef,
        vf_coef: float = _DEFAULTS.vf_coef,
        max_grad_norm: float = _DEFAULTS.max_grad_norm,
        policy_kwargs: dict[str, Any] | None = None,
        stats_window_size: int = 100,
        tensorboard_log: str | None = None,
        verbose: int = 0,
        seed: int | None = None,
        device: torch.device | str = "auto",
        _init_setup_model: bool = True,
    ) -> None:
        super().__init__(
            policy,
            env,
            learning_rate=learning_rate,
            n_steps=n_steps,
            gamma=gamma,
            gae_lambda=gae_lambda,
            ent_coef=FloatSchedule(ent_coef)(1.0),
            vf_coef=vf_coef,
            max_grad_norm=max_grad_norm,
            use_sde=False,
            sde_sample_freq=-1,
            stats_window_size=stats_window_size,
            tensorboard_log=tensorboard_log,
            policy_kwargs=policy_kwargs,
            verbose=verbose,
            seed=seed,
            device=device,
            _init_setup_model=False,
        )
        self.n_minibatches = n_minibatches
        self.n_epochs = n_epochs
        self.clip_range = clip_range
        self.ent_schedule = FloatSchedule(ent_coef)
        if _init_setup_model:
            self._setup_model()

    def _setup_model(self) -> None:
        if self.n_minibatches > self.n_envs:
            raise InputError(
                f"n_minibatches={self.n_minibatches} but only {self.n_envs} environments: "
                "a minibatch holds whole environments, so take fewer minibatches or more environments"
            )
        self.rollout_buffer_class = buffer_class(self.observation_space)
        super()._setup_model()
        self.hidden_states = self.policy.initial_states(self.n_envs)

    def collect_rollouts(
        self, env: VecEnv, callback: BaseCallback, rollout_buffer: RolloutBuffer, n_rollout_steps: int
    ) -> bool:
        """Fill the buffer with ``n_rollout_steps`` steps of every environment; False if the callback stops it."""
        assert isinstance(rollout_buffer, SequenceBuffer)
        self.policy.set_training_mode(False)
        rollout_buffer.reset()
        rollout_buffer.states = self.hidden_states
        callback.on_rollout_start()
        for _ in range(n_rollout_steps):
            obs, starts = self._last_obs, self._last_episode_starts
            assert obs is not None and starts is not None, "learn resets the environment before it collects"
            with torch.no_grad():
                try:
                    action_tensor, values, log_probs, states = self.policy(
                        obs_as_tensor(obs, self.device), self.hidden_states, self._on_device(starts)
                    )
                except FloatingPointError as error:
                    raise self._diverged(str(error)) from None
            actions = action_tensor.cpu().numpy()
            new_obs, rewards, dones, infos = env.step(self._within_bounds(actions))
            self.num_timesteps += env.num_envs
            callback.update_locals(locals())
            if not callback.on_step():
                return False
            self._update_info_buffer(infos, dones)
            rewards = rewards + self.gamma * self._values_at_time_limit(dones, infos, states)
            rollout_buffer.add(obs, actions, rewards, starts, values, log_probs)  # type: ignore[arg-type]
            self._last_obs = new_obs  # type: ignore[assignment]
            self._last_episode_starts, self.hidden_states = dones, states
        with torch.no_grad():
            last_values = self.policy.predict_values(
                obs_as_tensor(new_obs, self.device),  # type: ignore[arg-type]
                self.hidden_states,
                self._on_device(dones),
            )
        rollout_buffer.compute_returns_and_advantage(last_values=last_values, dones=dones)
        callback.update_locals(locals())
        callback.on_rollout_end()
        return True

    def _on_device(self, values: np.ndarray) -> Tensor:
        return torch.as_tensor(values, device=self.device)

    def _within_bounds(self, actions: np.ndarray) -> np.ndarray:
        if isinstance(self.action_space, spaces.Box):
            actions = np.clip(actions, self.action_space.low, self.action_space.high)
        return actions

    def _values_at_time_limit(self, dones: np.ndarray, infos: list[dict[str, Any]], states: Tensor) -> np.ndarray:
        """Return values (N,) of the terminal observations of episodes that the time limit cut off, 0 elsewhere.

        The hidden state there is ``states``, (N, hidden_size): the one after the episode's last action.
        """
        values = np.zeros(len(dones), np.float32)
        cut = [int(i) for i in np.flatnonzero(dones) if infos[i].get("TimeLimit.truncated", False)]
        if cut:
            terminal = _stacked([infos[i]["terminal_observation"] for i in cut])
            obs, _ = self.policy.obs_to_tensor(terminal)
            with torch.no_grad():
                predicted = self.policy.predict_values(obs, states[cut], self._on_device(np.zeros(len(cut), bool)))
            values[cut] = predicted.flatten().cpu().numpy()
        return values

    def train(self) -> None:
        """Improve the policy on the rollout in the buffer."""
        self.policy.set_training_mode(True)
        self._update_learning_rate(self.policy.optimizer)
        self.ent_coef = self.ent_schedule(self._current_progress_remaining)
        self.logger.record("train/ent_coef", self.ent_coef)
        records: dict[str, list[float]] = defaultdict(list)
        with wide_products(self.device.type == "cpu"):
            for _ in range(self.n_epochs):
                for batch in self.rollout_buffer.sequences(self.n_minibatches):
                    for name, value in self._update(batch).items():
                        records[name].append(value)
        self._n_updates += self.n_epochs
        if not all(parameter.isfinite().all() for parameter in self.policy.parameters()):
            raise self._diverged("the weights are not finite")
        for name, values in records.items():
            self.logger.record(f"train/{name}", np.mean(values))
        buffer = self.rollout_buffer
        self.logger.record(
            "train/explained_variance", explained_variance(buffer.values.flatten(), buffer.returns.flatten())
        )
        self.logger.record("train/n_updates", self._n_updates, exclude="tensorboard")

    def _update(self, batch: Sequences) -> dict[str, float]:
        """Take one gradient step; return what is worth logging."""
        try:
            values, log_probs, entropies = self.policy.evaluate_actions(
                batch.observations, batch.actions, batch.states, batch.episode_starts
            )
        except FloatingPointError as error:
            raise self._diverged(str(error)) from None
        decisions = Decisions(log_probs, batch.log_probs, batch.advantages, values.flatten(), batch.returns, entropies)
        loss = ppo_loss(decisions, clip_range=self.clip_range, ent_coef=self.ent_coef, vf_coef=self.vf_coef)
        self.policy.optimizer.zero_grad()
        loss.total.backward()  # type: ignore[no-untyped-call]
        norm = nn.utils.clip_grad_norm_(self.policy.parameters(), self.max_grad_norm)
        if not (math.isfinite(loss.total.item()) and math.isfinite(norm.item())):
            raise self._diverged("the loss or its gradient is not finite")
        self.policy.optimizer.step()
        return {
            "loss": loss.total.item(),
            "policy_gradient_loss": loss.policy.item(),
            "value_loss": loss.value.item(),
            "entropy_loss": -loss.entropy.item(),
            "approx_kl": loss.approx_kl.item(),
            "clip_fraction": loss.clip_fraction.item(),
        }

    def _diverged(self, problem: str) -> DivergedError:
        rate = self.policy.optimizer.param_groups[0]["lr"]
        return DivergedError(
            f"the training diverged at step {self.num_timesteps}: {problem}; "
            f"choose a lower learning_rate (it is {rate:g} there), and look for extreme observations and rewards"
        )

    def set_parameters(
        self,
        load_path_or_dict: str | TensorDict,
        exact_match: bool = True,
        device: torch.device | str = "auto",
    ) -> None:
        """Take over parameters; arguments as in Stable-Baselines3.

        Raises:
            InputError: weights are not finite; nothing has changed then.
        """
        if isinstance(load_path_or_dict, dict):
            weights: Mapping[str, Any] = load_path_or_dict.get("policy", {})  # type: ignore[assignment]
            for name, tensor in weights.items():
                if not tensor.isfinite().all():
                    raise InputError(f"weights {name} are not finite; give others")
        super().set_parameters(load_path_or_dict, exact_match, device)

    def learn(
        self,
        total_timesteps: int,
        callback: MaybeCallback = None,
        log_interval: int = 1,
        tb_log_name: str = "RecurrentPPO",
        reset_num_timesteps: bool = True,
        progress_bar: bool = False,
    ) -> Self:
        """Train for ``total_timesteps`` environment steps (further ones, without ``reset_num_timesteps``)."""
        keep_freed_memory()
        return super().learn(total_timesteps, callback, log_interval, tb_log_name, reset_num_timesteps, progress_bar)

    def save(
        self,
        path: str | pathlib.Path | io.BufferedIOBase,
        exclude: Iterable[str] | None = None,
        include: Iterable[str] | None = None,
    ) -> None:
        """Write policy, optimizer, settings and step count to one zip file, whole or not at all."""
        if isinstance(path, io.BufferedIOBase):
            super().save(path, exclude, include)
            return
        target = pathlib.Path(path)
        with whole_file(target if target.suffix else target.with_suffix(".zip")) as partial:
            super().save(partial, exclude, include)

    @classmethod
    def load(cls, path: str | pathlib.Path | io.BufferedIOBase, *args: Any, **kwargs: Any) -> Self:
        """Read a model back; arguments as in Stable-Baselines3. Only for files you trust: they are unpickled.

        Raises:
            InputError: the file is missing, damaged or unpacks to too much, or ``env`` has other spaces than the model.
        """
        try:
            if not isinstance(path, io.BufferedIOBase):
                for file in (pathlib.Path(path), pathlib.Path(f"{path}.zip")):  # as Stable-Baselines3 looks for it
                    if file.is_file():
                        require_zip(file, "policy", WEIGHTS_BYTES)
                        break
            return super().load(path, *args, **kwargs)
        except InputError:
            raise
        except (FileNotFoundError, IsADirectoryError):
            raise InputError(f"policy: no file {path}; check the path") from None
        except _UNREADABLE as error:
            reason = " ".join(str(error).split())
            raise InputError(f"policy: {path} does not fit or is damaged ({reason}); train it anew") from error

    def _excluded_save_params(self) -> list[str]:
        return [*super()._excluded_save_params(), "hidden_states"]


def _stacked(observations: list[Any]) -> Any:
    """Return observations of some environments as one batch."""
    first = observations[0]
    if isinstance(first, dict):
        return {key: np.stack([observation[key] for observation in observations]) for key in first}
    return np.stack(observations)
