"""Results made by hand."""

from tint_sumo.study.evaluation import Case, Evaluation
from tint_sumo.study.results import Result


def result(method: str, p_conservative: float, seed: int, success: int, timeout: int, collision: int) -> Result:
    """Cases with these outcomes; successes take 10, 11, 12... s."""
    cases = [
        *(Case("success", 10.0 + number) for number in range(success)),
        *[Case("timeout", 50.0)] * timeout,
        *[Case("collision", 4.0, "aggressive", "lower")] * collision,
    ]
    return Result(method, p_conservative, seed, Evaluation(tuple(cases)))
