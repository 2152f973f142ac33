import numpy as np
import pytest
import torch

from tint_sumo.errors import InputError
from tint_sumo.policy import EncoderTraits, NoTraits, OracleTraits
from tint_sumo.study.methods import METHODS, Learned, Rule, find_learned, find_method, register
from tint_sumo.study.rules import AlwaysGo


class Constant:
    """A trait model that says 1, 2 whatever it sees."""

    latent_size = 2

    def encode(self, states: torch.Tensor, length: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        mean = torch.tensor([1.0, 2.0]).expand(len(length), 2)
        return mean, torch.zeros_like(mean)


def test_the_methods_of_the_study() -> None:
    assert list(METHODS) == ["always_go", "ttc", "no_labels", "vae", "oracle"]
    assert {name for name, method in METHODS.items() if isinstance(method, Rule)} == {"always_go", "ttc"}


def test_trait_sources() -> None:
    sources = {
        name: type(method.source(Constant() if method.encoder else None))
        for name, method in METHODS.items()
        if isinstance(method, Learned)
    }
    assert sources == {"no_labels": NoTraits, "vae": EncoderTraits, "oracle": OracleTraits}


def test_rules_act() -> None:
    observation = {"ego": np.zeros((3, 4)), "vehicles": np.zeros((3, 12, 2)), "mask": np.zeros((3, 12))}
    for method in METHODS.values():
        if isinstance(method, Rule):
            actions, _ = method.make().predict(observation)
            assert actions.shape == (3,)


def test_a_name_is_taken_once() -> None:
    with pytest.raises(ValueError, match="two methods are called 'ttc'"):
        register(Rule("ttc", "another", AlwaysGo))
    assert METHODS["ttc"].title == "time to collision"


def test_unknown_methods_are_refused_with_the_known_ones() -> None:
    with pytest.raises(InputError, match="unknown method 'magic'; choose one of: always_go, ttc, no_labels, vae"):
        find_method("magic")


def test_rules_are_not_trained() -> None:
    with pytest.raises(InputError, match=r"hand-written rule.*choose one of: no_labels, vae, oracle"):
        find_learned("ttc")
    assert find_learned("vae").encoder == "vae"
