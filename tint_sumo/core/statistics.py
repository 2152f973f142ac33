"""Rates of outcomes with their uncertainty; the methods are SciPy's."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Interval = tuple[float, float]
Hits = NDArray[np.bool_]  # (S, C): whether policies of S training seeds had some outcome in the same C cases

RESAMPLES = 2000
CONFIDENCE = 0.95


@dataclass(frozen=True)
class Rate:
    """``count`` of ``total`` cases, as a fraction with its 95 % Wilson interval."""

    count: int
    total: int

    @property
    def value(self) -> float:
        return self.count / self.total

    @property
    def interval(self) -> Interval:
        """Wilson interval for one policy, without the spread between trainings."""
        from scipy.stats import binomtest  # noqa: PLC0415 - loads for half a second, and trainings need none of it

        found = binomtest(self.count, self.total).proportion_ci(CONFIDENCE, method="wilson")
        return float(found.low), float(found.high)


def rate_interval(hits: Hits) -> Interval:
    """Return the 95 % interval of a method's rate, over training seeds and cases.

    Both are resampled, each with replacement, as in a new study with other seeds and other cases
    (percentile bootstrap). With few seeds it is somewhat too narrow.
    """
    seeds, cases = (np.arange(size) for size in hits.shape)
    return _interval((seeds, cases), lambda s, c: _mean(hits, s, c))


def difference_interval(first: Hits, second: Hits) -> Interval:
    """Return the 95 % interval of one method's rate minus another's on the same cases; their seeds are not paired."""
    seeds, others, cases = (np.arange(size) for size in (first.shape[0], second.shape[0], first.shape[1]))
    return _interval((seeds, others, cases), lambda s, o, c: _mean(first, s, c) - _mean(second, o, c))


def _interval(samples: Sequence[NDArray[np.int64]], statistic: Callable[..., NDArray[np.float64]]) -> Interval:
    from scipy.stats import bootstrap  # noqa: PLC0415 - as above

    found = bootstrap(
        samples,
        lambda *resampled, axis: statistic(*resampled),  # noqa: ARG005, PLW0108 - SciPy passes an axis
        n_resamples=RESAMPLES,
        batch=50,
        vectorized=True,
        paired=False,
        method="percentile",
        confidence_level=CONFIDENCE,
        rng=np.random.default_rng(0),
    )
    return float(found.confidence_interval.low), float(found.confidence_interval.high)


def _mean(hits: Hits, seeds: NDArray[np.int64], cases: NDArray[np.int64]) -> NDArray[np.float64]:
    """Return the mean over some seeds and cases, given by indices (..., S) and (..., C)."""
    return np.asarray(hits[seeds[..., :, None], cases[..., None, :]].mean(axis=(-2, -1)))
