"""Search for the best that an ego can do in cases of the study; writes a table.

Usage: python scripts/measure_ceiling.py [--cases 400] [--mixes 0.1 0.25] [--out data/results/planner.csv]

A row of the table is a case: whether enough yielding drivers come in time (the generous ceiling), how the shipped
oracle fares, and whether the planner finds a plan. It searches in all cases of the ceiling that the oracle does not
finish, and for a check in the first 8 each of those that the oracle finishes, and of those beyond the ceiling. Rows
that an earlier, interrupted call has written are kept.
"""

import argparse
import csv
from collections import Counter
from dataclasses import replace
from pathlib import Path

import pandas

from tint_sumo.config import Mix
from tint_sumo.core.determinism import single_threaded
from tint_sumo.core.files import write_frame
from tint_sumo.envs import TaskSettings
from tint_sumo.methods.evaluation import REPORTED_SET, evaluate
from tint_sumo.methods.loading import load_policy
from tint_sumo.study.ceiling import finishable
from tint_sumo.study.planner import find_plan

FIELDS = ("p_conservative", "case", "ceiling", "oracle", "planner")
CHECKED = 8
DECISION_S = 0.4  # of the policies


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("--cases", type=int, default=400)
    parser.add_argument("--mixes", type=float, nargs="+", default=[0.1, 0.25])
    parser.add_argument("--out", type=Path, default=Path("data/results/planner.csv"))
    given = parser.parse_args()
    rows = list(csv.DictReader(given.out.read_text().splitlines())) if given.out.exists() else []
    known = {(row["p_conservative"], row["case"]) for row in rows}
    oracle = load_policy("oracle")
    with single_threaded():
        for p in given.mixes:
            task = replace(oracle.task, p_conservative=Mix(p))
            fared = evaluate(oracle.policy, lambda count: oracle.make_venv(count, task), given.cases, REPORTED_SET)  # noqa: B023
            planned = TaskSettings(task.scene, p, decision_s=DECISION_S)
            possible = finishable(Mix(p), given.cases, REPORTED_SET).tolist()
            checked: Counter[tuple[bool, bool]] = Counter()
            for case, (in_ceiling, outcome) in enumerate(
                zip(possible, (one.outcome for one in fared.cases), strict=True)
            ):
                kind = (in_ceiling, outcome == "success")
                checked[kind] += 1
                if (f"{p:g}", str(case)) in known:
                    continue
                found = "not searched"
                if kind == (True, False) or checked[kind] <= CHECKED:
                    found = "none" if find_plan(planned, REPORTED_SET, case) is None else "success"
                row = (f"{p:g}", str(case), "yes" if in_ceiling else "no", outcome, found)
                rows.append(dict(zip(FIELDS, row, strict=True)))
                print(*row, flush=True)
                write_frame(pandas.DataFrame(rows), given.out)
    print(f"wrote {given.out}")


if __name__ == "__main__":
    main()
