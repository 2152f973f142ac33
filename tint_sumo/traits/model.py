"""What every trait representation offers, and the registry of methods."""

from abc import ABC, abstractmethod
from typing import Any, ClassVar

import torch
from torch import Tensor, nn

from tint_sumo.config import LATENT_SIZE, VaeSettings
from tint_sumo.errors import InputError

FEATURES = 2  # numbers per step that a network sees: displacement and gap
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
    spreads it more often forms around who has a leader and who has none, and mirrors the traits in one of the two
    groups, which then no straight line separates.
    """

    method: ClassVar[str]

    feature_mean: Tensor
    feature_scale: Tensor

    def __init__(self, settings: VaeSettings, latent_size: int = LATENT_SIZE) -> None:
        super().__init__()
        self.settings = settings
        self.latent_size = latent_size
        self.register_buffer("feature_mean", torch.zeros(FEATURES))
        self.register_buffer("feature_scale", torch.ones(FEATURES))

    @abstractmethod
    def encode(self, states: Tensor, length: Tensor) -> tuple[Tensor, Tensor]:
        """Mean and log-variance of the latent, each (N, latent_size)."""

    @abstractmethod
    def loss(self, states: Tensor, length: Tensor, generator: torch.Generator) -> dict[str, Tensor]:
        """Named scalar terms of the training loss and ``"total"``, the one to minimise."""

    def fit_features(self, states: Tensor, length: Tensor) -> None:
        """Set the scaling from training windows; the first step, which has no displacement, is left out."""
        raw = displacement_and_gap(states)[:, 1:]
        values = raw[valid_steps(states, length)[:, 1:]].double()
        std = values.std(dim=0, correction=0)
        self.feature_mean.copy_(values.mean(dim=0))
        self.feature_scale.copy_(torch.where(std < SMALLEST_STD, 1.0, std) / torch.tensor(FEATURE_SPREAD))

    def features(self, states: Tensor, length: Tensor) -> Tensor:
        """Scaled displacement and gap (N, T, 2), zero after ``length``; the first displacement is zero too."""
        features = (displacement_and_gap(states) - self.feature_mean) / self.feature_scale
        features[:, 0, 0] = 0.0
        return torch.where(valid_steps(states, length).unsqueeze(-1), features, 0.0)


def displacement_and_gap(states: Tensor) -> Tensor:
    """(N, T, 2) in metres from (N, T, 2) of offset and gap; the first displacement is zero."""
    offset, gap = states.unbind(dim=-1)
    displacement = offset.diff(dim=1, prepend=offset[:, :1])
    return torch.stack((displacement, gap), dim=-1)


def valid_steps(states: Tensor, length: Tensor) -> Tensor:
    """Boolean (N, T): the steps before ``length``."""
    return torch.arange(states.shape[1], device=states.device) < length.unsqueeze(-1)


METHODS: dict[str, type[TraitModel]] = {}


def register(model: type[TraitModel]) -> type[TraitModel]:
    """Class decorator: make a method known under ``model.method``."""
    if model.method in METHODS:
        raise ValueError(f"two trait methods are called {model.method!r}")
    METHODS[model.method] = model
    return model


def find_method(name: Any) -> type[TraitModel]:
    """The method called ``name``.

    Raises:
        InputError: there is none.
    """
    if name not in METHODS:
        raise InputError(f"unknown trait method {name!r}; choose one of: {', '.join(sorted(METHODS))}")
    return METHODS[name]
