"""How the single policies of a study fared, as files."""

from dataclasses import astuple, dataclass
from pathlib import Path
from typing import Any

from tint_sumo.errors import InputError
from tint_sumo.files import read_json
from tint_sumo.study.evaluation import OUTCOMES, Case, Evaluation

RESULTS = "results"  # folder of the results in a study's folder


@dataclass(frozen=True)
class Result:
    """How one policy fared: one method, P(conservative) and seed."""

    method: str
    p_conservative: float
    seed: int
    evaluation: Evaluation

    def to_json(self) -> dict[str, Any]:
        return {
            "method": self.method,
            "p_conservative": self.p_conservative,
            "seed": self.seed,
            **self.evaluation.summary(),
            "cases": [astuple(case) for case in self.evaluation.cases],
        }

    @classmethod
    def read(cls, file: Path) -> "Result":
        """Raises InputError if the file is damaged."""
        content = read_json(file, "result of a study")
        try:
            cases = tuple(Case(outcome, float(time_s), *hit) for outcome, time_s, *hit in content["cases"])
            result = cls(content["method"], float(content["p_conservative"]), int(content["seed"]), Evaluation(cases))
        except (KeyError, TypeError, ValueError) as error:
            raise InputError(f"{file} is damaged ({error!r}); remove it and run the study again") from None
        if not cases or any(case.outcome not in OUTCOMES for case in cases):
            raise InputError(f"{file} is damaged (no cases, or unknown outcomes); remove it and run the study again")
        return result


def read_results(out: Path) -> list[Result]:
    """Results of all finished jobs of the study in ``out``.

    Raises:
        InputError: there are none, or a file is damaged.
    """
    files = sorted((out / RESULTS).glob("*.json"))
    if not files:
        raise InputError(f"no results in {out}; run the study first: tint-sumo study run --out {out}")
    return [Result.read(file) for file in files]
