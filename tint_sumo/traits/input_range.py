"""The range of a model's training windows, and which other windows lie outside of it."""

from collections.abc import Iterable
from dataclasses import asdict, dataclass
from typing import Self

import numpy as np
from numpy.typing import NDArray

from tint_sumo.config import WINDOW_STEPS
from tint_sumo.core.errors import InputError
from tint_sumo.dataset.windows import Windows, valid_steps

MARGIN_M = 0.1  # positions with two decimals, as SUMO writes them, are no other input

_Steps = tuple[float, ...]  # WINDOW_STEPS numbers, m


@dataclass(frozen=True)
class InputRange:
    """The least and the most that each step of the training windows has: offset from the first position, and gap."""

    low_offset_m: _Steps
    high_offset_m: _Steps
    low_gap_m: _Steps
    high_gap_m: _Steps

    def __post_init__(self) -> None:
        for name, steps in asdict(self).items():
            if len(steps) != WINDOW_STEPS:
                raise InputError(f"{name} must have {WINDOW_STEPS} numbers, not {len(steps)}")

    @classmethod
    def of(cls, parts: Iterable[Windows]) -> Self:
        """Return the range of windows that come in parts."""
        low, high = np.full((WINDOW_STEPS, 2), np.inf), np.full((WINDOW_STEPS, 2), -np.inf)
        for part in parts:
            valid = valid_steps(part.length)[:, :, None]
            low = np.minimum(low, np.where(valid, part.states, np.inf).min(axis=0))
            high = np.maximum(high, np.where(valid, part.states, -np.inf).max(axis=0))
        missing = low > high  # no window is so long: every value there is outside
        low, high = np.where(missing, 0.0, low), np.where(missing, -1.0, high)
        rounded = (np.round(steps, 3).tolist() for steps in (low[:, 0], high[:, 0], low[:, 1], high[:, 1]))
        return cls(*map(tuple, rounded))

    def outside(self, windows: Windows) -> NDArray[np.bool_]:
        """Return which of N windows have a step whose offset or gap no training window had at that step, (N,)."""
        low = np.stack((self.low_offset_m, self.low_gap_m), axis=-1) - MARGIN_M
        high = np.stack((self.high_offset_m, self.high_gap_m), axis=-1) + MARGIN_M
        beyond = ((windows.states < low) | (windows.states > high)).any(axis=2)
        return np.asarray((beyond & valid_steps(windows.length)).any(axis=1))
