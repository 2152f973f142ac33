"""Training windows as tensors: batches, other windows of the same driver, and noise on measured positions."""

from collections.abc import Iterator
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from tint_sumo.config import NO_LEADER_GAP_M
from tint_sumo.dataset.windows import WindowFile, Windows


@dataclass(frozen=True)
class WindowBatch:
    """N windows as in ``tint_sumo.dataset.windows.Windows``; steps after a window's length have no influence."""

    states: Tensor  # (N, T, 2) m: offset and gap
    length: Tensor  # (N,)
    other: "WindowBatch | None" = None  # another window of each window's driver, or the same one if there is no other
    conservative: Tensor | None = None  # (N,) bool, for methods that are trained with labels
    no_leader_gap_m: float = NO_LEADER_GAP_M  # stands for the gap without a leader, and caps all gaps

    def with_noise(self, noise_m: float, generator: torch.Generator) -> "WindowBatch":
        """Return the same windows as if positions had been measured with noise."""
        if noise_m == 0.0:
            return self
        states = add_position_noise(self.states, noise_m, generator, self.no_leader_gap_m)
        other = None if self.other is None else self.other.with_noise(noise_m, generator)
        return replace(self, states=states, other=other)


class TrainingWindows:
    """All windows of a training run; ``conservative`` is None for methods that learn without labels."""

    def __init__(
        self,
        windows: Windows | WindowFile,
        conservative: Tensor | None = None,
        *,
        with_other: bool = False,
        no_leader_gap_m: float = NO_LEADER_GAP_M,
    ) -> None:
        self._windows = windows
        self._no_leader_gap_m = no_leader_gap_m
        self._conservative = conservative
        self._siblings = Siblings(torch.from_numpy(windows.driver)) if with_other else None

    def __len__(self) -> int:
        return len(self._windows)

    def parts(self) -> Iterator[WindowBatch]:
        """Yield all windows in their order, some thousands at a time."""
        for part in self._windows.parts():
            yield self._batch(part)

    def batch(self, index: Tensor, generator: torch.Generator) -> WindowBatch:
        """Return the windows (N,) at ``index``, with others that ``generator`` chooses."""
        labels = None if self._conservative is None else self._conservative[index]
        other = None
        if self._siblings is not None:
            chosen = self._siblings.draw(index, generator)
            other = self._batch(self._windows[chosen.numpy()])
        return replace(self._batch(self._windows[index.numpy()]), other=other, conservative=labels)

    def _batch(self, windows: Windows) -> WindowBatch:
        states, length = torch.from_numpy(windows.states), torch.from_numpy(windows.length)
        return WindowBatch(states, length, no_leader_gap_m=self._no_leader_gap_m)


class Siblings:
    """Other windows of each window's driver; ``driver`` (N,) numbers the drivers, whose windows are in a row."""

    def __init__(self, driver: Tensor) -> None:
        found, count = torch.unique_consecutive(driver, return_counts=True)
        if len(found.unique()) < len(found):
            raise ValueError("all windows of a driver must stand in a row")
        self._end = count.cumsum(0)  # (D,) of each driver's windows

    def draw(self, index: Tensor, generator: torch.Generator) -> Tensor:
        """Return another window of the same driver at random for each window, or the window itself if there is none."""
        driver = torch.searchsorted(self._end, index, right=True)
        end = self._end[driver]
        first = torch.where(driver > 0, self._end[driver - 1], 0)
        count = end - first
        step = 1 + (torch.rand(len(index), generator=generator) * (count - 1)).long()
        chosen: Tensor = first + (index - first + step) % count
        return chosen


def add_position_noise(
    states: Tensor, noise_m: float, generator: torch.Generator, no_leader_gap_m: float = NO_LEADER_GAP_M
) -> Tensor:
    """Return states (N, T, 2) with Gaussian noise of this standard deviation on all positions of all vehicles.

    A driver's noise shifts its offset and its gap, the leader's the gap. Offsets still count from the first measured
    position, and no gap exceeds the number that stands for "no leader".
    """
    driver_m, leader_m = noise_m * torch.randn(2, *states.shape[:2], generator=generator)
    offset, gap = states.unbind(dim=-1)
    measured_gap = torch.where(gap < no_leader_gap_m, (gap + leader_m - driver_m).clamp(max=no_leader_gap_m), gap)
    return torch.stack((offset + driver_m - driver_m[:, :1], measured_gap), dim=-1)
