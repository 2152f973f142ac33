"""Test policies in worlds that their training has not met; writes tables.

Usage: python scripts/measure_strangers.py [RUNS] [--cases 200] [--out data/results/strangers.csv] [--ship]

RUNS is a folder of training runs METHOD.SEED, such as ``tint-sumo policy train --method oracle --world strangers
--budget strangers --seed 0 --out RUNS/oracle.0`` makes. A row of the table is a policy in a world; the rules and the
shipped policies of the old world stand there, too. Rows that an earlier, interrupted call has written are kept. Beside
the table stand its means by method and world, and its scores by method, as Markdown; without RUNS these are remade.
With --ship, data/models/policies/strangers gets the policy of the first seed of each method without a trait model, if
RUNS has it; its card has the rates of all seeds. RUNS may also hold policies of ``scripts/supervised.py``, the bound of
inference.
"""

import argparse
import csv
import shutil
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path

import pandas
from supervised import METHOD, NETWORK_FILE, register_supervised

from tint_sumo.benchmark import evaluate, worlds_suite
from tint_sumo.core.files import write_frame, write_json, write_text
from tint_sumo.core.percentages import percent, percent_and_ends
from tint_sumo.core.statistics import (
    Scores,
    improvement,
    improvement_interval,
    interquartile_interval,
    interquartile_mean,
)
from tint_sumo.core.weights import card_file, weights_file
from tint_sumo.envs.rows import BUILT_IN_OUTCOMES
from tint_sumo.methods.registry import METHODS, find_learned
from tint_sumo.methods.training import POLICY
from tint_sumo.policy.storage import read_policy_card
from tint_sumo.study.budgets import STRANGERS_TESTS
from tint_sumo.study.tables import Lines, markdown_table

OTHERS = ("ttc", "no_labels", "oracle")  # a rule, and policies of the old world
TRAINED_IN = "strangers"
REFERENCE = "no_labels"  # that other methods are compared with
CAREFUL = 0.01  # share of collisions that is the goal
SHIPPED = Path(__file__).resolve().parents[1] / "data" / "models" / "policies" / TRAINED_IN
FIELDS = ("trained_in", "method", "seed", "world", "cases", *(f"{outcome}_percent" for outcome in BUILT_IN_OUTCOMES))


def contenders(runs: Path) -> Iterator[tuple[str, str, str]]:
    """Yield the world of the training, the name of the method, and name or path of each policy; with its seed last."""
    for name in OTHERS:
        yield "" if name == "ttc" else "old", name, name
    for folder in sorted(runs.iterdir()):
        if (folder / "policy.safetensors").exists():
            yield TRAINED_IN, folder.name.split(".")[0], str(folder)


def measure(name: str, world: str, cases: int) -> dict[str, str]:
    found = evaluate(name, worlds_suite(world, [world]), cases=cases).evaluations[world]
    return {f"{outcome}_percent": f"{100 * found.rate(outcome).value:.1f}" for outcome in BUILT_IN_OUTCOMES}


def measure_all(runs: Path, cases: int, out: Path) -> list[dict[str, str]]:
    """Return the rows of all policies, and write them to ``out`` as they come; those that it has already are kept."""
    rows = list(csv.DictReader(out.read_text().splitlines())) if out.exists() else []
    if {row["cases"] for row in rows} - {str(cases)}:
        raise SystemExit(f"{out} has other numbers of cases than {cases}; give it another --out")
    known = {(row["trained_in"], row["method"], row["seed"], row["world"], row["cases"]) for row in rows}
    for trained_in, method, name in contenders(runs):
        for world in STRANGERS_TESTS:
            key = (trained_in, method, Path(name).suffix[1:], world, str(cases))
            if key not in known:
                rows.append(dict(zip(FIELDS, key, strict=False)) | measure(name, world, cases))
                print(*rows[-1].values(), flush=True)
                write_frame(pandas.DataFrame(in_order(rows)), out)
    print(f"wrote {out}")
    return rows


def in_order(rows: Sequence[dict[str, str]]) -> list[dict[str, str]]:
    """Return rows with those trained among strangers last, methods in the registry's order, and seeds rising."""
    methods = {name: number for number, name in enumerate(METHODS)}

    def place(row: Mapping[str, str]) -> tuple[bool, int, int]:
        return row["trained_in"] == TRAINED_IN, methods.get(row["method"], len(methods)), int(row["seed"] or 0)

    return sorted(rows, key=place)


def titled(trained_in: str, method: str) -> str:
    return f"{method}, old" if trained_in == "old" else method


