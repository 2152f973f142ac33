"""Fits a car-following model to one pair: the parameters with which the simulated gap is nearest to the recorded one.

Objective (Kesting and Treiber 2008, Transportation Research Record 2088, 148-156): the follower is driven behind its
recorded leader from its first position and speed on, without any correction, and the sum of squared errors of the gap
is least. Errors of such a trajectory grow and fade slowly (Zhang and Sun 2022, https://arxiv.org/abs/2210.03571), so
intervals take them for an AR(1) process; with independent errors they would be far too narrow.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.optimize import least_squares, minimize_scalar
from scipy.signal import lfilter

from tint_sumo.drivers.models import CarFollowing, Floats
from tint_sumo.drivers.pairs import Pair

_STARTS = 5  # of a fit, the first with usual parameters
_MOST_TRIES = 60  # evaluations from one start
_FAR_M = 500.0  # errors count no more than this, so that one start gone astray stays finite
_STEP = 1e-4  # of a parameter's logarithm, in derivatives
_INSIDE = 1e-6  # a start lies so far within the bounds
_FASTER = 1.1  # desired speed at a start, at least, times the highest recorded speed
_LEAST_VARIANCE = 1e-10  # of a logarithm: 1e-5 of a parameter
_MOST_CORRELATED = 0.9999
_NORMAL_95 = 1.959964  # 97.5 % quantile of the normal distribution


@dataclass(frozen=True, eq=False)
class Estimate:
    """Logarithms of fitted parameters, with the covariance matrix of their errors."""

    log_parameters: Floats  # (P,)
    covariance: Floats  # (P, P)

    def interval(self, model: CarFollowing) -> tuple[Floats, Floats]:
        """Return the ends of the 95 % intervals of the logarithms, within the bounds of the parameters; (P,) each."""
        return interval(self.log_parameters, self.covariance, model)


def interval(mean: Floats, covariance: Floats, model: CarFollowing) -> tuple[Floats, Floats]:
    """Return the ends of the 95 % intervals of normal variables, within the bounds of a model's parameters."""
    half = _NORMAL_95 * np.sqrt(np.diag(covariance))
    return np.maximum(mean - half, model.low), np.minimum(mean + half, model.high)


def gap_errors_m(model: CarFollowing, pair: Pair, log_parameters: Floats) -> Floats:
    """Return simulated less recorded gap in each row; (T,)."""
    front_m, _ = model.follow(
        pair.leader_rear_m, pair.leader_speed_mps, pair.front_m[0], pair.speed_mps[0], log_parameters, pair.step_s
    )
    return np.clip(pair.front_m - front_m, -_FAR_M, _FAR_M)


def gap_rmse_m(model: CarFollowing, pair: Pair, log_parameters: Floats) -> float:
    """Return the root mean square error of the gap."""
    return float(np.sqrt(np.mean(gap_errors_m(model, pair, log_parameters) ** 2)))


def sensitivities(model: CarFollowing, pair: Pair, log_parameters: Floats) -> Floats:
    """Return the derivatives of the errors by the logarithms of the parameters; (T, P)."""
    columns = np.empty((pair.rows, len(log_parameters)))
    for index in range(len(log_parameters)):
        above, below = log_parameters.copy(), log_parameters.copy()
        above[index] = min(above[index] + _STEP, model.high[index])
        below[index] = max(below[index] - _STEP, model.low[index])
        change_m = gap_errors_m(model, pair, above) - gap_errors_m(model, pair, below)
        columns[:, index] = change_m / (above[index] - below[index])
    return columns


def starts(model: CarFollowing, pair: Pair) -> list[Floats]:
    """Return where a fit begins: usual parameters, and others drawn from all that is allowed, always the same ones."""
    rng = np.random.default_rng(0)
    drawn = [model.usual, *rng.uniform(model.low, model.high, (_STARTS - 1, len(model.low)))]
    return [inside(model, start, pair) for start in drawn]


def inside(model: CarFollowing, start: Floats, pair: Pair) -> Floats:
    """Return a start within the bounds, with a desired speed that exceeds the recorded speeds where it can.

    SUMO brakes hard down to the desired speed, and such a start would learn nothing.
    """
    start = start.copy()
    names = [parameter.name for parameter in model.parameters]
    speed = names.index("desired_speed_mps")
    start[speed] = max(start[speed], math.log(max(_FASTER * pair.speed_mps.max(), 1.0)))
    return np.clip(start, model.low + _INSIDE, model.high - _INSIDE)


