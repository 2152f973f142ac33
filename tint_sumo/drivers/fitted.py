"""Fitted drivers: the file of a fit, and the run that makes it."""

import hashlib
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pandas as pd

from tint_sumo.core.errors import InputError, find_named
from tint_sumo.core.files import claim_folder, read_record, whole_file, write_json
from tint_sumo.core.progress import Progress, Report, silent
from tint_sumo.core.structures import plain
from tint_sumo.drivers.fitting import Estimate, fit_pair, gap_rmse_m, interval
from tint_sumo.drivers.models import MODELS, CarFollowing, Floats
from tint_sumo.drivers.pairs import Pair
from tint_sumo.drivers.population import (
    Iteration,
    Noise,
    Population,
    evidence,
    first_iteration,
    iterate,
    mean_covariance,
    posterior,
)

FITTED_FILE = "fitted.json"
TABLES = ("drivers.csv", "pairs.csv")
_PAIRS_FILE, _POPULATION_FILE = "pairs.json", "population.json"  # of an unfinished run
_KEEP_EVERY_S = 5.0
_ROLE = "fitted drivers"

Numbers = tuple[float, ...]


@dataclass(frozen=True)
class Fit:
    """Parameters of a pair, a driver or a population: logarithms with their covariance matrix."""

    log_parameters: Numbers
    covariance: tuple[Numbers, ...]

    @classmethod
    def of(cls, estimate: Estimate) -> "Fit":
        return cls(_numbers(estimate.log_parameters), _matrix(estimate.covariance))

    @property
    def estimate(self) -> Estimate:
        return Estimate(np.array(self.log_parameters), np.array(self.covariance))


@dataclass(frozen=True)
class PairFit:
    """A pair fitted alone."""

    name: str
    driver: str
    duration_s: float
    gap_rmse_m: float  # of the fit
    sumo_gap_rmse_m: float  # of SUMO's default parameters
    fit: Fit


@dataclass(frozen=True)
class DriverFit:
    """A driver's parameters, given all its pairs and the population."""

    name: str
    pairs: int
    duration_s: float
    fit: Fit


@dataclass(frozen=True)
class PopulationFit:
    """Distribution of the drivers' parameters; see ``tint_sumo.drivers.population``."""

    mean: Fit  # with the error of the mean
    between: tuple[Numbers, ...]
    within: tuple[Numbers, ...]
    correlation: float
    deviation_m: float

    @property
    def population(self) -> Population:
        noise = Noise(self.correlation, self.deviation_m)
        return Population(np.array(self.mean.log_parameters), np.array(self.between), np.array(self.within), noise)


@dataclass(frozen=True)
class Fitted:
    """Drivers fitted to a recording."""

    model: str
    parameters: tuple[str, ...]  # names, in the order of all numbers
    step_s: float
    population: PopulationFit
    drivers: tuple[DriverFit, ...]
    pairs: tuple[PairFit, ...]

    def __post_init__(self) -> None:
        model = find_named("car-following model", self.model, MODELS)
        names = tuple(parameter.name for parameter in model.parameters)
        if self.parameters != names:
            raise InputError(f"parameters must be {', '.join(names)}, not {', '.join(self.parameters)}")
        if not self.drivers or not self.pairs:
            raise InputError("drivers and pairs must not be empty")
        fits = [self.population.mean, *(one.fit for one in self.drivers), *(one.fit for one in self.pairs)]
        covariances = [self.population.between, self.population.within, *(fit.covariance for fit in fits)]
        if any(len(fit.log_parameters) != len(names) for fit in fits):
            raise InputError(f"log_parameters must have {len(names)} numbers")
        for matrix in covariances:
            if any(len(row) != len(names) for row in matrix) or len(matrix) != len(names):
                raise InputError(f"covariances must be {len(names)} lists of {len(names)} numbers")
            if np.linalg.eigvalsh(np.array(matrix)).min() <= 0.0:
                raise InputError("covariances must be positive definite")

    @property
    def car_following(self) -> CarFollowing:
        return MODELS[self.model]

    def drivers_table(self) -> pd.DataFrame:
        """Return a row for each driver, over all situations: its parameters with the ends of their 95 % intervals."""
        rows = [
            {"driver": one.name, "pairs": one.pairs, "duration_s": one.duration_s, **self._columns(one.fit)}
            for one in self.drivers
        ]
        return pd.DataFrame(rows)

    def pairs_table(self) -> pd.DataFrame:
        """Return a row for each pair, fitted alone: errors of the gap, and parameters with their 95 % intervals."""
        rows = [
            {
                "pair": one.name,
                "driver": one.driver,
                "duration_s": one.duration_s,
                "gap_rmse_m": one.gap_rmse_m,
                "sumo_gap_rmse_m": one.sumo_gap_rmse_m,
                **self._columns(one.fit),
            }
            for one in self.pairs
        ]
        return pd.DataFrame(rows)

    def _columns(self, fit: Fit) -> dict[str, float]:
        """Return parameters with the ends of their intervals, by the names of their columns."""
        ends = fit.estimate.interval(self.car_following)
        columns: dict[str, float] = {}
        for name, value, low, high in zip(self.parameters, np.array(fit.log_parameters), *ends, strict=True):
            columns |= {
                name: float(np.exp(value)),
                f"{name}_low": float(np.exp(low)),
                f"{name}_high": float(np.exp(high)),
            }
        return columns


