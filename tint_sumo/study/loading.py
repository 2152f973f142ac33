"""Policies by name or path, ready to be evaluated."""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from stable_baselines3.common.vec_env import VecEnv

from tint_sumo import traits
from tint_sumo.config import LATENT_SIZE, Share, ends, is_share
from tint_sumo.envs.sb3 import TIntersectionVecEnv
from tint_sumo.errors import InputError
from tint_sumo.files import read_json, shipped
from tint_sumo.policy import ActionRepeat, RecurrentPPO, TraitObservation, TraitSource
from tint_sumo.study.methods import METHODS, Learned, Policy, Rule, find_learned

POLICY_FILE = "policy.zip"
CARD_FILE = "policy.json"
SHIPPED = "shipped"
DEFAULT_P_CONSERVATIVE = 0.4


@dataclass(frozen=True)
class Contender:
    """A policy and the environment it drives in."""

    name: str
    policy: Policy
    source: Callable[[], TraitSource] | None = None  # where the traits in its observations come from; None: no traits
    p_conservative: Share = DEFAULT_P_CONSERVATIVE  # what it was trained for
    action_repeat: int = 1  # simulation steps per decision

    def make_venv(self, num_envs: int, p_conservative: Share) -> VecEnv:
        """Environments with the observations the policy takes."""
        venv: VecEnv = TIntersectionVecEnv(num_envs, p_conservative=p_conservative)
        observed = venv if self.source is None else TraitObservation(venv, self.source())
        return ActionRepeat(observed, self.action_repeat)


def load_policy(name_or_path: str | Path) -> Contender:
    """A hand-written rule by its name, the ``shipped`` policy, or a trained one by its folder or .zip file.

    The card, a .json file beside the .zip file, tells the method, and where the trait model is.

    Raises:
        InputError: there is no such policy, or its files are missing or damaged.
    """
    method = METHODS.get(str(name_or_path))
    if isinstance(method, Rule):
        return Contender(method.name, method.make())
    file = _find(name_or_path)
    card = _read_card(file)
    learned = find_learned(card["method"])
    encoder = None
    if learned.encoder is not None:
        encoder = traits.load(file.parent / f"{card['traits']}.safetensors", latent_size=LATENT_SIZE)
    policy: Any = RecurrentPPO.load(file)
    return Contender(
        str(name_or_path),
        policy,
        lambda: learned.source(encoder),
        ends(card["p_conservative"]),
        int(card["settings"]["action_repeat"]),
    )


def _find(name_or_path: str | Path) -> Path:
    given = Path(name_or_path)
    if str(name_or_path) == SHIPPED:
        given = shipped("models") / POLICY_FILE
        if not given.is_file():
            raise InputError(f"no shipped policy ({given} is missing); reinstall the package or train a policy")
    for file in (given / POLICY_FILE, given):
        if file.is_file():
            return file
    if (given / "run.json").exists():
        raise InputError(f"{given} holds a run that is not finished; repeat its command to finish it")
    rules = ", ".join(name for name, method in METHODS.items() if isinstance(method, Rule))
    raise InputError(f"no policy {name_or_path}; give {SHIPPED}, {rules}, the folder of a training run or a .zip file")


def _read_card(file: Path) -> dict[str, Any]:
    card_file = file.with_suffix(".json")
    card = read_json(card_file, "card of the policy")
    method = METHODS.get(str(card.get("method")))
    known = isinstance(method, Learned) and is_share(card.get("p_conservative"))
    has_traits = isinstance(card.get("traits"), str)
    settings = card.get("settings")
    known &= isinstance(settings, dict) and isinstance(settings.get("action_repeat"), int)
    if not known or (isinstance(method, Learned) and method.encoder is not None and not has_traits):
        raise InputError(f"{card_file} is not the card of a policy; restore the file or train the policy again")
    return card
