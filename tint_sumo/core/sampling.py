"""Some of many."""

import numpy as np
from numpy.typing import NDArray


def evenly_spread(size: int, count: int) -> NDArray[np.int64]:
    """Return ``count`` indices in 0 to ``size - 1`` at even distances, with the first and the last among them.

    Without ``count`` different ones, all of them are returned.
    """
    return np.linspace(0, size - 1, min(count, size)).round().astype(np.int64)
