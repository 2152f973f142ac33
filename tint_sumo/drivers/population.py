"""The population of drivers: how drivers differ, and how a driver differs from one situation to the next.

Model, with z the logarithms of the parameters:

* a driver d has z_d ~ N(mean, between): correlated log-normals;
* with each leader it drives by z_p ~ N(z_d, within), since drivers do not keep their parameters from one situation to
  the next;
* the errors of the gap, looked at once a second, follow an AR(1) process that begins at 0, with the same correlation
  and deviation for all pairs.

It is fitted by expectation maximisation. In the expectation each pair's likelihood is replaced by a normal
distribution; all else is linear and normal, and solved exactly. That normal distribution is found from the mode on
(Laplace), and then by importance sampling around it, since likelihoods are skewed: hardly any braking is too hard.
Inverse Wishart priors on both covariances weigh as much as ``PRIOR_WEIGHT`` drivers.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cache

import numpy as np
from scipy.optimize import least_squares

from tint_sumo.core.progress import Progress, Report, silent
from tint_sumo.drivers.fitting import Estimate, autocorrelation, gap_errors_m, inside, sensitivities
from tint_sumo.drivers.models import CarFollowing, Floats
from tint_sumo.drivers.pairs import Pair

SPACING_S = 1.0  # time between the errors that the noise model looks at; nearer ones hardly differ
PRIOR_WEIGHT = 10.0
_PRIOR_SPREAD = 0.35  # standard deviation of a logarithm, between drivers and within each
_PRIOR_SPEED_SPREAD = 0.15  # that of desired speeds
_FIRST_NOISE = (0.9, 3.0)  # correlation, and deviation in m
_MOST_ITERATIONS = 20
_SETTLED = 0.02  # change of means and of logarithms of spreads from which the fit is finished
_MOST_TRIES = 40
_POINTS = 256  # at which a pair's posterior is looked at
_FREEDOM = 6.0  # degrees of the t distribution from which they are drawn
_LEAST_PRECISION, _LEAST_VARIANCE = 1e-6, 1e-9
_TRIES = 20  # draws for each one that is wanted, of which some are out of bounds
_LEAST_DEVIATION_M = 0.01  # in recordings of our simulations the model is exact


@dataclass(frozen=True)
class Noise:
    """Errors of the gap in a second's distance: an AR(1) process."""

    correlation: float
    deviation_m: float

    def whitened(self, errors_m: Floats) -> Floats:
        """Return innovations in units of their deviation, from errors a second apart; one row less."""
        scale = self.deviation_m * math.sqrt(1.0 - self.correlation**2)
        return np.asarray((errors_m[1:] - self.correlation * errors_m[:-1]) / scale)


@dataclass(frozen=True, eq=False)
class Population:
    """Distribution of the logarithms of the parameters."""

    mean: Floats  # (P,)
    between: Floats  # (P, P) covariance of drivers
    within: Floats  # (P, P) covariance of a driver's pairs
    noise: Noise

    @property
    def total(self) -> Floats:
        """Covariance of the parameters in one situation, over drivers and situations; (P, P)."""
        return self.between + self.within

    @property
    def any_pair(self) -> Estimate:
        """Distribution of the parameters of a pair without a recording."""
        return Estimate(self.mean, self.total)


@dataclass(frozen=True, eq=False)
class Evidence:
    """Likelihood of a pair's parameters as a normal distribution, given by its precision."""

    mode: Floats  # (P,) with the prior
    precision: Floats  # (P, P)
    shift: Floats  # (P,) precision times mean


def prior(model: CarFollowing) -> Population:
    """Return the population that a fit begins with."""
    spreads = [
        _PRIOR_SPEED_SPREAD if parameter.name == "desired_speed_mps" else _PRIOR_SPREAD
        for parameter in model.parameters
    ]
    covariance = np.diag(np.square(spreads))
    return Population(model.usual, covariance, covariance, Noise(*_FIRST_NOISE))


