"""Test policies that were trained with the paper's own recipe, and others beside them; writes a table.

Usage: python scripts/measure_paper_recipe.py RUNS [--cases 500] [--out data/results/paper_recipe.csv]
    [--figure data/images/paper_recipe.png]

RUNS is a folder of training runs BUDGET.METHOD.SEED, such as ``tint-sumo policy train --method oracle --budget paper
--p-conservative 0.4 --seed 0 --out RUNS/paper.oracle.0`` makes; with BUDGET "full" they have our recipe. Each policy is
tested in the mix that it was trained for, after 25, 50 and 100 % of its training. Rows that the table has already of
other trainings are kept, so trainings can be made one by one. With --figure, the curves of those in RUNS are drawn.
"""

import argparse
from collections.abc import Iterator
from pathlib import Path

import pandas
from matplotlib.figure import Figure

from tint_sumo.benchmark import Suite, Trial, evaluate
from tint_sumo.config import PPO_BUDGETS, SNAPSHOTS_PERCENT, STEP_S, Mix
from tint_sumo.core.files import whole_file, write_frame
from tint_sumo.envs.rows import BUILT_IN_OUTCOMES
from tint_sumo.methods.evaluation import REPORTED_SET
from tint_sumo.methods.training import CURVE_FILE, snapshot_stem
from tint_sumo.policy.storage import card_file, read_policy_card
from tint_sumo.study.published import RATES_PERCENT

LOOKS = {"paper": ("#1793fc", "the paper's recipe"), "full": ("#d77e0b", "our recipe")}
KEY = ["budget", "method", "p_conservative", "seed", "percent"]  # columns that tell rows apart
LINES = {"success": "-", "collision": ":"}
POINTS = 400  # of a curve


def finished(runs: Path) -> Iterator[tuple[str, Path]]:
    """Yield budget and folder of each finished training."""
    for folder in sorted(runs.iterdir(), key=lambda path: path.name):
        budget = folder.name.split(".")[0]
        if budget in LOOKS and card_file(snapshot_stem(folder, 100)).exists():
            yield budget, folder


def rows_of(budget: str, folder: Path, cases: int) -> Iterator[dict[str, object]]:
    """Yield a row for each part of a training: rates in percent with intervals, and those of the paper."""
    for percent in (*SNAPSHOTS_PERCENT, 100):
        stem = snapshot_stem(folder, percent)
        card = read_policy_card(stem)
        method, p_conservative = card["method"], float(card["p_conservative"][0])
        suite = Suite("mix", (Trial("mix", "old", Mix(p_conservative)),), REPORTED_SET)
        shares = evaluate(stem, suite, cases=cases).table.iloc[0].to_dict()
        published = RATES_PERCENT.get((method, p_conservative), ()) if budget == "paper" else ()
        names = [f"published_{outcome}_percent" for outcome in BUILT_IN_OUTCOMES]
        yield {
            "budget": budget,
            "method": method,
            "p_conservative": p_conservative,
            "seed": card["seed"],
            "percent": percent,
            "decisions": card.get("decisions", card["steps"]),
            **{name: value for name, value in shares.items() if name != "world"},
            **dict(zip(names, published, strict=False)),
        }


def with_kept(table: pandas.DataFrame, out: Path) -> pandas.DataFrame:
    """Return a table with the rows that ``out`` has already of other trainings."""
    if out.exists():
        table = pandas.concat([pandas.read_csv(out), table])
    return table.drop_duplicates(KEY, keep="last").sort_values(KEY, ignore_index=True)


def plot(runs: Path, file: Path) -> None:
    """Draw success and collisions of the last 500 episodes in training against the simulated time."""
    figure = Figure(figsize=(7.5, 4.2), dpi=150, layout="constrained")
    axes = figure.subplots()
    for budget, folder in finished(runs):
        curve = pandas.read_csv(folder / CURVE_FILE)
        curve = curve.iloc[:: max(len(curve) // POINTS, 1)]
        hours = curve["decisions"] * PPO_BUDGETS[budget].action_repeat * STEP_S / 3600.0
        colour, title = LOOKS[budget]
        for outcome, line in LINES.items():
            axes.plot(hours, 100 * curve[outcome], line, color=colour, lw=1.2, label=f"{title}: {outcome}")
    axes.set(xlabel="simulated time (hours)", ylabel="last 500 episodes in training (%)", ylim=(0, 100))
    axes.grid(alpha=0.25)
    axes.legend(frameon=False, fontsize=8)
    with whole_file(file) as partial:
        figure.savefig(partial, format="png")
    print(f"wrote {file}")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("runs", type=Path)
    parser.add_argument("--cases", type=int, default=500)
    parser.add_argument("--out", type=Path, default=Path("data/results/paper_recipe.csv"))
    parser.add_argument("--figure", type=Path)
    given = parser.parse_args()
    rows = []
    for budget, folder in finished(given.runs):
        for row in rows_of(budget, folder, given.cases):
            rows.append(row)
            print(*row.values(), flush=True)
    write_frame(with_kept(pandas.DataFrame(rows), given.out), given.out)
    print(f"wrote {given.out}")
    if given.figure is not None:
        plot(given.runs, given.figure)


if __name__ == "__main__":
    main()
