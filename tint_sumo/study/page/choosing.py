"""Choice of the policies and cases that the page's player shows."""

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass

from tint_sumo.config import Mix
from tint_sumo.methods.evaluation import Evaluation
from tint_sumo.study.budgets import Conditions
from tint_sumo.study.jobs import label
from tint_sumo.study.summary import Row, at_mixes, by_title, in_other_conditions, in_worlds

FAILURES = ("collision", "timeout")
MOST_CASES = 14
_FAILURES_OF_EACH = 2  # failures of each kind and policy, as far as there is room
_SUCCESSES = 2


@dataclass(frozen=True)
class Shown:
    """One policy of a method: that of its first seed."""

    title: str
    method: str
    mix: Mix | None  # P(conservative) in training; None where the study did not train
    seed: int
    evaluation: Evaluation  # results in all cases that it was tested on

    @property
    def label(self) -> str:
        return label(self.method, self.mix, self.seed)


@dataclass(frozen=True)
class Choice:
    """Policies and cases of the player: all policies on the same cases."""

    conditions: Conditions
    policies: tuple[Shown, ...]
    cases: tuple[int, ...]


def choose(rows: Sequence[Row]) -> Choice:
    """Return the conditions in which most policies were tested, and cases in which their outcomes differ."""
    tested = at_mixes(rows) or in_other_conditions(rows) or in_worlds(rows)
    numbers = Counter(row.conditions for row in tested)
    common = [conditions for conditions, number in numbers.items() if number == max(numbers.values())]
    conditions = common[(len(common) - 1) // 2]
    by_policy = by_title([row for row in tested if row.conditions == conditions])
    firsts = {title: found[0] for title, found in by_policy.items()}
    policies = tuple(
        Shown(title, row.method, row.mix, row.seeds[0], row.evaluations[0]) for title, row in firsts.items()
    )
    return Choice(conditions, policies, choose_cases([policy.evaluation for policy in policies]))


def choose_cases(evaluations: Sequence[Evaluation]) -> tuple[int, ...]:
    """Return the cases in which policies fail, first those of the policies that rarely do, and of some successes.

    A case in which several policies fail counts for all of them.
    """
    common = range(min(len(evaluation.cases) for evaluation in evaluations))
    best_first = sorted(evaluations, key=lambda evaluation: -evaluation.rate("success").value)
    chosen: list[int] = []
    for wanted in range(1, _FAILURES_OF_EACH + 1):
        for evaluation in best_first:
            for outcome in FAILURES:
                failed = [number for number in common if evaluation.cases[number].outcome == outcome]
                missing = wanted - len(set(failed) & set(chosen))
                chosen += [number for number in failed if number not in chosen][: max(missing, 0)]
    successes = [sum(evaluation.cases[number].outcome == "success" for evaluation in evaluations) for number in common]
    finished = sorted((number for number in common if number not in chosen), key=lambda number: -successes[number])
    return tuple(sorted([*chosen[: MOST_CASES - _SUCCESSES], *finished[:_SUCCESSES]]))
