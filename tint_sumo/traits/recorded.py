"""Windows of recorded drivers, and of drivers that are drawn from a fit and follow the recorded leaders.

Windows are those of simulated datasets, in the same units: offset along the driver's way and gap to its leader. Their
drivers are vehicles of a recording, with all the leaders that they follow one after the other.
"""

import hashlib
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import CubicSpline

from tint_sumo.config import TraitSettings
from tint_sumo.core.errors import InputError
from tint_sumo.core.progress import Report, silent
from tint_sumo.dataset.windows import Windows, cut_windows
from tint_sumo.drivers.fitted import read_fitted
from tint_sumo.drivers.fitting import Estimate
from tint_sumo.drivers.models import CarFollowing, Floats
from tint_sumo.drivers.pairs import REACH_M, Pair, read_pairs
from tint_sumo.drivers.population import SPACING_S, Noise, Population, draws
from tint_sumo.traits.model import find_trait_method
from tint_sumo.traits.storage import read_card
from tint_sumo.traits.training import train

RECORDED_GAP_M = REACH_M  # stands for the gap without a leader on roads, where speeds and gaps exceed those of scenes
_DIGITS = 16  # of a recording's checksum
DRAWN, ENCOUNTERS = 400, 4  # drivers that are drawn from a fit, and the leaders that each of them follows


def windows_of(pairs: Sequence[Pair], no_leader_gap_m: float = RECORDED_GAP_M) -> tuple[Windows, NDArray[np.int64]]:
    """Return the windows of some pairs, by driver and time, and the number of each window's pair, (N,).

    A leader at ``no_leader_gap_m`` or farther counts as none.
    """
    order = sorted(range(len(pairs)), key=lambda number: (pairs[number].driver, pairs[number].start_s))
    drivers = {name: number for number, name in enumerate(sorted({pair.driver for pair in pairs}))}
    recordings = {name: number for number, name in enumerate(sorted({pair.recording for pair in pairs}))}
    track = np.repeat(np.array(order, np.int64), [pairs[number].rows for number in order])
    front_m, gap_m = (
        np.concatenate([getattr(pairs[number], name) for number in order]) for name in ("front_m", "gap_m")
    )
    gap_m = np.where(gap_m < no_leader_gap_m, gap_m, np.inf)
    found = cut_windows(track, np.zeros_like(track), front_m, gap_m, no_leader_gap_m)
    pair = found.driver
    found = replace(
        found,
        driver=np.array([drivers[one.driver] for one in pairs], np.int64)[pair],
        episode=np.array([recordings[one.recording] for one in pairs], np.int64)[pair],
    )
    return found, pair


def train_on_tracks(
    tracks: Path,
    out: Path,
    *,
    method: str = "cross_window",
    settings: TraitSettings,
    seed: int = 0,
    fit: Path | None = None,
    format_name: str | None = None,
    no_leader_gap_m: float = RECORDED_GAP_M,
    report: Report = silent,
) -> dict[str, Any]:
    """Train a trait model on recorded drivers, or on drivers drawn from their fit, and return its card.

    Args:
        tracks: file of tracks, or folder of such files.
        out: a new folder, or the one of this very run.
        method: a name in ``tint_sumo.traits.TRAIT_METHODS`` that learns without labels.
        settings: sizes, loss weights and schedule.
        seed: of weights, order, noise and draws.
        fit: folder of a fit; 400 drivers are then drawn from its population, and each follows four recorded leaders.
        format_name: format of the tracks; recognised if not given.
        no_leader_gap_m: gap from which on a leader counts as none.
        report: called with the progress.

    Raises:
        InputError: the method learns with labels, there is nobody to learn from, or ``out`` holds another run.
    """
    if find_trait_method(method).uses_labels:
        raise InputError(
            f"method {method} learns with labels, which recorded tracks do not have; choose another method"
        )
    pairs = read_pairs(tracks, format_name, with_free=fit is None).pairs
    described: dict[str, Any] = {
        "tracks": tracks.name,
        "recordings": _digests(pairs),
        "pairs": len(pairs),
        "drivers": len({pair.driver for pair in pairs}),
    }
    if fit is not None:
        fitted = read_fitted(fit)
        population = fitted.population.population
        pairs = tuple(drawn_pairs(fitted.car_following, population, pairs, DRAWN, ENCOUNTERS, seed))
        described |= {"drawn": DRAWN, "model": fitted.model}
    windows, _ = windows_of(pairs, no_leader_gap_m)
    card = {"recorded": described}
    train(windows, settings, out, method=method, seed=seed, no_leader_gap_m=no_leader_gap_m, report=report, card=card)
    return read_card(out / "model.safetensors").entries


