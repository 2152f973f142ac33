"""A small study whose page has all sections."""

from pathlib import Path

from tests.study.scenes import given, write_results
from tint_sumo.config import ALL_MIXES, Mix
from tint_sumo.core.files import write_json, write_text
from tint_sumo.methods.training import CURVE_FILE
from tint_sumo.study.budgets import Conditions
from tint_sumo.study.ceiling_job import CEILINGS_FILE
from tint_sumo.study.page import write_page
from tint_sumo.study.report import StudyReport, write_report

CURVE = "decisions,success,timeout,collision\n64,0.1,0.4,0.5\n128,0.6,0.1,0.3\n"
OTHERS = (Conditions(ALL_MIXES), Conditions(ALL_MIXES, 0.1))


def small_study(out: Path) -> Path:
    """Results of rules and of a shipped policy, made by hand: their episodes are real, and may end otherwise."""
    fared = {"always_go": (1, 0, 2), "ttc": (1, 0, 2), "vae": (3, 0, 0)}
    results = [
        given(name, {Conditions(Mix(0.25)): counts, Conditions(Mix(0.4)): counts, **dict.fromkeys(OTHERS, counts)})
        for name, counts in fared.items()
    ]
    write_results(results, out)
    write_json(out / CEILINGS_FILE, {"0.25": 0.9, "0.4": 1.0})
    write_json(out / "run.json", {"kind": "study", "seeds": [0], "ppo": {"gamma": 0.999}})
    write_text(out / "policies" / "oracle-P0.1to0.9-seed0" / CURVE_FILE, CURVE)
    return out


def small_page(out: Path) -> StudyReport:
    """The page of that study; its episodes are recorded in a process of their own."""
    small_study(out)
    return write_page(write_report(out), out, workers=1, progress=False)
