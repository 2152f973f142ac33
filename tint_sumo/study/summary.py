"""The rows of the results: all seeds of a method under the same conditions."""

from abc import ABC, abstractmethod
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from itertools import groupby
from typing import Any, TypeVar

import numpy as np

from tint_sumo.config import WORLDS, Mix
from tint_sumo.core.statistics import Hits, Interval, Scores, rate_interval
from tint_sumo.envs.rows import BUILT_IN_OUTCOMES
from tint_sumo.methods.evaluation import Evaluation
from tint_sumo.methods.registry import METHODS, Learned, Look, look_of
from tint_sumo.study.budgets import Conditions
from tint_sumo.study.published import RATES_PERCENT, Rates
from tint_sumo.study.results import GIVEN, Result

CONDITION_TITLES = {  # what can differ from the conditions of the training
    "position_noise_m": "noise on positions (m)",
    "tau_s": "headway tau of the drivers (s)",
    "percent": "part of the training (%)",
}


@dataclass(frozen=True)
class Summary(ABC):
    """Numbers in tables, figures and files about policies that differ by their training's seed alone."""

    method: str
    origin: str
    mix: Mix | None  # P(conservative) in training
    conditions: Conditions
    seeds: tuple[int, ...]
    scene_tau_s: float  # headway of the scene's drivers
    named_mix: Mix | None = field(default=None, kw_only=True)  # that of the training, where a study has several
    published: Mapping[str, float] = field(default_factory=dict, kw_only=True)  # the paper's rates in percent

    @property
    def resolved(self) -> Conditions:
        """The conditions with the scene's headway where none was given."""
        return self.conditions.resolved(self.scene_tau_s)

    @property
    @abstractmethod
    def episodes(self) -> int:
        """Number of cases."""

    @abstractmethod
    def rate(self, outcome: str) -> float:
        """Return the share of the cases with an outcome, over all seeds."""

    @abstractmethod
    def spread(self, outcome: str) -> float | None:
        """Return the standard deviation between the seeds; None with one seed."""

    @property
    @abstractmethod
    def intervals(self) -> Mapping[str, Interval]:
        """95 % intervals of the outcomes: over seeds and cases, or over cases alone where there is one seed."""

    @property
    @abstractmethod
    def navigation_time_s(self) -> float | None:
        """Mean time of successful episodes; None without any."""

    @property
    def is_shipped(self) -> bool:
        """Whether the package came with the policy."""
        return self.origin == GIVEN and isinstance(METHODS.get(self.method), Learned)

    @property
    def title(self) -> str:
        """The method, and where its policy comes from; among worlds, policies of several are shipped."""
        shipped = "shipped" if self.conditions.world is None else "old world"
        return title_of(self.method, self.named_mix) + (f" ({shipped})" if self.is_shipped else "")


@dataclass(frozen=True)
class Row(Summary):
    """The results of such policies in the same cases, case by case."""

    evaluations: tuple[Evaluation, ...]  # one for each seed

    @property
    def episodes(self) -> int:
        return len(self.evaluations[0].cases)

    def hits(self, outcome: str) -> Hits:
        """Return whether there was an outcome, (seeds, cases)."""
        return np.array([[case.outcome == outcome for case in evaluation.cases] for evaluation in self.evaluations])

    def rate(self, outcome: str) -> float:
        return float(self.hits(outcome).mean())

    def spread(self, outcome: str) -> float | None:
        rates = self.hits(outcome).mean(axis=1)
        return float(rates.std(ddof=1)) if len(rates) > 1 else None

    @cached_property
    def intervals(self) -> dict[str, Interval]:
        if len(self.seeds) == 1:
            return {outcome: self.evaluations[0].rate(outcome).interval for outcome in BUILT_IN_OUTCOMES}
        return {outcome: rate_interval(self.hits(outcome)) for outcome in BUILT_IN_OUTCOMES}

    @property
    def navigation_time_s(self) -> float | None:
        return self._pooled.navigation_time_s

    @property
    def collisions(self) -> dict[str, int]:
        """Number of collisions by trait and route of the driver that was hit, over all seeds."""
        return self._pooled.collisions

    @property
    def _pooled(self) -> Evaluation:
        return Evaluation(tuple(case for evaluation in self.evaluations for case in evaluation.cases))

    def to_json(self) -> dict[str, Any]:
        return {
            "method": self.method,
            "origin": self.origin,
            "trained_p_conservative": None if self.mix is None else self.mix.plain(),
            "p_conservative": self.conditions.p_conservative.plain(),
            "position_noise_m": self.conditions.position_noise_m,
            "tau_s": self.resolved.tau_s,
            "percent": self.conditions.percent,
            "world": self.conditions.world,
            "seeds": list(self.seeds),
            "episodes": self.episodes,
            **{outcome: self.rate(outcome) for outcome in BUILT_IN_OUTCOMES},
            "intervals": {outcome: list(interval) for outcome, interval in self.intervals.items()},
            "success_sd": self.spread("success"),
            "navigation_time_s": self.navigation_time_s,
            "collisions": self.collisions,
            "published_percent": dict(self.published) or None,
        }


