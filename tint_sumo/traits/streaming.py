"""Posteriors of drivers from all their windows so far, from a table of windows or with every step of a track.

Windows are independent given the trait, so that the posterior of several is the product of theirs, with the prior
N(0, 1) counted once. In terms of evidence, which is the precision beyond the prior's and the precision times the mean,
products are sums.
"""

from typing import Any

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
    beyond_prior, weighted = total
    precision = 1.0 + beyond_prior
    return (weighted / precision).numpy(), precision.rsqrt().numpy()


def fuse_so_far(latents: Latents, vehicle: NDArray[np.integer]) -> Latents:
    """Return the posteriors of each window and those before it of its vehicle, (N,), windows sorted by time."""
    found = evidence(torch.from_numpy(latents.mean), 2.0 * torch.from_numpy(latents.std).log())
    rows = pd.DataFrame(found.swapaxes(0, 1).flatten(1).numpy())
    total = torch.from_numpy(rows.groupby(vehicle).cumsum().to_numpy(copy=True))
    return Latents(*posterior(total.view(len(total), 2, -1).swapaxes(0, 1)))


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
        index, along = torch.from_numpy(tracks), torch.from_numpy(along_m)
        begins = self._window_steps[index] == 0
        displacement = torch.where(begins, 0.0, along - self._along_m[index])
        raw = torch.stack(
            [displacement, torch.from_numpy(capped(gap_m, self._model.no_leader_gap_m).astype(np.float32))], dim=-1
        )
        features = (raw - self._model.feature_mean) / self._model.feature_scale
        features[:, 0].masked_fill_(begins, 0.0)
        hidden = self._model.encoder.step(features, self._hidden[index].masked_fill_(begins.unsqueeze(-1), 0.0))
        window_steps = self._window_steps[index] + 1
        counts, complete = window_steps >= MIN_WINDOW_STEPS, window_steps == WINDOW_STEPS
        self._hidden[index], self._along_m[index] = hidden, along
        self._window_steps[index] = window_steps.masked_fill(complete, 0)
        self.steps[tracks] += 1.0

        window = evidence(*self._model.encoder.heads(hidden)).masked_fill_(~counts.unsqueeze(-1), 0.0)
        so_far = self._complete[:, index] + window
        self._complete[:, index] = torch.where(complete.unsqueeze(-1), so_far, self._complete[:, index])
        return posterior(so_far)