def require_unseen(model: str | Path, pairs: Sequence[Pair]) -> None:
    """Raise InputError if a trait model has learnt from a recording of these pairs, by its card."""
    recorded = read_card(model).entries.get("recorded")
    seen = recorded.get("recordings") if isinstance(recorded, dict) else None
    if isinstance(seen, list) and any(digest in seen for digest in _digests(pairs)):
        raise InputError(
            f"{model} has learnt from these recorded drivers, which would make all measures too high; give `tracks` of "
            "others, or no `model`: then one is trained for each fifth of the drivers, from the other ones"
        )


def _digests(pairs: Sequence[Pair]) -> list[str]:
    """Return a checksum of each recording's pairs, whatever its name; stretches without a leader do not count."""
    found: dict[str, Any] = {}
    for pair in pairs:
        if pair.leader:
            found.setdefault(pair.recording, hashlib.sha256()).update(pair.front_m.tobytes())
    return [digest.hexdigest()[:_DIGITS] for digest in found.values()]


def drawn_pairs(
    model: CarFollowing, population: Population, pairs: Sequence[Pair], drivers: int, encounters: int, seed: int = 0
) -> list[Pair]:
    """Let drivers that are drawn from a population follow recorded leaders.

    A driver's parameters are drawn from the population, and those behind each leader from around these. It begins at
    its wished gap, with the speed that was recorded, and its position errs as the fit found: smoothly, within seconds.

    Args:
        model: car-following model.
        population: of its parameters.
        pairs: whose leaders are followed.
        drivers: their number.
        encounters: leaders that each of them follows.
        seed: of all draws.
    """
    rng, names = np.random.default_rng(seed), [parameter.name for parameter in model.parameters]
    tau, min_gap = names.index("tau_s"), names.index("min_gap_m")
    found: list[Pair] = []
    for driver, z in enumerate(draws(model, Estimate(population.mean, population.between), drivers, seed)):
        for number in rng.integers(0, len(pairs), encounters).tolist():
            pair = pairs[number]
            (behind,) = draws(model, Estimate(z, population.within), 1, int(rng.integers(2**32)))
            start_m = pair.leader_rear_m[0] - np.exp(behind[min_gap]) - np.exp(behind[tau]) * pair.speed_mps[0]
            front_m, speed_mps = model.follow(
                pair.leader_rear_m, pair.leader_speed_mps, start_m, pair.speed_mps[0], behind, pair.step_s
            )
            front_m = front_m + _wandering(population.noise, pair, rng)
            follower, leader = f"{driver:06}", f"{len(found)}"
            found.append(
                replace(pair, follower=follower, leader=leader, recording="drawn", front_m=front_m, speed_mps=speed_mps)
            )
    return found


def _wandering(noise: Noise, pair: Pair, rng: np.random.Generator) -> Floats:
    """Return errors of a position that come and go, (T,): an AR(1) process at the fit's spacing, smooth in between."""
    count = int(np.ceil(pair.duration_s / SPACING_S)) + 3
    errors_m = np.zeros(count)
    scale_m = noise.deviation_m * np.sqrt(1.0 - noise.correlation**2)
    for number in range(1, count):
        errors_m[number] = noise.correlation * errors_m[number - 1] + rng.normal(0.0, scale_m)
    at_s = pair.step_s * np.arange(pair.rows)
    return np.asarray(CubicSpline(SPACING_S * np.arange(count), errors_m)(at_s))
