"""How the policies of a study fared, as files."""

from dataclasses import asdict, astuple, dataclass
from pathlib import Path
from typing import Any

from tint_sumo.config import Idm, Share
from tint_sumo.envs.rows import OUTCOMES
from tint_sumo.errors import InputError
from tint_sumo.files import read_json
from tint_sumo.reading import RESULT_BYTES
from tint_sumo.study.budgets import Conditions
from tint_sumo.study.evaluation import CASES, Case, Evaluation
from tint_sumo.study.folders import RESULTS

TRAINED, GIVEN = "trained", "given"  # origin of a policy: the study itself, or a rule or the package


@dataclass(frozen=True)
class Measured:
    """How a policy fared under some conditions."""

    conditions: Conditions
    evaluation: Evaluation


@dataclass(frozen=True)
class Result:
    """How one policy fared: one method, mix of drivers in training, and seed."""

    method: str
    origin: str  # TRAINED or GIVEN
    mix: Share | None  # P(conservative) in training; None where the study did not train
    seed: int
    tested: tuple[Measured, ...]
    case_set: int = CASES
    scene_tau_s: float = Idm.tau_s  # headway of the scene's drivers, where conditions give none

    def to_json(self) -> dict[str, Any]:
        return {
            "method": self.method,
            "origin": self.origin,
            "mix": self.mix,
            "seed": self.seed,
            "case_set": self.case_set,
            "scene_tau_s": self.scene_tau_s,
            "tested": [
                {
                    **asdict(one.conditions.resolved(self.scene_tau_s)),
                    **one.evaluation.summary(),
                    "cases": [astuple(case) for case in one.evaluation.cases],
                }
                for one in self.tested
            ],
        }

    @classmethod
    def read(cls, file: Path) -> "Result":
        """Raises InputError if the file is damaged."""
        content = read_json(file, "result of a study", RESULT_BYTES)
        try:
            scene_tau_s = float(content.get("scene_tau_s", Idm.tau_s))
            tested = tuple(
                Measured(_conditions(one).relative_to(scene_tau_s), _evaluation(one)) for one in content["tested"]
            )
            mix, seed, case_set = _share(content["mix"]), int(content["seed"]), int(content.get("case_set", CASES))
            result = cls(content["method"], content["origin"], mix, seed, tested, case_set, scene_tau_s)
        except (LookupError, TypeError, ValueError) as error:
            raise InputError(f"{file} is damaged ({error!r}); remove it and run the study again") from None
        all_cases = [one.evaluation.cases for one in tested]
        if not all(all_cases) or any(case.outcome not in OUTCOMES for cases in all_cases for case in cases):
            raise InputError(f"{file} is damaged (no cases, or unknown outcomes); remove it and run the study again")
        return result


def _conditions(one: dict[str, Any]) -> Conditions:
    share = _share(one["p_conservative"])
    if share is None:
        raise ValueError("no p_conservative")
    return Conditions(share, float(one["position_noise_m"]), float(one["tau_s"]), int(one["percent"]))


def _evaluation(one: dict[str, Any]) -> Evaluation:
    return Evaluation(tuple(Case(outcome, float(time_s), *hit) for outcome, time_s, *hit in one["cases"]))


def _share(value: Any) -> Share | None:
    return None if value is None else (float(value[0]), float(value[1])) if isinstance(value, list) else float(value)


def read_results(out: Path) -> list[Result]:
    """Results of all finished jobs of the study in ``out``.

    Raises:
        InputError: there are none, a file is damaged, or they are of other cases than those that studies report.
    """
    files = sorted((out / RESULTS).glob("*.json"))
    if not files:
        raise InputError(f"no results in {out}; run the study first: tint-sumo study run --out {out}")
    results = [Result.read(file) for file in files]
    if any(one.case_set != CASES for one in results):
        raise InputError(f"{out} is part of a sweep, whose cases no study reports; read sweep.md in the folder above")
    return results
