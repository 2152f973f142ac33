"""The meaning of P and the main results, in a few sentences before all tables."""

from collections.abc import Sequence

from tint_sumo.core.percentages import percent
from tint_sumo.methods.registry import METHODS, Learned
from tint_sumo.study.budgets import Conditions
from tint_sumo.study.summary import Summary, at_mixes, by_title, over_all_mixes

MEANING_OF_P = (
    "P is P(conservative): the probability that a driver is conservative, and yields when the ego moves in front of "
    "it. All other drivers are aggressive and do not yield. Only the method oracle knows who is who."
)


def what_came_out(rows: Sequence[Summary]) -> str:
    """Return which method succeeded most often and which least often, and whether inferred traits helped.

    Rates are means over the mixes of drivers that all methods were tested on; empty where there is none.
    """
    as_trained = [row for row in over_all_mixes(rows) if row.conditions == Conditions(row.conditions.p_conservative)]
    methods = by_title(at_mixes(rows) or as_trained)
    mixes = sorted(
        set.intersection(*({row.conditions.p_conservative for row in tested} for tested in methods.values()))
        if methods
        else (),
        key=str,
    )
    if not mixes:
        return ""
    shown = by_title([row for tested in methods.values() for row in tested if row.conditions.p_conservative in mixes])
    rates = {title: sum(row.rate("success") for row in tested) / len(tested) for title, tested in shown.items()}
    at = f"At P {_listed([mix.text for mix in mixes])}"
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


def _infers(name: str) -> bool:
    method = METHODS.get(name)
    return isinstance(method, Learned) and method.encoder is not None


def _listed(words: Sequence[str]) -> str:
    *first, last = words
    return f"{', '.join(first)} and {last}" if first else last
