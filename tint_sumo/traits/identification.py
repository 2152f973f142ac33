"""Measures of the traits of recorded drivers, without labels.

* Prediction: how likely is what a driver does next, given what is known of it from the beginning of the same encounter,
  or from its other encounters? In the middle of each window of 2 s the distance driven in the next second is predicted,
  behind the recorded leader. Errors follow a Laplace distribution, whose scale is that of the same predictor's errors
  for all other drivers.
* Identification: which of the drivers is this, from another of its encounters, or from the other half of the same?
  Vectors are compared by their distance, each number in units of its standard deviation over all encounters.
* Intraclass correlation: the share of a number's variance over encounters that lies between drivers.

An encounter is a driver's way behind one leader (``Pair``). Drivers are split into folds, and what is learnt for a fold
is learnt from the drivers of the others. Intervals are from a bootstrap over drivers.
"""

import tempfile
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray

from tint_sumo.config import TRAIT_BUDGETS, WINDOW_STEPS
from tint_sumo.core.errors import InputError
from tint_sumo.core.progress import Progress, Report, silent
from tint_sumo.drivers.fitting import Estimate, fit_pair
from tint_sumo.drivers.models import MODELS, Floats
from tint_sumo.drivers.pairs import Pair
from tint_sumo.drivers.population import Population, evidence, fit_population, posterior
from tint_sumo.traits.cross_window import CrossWindow
from tint_sumo.traits.evaluation import encode_windows
from tint_sumo.traits.recorded import DRAWN, ENCOUNTERS, RECORDED_GAP_M, drawn_pairs, windows_of
from tint_sumo.traits.training import train

CONSTANT, SUMO, POPULATION, SINGLE, POSTERIOR, WITHOUT, WITH = PREDICTORS = (
    "constant speed",
    "IDM, SUMO's defaults",
    "IDM, population of the other drivers",
    "IDM, fitted to what is known of the driver alone",
    "IDM, the driver's posterior",
    "trait model, mean latents of the other drivers",
    "trait model, the driver's latents",
)
LATENTS, FITTED, SPEED, TIME_GAP = VECTORS = ("latents", "fitted parameters", "mean speed", "mean time gap")
SAME, OTHER = "same encounter", "other encounters"
PREDICTION, RANK_ONE, AMONG_RUN, CHANCE, ICC, ICC_LESS_SPEED = (
    "log-likelihood",
    "identified",
    "identified in its recording",
    "chance",
    "intraclass correlation",
    "intraclass correlation without speed",
)
MIN_S, MIN_SAME_S = 10.0, 20.0  # duration of encounters, and of those that are halved
_MODEL = MODELS["IDM"]
_FOLDS, _RESAMPLES = 5, 2_000
_SEEN = WINDOW_STEPS // 2  # steps of a window from which its rest is predicted
_SLOW_MPS = 1.0
_LEAST_TIME_GAP_S = 0.05
_LEARNING = replace(TRAIT_BUDGETS["quick"], noise_m=0.05)

ModelOf = Callable[[int, Population, Sequence[Pair]], CrossWindow]


@dataclass(frozen=True)
class Measure:
    """A number with its 95 % interval; both ends are the number where there is none."""

    group: str
    situation: str
    name: str
    value: float
    low: float
    high: float
    count: int  # of predictions, encounters to identify, or encounters


@dataclass(frozen=True)
class _Halves:
    """The halves of the longest encounters of some drivers, one encounter each, and their fits by name."""

    firsts: list[Pair]
    seconds: list[Pair]
    fits: dict[str, Estimate]


@dataclass(frozen=True)
class _Observed:
    """Values with the drivers they belong to, by situation and name, from all folds."""

    errors_m: dict[tuple[str, str], list[Floats]]
    hits: dict[tuple[str, str, str], list[float]]
    drivers: dict[tuple[str, str], list[str]]  # of errors and hits, by group and situation
    blocks: dict[tuple[str, str], list[tuple[Floats, NDArray[np.str_]]]]  # vectors and drivers, by group and name