def title_of(method: str, named_mix: Mix | None = None) -> str:
    """Return a method's name for readers, with the mix of a training; as it is if nobody has registered it."""
    title = METHODS[method].title if method in METHODS else method
    return title if named_mix is None else f"{title} (trained at P {named_mix.text})"


def named(mixes: Iterable[Mix | None]) -> Callable[[Mix | None], Mix | None]:
    """Return which mix of a training its title names: its own if there are several among all of these, else none."""
    is_several = len(set(mixes) - {None}) > 1
    return lambda mix: mix if is_several else None


AnyRow = TypeVar("AnyRow", bound=Summary)


def tabulate(results: Sequence[Result], published: Rates = RATES_PERCENT) -> list[Row]:
    """Return one row per conditions, origin, method and mix in training; methods in the registry's order.

    Args:
        results: of a study.
        published: rates of the paper, for rows at one P(conservative) in which nothing else differs.
    """
    order = {name: position for position, name in enumerate(METHODS)}
    flat = [(result, test) for result in results for test in result.tested]

    def key(pair: tuple[Result, Any]) -> tuple[Any, ...]:
        result, conditions = pair[0], pair[1].conditions
        headway_s = 0.0 if conditions.tau_s is None else conditions.tau_s - result.scene_tau_s
        return (
            _position_of_world(conditions),
            -conditions.percent,
            conditions.position_noise_m,
            abs(headway_s),  # the difference from the scene's
            headway_s,
            not conditions.p_conservative.is_single,
            conditions.p_conservative,
            order.get(result.method, len(order)),
            result.method,
            result.origin,
            (result.mix is None, result.mix),
        )

    rows, named_mix = [], named(result.mix for result in results)
    for _, group in groupby(sorted(flat, key=key), key):
        members = sorted(group, key=lambda pair: pair[0].seed)
        first, tested = members[0]
        seeds = tuple(result.seed for result, _ in members)
        evaluations = tuple(test.evaluation for _, test in members)
        rows.append(
            Row(
                first.method,
                first.origin,
                first.mix,
                tested.conditions,
                seeds,
                first.scene_tau_s,
                evaluations,
                named_mix=named_mix(first.mix),
                published=_published(first.method, tested.conditions, published),
            )
        )
    return rows


def _published(method: str, conditions: Conditions, rates: Rates) -> dict[str, float]:
    """Return the paper's rates of a method by outcome, empty where it has none."""
    found = rates.get((method, conditions.p_conservative.low)) if conditions.is_single_mix else None
    return dict(zip(BUILT_IN_OUTCOMES, found, strict=True)) if found else {}


def at_mixes(rows: Sequence[AnyRow]) -> list[AnyRow]:
    """Return the rows of the main table: fully trained, the default conditions, one P(conservative) each."""
    return [row for row in rows if row.conditions.is_single_mix]


def in_other_conditions(rows: Sequence[AnyRow]) -> list[AnyRow]:
    """Return the rows outside of worlds that the main table lacks, and those of the same mixes beside them."""
    outside = [row for row in rows if row.conditions.world is None]
    mixes = {row.conditions.p_conservative for row in outside if not row.conditions.is_single_mix}
    return [row for row in outside if row.conditions.p_conservative in mixes]


def in_worlds(rows: Sequence[AnyRow]) -> list[AnyRow]:
    """Return the rows of policies in worlds."""
    return [row for row in rows if row.conditions.world is not None]