def worlds_lines(table: pandas.DataFrame) -> Lines:
    """Return success / timeout / collision in percent of each method in each world, mean over its seeds."""
    columns = list(dict.fromkeys(zip(table["trained_in"], table["method"], strict=True)))
    lines = [["world", *(titled(*column) for column in columns)]]
    for world in STRANGERS_TESTS:
        cells = []
        for trained_in, method in columns:
            found = table[(table["trained_in"] == trained_in) & (table["method"] == method) & (table["world"] == world)]
            means = (found[f"{outcome}_percent"].mean() / 100.0 for outcome in BUILT_IN_OUTCOMES)
            cells.append("/".join(percent(mean, 0) for mean in means))
        lines.append([f"`{world}`", *cells])
    return lines


def scores_lines(table: pandas.DataFrame) -> Lines:
    """Return what the trainings of each method have reached over all worlds, seed by seed, in percent."""
    trained = table[table["trained_in"] == TRAINED_IN]
    success = {str(method): _by_seed(found, "success") for method, found in trained.groupby("method", sort=False)}
    lines = [
        [
            "method",
            "interquartile mean",
            "success by seed",
            "collisions by seed",
            "worlds at most 1 %",
            "above no_labels",
        ]
    ]
    reference = success.get(REFERENCE)
    for method, scores in success.items():
        collisions = _by_seed(trained[trained["method"] == method], "collision")
        above = "-"
        if reference is not None and method != REFERENCE:
            above = _with_interval(improvement(scores, reference), improvement_interval(scores, reference), scores)
        lines.append(
            [
                f"`{method}`",
                _with_interval(interquartile_mean(scores), interquartile_interval(scores), scores),
                ", ".join(percent(score, 0) for score in scores.mean(axis=1)),
                ", ".join(map(percent, collisions.mean(axis=1))),
                ", ".join(str(count) for count in (collisions <= CAREFUL).sum(axis=1)),
                above,
            ]
        )
    return lines


def _with_interval(share: float, interval: tuple[float, float], scores: Scores) -> str:
    """Return a share in percent, with its interval over seeds if there are several."""
    return percent(share, 0) if len(scores) == 1 else percent_and_ends(share, interval, digits=0)


def _by_seed(table: pandas.DataFrame, outcome: str) -> Scores:
    """Return the share of an outcome, (seeds, worlds)."""
    return table.pivot(index="seed", columns="world", values=f"{outcome}_percent").to_numpy() / 100.0


def read_table(file: Path) -> pandas.DataFrame:
    """Return a table that this script has written; rules have neither a seed nor a world of their training."""
    return pandas.read_csv(file, keep_default_na=False, dtype={"seed": str})


def write_tables(file: Path) -> None:
    """Write the Markdown tables that follow from a table of all policies, beside it."""
    table = read_table(file)
    target = file.with_suffix(".md")
    write_text(target, f"{markdown_table(worlds_lines(table))}\n\n{markdown_table(scores_lines(table))}\n")
    print(f"wrote {target}")


def ship(runs: Path, rows: Sequence[Mapping[str, str]]) -> None:
    """Copy the policy of each method's first seed, with the method's rates; not those that need a trait model."""
    trained = [row for row in rows if row["trained_in"] == TRAINED_IN and row["method"] != METHOD]
    for method in dict.fromkeys(row["method"] for row in trained if find_learned(row["method"]).encoder is None):
        of_method = [row for row in trained if row["method"] == method]
        seeds = sorted({int(row["seed"]) for row in of_method})
        results = {}
        for world in STRANGERS_TESTS:
            found = [row for row in of_method if row["world"] == world]
            means = {
                outcome: round(sum(float(row[f"{outcome}_percent"]) for row in found) / len(found) / 100, 4)
                for outcome in BUILT_IN_OUTCOMES
            }
            results[world] = {"seeds": seeds, "episodes": int(found[0]["cases"]), **means}
        run, shipped = runs / f"{method}.{seeds[0]}" / POLICY, SHIPPED / method
        trained_here = weights_file(run).exists()
        if trained_here:
            SHIPPED.mkdir(parents=True, exist_ok=True)
            shutil.copyfile(weights_file(run), weights_file(shipped))
        write_json(card_file(shipped), {**read_policy_card(run if trained_here else shipped), "results": results})
        print(f"wrote {card_file(shipped)}")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("runs", type=Path, nargs="?")
    parser.add_argument("--cases", type=int, default=200)
    parser.add_argument("--out", type=Path, default=Path("data/results/strangers.csv"))
    parser.add_argument("--ship", action="store_true")
    given = parser.parse_args()
    if given.runs is not None:
        if (given.runs / NETWORK_FILE).exists():
            register_supervised(given.runs / NETWORK_FILE)
        rows = measure_all(given.runs, given.cases, given.out)
        if given.ship:
            ship(given.runs, rows)
    write_tables(given.out)


if __name__ == "__main__":
    main()
