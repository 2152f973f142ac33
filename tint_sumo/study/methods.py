"""The methods of the study. A new one is one entry here (and its rule or trait source)."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from tint_sumo.errors import InputError, refuse_old_name
from tint_sumo.policy.trait_observation import Encoder, EncoderTraits, NoTraits, OracleTraits, TraitSource
from tint_sumo.study.rules import AlwaysGo, TimeToCollision


class Policy(Protocol):
    """What drives the ego: a rule, or a Stable-Baselines3 model."""

    def predict(
        self,
        observation: Any,
        state: Any = None,
        episode_start: NDArray[np.bool_] | None = None,
        deterministic: bool = False,
    ) -> tuple[NDArray[Any], Any]:
        """Actions (N,) for N observations, and the state for the next call."""


@dataclass(frozen=True)
class Rule:
    """A hand-written policy."""

    name: str
    title: str  # in tables and figures
    make: Callable[[], Policy]


@dataclass(frozen=True)
class Learned:
    """The policy network trained with PPO, and where its traits come from."""

    name: str
    title: str
    source: Callable[[Encoder | None], TraitSource]  # takes the trait model, None if there is none
    encoder: str | None = None  # trait method (``tint_sumo.traits.METHODS``) whose model it needs


Method = Rule | Learned

METHODS: dict[str, Method] = {}


def register(method: Method) -> Method:
    """Make a method known under its name.

    Raises:
        ValueError: the name is taken.
    """
    if method.name in METHODS:
        raise ValueError(f"two methods are called {method.name!r}")
    METHODS[method.name] = method
    return method


def find_method(name: str) -> Method:
    """The method called ``name``.

    Raises:
        InputError: there is none.
    """
    refuse_old_name(name)
    if name not in METHODS:
        raise InputError(f"unknown method {name!r}; choose one of: {', '.join(METHODS)}")
    return METHODS[name]


def find_learned(name: str) -> Learned:
    """The same for methods that can be trained.

    Raises:
        InputError: there is none, or it is a hand-written rule.
    """
    method = find_method(name)
    if isinstance(method, Rule):
        learned = ", ".join(one.name for one in METHODS.values() if isinstance(one, Learned))
        raise InputError(f"{name!r} is a hand-written rule and needs no training; choose one of: {learned}")
    return method


def _inferred(encoder: Encoder | None) -> TraitSource:
    assert encoder is not None, "an encoder method is given its trait model"
    return EncoderTraits(encoder)


register(Rule("always_go", "always go", AlwaysGo))
register(Rule("ttc", "time to collision", TimeToCollision))
register(Learned("no_labels", "no labels", lambda _: NoTraits()))
register(Learned("vae", "paper's method", _inferred, encoder="vae"))
register(Learned("oracle", "oracle", lambda _: OracleTraits()))
