"""Policies as files: NAME.safetensors with the network's weights and NAME.json, the card that says what they are.

Neither can hold code, so that reading a policy from anywhere is safe; Stable-Baselines3's .zip files are pickles.
"""

from collections.abc import Mapping
from dataclasses import asdict
from pathlib import Path
from typing import Any

import safetensors.torch
from gymnasium import spaces
from safetensors import SafetensorError
from torch import Tensor

from tint_sumo.config import PolicySettings
from tint_sumo.determinism import preserved_random_state
from tint_sumo.envs.episodes import observation_space
from tint_sumo.errors import InputError
from tint_sumo.files import read_json, whole_file, write_json
from tint_sumo.policy.network import GruPolicy
from tint_sumo.policy.trait_observation import TRAITS, TRUE_TRAITS, trait_space
from tint_sumo.policy.trait_sources import OracleTraits

_NETWORK = "network"  # the card's entry with all that is needed to build the network


def save_policy(policy: GruPolicy, stem: Path, card: Mapping[str, Any]) -> None:
    """Write ``stem``.safetensors and ``stem``.json; the card comes last, so that where there is one there are weights.

    Args:
        policy: for observations of a scene with traits.
        stem: path without suffix.
        card: what else is worth knowing: method, training, results.
    """
    space = policy.observation_space
    assert isinstance(space, spaces.Dict) and isinstance(policy.action_space, spaces.Discrete)
    traits_shape = space[TRAITS].shape
    assert traits_shape is not None
    network = {
        "settings": asdict(policy.settings),
        "trait_size": traits_shape[-1],
        "critic_sees_true_traits": TRUE_TRAITS in space.spaces,
        "max_vehicles": traits_shape[0],
        "actions": int(policy.action_space.n),
    }
    with whole_file(weights_file(stem)) as partial:
        partial.write_bytes(safetensors.torch.save(_own_weights(policy)))  # save_model would hide it from others
    write_json(card_file(stem), {**card, _NETWORK: network})


def load_policy_network(stem: Path) -> GruPolicy:
    """The network in ``stem``.safetensors, ready to drive.

    Raises:
        InputError: a file is missing or damaged, or the card does not fit the weights.
    """
    network = read_policy_card(stem)[_NETWORK]
    try:
        with preserved_random_state():
            policy = _build(network)
    except (LookupError, TypeError, ValueError, AttributeError, MemoryError, RuntimeError) as error:
        raise InputError(f"{card_file(stem)}: unusable network ({error!r}); restore the file") from None
    try:
        safetensors.torch.load_model(policy, weights_file(stem))
    except FileNotFoundError:
        raise InputError(f"policy: no file {weights_file(stem)}; restore it or train the policy again") from None
    except (OSError, SafetensorError):
        raise InputError(f"{weights_file(stem)} is damaged; restore the file or train the policy again") from None
    except RuntimeError:
        raise InputError(f"{card_file(stem)} does not fit the weights beside it; restore both files") from None
    policy.set_training_mode(False)
    return policy.requires_grad_(False)


def _own_weights(policy: GruPolicy) -> dict[str, Tensor]:
    """The weights, each once: Stable-Baselines3 knows the features extractor of actor and critic by three names."""
    twins = ("pi_features_extractor.", "vf_features_extractor.")
    return {name: weights for name, weights in policy.state_dict().items() if not name.startswith(twins)}


def read_policy_card(stem: Path) -> dict[str, Any]:
    """The card beside the weights.

    Raises:
        InputError: it is missing, damaged or none of a policy.
    """
    card = read_json(card_file(stem), "card of the policy")
    if not isinstance(card.get(_NETWORK), dict):
        raise InputError(f"{card_file(stem)} is not the card of a policy; restore the file or train the policy again")
    return card


def weights_file(stem: Path) -> Path:
    return stem.with_name(stem.name + ".safetensors")


def card_file(stem: Path) -> Path:
    return stem.with_name(stem.name + ".json")


def _build(network: Mapping[str, Any]) -> GruPolicy:
    settings: dict[str, Any] = {
        key: tuple(value) if isinstance(value, list) else value for key, value in network["settings"].items()
    }
    slots = network["max_vehicles"]
    parts = {**observation_space(slots).spaces, TRAITS: trait_space(slots, network["trait_size"])}
    if network["critic_sees_true_traits"]:
        parts[TRUE_TRAITS] = trait_space(slots, OracleTraits().size)
    actions = spaces.Discrete(network["actions"])
    return GruPolicy(spaces.Dict(parts), actions, lambda _: 0.0, settings=PolicySettings(**settings))
