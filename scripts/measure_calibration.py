"""Measure how well drivers are fitted: to their recordings, to other pairs of them, and in SUMO's traffic.

Reads the recordings that stand beside the project, and writes ``calibration.csv`` into data/results:
python scripts/measure_calibration.py [FOLDER]
"""

import csv
import io
import math
import sys
import tempfile
import time
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import astuple, dataclass, fields
from itertools import pairwise
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from tint_sumo.core.files import write_text
from tint_sumo.drivers.check import Check, check
from tint_sumo.drivers.fitted import Fitted, fit_drivers
from tint_sumo.drivers.fitting import Estimate, fit_pair, gap_rmse_m
from tint_sumo.drivers.models import MODELS
from tint_sumo.drivers.pairs import Pair, read_pairs
from tint_sumo.drivers.prediction import ERRORS, predict_each

Floats = NDArray[np.float64]

ROOT = Path(__file__).parents[1]
RESULTS = ROOT / "data" / "results"
RECORDINGS = ROOT.parent / "shared" / "real" / "car_following"
LONG_S = 15.0
RESAMPLES = 10_000
_MEDIAN_SQUARE = 0.4549  # of a standard normal variable: outliers of jerky recordings count for little


@dataclass(frozen=True)
class Row:
    """A number with its 95 % interval, from a bootstrap over drivers; NaN where there is none."""

    group: str
    name: str
    unit: str
    value: float
    low: float
    high: float
    count: int  # of pairs


def bootstrap(drivers: Sequence[str], values: Floats, mean: bool = False) -> tuple[float, float, float]:
    """Return the median or mean of the pairs' values, and the ends of its interval."""
    statistic = np.mean if mean else np.median
    own = [np.flatnonzero([driver == name for driver in drivers]) for name in dict.fromkeys(drivers)]
    rng = np.random.default_rng(0)
    found = []
    for _ in range(RESAMPLES):
        sample = np.concatenate([own[index] for index in rng.integers(0, len(own), len(own))])
        found.append(statistic(values[sample]))
    low, high = np.percentile(found, [2.5, 97.5])
    return float(statistic(values)), float(low), float(high)


def fits_of_pairs(pairs: Sequence[Pair], model: str) -> tuple[dict[str, Estimate], Iterator[Row]]:
    """Fit each pair alone."""
    fits = {pair.name: fit_pair(MODELS[model], pair) for pair in pairs}
    drivers = [pair.driver for pair in pairs]

    def rows() -> Iterator[Row]:
        for name, parameters in (
            ("fitted to the pair itself", {pair.name: fits[pair.name].log_parameters for pair in pairs}),
            ("SUMO's defaults", {pair.name: MODELS[model].defaults for pair in pairs}),
        ):
            errors_m = np.array([gap_rmse_m(MODELS[model], pair, parameters[pair.name]) for pair in pairs])
            yield Row(f"gap error {model}", name, "m", *bootstrap(drivers, errors_m), len(pairs))

    return fits, rows()


def predictions(pairs: Sequence[Pair], fits: Mapping[str, Estimate]) -> Iterator[Row]:
    """Predict each pair of a driver with several from its others."""
    found = predict_each(MODELS["IDM"], pairs, fits)
    drivers = [pair.driver for pair in pairs if pair.name in found]
    errors_m = {
        name: np.array([getattr(found[pair.name], name) for pair in pairs if pair.name in found]) for name in ERRORS
    }
    for name in ERRORS:
        yield Row("prediction", name, "m", *bootstrap(drivers, errors_m[name]), len(drivers))
    for name in ERRORS:
        if name not in ("fitted", "posterior"):
            difference_m = errors_m["posterior"] - errors_m[name]
            yield Row("posterior less", name, "m", *bootstrap(drivers, difference_m), len(drivers))
            yield Row("posterior less, mean", name, "m", *bootstrap(drivers, difference_m, mean=True), len(drivers))


