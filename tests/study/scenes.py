"""Results made by hand."""

from collections.abc import Sequence
from pathlib import Path

from tint_sumo.config import ALL_MIXES, Mix
from tint_sumo.core.files import write_json
from tint_sumo.methods.evaluation import Case, Evaluation
from tint_sumo.study.budgets import Conditions
from tint_sumo.study.folders import RESULTS
from tint_sumo.study.results import GIVEN, TRAINED, Measured, Result


def evaluation(success: int, timeout: int, collision: int) -> Evaluation:
    """Cases with these outcomes; successes take 10, 11, 12... s."""
    cases = [
        *(Case("success", 10.0 + number) for number in range(success)),
        *[Case("timeout", 50.0)] * timeout,
        *[Case("collision", 4.0, "aggressive", "lower")] * collision,
    ]
    return Evaluation(tuple(cases))


def trained(
    method: str, seed: int, tested: dict[Conditions, tuple[int, int, int]], mix: Mix | None = ALL_MIXES
) -> Result:
    """A policy that the study trained, with so many successes, timeouts and collisions under each conditions."""
    fared = tuple(Measured(conditions, evaluation(*counts)) for conditions, counts in tested.items())
    return Result(method, TRAINED, mix, seed, fared)


def given(method: str, tested: dict[Conditions, tuple[int, int, int]]) -> Result:
    """The same for a rule, or a policy that came with the package."""
    fared = tuple(Measured(conditions, evaluation(*counts)) for conditions, counts in tested.items())
    return Result(method, GIVEN, None, 0, fared)


def write_results(results: Sequence[Result], out: Path) -> Path:
    """A study's folder that holds nothing but results."""
    for number, one in enumerate(results):
        write_json(out / RESULTS / f"{number}.json", one.to_json())
    return out
