"""Rates of outcomes with their uncertainty; the methods are SciPy's."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Interval = tuple[float, float]
Hits = NDArray[np.bool_]  # (S, C): whether policies of S training seeds had some outcome in the same C cases
Scores = NDArray[np.float64]  # (S, T): rates of policies of S training seeds in T tasks

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
    seeds, cases = map(_numbers, hits.shape)
    return _interval((seeds, cases), lambda s, c: _mean(hits, s, c))


def difference_interval(first: Hits, second: Hits) -> Interval:
    """Return the 95 % interval of one method's rate minus another's on the same cases; their seeds are not paired."""
    seeds, others, cases = map(_numbers, (first.shape[0], second.shape[0], first.shape[1]))
    return _interval((seeds, others, cases), lambda s, o, c: _mean(first, s, c) - _mean(second, o, c))


def interquartile_mean(scores: Scores) -> float:
    """Return the mean of the middle half of all scores (Agarwal et al. 2021, as rliable computes it).

    A training that has failed changes it little, and so does one that was lucky.
    """
    from scipy.stats import trim_mean  # noqa: PLC0415 - as above

    return float(trim_mean(scores, 0.25, axis=None))


def interquartile_interval(scores: Scores) -> Interval:
    """Return the 95 % interval of the interquartile mean: the seeds of each task are resampled by themselves."""
    from scipy.stats import trim_mean  # noqa: PLC0415 - as above

    (samples,) = _resampled(scores)
    return _ends(trim_mean(samples.reshape(RESAMPLES, -1), 0.25, axis=1))


def improvement(scores: Scores, others: Scores) -> float:
    """Return the probability that a training of one method beats one of another in a task, mean over the tasks.

    A draw counts half (Agarwal et al. 2021). The tasks are the same, the seeds are not paired.
    """
    return float(_improvement(scores[None], others[None])[0])


def improvement_interval(scores: Scores, others: Scores) -> Interval:
    """Return the 95 % interval of ``improvement``: the seeds of each task are resampled by themselves."""
    return _ends(_improvement(*_resampled(scores, others)))


def _improvement(scores: NDArray[np.float64], others: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the probabilities (R,) for scores (R, S, T) and others (R, Q, T)."""
    difference = np.sign(scores[:, :, None] - others[:, None])
    return np.asarray(0.5 + 0.5 * difference.mean(axis=(1, 2, 3)))


def _resampled(*all_scores: Scores) -> list[NDArray[np.float64]]:
    """Return resamples (R, S, T) of scores, with the seeds of each task drawn anew with replacement."""
    rng = np.random.default_rng(0)
    drawn = [rng.integers(len(scores), size=(RESAMPLES, *scores.shape)) for scores in all_scores]
    return [np.take_along_axis(scores[None], seeds, axis=1) for scores, seeds in zip(all_scores, drawn, strict=True)]


def _ends(found: NDArray[np.float64]) -> Interval:
    """Return the percentile interval of a statistic's resamples (R,)."""
    low, high = np.quantile(found, [(1.0 - CONFIDENCE) / 2, (1.0 + CONFIDENCE) / 2])
    return float(low), float(high)


def _numbers(size: int) -> NDArray[np.int64]:
    """Return the numbers of seeds or cases; the only one twice, because SciPy resamples two or more."""
    return np.arange(size) if size > 1 else np.zeros(2, np.int64)


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
