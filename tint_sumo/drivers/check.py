"""Compares simulated with recorded traffic: fitted drivers, SUMO's defaults and SUMO's own tool, all driven by SUMO.

Each recorded follower is replaced by drivers of a distribution, which follow the recorded leader from the follower's
first position and speed on. Fitted drivers are drawn from the population, and from what the fit knows of the follower
itself where it is one of the fitted drivers; all of them want to drive at least as fast as the follower does first.
Compared are the distributions over all moments, a second apart: time gaps, speeds, and
accelerations and jerks from the change of speed in a second, in which the noise of recordings at 10 Hz averages out.
The distance is Wasserstein's, in the unit of the quantity: the mean amount by which values must be moved. Intervals are
from a bootstrap over drivers.
"""

import subprocess
import sys
import tempfile
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
import sumo
from scipy.stats import wasserstein_distance

from tint_sumo.core.files import write_text
from tint_sumo.core.progress import Report, part_of, silent
from tint_sumo.drivers.fitted import Fitted
from tint_sumo.drivers.fitting import Estimate
from tint_sumo.drivers.models import Floats
from tint_sumo.drivers.pairs import Pair
from tint_sumo.drivers.population import draws, next_pair
from tint_sumo.drivers.replay import drive, vtype_xml

QUANTITIES = {"time gap": "s", "speed": "m/s", "acceleration": "m/s²", "jerk": "m/s³"}  # with their units
FITTED = POPULATION, SAME = "fitted population", "fitted, driver by driver"
OTHERS = DEFAULT, TOOL = "SUMO's default", "createVehTypeDistribution.py"
_SECOND_S = 1.0
_SLOW_MPS = 1.0  # a time gap is that of a vehicle that moves
_MOST_TIME_GAP_S = 20.0  # larger ones count as this
_DRIVERS = 200  # vTypes of a distribution
_DRAWN = 40  # parameters for each driver that is wanted, of which some want to drive too slowly
_RESAMPLES = 400
_ENDS = (2.5, 97.5)  # of a 95 % interval, in percent
# The example in SUMO's documentation of the tool, without the parameter that only shows the form, and with limits of
# sigma, since SUMO refuses more than 1.
_TOOL_CONFIG = """tau; normal(0.8,0.1)
sigma; normal(0.5,0.2); [0,1]
length; normal(4.9,0.2); [3.5,5.5]
vClass; passenger
carFollowModel; Krauss
"""


@dataclass(frozen=True)
class Measured:
    """A number with its 95 % interval."""

    value: float
    low: float
    high: float

    @classmethod
    def of(cls, values: Floats) -> "Measured":
        """Return the first value, with the interval of the others, which are resampled."""
        low, high = np.percentile(values[1:], _ENDS)
        return cls(float(values[0]), float(low), float(high))


@dataclass(frozen=True)
class Distance:
    """Wasserstein distance of a simulated quantity from the recorded one."""

    quantity: str
    drivers: str  # one of FITTED or OTHERS
    distance: Measured
    ratios: dict[str, Measured]  # for fitted drivers: this distance to that of each of OTHERS


@dataclass(frozen=True)
class Check:
    """Distances of simulated from recorded traffic."""

    pairs: int
    drivers: int
    repeats: int
    speed_limit_mps: float
    distances: tuple[Distance, ...]

    def summary(self) -> dict[str, Any]:
        """Return all numbers, for JSON."""
        return asdict(self)


def check(
    fitted: Fitted,
    pairs: Sequence[Pair],
    repeats: int,
    seed: int,
    speed_limit_mps: float | None = None,
    report: Report = silent,
    attributes: Mapping[str, str] | None = None,
) -> Check:
    """Let SUMO drive in place of recorded followers, and compare.

    Args:
        fitted: drivers of a fit.
        pairs: of the recording, with the step of the fit.
        repeats: drivers that each follower is replaced by, one after the other.
        seed: of the draws and of SUMO's randomness.
        speed_limit_mps: of the recorded road; if not given, the speed that 5 % of the recorded moments exceed. SUMO's
            own drivers go by it.
        report: of the pairs done.
        attributes: further ones of the fitted drivers' vTypes, such as errors of their driving.
    """
    limit_mps = speed_limit_mps or float(np.quantile(np.concatenate([pair.speed_mps for pair in pairs]), 0.95))
    one = fitted.population.population
    known = {driver.name: next_pair(one, driver.fit.estimate) for driver in fitted.drivers}
    ids = [f"{index}" for index in range(len(pairs) * repeats)]
    sources = {
        POPULATION: (drawn_types(fitted, pairs, [one.any_pair] * len(pairs), repeats, seed, limit_mps, attributes), ids)
    }
    if all(pair.driver in known for pair in pairs):
        own = [known[pair.driver] for pair in pairs]
        sources[SAME] = (drawn_types(fitted, pairs, own, repeats, seed, limit_mps, attributes), ids)
    sources[DEFAULT] = ("", ["DEFAULT_VEHTYPE"] * len(ids))
    sources[TOOL] = (_by_tool(seed), ["vehDist"] * len(ids))
    repeated = [pair for pair in pairs for _ in range(repeats)]
    simulated = {}
    for number, (name, (types_xml, type_ids)) in enumerate(sources.items()):
        part = part_of(report, number * len(repeated), len(sources) * len(repeated))
        driven = drive(repeated, types_xml, type_ids, limit_mps, seed, part)
        parts = [quantities(pair, two.front_m, two.speed_mps) for pair, two in zip(repeated, driven, strict=True)]
        simulated[name] = [_joined(parts[first : first + repeats]) for first in range(0, len(parts), repeats)]
    recorded = [quantities(pair, pair.front_m, pair.speed_mps) for pair in pairs]
    names = tuple(dict.fromkeys(pair.driver for pair in pairs))
    indices = [[index for index, pair in enumerate(pairs) if pair.driver == name] for name in names]
    return Check(len(pairs), len(names), repeats, limit_mps, _distances(indices, recorded, simulated))