def _numbers(values: Floats) -> Numbers:
    return tuple(map(float, values))


def _matrix(values: Floats) -> tuple[Numbers, ...]:
    return tuple(map(_numbers, values))


def read_fitted(path: Path) -> Fitted:
    """Read the drivers of a finished fit.

    Args:
        path: folder of the fit, or its file.

    Raises:
        InputError: there is none, it is unfinished, or damaged.
    """
    file = path / FITTED_FILE if path.is_dir() else path
    if path.is_dir() and not file.exists():
        raise InputError(f"{path} has no {FITTED_FILE}; fit drivers first, or finish the fit: tint-sumo drivers fit")
    return read_record(file, _ROLE, Fitted)


def fit_drivers(pairs: Sequence[Pair], model: CarFollowing, out: Path, report: Report = silent) -> Fitted:
    """Fit each pair, each driver and the population, in a folder; a run that was interrupted goes on.

    Args:
        pairs: of all drivers, with the same step.
        model: car-following model.
        out: folder of the run.
        report: of the pairs fitted alone, and of the population's iterations.

    Raises:
        InputError: the folder holds another run, or files of unknown origin.
    """
    settings = {"kind": "drivers", "model": model.name, "step_s": pairs[0].step_s, "recording": _digest(pairs)}
    with claim_folder(out, settings):
        if not (out / FITTED_FILE).exists():
            fits = _fit_pairs(pairs, model, out / _PAIRS_FILE, report)
            population = _fit_population(pairs, model, fits, out / _POPULATION_FILE, report)
            fitted = _collect(pairs, model, fits, population)
            for name, table in zip(TABLES, (fitted.drivers_table(), fitted.pairs_table()), strict=True):
                with whole_file(out / name) as partial:
                    table.to_csv(partial, index=False, float_format="%.6g")
            write_json(out / FITTED_FILE, plain(fitted))
        for name in (_PAIRS_FILE, _POPULATION_FILE):
            (out / name).unlink(missing_ok=True)
        return read_fitted(out)


def _digest(pairs: Sequence[Pair]) -> str:
    """Return a checksum of all that the fit reads of the recordings."""
    digest = hashlib.sha256()
    for pair in pairs:
        digest.update(pair.name.encode())
        for column in (pair.leader_rear_m, pair.leader_speed_mps, pair.front_m, pair.speed_mps):
            digest.update(np.ascontiguousarray(column).tobytes())
    return digest.hexdigest()


def _fit_pairs(pairs: Sequence[Pair], model: CarFollowing, file: Path, report: Report) -> dict[str, Fit]:
    """Fit each pair alone; from time to time the fits so far are kept in a file."""
    found: dict[str, Fit] = read_record(file, _ROLE, dict[str, Fit]) if file.exists() else {}
    kept_s = time.monotonic()
    for done, pair in enumerate(pairs):
        report(Progress(done, len(pairs), "pair"))
        if pair.name not in found:
            found[pair.name] = Fit.of(fit_pair(model, pair))
            if time.monotonic() - kept_s > _KEEP_EVERY_S:
                write_json(file, plain(found))
                kept_s = time.monotonic()
    write_json(file, plain(found))
    return found


