"""The base class of trait models, and the registry of methods."""

from abc import ABC, abstractmethod
from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any, ClassVar

import torch
from torch import Tensor, nn

from tint_sumo.config import LATENT_SIZE, NO_LEADER_GAP_M, TraitSettings
from tint_sumo.core.errors import find_named
from tint_sumo.traits.batches import WindowBatch
from tint_sumo.traits.encoder import WindowEncoder

FEATURES = 2  # numbers per step: displacement and gap
FEATURE_SPREAD = (2.0, 1.0)  # standard deviation of the scaled displacement and gap in the training data
SMALLEST_STD = 1e-6  # a feature that varies less is a constant and is only centred


class TraitModel(nn.Module, ABC):
    """Maps windows of a driver's trajectory to a Gaussian over latent traits.

    Windows come as in ``tint_sumo.dataset.windows.Windows``: states (N, T, 2) in metres, holding the offset along the
    lane from the window's first position and the gap to the leader, and length (N,), the number of valid steps.
    Whatever stands after ``length`` has no influence.

    Networks see each step as its displacement since the step before and its gap, each centred and scaled to the spread
    in ``FEATURE_SPREAD`` by the mean and standard deviation of the training data (``fit_features``). Offsets are the
    running sum of displacements, so this is a linear and invertible change of the paper's state (III-B1): nothing is
    added or lost, but the few centimetres per step by which traits differ are no longer dwarfed by an offset that grows
    to 6 m. Displacement has the larger spread so that the latent space is laid out along speed first: with equal
    spreads it more often forms around having a leader or none, and mirrors the traits in one of the two
    groups, which then no straight line separates.
    """

    method: ClassVar[str]
    feature_spread: ClassVar[tuple[float, ...]] = FEATURE_SPREAD
    undefined_steps: ClassVar[tuple[int, ...]] = (1, 0)  # leading steps at which each feature is unknown, and zero
    uses_other_window: ClassVar[bool] = False  # whether the loss takes another window of the same driver
    uses_labels: ClassVar[bool] = False  # whether the loss takes the true traits
    unused_settings: ClassVar[tuple[str, ...]] = ()  # fields of TraitSettings that have no influence

    feature_mean: Tensor
    feature_scale: Tensor

    def __init__(self, settings: TraitSettings, latent_size: int = LATENT_SIZE) -> None:
        super().__init__()
        self.settings = settings
        self.latent_size = latent_size
        self.no_leader_gap_m = NO_LEADER_GAP_M  # stands for the gap without a leader, and caps all gaps
        self.register_buffer("feature_mean", torch.zeros(len(self.feature_spread)))
        self.register_buffer("feature_scale", torch.ones(len(self.feature_spread)))
        self.encoder = WindowEncoder(len(self.feature_spread), settings, latent_size)

    @abstractmethod
    def loss(self, batch: WindowBatch, generator: torch.Generator) -> dict[str, Tensor]:
        """Return named scalar terms of the training loss and ``"total"``, which is minimised."""

    @abstractmethod
    def squared_errors_m2(self, batch: WindowBatch) -> Tensor:
        """Return squared errors (M,) in m2 of all positions that the latent means predict, if any."""

    def encode(self, states: Tensor, length: Tensor) -> tuple[Tensor, Tensor]:
        """Return mean and log-variance of the latent, each (N, latent_size), from windows of 20 steps at most."""
        return self.encoder(self.features(states, length), length)  # type: ignore[no-any-return]

    def raw_features(self, states: Tensor) -> Tensor:
        """Return features (N, T, F) before they are scaled."""
        return displacement_and_gap(states)

    def fit_features(self, parts: Iterable[WindowBatch]) -> None:
        """Set the scaling from training windows."""
        found = [Moments()] * len(self.feature_spread)
        for part in parts:
            raw, valid = self.raw_features(part.states).double(), valid_steps(part.states, part.length)
            for feature, undefined in enumerate(self.undefined_steps):
                found[feature] += Moments.of(raw[:, undefined:, feature][valid[:, undefined:]])
        for feature, (spread, moments) in enumerate(zip(self.feature_spread, found, strict=True)):
            self.feature_mean[feature] = moments.mean
            self.feature_scale[feature] = (moments.std if moments.std >= SMALLEST_STD else 1.0) / spread

    def scaled(self, raw: Tensor) -> Tensor:
        """Return features (..., F), centred and scaled."""
        gain = 1.0 / self.feature_scale
        return torch.addcmul(-self.feature_mean * gain, raw, gain)

    def features(self, states: Tensor, length: Tensor) -> Tensor:
        """Return scaled features (N, T, F), zero after ``length`` and where they are unknown."""
        scaled = self.scaled(self.raw_features(states))
        features = torch.where(valid_steps(states, length).unsqueeze(-1), scaled, 0.0)
        for feature, steps in enumerate(self.undefined_steps):
            features[:, :steps, feature] = 0.0
        return features


@dataclass(frozen=True)
class Moments:
    """Count, mean and squares of some numbers, which add up to those of all numbers."""

    count: int = 0
    mean: float = 0.0
    squares: float = 0.0  # sum of squared differences from the mean

    @classmethod
    def of(cls, values: Tensor) -> "Moments":
        """Return the moments of values (N,)."""
        if len(values) == 0:
            return cls()
        mean = values.mean()
        return cls(len(values), float(mean), float((values - mean).square().sum()))

    def __add__(self, other: "Moments") -> "Moments":
        count = self.count + other.count
        if count == 0:
            return self
        share, apart = other.count / count, other.mean - self.mean
        return Moments(
            count,
            self.mean + share * apart,
            self.squares + other.squares + self.count * share * apart**2,
        )

    @property
    def std(self) -> float:
        """Standard deviation; 0 of no numbers."""
        return (self.squares / self.count) ** 0.5 if self.count else 0.0


def displacement_and_gap(states: Tensor) -> Tensor:
    """Return displacement and gap (N, T, 2) from offset and gap, in metres; the first displacement is zero."""
    offset, gap = states.unbind(dim=-1)
    displacement = offset.diff(dim=1, prepend=offset[:, :1])
    return torch.stack((displacement, gap), dim=-1)


def valid_steps(states: Tensor, length: Tensor) -> Tensor:
    """Return which steps (N, T) come before ``length``."""
    return torch.arange(states.shape[1], device=states.device) < length.unsqueeze(-1)


TRAIT_METHODS: dict[str, type[TraitModel]] = {}


def register(model: type[TraitModel]) -> type[TraitModel]:
    """Make a method known under ``model.method``; a class decorator."""
    if model.method in TRAIT_METHODS:
        raise ValueError(f"two trait methods are called {model.method!r}")
    TRAIT_METHODS[model.method] = model
    return model


def find_trait_method(name: Any) -> type[TraitModel]:
    """Return the method called ``name``.

    Raises:
        InputError: there is none.
    """
    return find_named("trait method", name, dict(sorted(TRAIT_METHODS.items())))
