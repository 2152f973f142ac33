"""The population draws drivers together as far as they are alike, and its intervals hold what is true."""

from collections.abc import Mapping, Sequence

import numpy as np
import pytest

from tests.drivers.conftest import KnownFit
from tests.drivers.recordings import simulated_pair
from tint_sumo.drivers import prediction
from tint_sumo.drivers.fitting import Estimate, gap_errors_m
from tint_sumo.drivers.models import MODELS, CarFollowing, Floats
from tint_sumo.drivers.pairs import Pair
from tint_sumo.drivers.population import (
    Evidence,
    Noise,
    Population,
    draws,
    evidence,
    moments,
    next_pair,
    posterior,
    predicted_gap_m,
    prior,
)
from tint_sumo.drivers.prediction import predict_each

BETWEEN, WITHIN = np.diag([0.2, 0.1, 0.1, 0.1, 0.1]), np.diag([0.05, 0.1, 0.2, 0.1, 0.1])
POPULATION = Population(MODELS["IDM"].usual, BETWEEN, WITHIN, Noise(0.9, 2.0))


def seen(offset: float, variance: float) -> Evidence:
    """A pair that says all logarithms are so far above the mean, with this variance."""
    precision = np.eye(5) / variance
    mean = POPULATION.mean + offset
    return Evidence(mean, precision, precision @ mean)


def test_the_posterior_is_the_weighted_mean_of_population_and_pairs() -> None:
    found = posterior(POPULATION, [seen(0.6, 0.1), seen(0.6, 0.1)])
    of_pairs = (np.diag(WITHIN) + 0.1) / 2.0  # variance of the mean of both
    weight = np.diag(BETWEEN) / (np.diag(BETWEEN) + of_pairs)
    np.testing.assert_allclose(found.log_parameters - POPULATION.mean, 0.6 * weight)
    np.testing.assert_allclose(np.diag(found.covariance), np.diag(BETWEEN) * (1.0 - weight))
    np.testing.assert_allclose(next_pair(POPULATION, found).covariance, found.covariance + WITHIN)


def test_a_driver_without_pairs_is_as_the_population() -> None:
    found = posterior(POPULATION, [])
    np.testing.assert_allclose(found.log_parameters, POPULATION.mean)
    np.testing.assert_allclose(found.covariance, BETWEEN)


def test_the_deviations_of_pairs_are_those_of_the_joint_distribution() -> None:
    """Driver and pairs together are one normal distribution, whose precision is written down here."""
    found, inverse = [seen(0.6, 0.1), seen(-0.2, 0.3)], np.linalg.inv(WITHIN)
    precision, shift = np.zeros((15, 15)), np.zeros(15)
    precision[:5, :5] = np.linalg.inv(BETWEEN) + 2.0 * inverse
    shift[:5] = np.linalg.solve(BETWEEN, POPULATION.mean)
    for first, one in ((5, found[0]), (10, found[1])):
        own = slice(first, first + 5)
        precision[own, own], shift[own] = inverse + one.precision, one.shift
        precision[:5, own] = precision[own, :5] = -inverse
    covariance = np.linalg.inv(precision)
    mean, expected = covariance @ shift, np.zeros((5, 5))
    for own in (slice(5, 10), slice(10, 15)):
        off = mean[own] - mean[:5]
        crossed = covariance[own, :5]
        expected += np.outer(off, off) + covariance[own, own] + covariance[:5, :5] - crossed - crossed.T
    driver, spread = moments(POPULATION, found)
    np.testing.assert_allclose(driver.log_parameters, mean[:5])
    np.testing.assert_allclose(driver.covariance, covariance[:5, :5], atol=1e-12)
    np.testing.assert_allclose(spread, expected, atol=1e-12)


def test_what_a_pair_says_is_its_posterior_less_the_population() -> None:
    """Compared with 10,000 drivers of the population, each weighted with its likelihood."""
    model, noise = MODELS["IDM"], Noise(0.9, 1.0)
    usual = Population(model.usual, 0.02 * np.eye(5), 0.02 * np.eye(5), noise)
    pair = simulated_pair(model.usual + 0.3, 3, 150)
    found = evidence(model, pair, usual, [model.usual])
    inverse = np.linalg.inv(usual.total)
    mean = np.linalg.solve(inverse + found.precision, found.shift + inverse @ usual.mean)
    drawn = np.random.default_rng(0).multivariate_normal(usual.mean, usual.total, 10_000)
    errors = [noise.whitened(gap_errors_m(model, pair, z)[::10]) for z in drawn]
    weights = np.exp([-float(one @ one) / 2.0 for one in errors])
    expected = weights @ drawn / weights.sum()
    assert np.abs(expected - usual.mean).max() > 0.1
    np.testing.assert_allclose(mean, expected, atol=0.03)


