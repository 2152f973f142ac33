"""Test policies in worlds that their training has not met; writes a table.

Usage: python scripts/measure_strangers.py RUNS [--cases 200] [--out data/results/strangers.csv] [--ship]

RUNS is a folder of training runs METHOD.SEED, such as ``tint-sumo policy train --method oracle --world strangers
--budget strangers --seed 0 --out RUNS/oracle.0`` makes. A row of the table is a policy in a world; the rules and the
shipped policies of the old world stand there, too. Rows that an earlier, interrupted call has written are kept.
With --ship, data/models/policies/strangers gets the policy of each method's first seed; its card has the rates of all.
"""

import argparse
import csv
import shutil
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path

import pandas

from tint_sumo.benchmark import evaluate, worlds_suite
from tint_sumo.core.files import write_frame, write_json
from tint_sumo.methods.evaluation import BUILT_IN_OUTCOMES
from tint_sumo.methods.training import POLICY
from tint_sumo.policy.storage import card_file, read_policy_card, weights_file
from tint_sumo.study.budgets import STRANGERS_TESTS

OTHERS = ("ttc", "no_labels", "oracle")  # a rule, and policies of the old world
TRAINED_IN = "strangers"
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


def ship(runs: Path, rows: Sequence[Mapping[str, str]]) -> None:
    """Copy the policy of each method's first seed, with the method's rates in each world."""
    trained = [row for row in rows if row["trained_in"] == TRAINED_IN]
    for method in dict.fromkeys(row["method"] for row in trained):
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
        SHIPPED.mkdir(parents=True, exist_ok=True)
        shutil.copyfile(weights_file(run), weights_file(shipped))
        write_json(card_file(shipped), {**read_policy_card(run), "results": results})
        print(f"wrote {weights_file(shipped)}")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("runs", type=Path)
    parser.add_argument("--cases", type=int, default=200)
    parser.add_argument("--out", type=Path, default=Path("data/results/strangers.csv"))
    parser.add_argument("--ship", action="store_true")
    given = parser.parse_args()
    rows = list(csv.DictReader(given.out.read_text().splitlines())) if given.out.exists() else []
    known = {(row["trained_in"], row["method"], row["seed"], row["world"], row["cases"]) for row in rows}
    for trained_in, method, name in contenders(given.runs):
        for world in STRANGERS_TESTS:
            seed = Path(name).suffix[1:]
            key = (trained_in, method, seed, world, str(given.cases))
            if key in known:
                continue
            rows.append(dict(zip(FIELDS, key, strict=False)) | measure(name, world, given.cases))
            print(*rows[-1].values(), flush=True)
            write_frame(pandas.DataFrame(rows), given.out)
    print(f"wrote {given.out}")
    if given.ship:
        ship(given.runs, rows)


if __name__ == "__main__":
    main()
