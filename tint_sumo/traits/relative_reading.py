"""Accuracy and calibration of probabilities of yielding, from relative traits or any other numbers about drivers."""

from dataclasses import dataclass
from typing import Self

import numpy as np
from numpy.typing import NDArray
from sklearn.linear_model import LogisticRegression

from tint_sumo.config import RelativeSettings
from tint_sumo.traits.perceived import Perceived
from tint_sumo.traits.relative_fit import follow

EVERY_STEPS = 10  # between two readings, which are alike from step to step
BINS = 10  # of the reliability diagram

Floats = NDArray[np.floating]


@dataclass(frozen=True)
class Readings:
    """Numbers about M drivers at some steps of the traffic, and whether they yield."""

    values: Floats  # (M, F)
    yields: NDArray[np.bool_]  # (M,)
    age_steps: NDArray[np.int64]  # (M,) since the track's first step

    @classmethod
    def of(cls, seen: Perceived, values: Floats) -> Self:
        """Return the readings of every tenth step of traffic; ``values`` are (T, N, V, F)."""
        steps = np.arange(len(seen.present))
        first = np.maximum.accumulate(np.where(seen.begins_track, steps[:, None, None], 0), axis=0)
        chosen = seen.present & (steps % EVERY_STEPS == EVERY_STEPS - 1)[:, None, None]
        age = (steps[:, None, None] - first)[chosen]
        return cls(values[chosen], seen.traits[chosen] == 0, age)


@dataclass(frozen=True)
class Reading:
    """Probabilities of yielding beside the truth, and their scores."""

    probability: Floats  # (M,) of yielding
    yields: NDArray[np.bool_]  # (M,)

    @property
    def accuracy(self) -> float:
        """Share of drivers whose likelier trait is the true one."""
        return float(np.mean((self.probability > 0.5) == self.yields))

    @property
    def brier(self) -> float:
        """Mean squared error of the probability: 0.25 for those who know nothing, 0 at best (Brier, 1950)."""
        return float(np.mean(np.square(self.probability - self.yields)))

    @property
    def calibration_error(self) -> float:
        """Expected calibration error: mean distance of probability and frequency in ten bins (Naeini et al., 2015)."""
        share, predicted, found = self.reliability().T
        return float(share @ np.abs(predicted - found))

    def reliability(self) -> NDArray[np.float64]:
        """Return the share of readings, mean probability and frequency of yielding of each bin that has any, (B, 3)."""
        where = np.minimum((self.probability * BINS).astype(int), BINS - 1)
        bins = [where == one for one in range(BINS)]
        return np.array([(b.mean(), self.probability[b].mean(), self.yields[b].mean()) for b in bins if b.any()])


def beliefs(settings: RelativeSettings, seen: Perceived) -> Reading:
    """Return the probabilities of yielding that relative traits give, in which no label has been used."""
    readings = Readings.of(seen, follow(settings, seen)[0])
    return Reading((readings.values[:, 0] + 1.0) / 2.0, readings.yields)


def read(training: Readings, test: Readings) -> Reading:
    """Return the probabilities that a logistic regression, fitted to labelled readings, gives to others.

    It is the linear classifier of the paper, with probabilities; nothing but it sees labels.
    """
    classifier = LogisticRegression(max_iter=1000).fit(training.values, training.yields)
    return Reading(classifier.predict_proba(test.values)[:, 1], test.yields)
