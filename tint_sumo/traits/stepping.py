"""Trait models that take one step at a time and hand their state back, for programs that run them from files."""

from abc import ABC, abstractmethod

import torch
from torch import Tensor, nn

from tint_sumo.config import STEP_S
from tint_sumo.traits.classifier import Classifier
from tint_sumo.traits.cross_window import CrossWindow
from tint_sumo.traits.model import TraitModel
from tint_sumo.traits.streaming import TrackState, advance, gaussian

AGE_SCALE_S = 10.0  # a vehicle crosses the street in 15 to 20 s


class TraitSteps(nn.Module, ABC):
    """One step of N vehicles.

    ``forward`` takes the position of each along its lane (N,), m, its gap to the leader (N,), m, infinite without one,
    and the state (N, S), zeros at first. It returns the numbers that policies take (N, Z) and the next state.
    """

    model: TraitModel
    state_size: int
    meaning: str  # of the numbers
    begins: str  # when the state is zeros

    @abstractmethod
    def forward(self, position_m: Tensor, gap_m: Tensor, state: Tensor) -> tuple[Tensor, Tensor]:
        """Return the numbers and the next state."""


class WindowSteps(TraitSteps):
    """The window so far of any trait model: the latent means, or the class of a classifier."""

    begins = "zeros at the first step of a window, which has 20 steps or, for a vehicle that came later, fewer"

    def __init__(self, model: TraitModel) -> None:
        super().__init__()
        self.model = model
        self.state_size = model.settings.hidden_size + 3
        self.meaning = "means of the latents"
        if isinstance(model, Classifier):
            self.meaning = "class: 1 and 0 for a conservative driver, 0 and 1 for an aggressive one"

    def forward(self, position_m: Tensor, gap_m: Tensor, state: Tensor) -> tuple[Tensor, Tensor]:
        hidden, memory = state[:, :-3], state[:, -3:]
        steps, last_m, before_m = memory.unbind(-1)
        gap = gap_m.clamp(max=self.model.no_leader_gap_m)
        positions = torch.stack([before_m, last_m, position_m], dim=-1)
        states = torch.stack([positions - before_m.unsqueeze(-1), gap.unsqueeze(-1).expand_as(positions)], dim=-1)
        features = self.model.scaled(self.model.raw_features(states)[:, -1])
        undefined = torch.tensor(self.model.undefined_steps, device=state.device)
        features = torch.where(steps.unsqueeze(-1) < undefined, 0.0, features)
        hidden = self.model.encoder.step(features, hidden)
        mean, _ = self.model.encoder.heads(hidden)
        after = torch.cat([hidden, torch.stack([steps + 1.0, position_m, last_m], dim=-1)], dim=-1)
        if isinstance(self.model, Classifier):
            is_conservative = (self.model.logit(mean) > 0.0).float()
            mean = torch.stack([is_conservative, 1.0 - is_conservative], dim=-1)
        return mean, after


class TrackSteps(TraitSteps):
    """The whole track so far, by a cross-window model: mean, standard deviation and for how long it has been seen."""

    begins = "zeros at the first step of a vehicle"

    def __init__(self, model: CrossWindow) -> None:
        super().__init__()
        self.model: CrossWindow = model
        self.state_size = model.settings.hidden_size + 2 * model.latent_size + 3
        self.meaning = "means of the latents, their standard deviations, and the time the vehicle has been seen / 10 s"

    def forward(self, position_m: Tensor, gap_m: Tensor, state: Tensor) -> tuple[Tensor, Tensor]:
        sizes = [self.model.settings.hidden_size, 2 * self.model.latent_size, 1, 1, 1]
        hidden, complete, window_steps, along_m, steps = torch.split(state, sizes, dim=-1)
        before = TrackState(
            hidden,
            window_steps.squeeze(-1).to(torch.int64),
            along_m.squeeze(-1),
            complete.reshape(-1, 2, self.model.latent_size).movedim(1, 0),
        )
        after, so_far = advance(self.model, before, position_m, gap_m.clamp(max=self.model.no_leader_gap_m))
        mean, std = gaussian(so_far)
        seen = steps + 1.0
        memory = [after.window_steps.unsqueeze(-1).to(state.dtype), after.along_m.unsqueeze(-1), seen]
        following = torch.cat([after.hidden, after.complete.movedim(0, 1).flatten(1), *memory], dim=-1)
        return torch.cat([mean, std, seen * (STEP_S / AGE_SCALE_S)], dim=-1), following