def test_noise_is_whitened() -> None:
    noise = Noise(0.9, 2.0)
    np.testing.assert_allclose(noise.whitened(np.array([0.0, 2.0, 1.8])), [1.0 / np.sqrt(0.19), 0.0], atol=1e-12)


def test_the_population_of_known_drivers_is_found(known: KnownFit) -> None:
    one = known.fitted.population.population
    truth = np.array(list(known.log_parameters.values()))
    low, high = known.fitted.population.mean.estimate.interval(known.fitted.car_following)
    assert ((low <= truth.mean(axis=0)) & (truth.mean(axis=0) <= high)).all()
    np.testing.assert_allclose(np.exp(one.mean - truth.mean(axis=0))[1:], 1.0, atol=0.15)
    assert one.noise.deviation_m < 2.0


def test_intervals_of_drivers_hold_the_true_parameters(known: KnownFit) -> None:
    inside = []
    for driver in known.fitted.drivers:
        low, high = driver.fit.estimate.interval(known.fitted.car_following)
        truth = known.log_parameters[driver.name]
        inside.append((low <= truth) & (truth <= high))
        assert (driver.pairs, round(driver.duration_s, 1)) == (2, 79.8)
    assert np.mean(inside) > 0.9


def test_draws_follow_from_their_seed_and_keep_to_the_bounds() -> None:
    model = MODELS["IDM"]
    found = draws(model, POPULATION.any_pair, 500, seed=1)
    np.testing.assert_array_equal(found, draws(model, POPULATION.any_pair, 500, seed=1))
    assert (found != draws(model, POPULATION.any_pair, 500, seed=2)).any()
    assert (found >= model.low).all() and (found <= model.high).all()
    assert len(np.unique(found[:, 0])) == 500  # none is moved to a bound
    narrow = Estimate(POPULATION.mean, POPULATION.total / 25.0)
    found = draws(model, narrow, 500, seed=1)
    np.testing.assert_allclose(found.mean(axis=0), narrow.log_parameters, atol=0.02)
    np.testing.assert_allclose(np.cov(found.T), narrow.covariance, atol=0.002)


def test_drivers_are_predicted_better_from_their_other_pair_than_from_the_population(known: KnownFit) -> None:
    """Known drivers drive alike behind all leaders, so that each pair says all about the other one."""
    pairs = known.pairs[:6]
    fits = {pair.name: pair.fit.estimate for pair in known.fitted.pairs}
    found = predict_each(MODELS["IDM"], pairs, fits)
    assert set(found) == {pair.name for pair in pairs}
    medians = {name: np.median([getattr(one, name) for one in found.values()]) for name in ("posterior", "population")}
    assert medians["posterior"] < 0.7 * medians["population"]
    for one in found.values():
        assert one.fitted < one.posterior
        assert one.fitted < one.other_pair < one.sumo


def test_predictions_use_nothing_of_their_pair(known: KnownFit, monkeypatch: pytest.MonkeyPatch) -> None:
    pairs, used = known.pairs[:4], []
    fits = {pair.name: pair.fit.estimate for pair in known.fitted.pairs}

    def fit(model: CarFollowing, others: Sequence[Pair], modes: Mapping[str, Floats]) -> Population:
        used.append({pair.name for pair in others} | set(modes))
        return prior(model)

    def look(model: CarFollowing, pair: Pair, population: Population, starts: Sequence[Floats]) -> Evidence:
        used.append({pair.name})
        return evidence(model, pair, population, starts)

    monkeypatch.setattr(prediction, "fit_population", fit)
    monkeypatch.setattr(prediction, "evidence", look)
    predict_each(MODELS["IDM"], pairs, fits)
    a, b, c, d = (pair.name for pair in pairs)
    assert used == [{c, d}, {b}, {a}, {a, b}, {d}, {c}]


def test_predictions_are_the_median_of_draws(known: KnownFit) -> None:
    pair = known.pairs[0]
    exact = Population(known.log_parameters[pair.driver], 1e-12 * np.eye(5), 1e-12 * np.eye(5), Noise(0.9, 2.0))
    gap_m = predicted_gap_m(MODELS["IDM"], pair, exact.any_pair)
    assert np.sqrt(np.mean((gap_m - pair.gap_m) ** 2)) == pytest.approx(0.15, abs=0.15)
