"""The methods of the study. A new one is one entry here, and its rule or trait source.

Help texts, tables, figures, the study's budgets and the list of shipped policies follow from the entries. Modules
that an entry needs are imported when it is used: help texts must not wait for torch.
"""

from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any, Protocol

import numpy as np
from numpy.typing import NDArray

from tint_sumo.config import EgoControl, PpoSettings
from tint_sumo.core.errors import InputError, find_named

if TYPE_CHECKING:
    from tint_sumo.policy.trait_sources import Encoder, TraitSource
    from tint_sumo.scenes import AnyScene
    from tint_sumo.traits import TraitModel

# ruff: noqa: PLC0415


class Policy(Protocol):
    """Driver of the ego: a rule, or a Stable-Baselines3 policy."""

    def predict(
        self,
        observation: Any,
        state: Any = None,
        episode_start: NDArray[np.bool_] | None = None,
        deterministic: bool = False,
    ) -> tuple[NDArray[Any], Any]:
        """Return actions (N,) for N observations, and the state for the next call."""


_MARKERS = "osD^vPX*hpd<>"


@dataclass(frozen=True)
class Look:
    """Colour and marks of a method in every figure, in the report and in films.

    Colours are of middling lightness, to be seen on white and on black, and far apart with each kind of colour
    blindness. Markers and dashes differ, too.
    """

    colour: str = "#70757a"  # "#rrggbb"
    marker: str = "o"  # Matplotlib's
    dash: str = "-"  # Matplotlib's line style

    def variant(self, number: int) -> "Look":
        """Return the same with another marker, where a method has several lines; itself for 0."""
        markers = list(dict.fromkeys([self.marker, *_MARKERS]))
        return replace(self, marker=markers[number % len(markers)])


@dataclass(frozen=True)
class Rule:
    """A hand-written policy."""

    name: str
    title: str  # name in tables and figures
    make: "Callable[[AnyScene], Policy]"
    look: Look = Look()
    ego_control: EgoControl = "speed"  # "sumo": SUMO's driver drives the ego, in SUMO configurations alone

    def scene_for(self, scene: "AnyScene") -> "AnyScene":
        """Return a scene with this rule's driver of the ego.

        Raises:
            InputError: that is SUMO's driver, and the scene is a built-in one.
        """
        from tint_sumo.scenes import SumocfgScene

        if self.ego_control == "speed":
            return scene
        if not isinstance(scene, SumocfgScene):
            raise InputError(f"method {self.name} drives in SUMO configurations alone; give a .sumocfg as the scene")
        return replace(scene, ego_control=self.ego_control)


@dataclass(frozen=True)
class Learned:
    """The policy network trained with PPO, and where its traits come from."""

    name: str
    title: str
    source: "Callable[..., TraitSource]"  # takes the trait model if there is one, else the settings of PPO
    encoder: str | None = None  # trait method (``tint_sumo.traits.TRAIT_METHODS``) whose model it needs
    attention: bool = True
    critic_sees_true_traits: bool = False  # only in training; the policy itself never sees them
    world: str = "old"  # the world whose study it belongs to
    trained_as: str | None = None  # the method whose training it shares, if it drives with other traits than it learnt
    look: Look = Look()

    @property
    def sees_true_traits(self) -> bool:
        """Whether true traits are used in its training."""
        return self.source is true_traits or self.critic_sees_true_traits or self.trained_as is not None

    @property
    def infers_traits(self) -> bool:
        """Whether it drives with traits that it infers from what the ego sees."""
        return self.source not in (no_traits, true_traits)

    def make_source(self, encoder: "TraitModel | None", settings: PpoSettings) -> "TraitSource":
        """Return a new source of what the settings let the policy observe of the vehicles beside their positions."""
        from tint_sumo.policy.trait_sources import WithMotion

        source = self.source(settings) if encoder is None else self.source(encoder)
        return WithMotion(source) if settings.motion else source

    def settings_of(self, settings: PpoSettings) -> PpoSettings:
        """Return settings of PPO with the network of this method.

        Raises:
            InputError: they leave out the attention, which this method has.
        """
        if self.attention and not settings.policy.attention:
            raise InputError(
                f"whether there is attention is part of the method, and {self.name} has it; "
                "leave policy.attention out, or choose the method no_attention"
            )
        return replace(settings, policy=replace(settings.policy, attention=self.attention))


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
    """Return the method called ``name``.

    Raises:
        InputError: there is none.
    """
    return find_named("method", name, METHODS)


def find_learned(name: str) -> Learned:
    """Return the learned method called ``name``.

    Raises:
        InputError: there is none, or it is a hand-written rule.
    """
    method = find_method(name)
    if isinstance(method, Rule):
        known = ", ".join(learned_methods())
        raise InputError(f"{name!r} is a hand-written rule and needs no training; choose one of: {known}")
    return method