def train_on_others(fold: int, population: Population, pairs: Sequence[Pair]) -> CrossWindow:
    """Train a model for a fold, on drivers that are drawn from the population of the other folds' drivers.

    Each of them follows some of the other drivers' leaders.
    """
    windows, _ = windows_of(drawn_pairs(_MODEL, population, pairs, DRAWN, ENCOUNTERS, seed=fold))
    with tempfile.TemporaryDirectory(prefix="tint_sumo-") as folder:
        out = Path(folder) / "model"
        model = train(windows, _LEARNING, out, method=CrossWindow.method, no_leader_gap_m=RECORDED_GAP_M)
    assert isinstance(model, CrossWindow)
    return model


def identify(
    pairs: Sequence[Pair], model_of: ModelOf = train_on_others, report: Report = silent
) -> tuple[Measure, ...]:
    """Measure what traits of recorded drivers are worth.

    Args:
        pairs: encounters, with steps of 0.1 s; those of less than 10 s are left out.
        model_of: returns the trait model for a fold, of its number, the population of the other folds' drivers and
            their encounters. A model that has learnt from the drivers of the fold makes the measures too high.
        report: of the folds done.

    Raises:
        InputError: there are too few drivers with several encounters.
    """
    pairs = [pair for pair in pairs if pair.leader and pair.duration_s > MIN_S - 1e-6]
    names = list(dict.fromkeys(pair.driver for pair in pairs))
    several = [name for name in names if sum(pair.driver == name for pair in pairs) > 1]
    if len(several) < 2 or len(names) < _FOLDS:
        raise InputError(
            f"{len(several):,} of {len(names):,} drivers follow several leaders for {MIN_S:g} s; two such drivers of "
            f"{_FOLDS} are needed to identify drivers: give a longer recording"
        )
    fits = _fits(pairs)
    halves = _halves(pairs)
    fold_of = {name: number % _FOLDS for number, name in enumerate(np.random.default_rng(0).permutation(names))}
    found = _Observed({}, {}, {}, {})
    for fold in range(_FOLDS):
        report(Progress(fold, _FOLDS, "fold"))
        others = [pair for pair in pairs if fold_of[pair.driver] != fold]
        population = fit_population(_MODEL, others, {pair.name: fits[pair.name].log_parameters for pair in others})
        model = model_of(fold, population, others)
        tested = {name for name in names if fold_of[name] == fold}
        vectors = _vectors(model, pairs, fits)
        _observe(found, model, population, pairs, fits, vectors, tested)
        _observe_halves(found, model, population, pairs, halves, vectors[LATENTS], tested)
    report(Progress(_FOLDS, _FOLDS, "fold"))
    return tuple(_measures(found))


def report_text(measures: Sequence[Measure]) -> str:
    """Return the measures as lines for people."""
    lines, group = [], ""
    for one in measures:
        if f"{one.group}, {one.situation}" != group:
            group = f"{one.group}, {one.situation}"
            lines.append(f"{group} ({one.count:,})")
        lines.append(f"  {one.name:50}{one.value:8.3f}  [{one.low:.3f}, {one.high:.3f}]")
    return "\n".join(lines)