def traffic(pairs: Sequence[Pair], model: str) -> Iterator[Row]:
    """Fit all pairs, and compare the traffic of the fitted drivers with the recorded one."""
    with tempfile.TemporaryDirectory() as folder:
        began_s = time.process_time()
        fitted = fit_drivers(pairs, MODELS[model], Path(folder) / "fit")
        yield Row(f"time {model}", "fit of all pairs", "s", time.process_time() - began_s, np.nan, np.nan, len(pairs))
    yield from distances(model, check(fitted, pairs, repeats=5, seed=0))
    if model == "EIDM":
        sigma, persistence_s = driving_errors(fitted, pairs)
        yield Row("errors EIDM", "sigmaerror", "1", sigma, np.nan, np.nan, len(pairs))
        yield Row("errors EIDM", "tPersDrive", "s", persistence_s, np.nan, np.nan, len(pairs))
        errors = {"sigmaerror": f"{sigma:.4g}", "tPersDrive": f"{persistence_s:.4g}"}
        yield from distances("EIDM with errors", check(fitted, pairs, repeats=5, seed=0, attributes=errors))


def distances(model: str, found: Check) -> Iterator[Row]:
    for one in found.distances:
        numbers = (one.distance.value, one.distance.low, one.distance.high)
        yield Row(f"distance {model}", f"{one.quantity}, {one.drivers}", "", *numbers, found.pairs)
        for other, ratio in one.ratios.items():
            numbers = (ratio.value, ratio.low, ratio.high)
            yield Row(f"ratio {model}", f"{one.quantity}, {one.drivers}, {other}", "1", *numbers, found.pairs)


def driving_errors(fitted: Fitted, pairs: Sequence[Pair]) -> tuple[float, float]:
    """Estimate EIDM's ``sigmaerror`` and ``tPersDrive`` from what the model errs in a second.

    Each pair is driven anew from every recorded second on, with its fitted parameters. The error of the speed after a
    second is the mean of EIDM's error of driving in it, which has ``sigmaerror`` times the acceleration parameter as
    its standard deviation, and whose correlation falls by a factor of e in ``tPersDrive``.
    """
    model, fits = fitted.car_following, {one.name: one.fit.estimate.log_parameters for one in fitted.pairs}
    accel = [parameter.name for parameter in model.parameters].index("accel_mps2")
    every = round(1.0 / fitted.step_s)
    squares, products, before = [], [], []
    for pair in pairs:
        z, errors = fits[pair.name], []
        for row in range(every, pair.rows - every, every):
            part = slice(row, row + every + 1)
            _, speed_mps = model.follow(
                pair.leader_rear_m[part],
                pair.leader_speed_mps[part],
                pair.front_m[row],
                pair.speed_mps[row],
                z,
                pair.step_s,
            )
            errors.append((pair.speed_mps[row + every] - speed_mps[-1]) / np.exp(z[accel]))
        squares += [error**2 for error in errors]
        products += [error * after for error, after in pairwise(errors)]
        before += [error**2 for error in errors[:-1]]
    return math.sqrt(np.median(squares) / _MEDIAN_SQUARE), -1.0 / math.log(sum(products) / sum(before))


def measure(folder: Path) -> Iterator[Row]:
    """Yield all numbers."""
    pairs = read_pairs(folder).pairs
    long = [pair for pair in pairs if pair.duration_s > LONG_S - 1e-6]
    for model in MODELS:
        fits, rows = fits_of_pairs(long, model)
        yield from rows
        if model == "IDM":
            yield from predictions(long, fits)
    for model in ("IDM", "EIDM"):
        yield from traffic(pairs, model)


def main(folder: Path) -> None:
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow([field.name for field in fields(Row)])
    for row in measure(folder):
        writer.writerow([f"{value:.4g}" if isinstance(value, float) else value for value in astuple(row)])
        print(row)
    write_text(RESULTS / "calibration.csv", text.getvalue())


if __name__ == "__main__":
    main(Path(sys.argv[1]) if len(sys.argv) > 1 else RECORDINGS)
