"""Policies as files: NAME.safetensors with the network's weights and NAME.json, the card that describes them.

Neither can hold code, so that reading a policy from anywhere is safe; Stable-Baselines3's .zip files are pickles.
"""

from collections.abc import Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import torch
from gymnasium import spaces
from torch import Tensor

from tint_sumo.config import Perceivable, PolicySettings, Slots
from tint_sumo.core.determinism import preserved_random_state
from tint_sumo.core.errors import InputError, NotFiniteError
from tint_sumo.core.files import read_json, write_json
from tint_sumo.core.ranges import Range
from tint_sumo.core.structures import FieldError, build
from tint_sumo.core.weights import card_file, read_weights, weights_file, write_weights
from tint_sumo.envs.episodes import observation_space
from tint_sumo.envs.perceived import perceived_in
from tint_sumo.policy.network import GruPolicy
from tint_sumo.policy.trait_sources import OracleTraits
from tint_sumo.policy.wrappers import TRAITS, TRUE_TRAITS, trait_space

_NETWORK = "network"  # the card's entry with all that is needed to build the network
_PROBES = 16  # observations for which a policy's outputs must be finite
_FAR = 10.0  # end of the range of traits, which have no bounds


@dataclass(frozen=True)
class _Network:
    """The card's entry about the network."""

    settings: PolicySettings
    trait_size: Annotated[int, Range(0, 64)]
    critic_sees_true_traits: bool
    max_vehicles: Slots
    actions: Annotated[int, Range(1, 100)]
    perceives: tuple[Perceivable, ...] = ()


def save_policy(policy: GruPolicy, stem: Path, card: Mapping[str, Any]) -> None:
    """Write ``stem``.safetensors and ``stem``.json; the card comes last, so that where there is one there are weights.

    Args:
        policy: for observations of a scene with traits.
        stem: path without suffix.
        card: further entries: method, training, results.

    Raises:
        NotFiniteError: its outputs are not finite; nothing is written then.
    """
    require_finite(policy, weights_file(stem))
    space = policy.observation_space
    assert isinstance(space, spaces.Dict) and isinstance(policy.action_space, spaces.Discrete)
    traits_shape = space[TRAITS].shape
    assert traits_shape is not None
    network: dict[str, Any] = {
        "settings": asdict(policy.settings),
        "trait_size": traits_shape[-1],
        "critic_sees_true_traits": TRUE_TRAITS in space.spaces,
        "max_vehicles": traits_shape[0],
        "actions": int(policy.action_space.n),
    }
    if perceives := perceived_in(space.spaces):
        network["perceives"] = perceives
    checksum = write_weights(stem, _weights_once(policy))
    write_json(card_file(stem), {**card, _NETWORK: network, **checksum})


def load_policy_network(stem: Path) -> GruPolicy:
    """Return the network in ``stem``.safetensors, ready to drive.

    Raises:
        InputError: a file is missing or damaged, or the card does not fit the weights.
    """
    card = read_policy_card(stem)
    try:
        network: _Network = build(_Network, card[_NETWORK])
        with preserved_random_state():
            weights = read_weights(stem, lambda: _build(network), card)
            policy = _build(network)
    except FieldError as error:
        raise InputError(f"{card_file(stem)}: unusable network ({error}); restore the file") from None
    except (LookupError, TypeError, MemoryError, RuntimeError) as error:
        raise InputError(f"{card_file(stem)}: unusable network ({error!r}); restore the file") from None
    if weights.keys() != _weights_once(policy).keys():
        raise InputError(f"{card_file(stem)} does not fit the weights beside it; restore both files")
    policy.load_state_dict(weights, strict=False)  # the extractor has other names, too
    policy.set_training_mode(False)
    return policy.requires_grad_(False)


@torch.no_grad()
def require_finite(policy: GruPolicy, file: Path) -> None:
    """Raise NotFiniteError if finite weights give outputs that are not, for observations at the ends of their ranges.

    A training with too high a learning rate can end with such weights. ``file`` is that of the weights.
    """
    assert isinstance(policy.observation_space, spaces.Dict)
    rng = np.random.default_rng(0)
    limits = {key: np.minimum(part.high, _FAR) for key, part in policy.observation_space.spaces.items()}  # type: ignore[attr-defined]
    policy.set_training_mode(False)
    try:
        for count in (1,) * _PROBES + (_PROBES,):  # whether sums overflow depends on the size of the batch, too
            drawn = {key: rng.choice([-1.0, 1.0], (count, *limit.shape)) * limit for key, limit in limits.items()}
            tensors, _ = policy.obs_to_tensor({key: array.astype(np.float32) for key, array in drawn.items()})
            starts = torch.ones(count, device=policy.device)
            _, values, _, _ = policy(tensors, policy.initial_states(count), starts, deterministic=True)
            if not values.isfinite().all():
                raise FloatingPointError
    except FloatingPointError:
        raise NotFiniteError(
            f"{file}: the policy's outputs are not finite, since its weights are too large; "
            "train it again with a lower learning_rate"
        ) from None


def _weights_once(policy: GruPolicy) -> dict[str, Tensor]:
    """Return the weights, each once: Stable-Baselines3 has three names for the features extractor."""
    twins = ("pi_features_extractor.", "vf_features_extractor.")
    return {name: weights for name, weights in policy.state_dict().items() if not name.startswith(twins)}


def read_policy_card(stem: Path) -> dict[str, Any]:
    """Return the card beside the weights.

    Raises:
        InputError: it is missing, damaged or none of a policy.
    """
    card = read_json(card_file(stem), "card of the policy")
    if not isinstance(card.get(_NETWORK), dict):
        raise InputError(f"{card_file(stem)} is not the card of a policy; restore the file or train the policy again")
    return card


def read_versions(stem: Path) -> dict[str, str]:
    """Return the versions of the packages that trained a policy, by its card; none if the card has none.

    Raises:
        InputError: as in ``read_policy_card``, or they are no versions.
    """
    try:
        found: dict[str, str] = build(dict[str, str], read_policy_card(stem).get("versions", {}), ("versions",))
    except FieldError as error:
        raise InputError(f"{card_file(stem)}: {error}; restore the file") from None
    return found


def _build(network: _Network) -> GruPolicy:
    slots = network.max_vehicles
    parts = {**observation_space(slots, network.perceives).spaces, TRAITS: trait_space(slots, network.trait_size)}
    if network.critic_sees_true_traits:
        parts[TRUE_TRAITS] = trait_space(slots, OracleTraits().size)
    actions = spaces.Discrete(network.actions)
    return GruPolicy(spaces.Dict(parts), actions, lambda _: 0.0, settings=network.settings)