def _observe(
    found: _Observed,
    model: CrossWindow,
    population: Population,
    pairs: Sequence[Pair],
    fits: Mapping[str, Estimate],
    vectors: Mapping[str, Floats],
    tested: set[str],
) -> None:
    """Look at all encounters of the tested drivers: what do a driver's other encounters tell about each?"""
    driver, recording = (np.array([getattr(pair, name) for pair in pairs]) for name in ("driver", "recording"))
    everywhere = np.full(len(pairs), "")
    for name, values in vectors.items():
        for group, candidates in ((RANK_ONE, everywhere), (AMONG_RUN, recording)):
            for number, pair in enumerate(pairs):
                others = np.arange(len(pairs)) != number
                others &= candidates == candidates[number]
                if pair.driver in tested and pair.driver in driver[others] and len(set(driver[others])) > 1:
                    _note(found, group, OTHER, name, pair.driver, *_nearest(values, driver, number, others))
        is_tested = np.isin(driver, sorted(tested))
        found.blocks.setdefault((ICC, name), []).append((values[is_tested], driver[is_tested]))
        if name != SPEED:
            left = _without(values, vectors[SPEED])
            found.blocks.setdefault((ICC_LESS_SPEED, name), []).append((left[is_tested], driver[is_tested]))
    known = np.array([fits[pair.name].log_parameters for pair in pairs])
    for number, pair in enumerate(pairs):
        own = [other for other in np.flatnonzero(driver == pair.driver).tolist() if other != number]
        if pair.driver in tested and own:
            seen = [evidence(_MODEL, pairs[other], population, [known[other], population.mean]) for other in own]
            latents = vectors[LATENTS][own].mean(axis=0), vectors[LATENTS][driver != pair.driver].mean(axis=0)
            longest = max(own, key=lambda other: pairs[other].rows)
            parameters = known[longest], posterior(population, seen).log_parameters
            _predict(found, OTHER, model, population, pair, parameters, latents)


def _observe_halves(
    found: _Observed,
    model: CrossWindow,
    population: Population,
    pairs: Sequence[Pair],
    halves: _Halves,
    latents: Floats,
    tested: set[str],
) -> None:
    """Look at the longest encounters of the tested drivers: is the second half known by the first halves of all?"""
    count = len(halves.firsts)
    if not count:
        return
    vectors = _vectors(model, [*halves.firsts, *halves.seconds], halves.fits)
    driver = np.array([pair.driver for pair in halves.firsts] * 2)
    for number, (first, second) in enumerate(zip(halves.firsts, halves.seconds, strict=True)):
        if second.driver not in tested:
            continue
        for name, values in vectors.items():
            hit = _nearest(values, driver, count + number, np.arange(len(driver)) < count)
            _note(found, RANK_ONE, SAME, name, second.driver, *hit)
        fit = halves.fits[first.name].log_parameters
        seen = evidence(_MODEL, first, population, [fit, population.mean])
        others_latents = latents[[pair.driver != first.driver for pair in pairs]].mean(axis=0)
        parameters = fit, posterior(population, [seen]).log_parameters
        _predict(found, SAME, model, population, second, parameters, (vectors[LATENTS][number], others_latents))


def _note(found: _Observed, group: str, situation: str, name: str, driver: str, hit: bool, chance: float) -> None:
    found.hits.setdefault((group, situation, name), []).append(float(hit))
    if name == LATENTS:
        found.hits.setdefault((group, situation, CHANCE), []).append(chance)
        found.drivers.setdefault((group, situation), []).append(driver)


