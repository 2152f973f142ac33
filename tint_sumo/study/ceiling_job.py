"""The study's job of finding what a careful driver can reach at best."""

from dataclasses import dataclass
from pathlib import Path

from tint_sumo.errors import InputError
from tint_sumo.files import read_json, write_json
from tint_sumo.percentages import percent
from tint_sumo.progress import Progress, Report
from tint_sumo.reading import RESULT_BYTES
from tint_sumo.scenes import T_INTERSECTION, Scene
from tint_sumo.standings import Title
from tint_sumo.study.budgets import Trials
from tint_sumo.study.ceiling import ceiling
from tint_sumo.study.evaluation import CASES

CEILINGS_FILE = "ceilings.json"


@dataclass(frozen=True)
class CeilingJob:
    """Compute the ceiling for each P(conservative) that policies are tested at."""

    trials: tuple[Trials, ...]
    out: Path  # folder of the study
    scene: str | Scene = T_INTERSECTION

    name = "ceilings"
    title = Title("ceilings")
    needs = ()
    inputs = ()
    outputs = (CEILINGS_FILE,)
    uses_gpu = False

    def is_done(self) -> bool:
        return (self.out / CEILINGS_FILE).exists()

    def run(self, report: Report) -> str:
        wanted = {
            one.p_conservative: trials.episodes
            for trials in self.trials
            for one in trials.conditions
            if one.is_single_mix and isinstance(one.p_conservative, float)
        }
        found: dict[str, float] = {}
        done, total = 0, sum(wanted.values())
        for p_conservative, episodes in wanted.items():
            report(Progress(done, total, "case"))
            found[f"{p_conservative:g}"] = ceiling(p_conservative, episodes, CASES, self.scene)
            done += episodes
        write_json(self.out / CEILINGS_FILE, found)
        return ", ".join(f"P {p}: {percent(share)}%" for p, share in found.items())


def read_ceilings(out: Path) -> dict[float, float]:
    """Ceilings by P(conservative); none if the study has not computed them.

    Raises:
        InputError: the file is damaged.
    """
    file = out / CEILINGS_FILE
    found = read_json(file, "ceilings", RESULT_BYTES) if file.exists() else {}
    try:
        return {float(p): float(share) for p, share in found.items()}
    except (TypeError, ValueError) as error:
        raise InputError(f"{file} is damaged ({error}); remove it and run the study again") from None
