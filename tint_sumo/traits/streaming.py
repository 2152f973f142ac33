"""Posteriors of drivers from all their windows so far, from a table of windows or with every step of a track.

Windows are independent given the trait, so that the posterior of several is the product of theirs, with the prior
N(0, 1) counted once. In terms of evidence, which is the precision beyond the prior's and the precision times the mean,
products are sums.
"""

from typing import Any, NamedTuple

import numpy as np
import pandas as pd
import torch
from numpy.typing import NDArray
from torch import Tensor

from tint_sumo.config import MIN_WINDOW_STEPS, WINDOW_STEPS
from tint_sumo.dataset.windows import capped
from tint_sumo.traits.cross_window import CrossWindow
from tint_sumo.traits.evaluation import Latents


def evidence(mean: Tensor, log_var: Tensor) -> Tensor:
    """Return the evidence (2, ..., latent_size) in posteriors of windows; a window cannot say less than the prior."""
    precision = torch.exp(-log_var).clamp(min=1.0)
    return torch.stack((precision - 1.0, precision * mean))


def posterior(total: Tensor) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Return mean and standard deviation, each (..., latent_size), from a sum of evidence; of none, the prior's."""
    mean, std = gaussian(total)
    return mean.numpy(), std.numpy()


def gaussian(total: Tensor) -> tuple[Tensor, Tensor]:
    """Return mean and standard deviation, as ``posterior`` does."""
    beyond_prior, weighted = total.unbind()
    precision = 1.0 + beyond_prior
    return weighted / precision, precision.rsqrt()


def fuse_so_far(latents: Latents, vehicle: NDArray[np.integer]) -> Latents:
    """Return the posteriors of each window and those before it of its vehicle, (N,), windows sorted by time."""
    found = evidence(torch.from_numpy(latents.mean), 2.0 * torch.from_numpy(latents.std).log())
    rows = pd.DataFrame(found.swapaxes(0, 1).flatten(1).numpy())
    total = torch.from_numpy(rows.groupby(vehicle).cumsum().to_numpy(copy=True))
    return Latents(*posterior(total.view(len(total), 2, -1).swapaxes(0, 1)))


class TrackState(NamedTuple):
    """All that the posteriors of K tracks need of the steps before; zeros at the start of a track."""

    hidden: Tensor  # (K, hidden_size)
    window_steps: Tensor  # (K,) int64, steps so far in the present window
    along_m: Tensor  # (K,)
    complete: Tensor  # (2, K, latent_size), evidence in complete windows


def advance(model: CrossWindow, before: TrackState, along_m: Tensor, gap_m: Tensor) -> tuple[TrackState, Tensor]:
    """Take one step of K tracks, each with its position along the lane and its gap, capped; both (K,).

    Returns:
        The state for the next step, and the evidence so far (2, K, latent_size).
    """
    begins = before.window_steps == 0
    displacement = torch.where(begins, 0.0, along_m - before.along_m)
    features = (torch.stack([displacement, gap_m], dim=-1) - model.feature_mean) / model.feature_scale
    features = torch.stack([features[:, 0].masked_fill(begins, 0.0), features[:, 1]], dim=-1)
    hidden = model.encoder.step(features, before.hidden.masked_fill(begins.unsqueeze(-1), 0.0))
    window_steps = before.window_steps + 1
    counts, complete = window_steps >= MIN_WINDOW_STEPS, window_steps == WINDOW_STEPS
    window = evidence(*model.encoder.heads(hidden)).masked_fill(~counts.unsqueeze(-1), 0.0)
    so_far = before.complete + window
    after = torch.where(complete.unsqueeze(-1), so_far, before.complete)
    return TrackState(hidden, window_steps.masked_fill(complete, 0), along_m, after), so_far


class TrackStream:
    """Posteriors of a cross-window model for M tracks so far.

    A track's windows of 20 steps follow one another from its first step on; the posteriors of those that are complete
    and of the present one, as far as it goes, are multiplied.

    Args:
        model: cross-window model.
        tracks: their number M.
    """

    steps: NDArray[np.float32]  # (M,) seen of each track

    def __init__(self, model: CrossWindow, tracks: int) -> None:
        self._model = model
        self._hidden = torch.zeros(tracks, model.settings.hidden_size)
        self._window_steps = torch.zeros(tracks, dtype=torch.int64)  # steps so far in the present window
        self._along_m = torch.zeros(tracks)
        self._complete = torch.zeros(2, tracks, model.latent_size)  # evidence in complete windows
        self.steps = np.zeros(tracks, np.float32)

    def forget(self, tracks: NDArray[np.int64]) -> None:
        """Start some tracks anew, given by their indices."""
        index = torch.from_numpy(tracks)
        self._window_steps[index] = 0
        self._complete[:, index] = 0.0
        self.steps[tracks] = 0.0

    def memory(self) -> dict[str, Any]:
        """Return the arrays and tensors with all that is known of the tracks, by name."""
        return {
            "hidden": self._hidden,
            "window_steps": self._window_steps,
            "along_m": self._along_m,
            "complete": self._complete,
            "steps": self.steps,
        }

    @torch.no_grad()
    def advance(
        self, tracks: NDArray[np.int64], along_m: NDArray[np.float32], gap_m: NDArray[np.floating]
    ) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
        """Take one step of K tracks, each at most once.

        Args:
            tracks: (K,) their indices.
            along_m: (K,) position along the lane.
            gap_m: (K,) to the leader, infinite without one.

        Returns:
            Mean and standard deviation of their latents, each (K, latent_size).
        """
        index, gap = torch.from_numpy(tracks), capped(gap_m, self._model.no_leader_gap_m).astype(np.float32)
        before = TrackState(
            self._hidden[index], self._window_steps[index], self._along_m[index], self._complete[:, index]
        )
        after, so_far = advance(self._model, before, torch.from_numpy(along_m), torch.from_numpy(gap))
        self._hidden[index], self._window_steps[index], self._along_m[index] = after[:3]
        self._complete[:, index] = after.complete
        self.steps[tracks] += 1.0
        return posterior(so_far)