@dataclass(frozen=True)
class _State:
    """An iteration of the population, as a file holds it."""

    number: int
    is_last: bool
    mean: Numbers
    between: tuple[Numbers, ...]
    within: tuple[Numbers, ...]
    correlation: float
    deviation_m: float
    modes: dict[str, Numbers]

    @classmethod
    def of(cls, state: Iteration) -> "_State":
        one = state.population
        matrices = (_matrix(one.between), _matrix(one.within))
        modes = {name: _numbers(mode) for name, mode in state.modes.items()}
        noise = (one.noise.correlation, one.noise.deviation_m)
        return cls(state.number, state.is_last, _numbers(one.mean), *matrices, *noise, modes)

    @property
    def iteration(self) -> Iteration:
        noise = Noise(self.correlation, self.deviation_m)
        population = Population(np.array(self.mean), np.array(self.between), np.array(self.within), noise)
        return Iteration(
            self.number, population, {name: np.array(mode) for name, mode in self.modes.items()}, self.is_last
        )


def _fit_population(
    pairs: Sequence[Pair], model: CarFollowing, fits: Mapping[str, Fit], file: Path, report: Report
) -> Population:
    """Fit the population; the state after each iteration is kept in a file."""
    if file.exists():
        state = read_record(file, _ROLE, _State).iteration
    else:
        state = first_iteration(model, {name: np.array(fit.log_parameters) for name, fit in fits.items()})
    while not state.is_last:
        state = iterate(model, pairs, state, report)
        write_json(file, plain(_State.of(state)))
    return state.population


def _collect(pairs: Sequence[Pair], model: CarFollowing, fits: Mapping[str, Fit], population: Population) -> Fitted:
    own: dict[str, list[Pair]] = {}
    for pair in pairs:
        own.setdefault(pair.driver, []).append(pair)
    starts = {name: np.array(fit.log_parameters) for name, fit in fits.items()}
    seen = {
        driver: [evidence(model, pair, population, [starts[pair.name], population.mean]) for pair in theirs]
        for driver, theirs in own.items()
    }
    drivers = tuple(
        DriverFit(
            driver, len(theirs), sum(pair.duration_s for pair in theirs), Fit.of(posterior(population, seen[driver]))
        )
        for driver, theirs in own.items()
    )
    pair_fits = tuple(
        PairFit(
            pair.name,
            pair.driver,
            pair.duration_s,
            gap_rmse_m(model, pair, starts[pair.name]),
            gap_rmse_m(model, pair, model.defaults),
            fits[pair.name],
        )
        for pair in pairs
    )
    mean = Fit(_numbers(population.mean), _matrix(mean_covariance(population, seen)))
    noise = (population.noise.correlation, population.noise.deviation_m)
    spreads = PopulationFit(mean, _matrix(population.between), _matrix(population.within), *noise)
    names = tuple(parameter.name for parameter in model.parameters)
    return Fitted(model.name, names, pairs[0].step_s, spreads, drivers, pair_fits)


def report_text(fitted: Fitted) -> str:
    """Return the fit as lines for people."""
    model, one = fitted.car_following, fitted.population.population
    errors_m = np.median([[pair.gap_rmse_m, pair.sumo_gap_rmse_m] for pair in fitted.pairs], axis=0)
    low, high = np.exp(interval(one.mean, np.array(fitted.population.mean.covariance), model))
    spreads = np.exp(np.sqrt([np.diag(one.between), np.diag(one.within)]))
    lines = [
        f"{fitted.model}: {len(fitted.pairs):,} pairs of {len(fitted.drivers):,} drivers, "
        f"{sum(pair.duration_s for pair in fitted.pairs):,.0f} s",
        f"gap error (RMSE, median over pairs): {errors_m[0]:.2f} m fitted to the pair itself, {errors_m[1]:.2f} m with "
        "SUMO's defaults",
        f"{'':28}{'median':>8}  {'95 % interval':16}{'drivers':>10}{'situations':>12}{'SUMO':>8}",
    ]
    for index, parameter in enumerate(model.parameters):
        ends = f"{low[index]:.3g} to {high[index]:.3g}"
        lines.append(
            f"{f'{parameter.title} ({parameter.unit})':28}{np.exp(one.mean[index]):8.3g}  {ends:16}"
            f"{spreads[0][index]:10.2f}{spreads[1][index]:12.2f}{parameter.default:8.3g}"
        )
    lines.append("drivers, situations: factor of one standard deviation between drivers, between pairs of a driver")
    return "\n".join(lines)