def learned_methods() -> tuple[str, ...]:
    """Return the names of all methods that learn."""
    return tuple(name for name, method in METHODS.items() if isinstance(method, Learned))


def built_in_methods() -> tuple[str, ...]:
    """Return the names of the methods of the study, which drive in built-in scenes and learn in the old world."""
    return tuple(
        name
        for name, one in METHODS.items()
        if (one.world == "old" if isinstance(one, Learned) else one.ego_control == "speed")
    )


def needed_encoders() -> tuple[str, ...]:
    """Return the names of the trait methods whose models the learned methods need, each of them once."""
    encoders = (method.encoder for method in METHODS.values() if isinstance(method, Learned))
    return tuple(dict.fromkeys(name for name in encoders if name is not None))


def with_shared_trainings(names: Iterable[str]) -> list[str]:
    """Return the names of learned methods, those whose training others share first, each of them once."""
    methods = [find_learned(name) for name in names]
    shared = [method.trained_as for method in methods if method.trained_as is not None]
    return list(dict.fromkeys([*shared, *(method.name for method in methods)]))


def look_of(name: str) -> Look:
    """Return how a method is drawn; in grey if nobody has registered it."""
    return METHODS[name].look if name in METHODS else Look()


def look_of_encoder(name: str) -> Look:
    """Return how a trait method is drawn: as the first method that drives with its traits."""
    users = (method for method in METHODS.values() if isinstance(method, Learned) and method.encoder == name)
    return next((method.look for method in users), Look())


# Rules and trait sources by the modules that hold them.


def always_go(scene: "AnyScene") -> Policy:
    from tint_sumo.methods.rules import AlwaysGo

    return AlwaysGo(len(scene.ego.controller.desired_speeds_mps) - 1)


def time_to_collision(scene: "AnyScene") -> Policy:
    from tint_sumo.methods.network_ttc import NetworkTimeToCollision
    from tint_sumo.methods.rules import TimeToCollision, threshold_s
    from tint_sumo.scenes import SumocfgScene

    return (
        NetworkTimeToCollision(scene)
        if isinstance(scene, SumocfgScene)
        else TimeToCollision(threshold_s(scene), scene=scene)
    )


def no_traits(_: PpoSettings) -> "TraitSource":
    from tint_sumo.policy.trait_sources import NoTraits

    return NoTraits()


def window_traits(model: "Encoder") -> "TraitSource":
    from tint_sumo.policy.trait_sources import EncoderTraits

    return EncoderTraits(model)


def classified_traits(model: "TraitModel") -> "TraitSource":
    from tint_sumo.policy.trait_sources import ClassifierTraits

    return ClassifierTraits(model)


def streaming_traits(model: "TraitModel") -> "TraitSource":
    from tint_sumo.policy.trait_sources import StreamingTraits

    return StreamingTraits(model)


def neighbour_traits(settings: PpoSettings) -> "TraitSource":
    from tint_sumo.policy.trait_sources import NeighbourTraits

    return NeighbourTraits(settings.relative)


def true_traits(_: PpoSettings) -> "TraitSource":
    from tint_sumo.policy.trait_sources import OracleTraits

    return OracleTraits()


register(Rule("always_go", "always go", always_go, look=Look("#5444fd", "o", ":")))
register(Rule("ttc", "time to collision", time_to_collision, look=Look("#8f9047", "s", ":")))
register(Rule("sumo", "SUMO's driver", always_go, look=Look("#f524f0", "p", ":"), ego_control="sumo"))
register(Learned("no_labels", "no labels", no_traits, look=Look("#1793fc", "D", "-")))
register(Learned("morton", "Morton", window_traits, encoder="morton", look=Look("#d77e0b", "^", "--")))
register(Learned("vae", "paper's method", window_traits, encoder="vae", look=Look("#197847", "v", "-")))
register(
    Learned(
        "no_attention",
        "paper's, no attention",
        window_traits,
        encoder="vae",
        attention=False,
        look=Look("#ce1306", "P", "--"),
    )
)
register(Learned("cross_window", "cross-window", window_traits, encoder="cross_window", look=Look("#884bb5", "*", "-")))
register(Learned("streaming", "streaming", streaming_traits, encoder="cross_window", look=Look("#c0867a", "X", "-.")))
register(
    Learned(
        "streaming_critic",
        "streaming, informed critic",
        streaming_traits,
        encoder="cross_window",
        critic_sees_true_traits=True,
        look=Look("#fc329e", "h", "-."),
    )
)
register(Learned("relative", "relative traits", neighbour_traits, world="strangers", look=Look("#007700", "d", "-")))
register(
    Learned("ma", "Ma", classified_traits, encoder="classifier", trained_as="oracle", look=Look("#15a1bb", "<", "--"))
)
register(Learned("oracle", "oracle", true_traits, look=Look("#646971", ">", "-")))
