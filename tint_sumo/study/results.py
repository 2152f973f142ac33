"""Results of a study's policies, as files."""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal

from tint_sumo.config import Idm, Mix, NoiseM, Seed, TauS
from tint_sumo.core.errors import InputError
from tint_sumo.core.files import read_record
from tint_sumo.core.reading import RESULT_BYTES
from tint_sumo.core.structures import plain
from tint_sumo.methods.evaluation import CASE_SETS, REPORTED_SET, Case, Evaluation, StoredCase
from tint_sumo.study.budgets import Conditions
from tint_sumo.study.folders import RESULTS

TRAINED, GIVEN = "trained", "given"  # origin of a policy: the study itself, or a rule or the package


@dataclass(frozen=True)
class Measured:
    """Result of a policy in one set of conditions."""

    conditions: Conditions
    evaluation: Evaluation


@dataclass(frozen=True)
class Result:
    """Results of one policy: one method, mix of drivers in training, and seed."""

    method: str
    origin: str  # TRAINED or GIVEN
    mix: Mix | None  # P(conservative) in training; None where the study did not train
    seed: int
    tested: tuple[Measured, ...]
    case_set: int = REPORTED_SET
    scene_tau_s: float = Idm.tau_s  # headway of the scene's drivers, where conditions give none

    def to_json(self) -> dict[str, Any]:
        return {
            "method": self.method,
            "origin": self.origin,
            "mix": plain(self.mix),
            "seed": self.seed,
            "case_set": self.case_set,
            "scene_tau_s": self.scene_tau_s,
            "tested": [
                {
                    **plain(test.conditions.resolved(self.scene_tau_s)),
                    **test.evaluation.summary(),
                    "cases": [case.stored() for case in test.evaluation.cases],
                }
                for test in self.tested
            ],
        }

    @classmethod
    def read(cls, file: Path) -> "Result":
        """Raises InputError if the file is damaged."""
        stored = read_record(file, "result of a study", _Stored, RESULT_BYTES)
        tested = tuple(test.measured(stored.scene_tau_s) for test in stored.tested)
        return cls(stored.method, stored.origin, stored.mix, stored.seed, tested, stored.case_set, stored.scene_tau_s)


@dataclass(frozen=True)
class _StoredTest:
    """A test as a file holds it: its conditions, its cases, and the rates that follow from them."""

    p_conservative: Mix
    position_noise_m: NoiseM
    tau_s: TauS | None  # None in a world
    percent: int
    success: float
    timeout: float
    collision: float
    intervals: Mapping[str, tuple[float, float]]
    episodes: int
    navigation_time_s: float | None
    collisions: Mapping[str, int]
    cases: tuple[StoredCase, ...]
    world: str | None = None

    def __post_init__(self) -> None:
        _ = self.conditions  # they are checked
        if self.tau_s is None and self.world is None:
            raise InputError("tau_s must be a number outside of a world")
        if not self.cases:
            raise InputError("there are no cases")

    @property
    def conditions(self) -> Conditions:
        return Conditions(self.p_conservative, self.position_noise_m, self.tau_s, self.percent, self.world)

    def measured(self, scene_tau_s: float) -> Measured:
        evaluation = Evaluation(tuple(Case(*case) for case in self.cases))
        return Measured(self.conditions.relative_to(scene_tau_s), evaluation)


@dataclass(frozen=True)
class _Stored:
    """A result as a file holds it."""

    method: str
    origin: Literal["trained", "given"]
    mix: Mix | None
    seed: Seed
    tested: tuple[_StoredTest, ...]
    case_set: Annotated[int, CASE_SETS] = REPORTED_SET
    scene_tau_s: TauS = Idm.tau_s


def read_results(out: Path) -> list[Result]:
    """Return the results of all finished jobs of the study in ``out``.

    Raises:
        InputError: there are none, a file is damaged, or they are of other cases than those that studies report.
    """
    files = sorted((out / RESULTS).glob("*.json"))
    if not files:
        raise InputError(f"no results in {out}; run the study first")
    results = [Result.read(file) for file in files]
    if not any(result.tested for result in results):
        raise InputError(f"no policy of {out} was tested; choose trials that meet the mixes of its trainings")
    if any(result.case_set != REPORTED_SET for result in results):
        raise InputError(f"{out} is part of a sweep, whose cases no study reports; read sweep.md in the folder above")
    return results
