"""Training of one policy: interruptible and resumable."""

import hashlib
import io
import platform
import time
from collections import deque
from collections.abc import Mapping
from dataclasses import asdict
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np
import safetensors.torch
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.logger import configure
from stable_baselines3.common.utils import LinearSchedule
from stable_baselines3.common.vec_env import VecEnv, VecMonitor

from tint_sumo import traits as trait_models
from tint_sumo.config import LATENT_SIZE, PpoSettings, Share, ends, require_share
from tint_sumo.envs.sb3 import TIntersectionVecEnv
from tint_sumo.errors import InputError
from tint_sumo.files import claim_folder, whole_file, write_json
from tint_sumo.policy import ActionRepeat, RecurrentPPO, TraitObservation
from tint_sumo.study.evaluation import CASE_SEED, OUTCOMES, require_seed
from tint_sumo.study.loading import CARD_FILE, POLICY_FILE
from tint_sumo.study.methods import find_learned
from tint_sumo.study.progress import Report, silent
from tint_sumo.traits import TraitModel
from tint_sumo.traits.storage import read_card, save

CHECKPOINT_FILE = "checkpoint.zip"
CHECKPOINT_INTERVAL_S = 15.0
TRAITS = "traits"  # name of the trait model beside a policy
RECENT_EPISODES = 200


def train_policy(
    method: str,
    p_conservative: Share,
    steps: int,
    seed: int,
    out: Path,
    *,
    settings: PpoSettings,
    traits: str | Path = "vae",
    report: Report = silent,
) -> Path:
    """Train a policy and write policy.zip, its card policy.json and, where it infers traits, its trait model.

    An interrupted run leaves a checkpoint, and the same call goes on from there. A finished run is not repeated.

    Args:
        method: name of a learned method.
        p_conservative: share of conservative drivers it trains among; a range: each episode draws its own.
        steps: decisions of the policy, at least; training ends with a whole rollout.
        seed: of weights, actions and environments, 0 to 1000.
        out: a new folder, or the one of this very run. A TensorBoard log goes to ``out/tensorboard``.
        settings: network and PPO; its ``total_steps`` is not used.
        traits: trait model by name or path, for methods that infer traits.
        report: told of the progress.

    Returns:
        The path of policy.zip.

    Raises:
        InputError: bad values, no such method or trait model, ``out`` holds another run, or its checkpoint is damaged.
    """
    learned = find_learned(method)
    require_share(p_conservative)
    require_seed(seed)
    if steps < 1:
        raise InputError(f"steps must be at least 1, not {steps}")
    encoder = None if learned.encoder is None else trait_models.load(traits, latent_size=LATENT_SIZE)
    identity = {
        "kind": "policy",
        "method": method,
        "p_conservative": list(ends(p_conservative)),
        "steps": steps,
        "seed": seed,
        "settings": asdict(settings),
        "traits": None if encoder is None else _digest(encoder),
    }
    with claim_folder(out, identity):
        if (out / CARD_FILE).exists():
            return out / POLICY_FILE

        if encoder is not None:
            save(encoder, out / TRAITS, read_card(traits))
        venv = TIntersectionVecEnv(settings.n_envs, p_conservative=p_conservative, time_limit_s=settings.time_limit_s)
        try:
            observed = VecMonitor(TraitObservation(venv, learned.source(encoder)))
            _learn(ActionRepeat(observed, settings.action_repeat), steps, seed, out, settings, report)
        finally:
            venv.close()
        write_json(out / CARD_FILE, _card(identity, encoder is not None))
        (out / CHECKPOINT_FILE).unlink(missing_ok=True)
        return out / POLICY_FILE