def drawn_types(
    fitted: Fitted,
    pairs: Sequence[Pair],
    known: Sequence[Estimate],
    repeats: int,
    seed: int,
    speed_limit_mps: float,
    attributes: Mapping[str, str] | None = None,
) -> str:
    """Return vTypes 0, 1, ... for each pair and repeat, drawn from what is known of the pair.

    They want to drive at least as fast as the follower does first, if such drivers are among those that are drawn.
    """
    model, types = fitted.car_following, []
    speed = fitted.parameters.index("desired_speed_mps")
    for index, (pair, estimate) in enumerate(zip(pairs, known, strict=True)):
        drawn = draws(model, estimate, _DRAWN * repeats, seed + index)
        fast_first = np.argsort(np.exp(drawn[:, speed]) < pair.speed_mps[0], kind="stable")[:repeats]
        types += [
            vtype_xml(f"{index * repeats + repeat}", {**model.vtype(drawn[row], speed_limit_mps), **(attributes or {})})
            for repeat, row in enumerate(fast_first)
        ]
    return "".join(types)


def _joined(parts: Sequence[Mapping[str, Floats]]) -> dict[str, Floats]:
    return {quantity: np.concatenate([part[quantity] for part in parts]) for quantity in QUANTITIES}


def _by_tool(seed: int) -> str:
    """Return the vTypeDistribution that SUMO's own tool makes."""
    tool = Path(sumo.SUMO_HOME) / "tools" / "createVehTypeDistribution.py"
    with tempfile.TemporaryDirectory() as name:
        config, out = Path(name) / "config.txt", Path(name) / "types.add.xml"
        write_text(config, _TOOL_CONFIG)
        numbers = ["-s", str(_DRIVERS), "--seed", str(seed + 1)]  # the tool takes 0 for no seed
        command = [sys.executable, str(tool), str(config), "-o", str(out), *numbers]
        result = subprocess.run(command, capture_output=True, text=True, check=False)
        if result.returncode != 0:
            raise OSError(f"{tool} failed: {result.stderr.strip()}")
        text = out.read_text(encoding="utf-8")
    return text[text.index("<vTypeDistribution") : text.rindex("</vTypeDistribution>")] + "</vTypeDistribution>"


def quantities(pair: Pair, front_m: Floats, speed_mps: Floats) -> dict[str, Floats]:
    """Return what is compared of one follower, by its name."""
    every = max(1, round(_SECOND_S / pair.step_s))
    gap_m, speed_mps = (pair.leader_rear_m - front_m)[::every], speed_mps[::every]
    moves = speed_mps > _SLOW_MPS
    acceleration = np.diff(speed_mps) / (every * pair.step_s)
    return {
        "time gap": np.clip(gap_m[moves] / speed_mps[moves], 0.0, _MOST_TIME_GAP_S),
        "speed": speed_mps,
        "acceleration": acceleration,
        "jerk": np.diff(acceleration) / (every * pair.step_s),
    }


def _distances(
    drivers: Sequence[Sequence[int]],
    recorded: Sequence[Mapping[str, Floats]],
    simulated: Mapping[str, Sequence[Mapping[str, Floats]]],
) -> tuple[Distance, ...]:
    """Return distances of all quantities and sources, with a bootstrap over drivers that is the same for all.

    Args:
        drivers: numbers of the pairs of each driver.
        recorded: quantities of each pair.
        simulated: the same by their source.
    """
    rng = np.random.default_rng(0)
    samples = [np.arange(len(drivers)), *(rng.integers(0, len(drivers), len(drivers)) for _ in range(_RESAMPLES))]
    chosen = [[index for driver in sample for index in drivers[driver]] for sample in samples]
    found = []
    for quantity in QUANTITIES:
        real = [part[quantity] for part in recorded]
        values = {
            source: np.array([_distance(real, [part[quantity] for part in parts], sample) for sample in chosen])
            for source, parts in simulated.items()
        }
        for source, distances in values.items():
            others = OTHERS if source in FITTED else ()
            ratios = {other: Measured.of(distances / np.maximum(values[other], 1e-12)) for other in others}
            found.append(Distance(quantity, source, Measured.of(distances), ratios))
    return tuple(found)


def _distance(real: Sequence[Floats], simulated: Sequence[Floats], sample: Sequence[int]) -> float:
    first, second = (np.concatenate([values[index] for index in sample]) for values in (real, simulated))
    return float(wasserstein_distance(first, second)) if len(first) and len(second) else 0.0


def report_text(found: Check) -> str:
    """Return the distances as lines for people."""
    lines = [
        f"{found.pairs:,} pairs of {found.drivers:,} drivers, each driven {found.repeats} times by SUMO with each "
        f"kind of drivers; speed limit {found.speed_limit_mps:.1f} m/s",
        f"{'Wasserstein distance':53}{'95 % interval':>18}   to the default   to the tool",
    ]
    for one in found.distances:
        quantity, distance = f"{one.quantity} ({QUANTITIES[one.quantity]})", one.distance
        interval = f"{distance.low:.3f} to {distance.high:.3f}"
        ratios = "".join(f"{ratio.value:13.2f}" for ratio in one.ratios.values())
        lines.append(f"{quantity:22}{one.drivers:31}{distance.value:.3f}{interval:>18}{ratios}".rstrip())
    return "\n".join(lines)