def evidence(model: CarFollowing, pair: Pair, population: Population, starts: Sequence[Floats]) -> Evidence:
    """Find what a pair says about its parameters.

    The pair's posterior among the population has a mode and a curvature there (Laplace). Points are drawn from a t
    distribution of that form, and weighted with the posterior; the normal distribution with their mean and covariance,
    divided by that of the population, is what the pair says.

    Args:
        model: car-following model.
        pair: what was recorded.
        population: the prior of the mode, and the noise.
        starts: where to look for the mode.
    """
    every = max(1, round(SPACING_S / pair.step_s))
    root = np.linalg.cholesky(np.linalg.inv(population.total)).T

    def errors(z: Floats) -> Floats:
        misfit = population.noise.whitened(gap_errors_m(model, pair, z)[::every])
        return np.concatenate([misfit, root @ (z - population.mean)])

    def slopes(z: Floats) -> Floats:
        return np.concatenate([population.noise.whitened(sensitivities(model, pair, z)[::every]), root])

    found = [
        least_squares(
            errors, inside(model, start, pair), jac=slopes, bounds=(model.low, model.high), max_nfev=_MOST_TRIES
        )
        for start in starts
    ]
    best = min(found, key=lambda result: float(result.cost))
    slope = slopes(best.x)
    curvature: Floats = slope.T @ slope
    points, log_density = _around(best.x, curvature)
    log_weights = np.full(len(points), -np.inf)
    for index in np.flatnonzero(((points >= model.low) & (points <= model.high)).all(axis=1)):
        error = errors(points[index])
        log_weights[index] = -float(error @ error) / 2.0 - log_density[index]
    mean, covariance = _weighted_moments(points, log_weights)
    # The pair's share of this posterior is that which the population does not explain, and never less than nothing.
    alone = root.T @ root
    values, vectors = np.linalg.eigh(np.linalg.inv(covariance) - alone)
    precision = (vectors * np.maximum(values, _LEAST_PRECISION)) @ vectors.T
    return Evidence(best.x, precision, precision @ mean + alone @ (mean - population.mean))


def _around(mode: Floats, precision: Floats) -> tuple[Floats, Floats]:
    """Return points from a t distribution, always from the same draws, and log densities but for a constant."""
    standard = _standard_draws(len(mode))
    log_density = -(_FREEDOM + len(mode)) / 2.0 * np.log1p((standard**2).sum(axis=1) / _FREEDOM)
    return mode + standard @ np.linalg.cholesky(np.linalg.inv(precision)).T, log_density


@cache
def _standard_draws(count: int) -> Floats:
    rng = np.random.default_rng(0)
    return rng.standard_normal((_POINTS, count)) / np.sqrt(rng.chisquare(_FREEDOM, (_POINTS, 1)) / _FREEDOM)


def _weighted_moments(points: Floats, log_weights: Floats) -> tuple[Floats, Floats]:
    """Return mean and covariance matrix of weighted points."""
    weights = np.exp(log_weights - log_weights.max())
    weights /= weights.sum()
    mean = weights @ points
    off = points - mean
    return mean, (off * weights[:, None]).T @ off + _LEAST_VARIANCE * np.eye(len(mean))


def posterior(population: Population, found: Sequence[Evidence]) -> Estimate:
    """Return a driver's parameters z_d, given its pairs; the population's if there are none."""
    precision = np.linalg.inv(population.between)
    shift = precision @ population.mean
    inverse = np.linalg.inv(population.within)
    for one in found:
        # The pair's own parameters are integrated out.
        seen = inverse @ np.linalg.inv(inverse + one.precision)
        precision = precision + inverse - seen @ inverse
        shift = shift + seen @ one.shift
    covariance = np.linalg.inv(precision)
    return Estimate(covariance @ shift, covariance)


def next_pair(population: Population, driver: Estimate) -> Estimate:
    """Return what is known of a driver's next pair, behind another leader."""
    return Estimate(driver.log_parameters, driver.covariance + population.within)


def draws(model: CarFollowing, known: Estimate, count: int, seed: int) -> Floats:
    """Draw parameters from the part of a distribution that lies within their bounds; (count, P) logarithms."""
    rng = np.random.default_rng(seed)
    drawn = rng.multivariate_normal(known.log_parameters, known.covariance, _TRIES * count, method="cholesky")
    inside_first = np.argsort(((drawn < model.low) | (drawn > model.high)).any(axis=1), kind="stable")
    return np.clip(drawn[inside_first[:count]], model.low, model.high)


def predicted_gap_m(model: CarFollowing, pair: Pair, known: Estimate, count: int = 200, seed: int = 0) -> Floats:
    """Predict the gap of a pair: in each row the median over drivers that are drawn from what is known; (T,)."""
    errors_m = [gap_errors_m(model, pair, z) for z in draws(model, known, count, seed)]
    return np.asarray(pair.gap_m + np.median(errors_m, axis=0))