def _learn(venv: VecEnv, steps: int, seed: int, out: Path, settings: PpoSettings, report: Report) -> None:
    """Train from the checkpoint, if there is one, to ``steps`` and write the policy."""
    checkpoint = out / CHECKPOINT_FILE
    model = RecurrentPPO.load(checkpoint, env=venv) if checkpoint.exists() else _new_model(venv, seed, settings)
    done = model.num_timesteps
    if done < steps:
        model.set_logger(configure(str(out / "tensorboard"), ["tensorboard"]))
        if done:  # loading has set the random streams back to their beginning
            model.set_random_seed(_training_seed(seed, done))
        venv.seed(_training_seed(seed, done))
        report(done, steps, "")
        watch = _Watch(checkpoint, steps, report)
        try:
            model.learn(steps - done, callback=watch, reset_num_timesteps=False)
        except KeyboardInterrupt:
            watch.write_checkpoint()
            raise
    model.save(out / POLICY_FILE)


def _new_model(venv: VecEnv, seed: int, settings: PpoSettings) -> RecurrentPPO:
    return RecurrentPPO(
        "GruPolicy",
        venv,
        learning_rate=LinearSchedule(settings.learning_rate, 0.0, 1.0),
        n_steps=settings.n_steps,
        n_minibatches=settings.n_minibatches,
        n_epochs=settings.n_epochs,
        gamma=settings.gamma,
        gae_lambda=settings.gae_lambda,
        clip_range=settings.clip_range,
        ent_coef=settings.ent_coef,
        vf_coef=settings.vf_coef,
        max_grad_norm=settings.max_grad_norm,
        policy_kwargs={"settings": settings.policy},
        seed=seed,
    )


def _training_seed(seed: int, done: int) -> int:
    """Seed of the first environment of a run that starts or goes on after ``done`` steps; below every case's seed."""
    return int(np.random.SeedSequence((seed, done)).generate_state(1)[0]) % (CASE_SEED // 2)


class _Watch(BaseCallback):
    """Keeps checkpoints, and reports the outcomes of recent episodes.

    A checkpoint is the state between two rollouts: within one, steps are counted from which nothing is learnt yet.
    """

    def __init__(self, checkpoint: Path, steps: int, report: Report) -> None:
        super().__init__()
        self._checkpoint = checkpoint
        self._steps = steps
        self._report = report
        self._recent: deque[str] = deque(maxlen=RECENT_EPISODES)
        self._saved_at = time.monotonic()
        self._state = b""

    def _on_rollout_start(self) -> None:
        state = io.BytesIO()
        self.model.save(state)
        self._state = state.getvalue()
        if time.monotonic() - self._saved_at >= CHECKPOINT_INTERVAL_S:
            self.write_checkpoint()
            self._saved_at = time.monotonic()

    def write_checkpoint(self) -> None:
        """Write the state at the start of the present rollout, if there is one."""
        if self._state:
            with whole_file(self._checkpoint) as partial:
                partial.write_bytes(self._state)

    def _on_step(self) -> bool:
        infos: list[dict[str, Any]] = self.locals["infos"]
        self._recent.extend(infos[index]["outcome"] for index in np.flatnonzero(self.locals["dones"]))
        return True

    def _on_rollout_end(self) -> None:
        note = ""
        if self._recent:
            shares = {outcome: self._recent.count(outcome) / len(self._recent) for outcome in OUTCOMES}
            for outcome, share in shares.items():
                self.logger.record(f"rollout/{outcome}", share)
            note = f"success {shares['success']:.0%}, collision {shares['collision']:.0%}"
        self._report(min(self.num_timesteps, self._steps), self._steps, note)


def _digest(encoder: TraitModel) -> str:
    return hashlib.sha256(safetensors.torch.save(encoder.state_dict())).hexdigest()


def _card(identity: Mapping[str, Any], has_traits: bool) -> dict[str, Any]:
    packages = ("tint_sumo", "libsumo", "torch", "stable-baselines3", "gymnasium", "numpy")
    return {
        **{key: value for key, value in identity.items() if key != "kind"},
        "traits": TRAITS if has_traits else None,
        "traits_sha256": identity["traits"],
        "versions": {name: version(name) for name in packages} | {"python": platform.python_version()},
    }