def _halves(pairs: Sequence[Pair]) -> _Halves:
    """Cut the longest encounter of each driver in two, where it is long enough; none if only one driver's is.

    A single driver would be compared with nobody.
    """
    longest = {pair.driver: pair for pair in sorted(pairs, key=lambda pair: pair.rows)}
    cut = [pair for pair in longest.values() if pair.duration_s > MIN_SAME_S - 1e-6]
    if len(cut) < 2:
        return _Halves([], [], {})
    firsts = [_cut(pair, 0, pair.rows // 2) for pair in cut]
    seconds = [_cut(pair, pair.rows // 2, pair.rows) for pair in cut]
    return _Halves(firsts, seconds, _fits([*firsts, *seconds]))


def _fits(pairs: Sequence[Pair]) -> dict[str, Estimate]:
    """Return the fit of each pair, by its name."""
    return {pair.name: fit_pair(_MODEL, pair) for pair in pairs}


def _cut(pair: Pair, first: int, last: int) -> Pair:
    columns = ("leader_rear_m", "leader_speed_mps", "front_m", "speed_mps")
    parts = {name: getattr(pair, name)[first:last] for name in columns}
    return replace(pair, start_s=pair.start_s + first * pair.step_s, **parts)


def _vectors(model: CrossWindow, pairs: Sequence[Pair], fits: Mapping[str, Estimate]) -> dict[str, Floats]:
    """Return what each encounter is known by, (N, numbers) by name."""
    windows, number = windows_of(pairs, model.no_leader_gap_m)
    latents = np.zeros((len(pairs), model.latent_size))
    np.add.at(latents, number, encode_windows(model, windows).mean)
    time_gaps_s = [pair.gap_m / np.maximum(pair.speed_mps, _SLOW_MPS) for pair in pairs]
    return {
        LATENTS: latents / np.bincount(number, minlength=len(pairs))[:, None],
        FITTED: np.array([fits[pair.name].log_parameters for pair in pairs]),
        SPEED: np.array([[pair.speed_mps.mean()] for pair in pairs]),
        TIME_GAP: np.array([[np.log(np.maximum(gaps_s, _LEAST_TIME_GAP_S)).mean()] for gaps_s in time_gaps_s]),
    }


def _nearest(values: Floats, driver: NDArray[np.str_], number: int, others: NDArray[np.bool_]) -> tuple[bool, float]:
    """Return whether the nearest driver is the right one, and how probable that is by chance."""
    scaled = values / np.maximum(values.std(axis=0), 1e-9)
    candidates = sorted(set(driver[others].tolist()))
    apart = [
        float(np.linalg.norm(scaled[others & (driver == name)].mean(axis=0) - scaled[number])) for name in candidates
    ]
    return candidates[int(np.argmin(apart))] == driver[number], 1.0 / len(candidates)


def _without(values: Floats, other: Floats) -> Floats:
    """Return what a straight line through another number leaves of some values."""
    design = np.column_stack([other, np.ones(len(other))])
    return np.asarray(values - design @ np.linalg.lstsq(design, values, rcond=None)[0])


def _predict(
    found: _Observed,
    situation: str,
    model: CrossWindow,
    population: Population,
    pair: Pair,
    parameters: tuple[Floats, Floats],
    latents: tuple[Floats, Floats],
) -> None:
    """Note the errors of all predictors in a pair, of the distance in the second half of each whole window."""
    windows, _ = windows_of([pair], model.no_leader_gap_m)
    states = torch.from_numpy(windows.states[windows.length == WINDOW_STEPS])
    starts = WINDOW_STEPS * np.arange(len(states)) + _SEEN - 1
    steps = WINDOW_STEPS - _SEEN
    true_m = pair.front_m[starts + steps] - pair.front_m[starts]
    predicted_m = {CONSTANT: pair.speed_mps[starts] * steps * pair.step_s}
    for name, z in zip(
        (SUMO, POPULATION, SINGLE, POSTERIOR), (_MODEL.defaults, population.mean, *parameters), strict=True
    ):
        inside = np.clip(z, _MODEL.low, _MODEL.high)
        predicted_m[name] = np.array([_followed_m(pair, start, start + steps + 1, inside) for start in starts.tolist()])
    for name, latent in zip((WITH, WITHOUT), latents, strict=True):
        given = torch.from_numpy(latent.astype(np.float32)).expand(len(states), -1)
        predicted_m[name] = model.ahead_m(states, given, _SEEN).numpy().astype(np.float64)
    for name, values_m in predicted_m.items():
        found.errors_m.setdefault((situation, name), []).append(values_m - true_m)
    found.drivers.setdefault((PREDICTION, situation), []).extend([pair.driver] * len(starts))


def _followed_m(pair: Pair, first: int, last: int, log_parameters: Floats) -> float:
    part = slice(first, last)
    front_m, _ = _MODEL.follow(
        pair.leader_rear_m[part],
        pair.leader_speed_mps[part],
        pair.front_m[first],
        pair.speed_mps[first],
        log_parameters,
        pair.step_s,
    )
    return float(front_m[-1] - front_m[0])


def _measures(found: _Observed) -> Iterator[Measure]:
    for situation in (SAME, OTHER):
        if (PREDICTION, situation) not in found.drivers:
            continue
        driver = np.array(found.drivers[PREDICTION, situation])
        likely = {name: _likelihoods(np.concatenate(found.errors_m[situation, name]), driver) for name in PREDICTORS}
        for name in PREDICTORS:
            yield Measure(PREDICTION, situation, name, *_mean(likely[name], driver))
        for name in PREDICTORS[:-1]:
            yield Measure(f"{PREDICTION} gained", situation, name, *_mean(likely[WITH] - likely[name], driver))
    for (group, situation, name), hits in found.hits.items():
        yield Measure(group, situation, name, *_mean(np.array(hits), np.array(found.drivers[group, situation])))
    for (group, name), blocks in found.blocks.items():
        yield Measure(group, OTHER, name, *_correlation(blocks))


def _likelihoods(errors_m: Floats, driver: NDArray[np.str_]) -> Floats:
    """Return the logarithm of each error's density, by a Laplace distribution with the scale of all other drivers."""
    size = np.abs(errors_m)
    scale_m = np.empty(len(size))
    for name in np.unique(driver):
        scale_m[driver == name] = max(size[driver != name].mean(), 1e-3)
    return np.asarray(-size / scale_m - np.log(2.0 * scale_m))


def _mean(values: Floats, driver: NDArray[np.str_]) -> tuple[float, float, float, int]:
    """Return a mean, the ends of its interval, and the number of values."""
    _, number = np.unique(driver, return_inverse=True)
    sums, counts = np.bincount(number, values), np.bincount(number)
    chosen = np.random.default_rng(0).integers(0, len(sums), (_RESAMPLES, len(sums)))
    low, high = np.percentile(sums[chosen].sum(axis=1) / counts[chosen].sum(axis=1), [2.5, 97.5])
    return float(values.mean()), float(low), float(high), len(values)


def _correlation(blocks: Sequence[tuple[Floats, NDArray[np.str_]]]) -> tuple[float, float, float, int]:
    """Return the intraclass correlation of vectors, the mean over their numbers, from blocks with their own means."""
    parts = [[values[driver == name] for name in np.unique(driver)] for values, driver in blocks]
    rng = np.random.default_rng(0)
    found = [_of_drivers(parts)]
    for _ in range(_RESAMPLES // 4):
        found.append(_of_drivers([[part[index] for index in rng.integers(0, len(part), len(part))] for part in parts]))
    low, high = np.nanpercentile(found[1:], [2.5, 97.5])
    return found[0], float(low), float(high), sum(len(values) for values, _ in blocks)


def _of_drivers(blocks: Sequence[Sequence[Floats]]) -> float:
    """Return the intraclass correlation of a one-way analysis of variance with unequal numbers of encounters."""
    between, within, groups, total, squares = 0.0, 0.0, 0, 0, 0.0
    for drivers in blocks:
        whole = np.concatenate(drivers)
        means, counts = np.array([part.mean(axis=0) for part in drivers]), np.array([len(part) for part in drivers])
        between = between + (counts[:, None] * (means - whole.mean(axis=0)) ** 2).sum(axis=0)
        within = within + sum(((part - part.mean(axis=0)) ** 2).sum(axis=0) for part in drivers)
        groups, total, squares = groups + len(drivers) - 1, total + len(whole), squares + (counts**2).sum() / len(whole)
    repeated = total - groups - len(blocks)
    if groups < 1 or repeated < 1:
        return float("nan")
    mean_between, mean_within = between / groups, within / repeated
    size = (total - squares) / groups  # encounters of a usual driver
    return float(np.mean((mean_between - mean_within) / (mean_between + (size - 1.0) * mean_within + 1e-12)))