@dataclass(frozen=True, eq=False)
class Iteration:
    """State of a fit between two iterations."""

    number: int
    population: Population
    modes: Mapping[str, Floats]  # of the pairs, by their names
    is_last: bool = False


def first_iteration(model: CarFollowing, modes: Mapping[str, Floats]) -> Iteration:
    """Return the state in which a fit begins, with the modes of the pairs alone."""
    return Iteration(0, prior(model), modes)


def iterate(model: CarFollowing, pairs: Sequence[Pair], state: Iteration, report: Report = silent) -> Iteration:
    """Do one iteration of expectation maximisation."""
    population = state.population
    found: dict[str, Evidence] = {}
    for done, pair in enumerate(pairs):
        report(Progress(done, len(pairs), "pair"))
        starts = [state.modes[pair.name], *([population.mean] if state.number == 0 else [])]
        found[pair.name] = evidence(model, pair, population, starts)
    by_driver: dict[str, list[Evidence]] = {}
    for pair in pairs:
        by_driver.setdefault(pair.driver, []).append(found[pair.name])
    start = prior(model)
    drivers = [moments(population, evidences) for evidences in by_driver.values()]
    mean = np.mean([driver.log_parameters for driver, _ in drivers], axis=0)
    off = np.array([driver.log_parameters - mean for driver, _ in drivers])
    between = off.T @ off + np.sum([driver.covariance for driver, _ in drivers], axis=0)
    within = np.sum([spread for _, spread in drivers], axis=0)
    every = max(1, round(SPACING_S / pairs[0].step_s))
    errors_m = [gap_errors_m(model, pair, found[pair.name].mode)[::every] for pair in pairs]
    correlation, deviation_m = autocorrelation(errors_m)
    updated = Population(
        mean,
        (between + PRIOR_WEIGHT * start.between) / (len(drivers) + PRIOR_WEIGHT),
        (within + PRIOR_WEIGHT * start.within) / (len(pairs) + PRIOR_WEIGHT),
        Noise(correlation, max(deviation_m, _LEAST_DEVIATION_M)),
    )
    number = state.number + 1
    is_last = number >= _MOST_ITERATIONS or _change(population, updated) < _SETTLED
    return Iteration(number, updated, {name: one.mode for name, one in found.items()}, is_last)


def moments(population: Population, found: Sequence[Evidence]) -> tuple[Estimate, Floats]:
    """Return a driver's parameters, and the expected sum of squares of its pairs' deviations from them; (P, P)."""
    driver = posterior(population, found)
    inverse = np.linalg.inv(population.within)
    spread = np.zeros_like(population.within)
    for one in found:
        # Given z_d, z_p is normal with this covariance and with a mean that is linear in z_d.
        covariance = np.linalg.inv(inverse + one.precision)
        share = covariance @ inverse - np.eye(len(inverse))
        off = covariance @ one.shift + share @ driver.log_parameters
        spread += np.outer(off, off) + covariance + share @ driver.covariance @ share.T
    return driver, spread


def _change(before: Population, after: Population) -> float:
    spreads = [
        np.abs(np.log(np.diag(one) / np.diag(other))).max() / 2.0
        for one, other in ((after.between, before.between), (after.within, before.within))
    ]
    return float(max(np.abs(after.mean - before.mean).max(), *spreads))


def fit_population(model: CarFollowing, pairs: Sequence[Pair], modes: Mapping[str, Floats]) -> Population:
    """Fit a population to some pairs, from the modes of the pairs alone on."""
    state = first_iteration(model, modes)
    while not state.is_last:
        state = iterate(model, pairs, state)
    return state.population


def mean_covariance(population: Population, drivers: Mapping[str, Sequence[Evidence]]) -> Floats:
    """Return the covariance matrix of the population's mean, (P, P): of the errors of a mean over its drivers."""
    alone = np.linalg.inv(population.between)
    total = np.zeros_like(alone)
    for found in drivers.values():
        seen = np.linalg.inv(posterior(population, found).covariance) - alone  # precision that the pairs add
        total += alone - alone @ np.linalg.inv(alone + seen) @ alone
    return np.linalg.inv(total)
