"""Training windows as tensors: batches, other windows of the same driver, and noise on measured positions."""

from dataclasses import dataclass

import torch
from torch import Tensor

from tint_sumo.config import NO_LEADER_GAP_M
from tint_sumo.dataset.windows import Windows


@dataclass(frozen=True)
class WindowBatch:
    """N windows as in ``tint_sumo.dataset.windows.Windows``; what stands after a window's length is of no account."""

    states: Tensor  # (N, T, 2) m: offset and gap
    length: Tensor  # (N,)
    other: "WindowBatch | None" = None  # another window of each window's driver, or the same one if there is no other
    conservative: Tensor | None = None  # (N,) bool, for methods that are trained with labels

    def with_noise(self, noise_m: float, generator: torch.Generator) -> "WindowBatch":
        """The same windows as positions measured with noise would give them."""
        if noise_m == 0.0:
            return self
        states = add_position_noise(self.states, noise_m, generator)
        other = None if self.other is None else self.other.with_noise(noise_m, generator)
        return WindowBatch(states, self.length, other, self.conservative)


class TrainingWindows:
    """All windows of a training run; ``conservative`` is None for methods that learn without labels."""

    def __init__(self, windows: Windows, conservative: Tensor | None = None, *, with_other: bool = False) -> None:
        self.states = torch.from_numpy(windows.states)
        self.length = torch.from_numpy(windows.length)
        self._conservative = conservative
        self._siblings = Siblings(torch.from_numpy(windows.driver)) if with_other else None

    def batch(self, index: Tensor, generator: torch.Generator) -> WindowBatch:
        """The windows (N,) at ``index``, beside others that ``generator`` chooses."""
        labels = None if self._conservative is None else self._conservative[index]
        other = None
        if self._siblings is not None:
            chosen = self._siblings.draw(index, generator)
            other = WindowBatch(self.states[chosen], self.length[chosen])
        return WindowBatch(self.states[index], self.length[index], other, labels)


class Siblings:
    """For each window the other windows of its driver."""

    def __init__(self, driver: Tensor) -> None:
        self._sorted = torch.argsort(driver, stable=True)  # windows, driver by driver
        _, inverse, count = torch.unique(driver, return_inverse=True, return_counts=True)
        self._count = count[inverse]
        self._first = (count.cumsum(0) - count)[inverse]  # position of a driver's first window
        self._rank = torch.empty_like(self._sorted)  # number of a window among those of its driver
        self._rank[self._sorted] = torch.arange(len(driver))
        self._rank -= self._first

    def draw(self, index: Tensor, generator: torch.Generator) -> Tensor:
        """For each window one of its driver's others at random, or itself if there is none."""
        count = self._count[index]
        step = 1 + (torch.rand(len(index), generator=generator) * (count - 1)).long()
        return self._sorted[self._first[index] + (self._rank[index] + step) % count]


def add_position_noise(states: Tensor, noise_m: float, generator: torch.Generator) -> Tensor:
    """States (N, T, 2) as measured with Gaussian noise of this standard deviation on every vehicle's every position.

    A driver's noise shifts its offset and its gap, the leader's the gap. Offsets still count from the first measured
    position, and nobody's gap exceeds the one that stands for "no leader".
    """
    own, leaders = noise_m * torch.randn(2, *states.shape[:2], generator=generator)
    offset, gap = states.unbind(dim=-1)
    measured_gap = torch.where(gap < NO_LEADER_GAP_M, (gap + leaders - own).clamp(max=NO_LEADER_GAP_M), gap)
    return torch.stack((offset + own - own[:, :1], measured_gap), dim=-1)