def by_method(rows: Sequence[AnyRow]) -> list[AnyRow]:
    """Return the rows in the registry's order and that of mixes in training; shipped policies come first."""
    order = {name: position for position, name in enumerate(METHODS)}

    def key(row: AnyRow) -> tuple[Any, ...]:
        return order.get(row.method, len(order)), row.origin != GIVEN, row.mix is not None, row.mix

    return sorted(rows, key=key)


def by_title(rows: Sequence[AnyRow]) -> dict[str, list[AnyRow]]:
    """Return the rows of each method and mix in training, shipped policies apart, in the registry's order."""
    found: dict[str, list[AnyRow]] = {}
    for row in by_method(rows):
        found.setdefault(row.title, []).append(row)
    return found


def by_line(rows: Sequence[AnyRow]) -> dict[str, list[AnyRow]]:
    """Return the rows of each line of a chart: a method at one P(conservative), named where there are several."""
    found: dict[str, list[AnyRow]] = {}
    for title, own in by_title(rows).items():
        for row in own:
            found.setdefault(title + _mix_among(rows, row.conditions), []).append(row)
    return found


def labels(rows: Sequence[Summary]) -> dict[Conditions, str]:
    """Return the names of the rows' conditions, which have P(conservative) where there are several of it.

    Worlds have the order of ``WORLDS``.
    """
    found = sorted(dict.fromkeys(row.conditions for row in rows), key=_position_of_world)
    return {conditions: conditions.label + _mix_among(rows, conditions) for conditions in found}


def looks(lines: Mapping[str, Sequence[Summary]]) -> list[Look]:
    """Return how each line of a chart is drawn: those of one method have its colour, and other markers."""
    return _variants([(rows[0].method, rows[0].is_shipped) for rows in lines.values()])


def titles_and_looks(trainings: Iterable[tuple[str, Mix]]) -> list[tuple[str, Look]]:
    """Return the title of each method and mix in training, and how its learning curve is drawn."""
    kinds = list(trainings)
    named_mix = named(mix for _, mix in kinds)
    titles = [title_of(method, named_mix(mix)) for method, mix in kinds]
    return list(zip(titles, _variants([(method, False) for method, _ in kinds]), strict=True))


def _variants(kinds: Sequence[tuple[str, bool]]) -> list[Look]:
    """Return the look of each line, by its method and whether it has open markers."""
    return [look_of(kind[0]).variant(kinds[:position].count(kind)) for position, kind in enumerate(kinds)]


def _mix_among(rows: Sequence[Summary], conditions: Conditions) -> str:
    mixes = {row.conditions.p_conservative for row in rows}
    return f", P {conditions.p_conservative.text}" if len(mixes) > 1 else ""


def _position_of_world(conditions: Conditions) -> int:
    return -1 if conditions.world is None else list(WORLDS).index(conditions.world)


def scores(rows: Sequence[Row]) -> dict[str, Scores]:
    """Return success (S, T) by method, of those with several trainings, in the conditions that all of these share.

    Parts of trainings are left out. The mix of the training is part of the conditions.
    """
    by_task: dict[str, dict[tuple[Mix | None, Conditions], Any]] = {}
    for row in by_method([row for row in rows if len(row.seeds) > 1 and row.conditions.percent == 100]):
        by_task.setdefault(row.method, {})[row.mix, row.conditions] = row.hits("success").mean(axis=1)
    common = [task for task in next(iter(by_task.values()), {}) if all(task in found for found in by_task.values())]
    return {method: np.stack([found[task] for task in common], axis=1) for method, found in by_task.items() if common}


def marker_offset(position: int, count: int, most: float) -> float:
    """Return how far from its line one of several markers is drawn, so that they stand side by side; up to ``most``."""
    return 0.0 if count == 1 else most * (2 * position / (count - 1) - 1)


def varied(rows: Sequence[AnyRow], name: str) -> dict[float, AnyRow]:
    """Return the rows that differ from the training in at most one condition, by its values in their order."""
    base = Conditions(rows[0].conditions.p_conservative)
    shown = [row for row in rows if replace(row.conditions, **{name: getattr(base, name)}) == base]
    return dict(sorted(((getattr(row.resolved, name), row) for row in shown), key=lambda pair: pair[0]))