def fit_pair(model: CarFollowing, pair: Pair) -> Estimate:
    """Fit a model to one pair, from several starts."""
    found = [
        least_squares(
            lambda z: gap_errors_m(model, pair, z),
            start,
            jac=lambda z: sensitivities(model, pair, z),
            bounds=(model.low, model.high),
            max_nfev=_MOST_TRIES,
        )
        for start in starts(model, pair)
    ]
    best = min(found, key=lambda result: float(result.cost)).x
    return Estimate(best, _covariance(model, pair, best))


def _covariance(model: CarFollowing, pair: Pair, best: Floats) -> Floats:
    """Return the covariance matrix of a least-squares fit with errors that follow an AR(1) process.

    It is that of the linearised model, J+ S J+', where S is the errors' covariance. Directions in which the recording
    says nothing have the spread of the allowed range.
    """
    errors_m, slopes = gap_errors_m(model, pair, best), sensitivities(model, pair, best)
    correlation, deviation_m = _noise(errors_m, slopes)
    # Sum over all pairs of rows of slope * correlation^distance * slope, by a filter that runs along the rows.
    smoothed = lfilter([1.0], [1.0, -correlation], slopes, axis=0)
    spread = deviation_m**2 * (slopes.T @ smoothed + smoothed.T @ slopes - slopes.T @ slopes)
    least = np.diag(12.0 / (model.high - model.low) ** 2)  # of a uniform distribution
    weight = max(deviation_m**2, 1e-12)
    solved = np.linalg.inv(slopes.T @ slopes + weight * least)
    covariance = solved @ (spread + weight**2 * least) @ solved
    # Where the model is exact, as in recordings of simulations, rounding can make the smallest variances negative.
    values, vectors = np.linalg.eigh((covariance + covariance.T) / 2.0)
    return np.asarray((vectors * np.maximum(values, _LEAST_VARIANCE)) @ vectors.T)


def _noise(errors_m: Floats, slopes: Floats) -> tuple[float, float]:
    """Return correlation of neighbouring errors, and deviation, of the AR(1) process behind a fit's errors.

    They are estimated by restricted maximum likelihood (REML), since the fit has taken up a part of the errors, of the
    slow ones most.
    """
    rows, count = len(errors_m) - 1, slopes.shape[1]
    if rows <= count:
        return autocorrelation([errors_m])

    def whitened(correlation: float) -> tuple[Floats, float]:
        """Return the normal matrix of the slopes, and the sum of squares that it leaves."""
        error = errors_m[1:] - correlation * errors_m[:-1]
        slope = slopes[1:] - correlation * slopes[:-1]
        matrix = slope.T @ slope
        matrix += (1e-9 * np.trace(matrix) / count + 1e-12) * np.eye(count)
        shift = slope.T @ error
        return matrix, max(float(error @ error - shift @ np.linalg.solve(matrix, shift)), 1e-12)

    def unlikelihood(log_distance: float) -> float:
        matrix, squares = whitened(1.0 - math.exp(log_distance))
        _, log_determinant = np.linalg.slogdet(matrix)
        return float((rows - count) * math.log(squares) + log_determinant)

    bounds = (math.log(1.0 - _MOST_CORRELATED), 0.0)
    correlation = 1.0 - math.exp(float(minimize_scalar(unlikelihood, bounds=bounds, method="bounded").x))
    innovation = whitened(correlation)[1] / (rows - count)
    return correlation, math.sqrt(innovation / (1.0 - correlation**2))


def autocorrelation(errors_m: Sequence[Floats]) -> tuple[float, float]:
    """Return correlation of neighbouring errors, and standard deviation, of AR(1) processes that begin at 0."""
    now = np.concatenate([errors[1:] for errors in errors_m])
    before = np.concatenate([errors[:-1] for errors in errors_m])
    power = float(before @ before)
    correlation = min(max(float(now @ before) / power, 0.0), _MOST_CORRELATED) if power > 0.0 else 0.0
    innovation = float(np.mean((now - correlation * before) ** 2)) if len(now) else 0.0
    return correlation, math.sqrt(innovation / (1.0 - correlation**2))
