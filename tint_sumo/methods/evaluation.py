"""Evaluation of policies on unseen cases, which are the same for every method."""

from collections import Counter
from collections.abc import Callable
from contextlib import closing
from dataclasses import astuple, dataclass
from typing import Annotated, Any

import numpy as np
from stable_baselines3.common.vec_env import VecEnv

from tint_sumo.config import MOST_VTYPES
from tint_sumo.core.errors import InputError
from tint_sumo.core.progress import Progress, Report, silent
from tint_sumo.core.ranges import Range
from tint_sumo.core.statistics import Rate
from tint_sumo.envs.rows import BUILT_IN_OUTCOMES, COST, OUTCOMES, Outcome
from tint_sumo.methods.driving import DrivenEpisode, drive
from tint_sumo.methods.registry import Policy

# Seed of the first case. Training draws its environments' seeds below this number, so no case is ever trained on.
CASE_SEED = 1_000_000_000
CASES_PER_SET = 1_000_000
CASE_SETS = Range(0, 1000)
REPORTED_SET = 0  # case set of studies
TUNING_SET = 1000  # case set on which settings are chosen; reported nowhere
BATCH = 100  # environments at a time


@dataclass(frozen=True)
class Case:
    """Result of one episode."""

    outcome: str  # one of OUTCOMES
    time_s: float  # time of its end
    trait: str | None = None  # trait of the driver that was hit
    route: str | None = None  # route of that driver
    town: int | None = None  # number of the episode's town
    cost: float | None = None  # sum of the costs of its steps; None where there are no costs

    def stored(self) -> tuple[Any, ...]:
        """Return the case as files hold it: with its town only if there are towns; costs are in no files."""
        *values, town, _ = astuple(self)
        return tuple(values) if town is None else (*values, town)


_Time = Annotated[float, Range(0.0, 1e6)]
_Town = Annotated[int, Range(0, MOST_VTYPES)]
StoredCase = (
    tuple[Outcome, _Time, str | None, str | None] | tuple[Outcome, _Time, str | None, str | None, _Town]
)  # a case in files


@dataclass(frozen=True)
class Evaluation:
    """Results of a policy in a number of cases."""

    cases: tuple[Case, ...]

    @property
    def outcomes(self) -> tuple[str, ...]:
        """The outcomes to show: those of built-in scenes, and others that happened."""
        happened = {case.outcome for case in self.cases}
        return tuple(outcome for outcome in OUTCOMES if outcome in BUILT_IN_OUTCOMES or outcome in happened)

    def rate(self, outcome: str) -> Rate:
        return Rate(sum(case.outcome == outcome for case in self.cases), len(self.cases))

    @property
    def navigation_time_s(self) -> float | None:
        """Mean time of successful episodes; None without any."""
        times_s = [case.time_s for case in self.cases if case.outcome == "success"]
        return float(np.mean(times_s)) if times_s else None

    @property
    def cost(self) -> float | None:
        """Mean cost of an episode; None where there are no costs."""
        costs = [case.cost for case in self.cases if case.cost is not None]
        return float(np.mean(costs)) if costs else None

    @property
    def collisions(self) -> dict[str, int]:
        """Number of collisions by trait and route of the driver that was hit, as ``"aggressive, lower"``."""
        hits = Counter(f"{case.trait}, {case.route}" for case in self.cases if case.outcome == "collision")
        return dict(sorted(hits.items()))

    def summary(self) -> dict[str, Any]:
        """Return rates as fractions with 95 % intervals, mean time and collisions, ready for JSON."""
        rates = {outcome: self.rate(outcome) for outcome in self.outcomes}
        return {
            **{outcome: rate.value for outcome, rate in rates.items()},
            "intervals": {outcome: list(rate.interval) for outcome, rate in rates.items()},
            "episodes": len(self.cases),
            "navigation_time_s": self.navigation_time_s,
            "collisions": self.collisions,
            **({} if self.cost is None else {"cost": self.cost}),
        }


def case_seed(case_set: int, number: int = 0) -> int:
    """Return the environment seed of case ``number`` of a case set."""
    return CASE_SEED + case_set * CASES_PER_SET + number


def require_cases(episodes: int, case_set: int, first: int = 0) -> None:
    """Raise InputError unless there is such a case set, and it has so many cases, from the case ``first`` on."""
    CASE_SETS.require("case_set", case_set)
    if not 1 <= episodes <= CASES_PER_SET - first:
        raise InputError(f"episodes must lie in 1 to {CASES_PER_SET}, not {episodes}")


def evaluate(
    policy: Policy,
    make_venv: Callable[[int], VecEnv],
    episodes: int,
    case_set: int,
    *,
    first: int = 0,
    batch: int = BATCH,
    report: Report = silent,
) -> Evaluation:
    """Run ``policy`` with its likeliest actions through the cases ``first``, ``first + 1``, ... of a case set.

    Case i is the first episode of an environment seeded with ``case_seed(case_set, i)``, whatever the method and the
    batch.

    Args:
        policy: a rule or a Stable-Baselines3 model; recurrent states are carried along.
        make_venv: makes the vector environment of so many environments; closed at the end.
        episodes: number of cases.
        case_set: number of the case set, 0 to 1000.
        first: number of the first case.
        batch: environments at a time.
        report: called with the progress.

    Raises:
        InputError: no episodes, too many, or no such case set.
    """
    require_cases(episodes, case_set, first)
    cases: dict[int, Case] = {}
    ends: Counter[str] = Counter()
    with closing(drive(policy, make_venv, case_seed(case_set, first), episodes, batch)) as all_driven:
        for driven in all_driven:
            case = cases[driven.number] = _case(driven)
            ends[case.outcome] += 1
            shares = {outcome: ends[outcome] / len(cases) for outcome in ("success", "collision")}
            report(Progress(len(cases), episodes, "case", shares))
    return Evaluation(tuple(cases[number] for number in range(episodes)))


def _case(driven: DrivenEpisode) -> Case:
    """Return the case that a driven episode is."""
    info = driven.info
    hit = info.get("collision", {})
    return Case(
        info["outcome"],
        round(info["time_s"], 3),
        hit.get("trait"),
        hit.get("route"),
        info.get("town"),
        driven.cost if COST in info else None,
    )
