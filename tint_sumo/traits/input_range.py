"""The range of a model's training windows, and which other windows lie outside of it."""

from collections.abc import Iterable
from dataclasses import asdict, dataclass
from typing import Self

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from tint_sumo.config import WINDOW_STEPS
from tint_sumo.core.errors import InputError
from tint_sumo.dataset.windows import Windows, valid_steps

INPUTS = ("offset", "gap")  # of a step of a window
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
        return self.farthest_outside(windows)["outside"].to_numpy()

    def farthest_outside(self, windows: Windows) -> pd.DataFrame:
        """Return which input of each window is the farthest beyond the range of the training, a row for each of N.

        Returns:
            outside (whether there is any), outside_input ("offset", "gap" or "none"), outside_step (1 to 20; 0
            inside), outside_m (its value), and trained_low_m and trained_high_m (the least and the most that the
            training had at that step; NaN where no window of it was so long). Numbers in m are NaN inside.
        """
        low = np.stack((self.low_offset_m, self.low_gap_m), axis=-1)
        high = np.stack((self.high_offset_m, self.high_gap_m), axis=-1)
        missing = low > high
        # Where the training had nothing, all values are equally far outside.
        by_m = np.where(missing, np.inf, np.maximum(low - windows.states, windows.states - high))
        by_m = np.where(valid_steps(windows.length)[:, :, None], by_m, -np.inf).reshape(len(windows), -1)
        farthest = by_m.argmax(axis=1)
        outside = by_m[np.arange(len(windows)), farthest] > MARGIN_M
        step, kind = np.divmod(farthest, len(INPUTS))
        value = windows.states[np.arange(len(windows)), step, kind].astype(np.float64)
        known = outside & ~missing[step, kind]
        return pd.DataFrame(
            {
                "outside": outside,
                "outside_input": np.where(outside, np.array(INPUTS)[kind], "none"),
                "outside_step": np.where(outside, step + 1, 0),
                "outside_m": np.where(outside, value, np.nan).round(3),
                "trained_low_m": np.where(known, low[step, kind], np.nan),
                "trained_high_m": np.where(known, high[step, kind], np.nan),
            }
        )
