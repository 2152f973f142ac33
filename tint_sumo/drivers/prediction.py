"""Predictions of pairs that no fit has seen: a driver behind another leader.

Each driver with several pairs is left out of the population in turn. Each of its pairs is then predicted from its other
pairs, and without them.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields

import numpy as np

from tint_sumo.core.progress import Progress, Report, silent
from tint_sumo.drivers.fitting import Estimate, gap_rmse_m
from tint_sumo.drivers.models import CarFollowing, Floats
from tint_sumo.drivers.pairs import Pair
from tint_sumo.drivers.population import (
    Population,
    evidence,
    fit_population,
    next_pair,
    posterior,
    predicted_gap_m,
)


@dataclass(frozen=True)
class Errors:
    """Root mean square errors of the gap of one pair in m, by the parameters it is predicted with."""

    fitted: float  # those fitted to the pair itself
    posterior: float  # the driver's posterior from its other pairs: in each moment the median of its predictions
    posterior_mode: float  # the most probable parameters of that posterior
    population: float  # the population without the driver: in each moment the median of its predictions
    population_median: float  # median of the parameters fitted to each pair of the other drivers
    other_pair: float  # fitted to another pair of the driver alone; the median if there are several
    sumo: float  # SUMO's defaults


ERRORS = tuple(field.name for field in fields(Errors))


def predict_each(
    model: CarFollowing, pairs: Sequence[Pair], fits: Mapping[str, Estimate], report: Report = silent
) -> dict[str, Errors]:
    """Predict the pairs of all drivers with several pairs.

    Args:
        model: car-following model.
        pairs: of all drivers.
        fits: of each pair alone, by its name.
        report: of the pairs done.

    Returns:
        the errors of each such pair, by its name.
    """
    by_driver: dict[str, list[Pair]] = {}
    for pair in pairs:
        by_driver.setdefault(pair.driver, []).append(pair)
    several = {driver: own for driver, own in by_driver.items() if len(own) > 1}
    total, found = sum(map(len, several.values())), dict[str, Errors]()
    for driver, own in several.items():
        others = [pair for pair in pairs if pair.driver != driver]
        population = fit_population(model, others, {pair.name: fits[pair.name].log_parameters for pair in others})
        median = np.median([fits[pair.name].log_parameters for pair in others], axis=0)
        for pair in own:
            found[pair.name] = _errors(model, pair, own, fits, population, median)
            report(Progress(len(found), total, "pair"))
    return found


def _errors(
    model: CarFollowing,
    pair: Pair,
    own: Sequence[Pair],
    fits: Mapping[str, Estimate],
    population: Population,
    median: Floats,
) -> Errors:
    others = [other for other in own if other is not pair]
    seen = [evidence(model, other, population, [fits[other.name].log_parameters, population.mean]) for other in others]
    driver = posterior(population, seen)

    def of_median(known: Estimate) -> float:
        return float(np.sqrt(np.mean((predicted_gap_m(model, pair, known) - pair.gap_m) ** 2)))

    return Errors(
        fitted=gap_rmse_m(model, pair, fits[pair.name].log_parameters),
        posterior=of_median(next_pair(population, driver)),
        posterior_mode=gap_rmse_m(model, pair, np.clip(driver.log_parameters, model.low, model.high)),
        population=of_median(population.any_pair),
        population_median=gap_rmse_m(model, pair, median),
        other_pair=float(np.median([gap_rmse_m(model, pair, fits[other.name].log_parameters) for other in others])),
        sumo=gap_rmse_m(model, pair, model.defaults),
    )
