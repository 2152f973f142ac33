"""The meaning of P and the main results, in a few sentences before all tables."""

from collections.abc import Collection, Sequence
from dataclasses import replace

from tint_sumo.config import WORLDS
from tint_sumo.core.percentages import percent
from tint_sumo.envs.worlds import find_world
from tint_sumo.methods.registry import METHODS, Learned
from tint_sumo.study.budgets import Conditions
from tint_sumo.study.summary import Summary, at_mixes, by_title, in_worlds

MEANING_OF_P = (
    "P is P(conservative): the probability that a driver is conservative, and yields when the ego moves in front of "
    "it. All other drivers are aggressive and do not yield. Only the method oracle knows who is who."
)


def what_came_out(rows: Sequence[Summary]) -> str:
    """Return which method succeeded most often and which least often, and whether inferred traits helped.

    Rates are means over the mixes of drivers that all methods were tested on, or over worlds if policies were tested
    in these alone; empty where there is none.
    """
    as_trained = [row for row in rows if row.conditions == Conditions(row.conditions.p_conservative)]
    whole = [row for row in in_worlds(rows) if row.conditions.percent == 100]
    methods = _by_method(at_mixes(rows) or as_trained or whole)
    common = (
        set.intersection(*({row.conditions for row in tested} for tested in methods.values())) if methods else set()
    )
    if not common:
        return ""
    shown = _by_method([row for tested in methods.values() for row in tested if row.conditions in common])
    rates = {title: sum(row.rate("success") for row in tested) / len(tested) for title, tested in shown.items()}
    at = _where(common)
    if len(rates) == 1:
        ((title, rate),) = rates.items()
        return f"{at} the method {title} succeeded in {percent(rate)} % of the cases."
    best, worst = max(rates, key=rates.__getitem__), min(rates, key=rates.__getitem__)
    if rates[best] == rates[worst]:
        return f"{at} all {len(rates)} methods succeeded in {percent(rates[best])} % of the cases."
    text = f"{at} the method {best} succeeded most often, in {percent(rates[best])} % of the cases, and {worst} least "
    text += f"often, in {percent(rates[worst])} %."
    inferring = [title for title, tested in shown.items() if _infers(tested[0].method)]
    without = [title for title, tested in shown.items() if tested[0].method == "no_labels"]
    if inferring and without:
        helped, bare = max(inferring, key=rates.__getitem__), max(without, key=rates.__getitem__)
        text += f" The best method that infers traits, {helped}, reached {percent(rates[helped])} %; {bare}, which "
        text += f"infers none, reached {percent(rates[bare])} %."
    return text


def _by_method(rows: Sequence[Summary]) -> dict[str, list[Summary]]:
    """Return the rows of each method, shipped policies apart, over all mixes in training."""
    return by_title([replace(row, named_mix=None) for row in rows])


def _where(conditions: Collection[Conditions]) -> str:
    """Return the conditions as the beginning of a sentence."""
    worlds = [name for name in WORLDS if any(one.world == name for one in conditions)]
    if worlds:
        return f"In {find_world(worlds[0]).title}" if len(worlds) == 1 else f"Over {len(worlds)} worlds"
    return f"At P {_listed(sorted(one.p_conservative.text for one in conditions))}"


def _infers(name: str) -> bool:
    method = METHODS.get(name)
    return isinstance(method, Learned) and method.infers_traits


def _listed(words: Sequence[str]) -> str:
    *first, last = words
    return f"{', '.join(first)} and {last}" if first else last
