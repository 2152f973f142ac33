"""Test policies that were trained with the paper's own recipe, and others beside them; writes a table and curves.

Usage: python scripts/measure_paper_recipe.py RUNS [--cases 500] [--out data/results/paper_recipe.csv]
    [--curves data/results/paper_recipe_curves.csv] [--figure data/images/paper_recipe_curves.png]

RUNS is a folder of training runs BUDGET.METHOD.SEED, such as ``tint-sumo policy train --method oracle --budget paper
--p-conservative 0.4 --seed 0 --out RUNS/paper.oracle.0`` makes; with BUDGET "full" they have our recipe. Each policy is
tested in the mix that it was trained for, after 25, 50 and 100 % of its training. Table and curves keep the rows that
they have already of other trainings, so trainings can be made one by one. With --figure, all curves are drawn.
A method that shares another's training, as Ma's shares the oracle's, is tested with it, from a folder beside it.
"""

import argparse
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import pandas
from matplotlib.figure import Figure

from tint_sumo.benchmark import Suite, Trial, evaluate
from tint_sumo.config import PPO_BUDGETS, SNAPSHOTS_PERCENT, STEP_S, Mix
from tint_sumo.core.files import whole_file, write_frame
from tint_sumo.core.sampling import evenly_spread
from tint_sumo.core.weights import card_file
from tint_sumo.envs.rows import BUILT_IN_OUTCOMES
from tint_sumo.methods.evaluation import REPORTED_SET
from tint_sumo.methods.registry import METHODS, Learned
from tint_sumo.methods.training import CURVE_FILE, share_training, snapshot_stem
from tint_sumo.policy.storage import read_policy_card
from tint_sumo.study.published import RATES_PERCENT

LOOKS = {"paper": ("#1793fc", "the paper's recipe"), "full": ("#d77e0b", "our recipe")}
TRAINING = ["budget", "method", "p_conservative", "seed"]  # columns that tell trainings apart
LINES = {"success": "-", "collision": ":"}
POINTS = 200  # of a curve
COLUMNS = 3  # panels in a row of the figure


def finished(runs: Path) -> Iterator[tuple[str, Path]]:
    """Yield budget and folder of each finished training."""
    for folder in sorted(runs.iterdir(), key=lambda path: path.name):
        budget = folder.name.split(".")[0]
        if budget in LOOKS and card_file(snapshot_stem(folder, 100)).exists():
            yield budget, folder


def share_trainings(runs: Path) -> None:
    """Write policies of methods that share a finished training beside it."""
    for budget, folder in list(finished(runs)):
        card = read_policy_card(snapshot_stem(folder, 100))
        for method in METHODS.values():
            if isinstance(method, Learned) and method.trained_as == card["method"]:
                share_training(folder, method.name, runs / f"{budget}.{method.name}.{card['seed']}")


def training_of(budget: str, card: Mapping[str, Any]) -> dict[str, object]:
    """Return the entries that tell a training apart from others."""
    values = (budget, card["method"], float(card["p_conservative"][0]), card["seed"])
    return dict(zip(TRAINING, values, strict=True))


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
            **training_of(budget, card),
            "percent": percent,
            "decisions": card.get("decisions", card["steps"]),
            **{str(name): value for name, value in shares.items() if name != "world"},
            **dict(zip(names, published, strict=False)),
        }


def curve_of(budget: str, folder: Path) -> pandas.DataFrame:
    """Return some points of a training's curve: outcomes in percent of the last 500 episodes."""
    card = read_policy_card(snapshot_stem(folder, 100))
    curve = pandas.read_csv(folder / CURVE_FILE)
    curve = curve.iloc[evenly_spread(len(curve), POINTS)]
    table = pandas.DataFrame({**training_of(budget, card), "decisions": curve["decisions"]})
    for outcome in BUILT_IN_OUTCOMES:
        table[f"{outcome}_percent"] = (100 * curve[outcome]).round(1)
    return table


def with_kept(table: pandas.DataFrame, out: Path) -> pandas.DataFrame:
    """Return a table with the rows that ``out`` has already of other trainings."""
    if out.exists():
        kept = pandas.read_csv(out)
        measured = pandas.MultiIndex.from_frame(table[TRAINING])
        table = pandas.concat([kept[~pandas.MultiIndex.from_frame(kept[TRAINING]).isin(measured)], table])
    return table.sort_values(TRAINING, ignore_index=True, kind="stable")


def plot(curves: pandas.DataFrame, file: Path) -> None:
    """Draw success and collisions in training against the simulated time, one panel for each method and mix."""
    panels = list(curves.groupby(["method", "p_conservative"], sort=False))
    columns, lines = min(len(panels), COLUMNS), -(-len(panels) // COLUMNS)
    figure = Figure(figsize=(4.2 * columns, 3.6 * lines), dpi=150, layout="constrained")
    all_axes = figure.subplots(lines, columns, sharey=True, squeeze=False).flat
    for axes in all_axes[len(panels) :]:
        axes.set_visible(False)
    for axes, ((method, p_conservative), found) in zip(all_axes, panels, strict=False):
        for (name, _), curve in found.groupby(["budget", "seed"], sort=False):
            budget = str(name)
            hours = curve["decisions"] * PPO_BUDGETS[budget].action_repeat * STEP_S / 3600.0
            colour, title = LOOKS[budget]
            for outcome, line in LINES.items():
                label = f"{title}: {outcome}"
                axes.plot(hours, curve[f"{outcome}_percent"], line, color=colour, lw=1.2, label=label)
        axes.set(title=f"{method}, P {p_conservative:g}", xlabel="simulated time (hours)", ylim=(0, 100))
        axes.grid(alpha=0.25)
        axes.legend(frameon=False, fontsize=8)
    figure.axes[0].set_ylabel("last 500 episodes in training (%)")
    with whole_file(file) as partial:
        figure.savefig(partial, format="png")
    print(f"wrote {file}")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("runs", type=Path)
    parser.add_argument("--cases", type=int, default=500)
    parser.add_argument("--out", type=Path, default=Path("data/results/paper_recipe.csv"))
    parser.add_argument("--curves", type=Path, default=Path("data/results/paper_recipe_curves.csv"))
    parser.add_argument("--figure", type=Path)
    given = parser.parse_args()
    rows, curves = [], []
    share_trainings(given.runs)
    for budget, folder in finished(given.runs):
        if (folder / CURVE_FILE).exists():  # there is none where a training is shared
            curves.append(curve_of(budget, folder))
        for row in rows_of(budget, folder, given.cases):
            rows.append(row)
            print(*row.values(), flush=True)
    if not rows:
        parser.error(f"{given.runs} has no finished training BUDGET.METHOD.SEED")
    write_frame(with_kept(pandas.DataFrame(rows), given.out), given.out)
    every_curve = with_kept(pandas.concat(curves), given.curves)
    write_frame(every_curve, given.curves)
    print(f"wrote {given.out}", f"wrote {given.curves}", sep="\n")
    if given.figure is not None:
        plot(every_curve, given.figure)


if __name__ == "__main__":
    main()
