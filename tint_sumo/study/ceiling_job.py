"""The study's job of finding what a careful driver can reach at best."""

from dataclasses import dataclass, field
from pathlib import Path

from tint_sumo.core.files import damaged, read_record, write_json
from tint_sumo.core.percentages import percent
from tint_sumo.core.progress import Progress, Report
from tint_sumo.core.reading import RESULT_BYTES
from tint_sumo.methods.evaluation import REPORTED_SET
from tint_sumo.scenes import Scene, paper_scene
from tint_sumo.study.budgets import Trials
from tint_sumo.study.ceiling import ceiling

CEILINGS_FILE = "ceilings.json"


@dataclass(frozen=True)
class CeilingJob:
    """Compute the ceiling for each P(conservative) that policies are tested at."""

    trials: tuple[Trials, ...]
    out: Path  # folder of the study
    scene: Scene = field(default_factory=paper_scene)

    name = "ceilings"
    needs = ()
    inputs = ()
    outputs = (CEILINGS_FILE,)
    uses_gpu = False

    def is_done(self) -> bool:
        return (self.out / CEILINGS_FILE).exists()

    def run(self, report: Report) -> str:
        wanted = {
            conditions.p_conservative: trials.episodes
            for trials in self.trials
            for conditions in trials.conditions
            if conditions.is_single_mix
        }
        found: dict[str, float] = {}
        done, total = 0, sum(wanted.values())
        for mix, episodes in wanted.items():
            report(Progress(done, total, "case"))
            found[mix.text] = ceiling(mix, episodes, REPORTED_SET, self.scene)
            done += episodes
        write_json(self.out / CEILINGS_FILE, found)
        return ", ".join(f"P {p}: {percent(share)}%" for p, share in found.items())


def read_ceilings(out: Path) -> dict[float, float]:
    """Return the ceilings by P(conservative); none if the study has not computed them.

    Raises:
        InputError: the file is damaged.
    """
    file = out / CEILINGS_FILE
    found = read_record(file, "ceilings", dict[str, float], RESULT_BYTES) if file.exists() else {}
    try:
        ceilings = {float(p): share for p, share in found.items()}
    except ValueError as error:
        raise damaged(file, "ceilings", error) from None
    if not all(0.0 <= share <= 1.0 for one in ceilings.items() for share in one):
        raise damaged(file, "ceilings", "all numbers must lie in 0 to 1")
    return ceilings
