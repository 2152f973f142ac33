"""The state of a training between two rollouts, from which it goes on to the very end that it would have had."""

import io
import pickle
import zipfile
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path

import torch
from stable_baselines3.common.vec_env import VecEnv

from tint_sumo.errors import InputError
from tint_sumo.policy import RecurrentPPO
from tint_sumo.policy.venv import VenvSnapshot, restore, snapshot

_MOMENT = "moment.pkl"  # in the zip file, beside what Stable-Baselines3 saves of the model


@dataclass(frozen=True)
class _Moment:
    """What a training follows from beside its model."""

    environments: VenvSnapshot
    hidden: torch.Tensor  # of the policy, (N, hidden_size)
    generator: torch.Tensor  # state of PyTorch's random numbers
    recent: tuple[str, ...]  # outcomes of the last episodes


def make_checkpoint(model: RecurrentPPO, recent: Iterable[str]) -> bytes:
    """The content of a checkpoint file; call it where a rollout starts.

    Args:
        model: with environments made by ``tint_sumo.policy.venv.policy_venv``.
        recent: outcomes of the last episodes.
    """
    venv = model.get_env()
    assert venv is not None
    content = io.BytesIO()
    model.save(content)
    moment = _Moment(snapshot(venv), model.hidden_states, torch.get_rng_state(), tuple(recent))
    with zipfile.ZipFile(content, "a") as archive:
        archive.writestr(_MOMENT, pickle.dumps(moment))
    return content.getvalue()


def load_checkpoint(file: Path, venv: VecEnv) -> tuple[RecurrentPPO, tuple[str, ...]]:
    """The model, and the outcomes of the last episodes; the environments and the random numbers are where they were.

    Only for files you trust: they are unpickled.

    Raises:
        InputError: the file is damaged, or of an earlier version.
    """
    model = RecurrentPPO.load(file, env=venv, force_reset=False)
    try:
        with zipfile.ZipFile(file) as archive:
            moment: _Moment = pickle.loads(archive.read(_MOMENT))
    except KeyError:
        raise InputError(f"{file} is of an earlier version; remove it to begin the training anew") from None
    restore(venv, moment.environments)
    model.hidden_states = moment.hidden
    torch.set_rng_state(moment.generator)
    return model, moment.recent
