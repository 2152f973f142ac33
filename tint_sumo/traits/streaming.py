"""Traits of many tracks at once, brought up to date with every step instead of read from whole windows."""

from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from tint_sumo.config import MIN_WINDOW_STEPS, WINDOW_STEPS
from tint_sumo.traits.cross_window import CrossWindow


class TrackStream:
    """What a cross-window model says of M tracks so far.

    A track's windows of 20 steps follow one another from its first step on; the posteriors of those that are complete
    and of the present one, as far as it goes, are multiplied. After every step the result is that of
    ``CrossWindow.encode`` for the whole track up to then.

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
        self._complete = torch.zeros(2, tracks, model.latent_size)  # evidence of complete windows, see _evidence
        self.steps = np.zeros(tracks, np.float32)

    def forget(self, tracks: NDArray[np.int64]) -> None:
        """Start some tracks anew, given by their indices."""
        index = torch.from_numpy(tracks)
        self._window_steps[index] = 0
        self._complete[:, index] = 0.0
        self.steps[tracks] = 0.0

    def memory(self) -> dict[str, Any]:
        """The arrays and tensors that hold what it has seen, by name."""
        return {
            "hidden": self._hidden,
            "window_steps": self._window_steps,
            "along_m": self._along_m,
            "complete": self._complete,
            "steps": self.steps,
        }

    @torch.no_grad()
    def advance(
        self, tracks: NDArray[np.int64], along_m: NDArray[np.float32], gap_m: NDArray[np.float32]
    ) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
        """Take one step of K tracks, each at most once.

        Args:
            tracks: (K,) their indices.
            along_m: (K,) position along the lane.
            gap_m: (K,) to the leader.

        Returns:
            Mean and standard deviation of their latents, each (K, latent_size).
        """
        index, along = torch.from_numpy(tracks), torch.from_numpy(along_m)
        begins = self._window_steps[index] == 0
        displacement = torch.where(begins, 0.0, along - self._along_m[index])
        raw = torch.stack([displacement, torch.from_numpy(gap_m)], dim=-1)
        features = (raw - self._model.feature_mean) / self._model.feature_scale
        features[:, 0].masked_fill_(begins, 0.0)
        hidden = self._model.encoder.step(features, self._hidden[index].masked_fill_(begins.unsqueeze(-1), 0.0))
        window_steps = self._window_steps[index] + 1
        counts, complete = window_steps >= MIN_WINDOW_STEPS, window_steps == WINDOW_STEPS
        self._hidden[index], self._along_m[index] = hidden, along
        self._window_steps[index] = window_steps.masked_fill(complete, 0)
        self.steps[tracks] += 1.0

        window = self._evidence(hidden).masked_fill_(~counts.view(-1, 1, 1), 0.0)
        so_far = self._complete[:, index] + window.transpose(0, 1)
        self._complete[:, index] = torch.where(complete.unsqueeze(-1), so_far, self._complete[:, index])
        precision, weighted = so_far
        total = 1.0 + precision
        return (weighted / total).numpy(), total.rsqrt().numpy()

    def _evidence(self, hidden: Tensor) -> Tensor:
        """Of windows with these states (K, hidden): precision beyond the prior's, and precision times mean.

        Both add up over windows; see ``tint_sumo.traits.cross_window.fuse``. (K, 2, latent_size).
        """
        mean, log_var = self._model.encoder.heads(hidden)
        precision = torch.exp(-log_var).clamp(min=1.0)
        return torch.stack([precision - 1.0, precision * mean], dim=1)
