"""Add a policy to data/results/leaderboard.csv, or repeat some cases of each row and compare.

    .venv/bin/python scripts/leaderboard.py add NAME ENTRY URL [--suite strangers] [--cases 200]
    .venv/bin/python scripts/leaderboard.py check [--cases 5] [--name NAME]

ENTRY is a name or folder that tint_sumo.methods.loading.load_policy reads, or MODULE:NAME of a policy or function,
which is imported. URL shows its code at a commit. The check fails if more than a tenth of the cases end otherwise:
other processors round differently, and a case may turn on that.
"""

import argparse
import sys
from dataclasses import asdict
from pathlib import Path

import pandas as pd

from tint_sumo.benchmark import SUITES, Entry, measure, read_leaderboard, repeat
from tint_sumo.core.errors import InputError
from tint_sumo.core.files import write_frame

FILE = Path(__file__).parents[1] / "data" / "results" / "leaderboard.csv"
LEAST_SAME = 0.9


def add(rows: list[Entry], added: list[Entry], file: Path) -> None:
    """Write the rows with those of a policy in place of its earlier ones in the suite."""
    new = {(one.name, one.suite) for one in added}
    kept = [one for one in rows if (one.name, one.suite) not in new]
    write_frame(pd.DataFrame([asdict(one) for one in (*kept, *added)]), file)


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("--file", type=Path, default=FILE)
    commands = parser.add_subparsers(dest="command", required=True)
    adding = commands.add_parser("add")
    for name in ("name", "entry", "url"):
        adding.add_argument(name)
    adding.add_argument("--suite", choices=SUITES, default="strangers")
    adding.add_argument("--cases", type=int, default=200)
    checking = commands.add_parser("check")
    checking.add_argument("--cases", type=int, default=5)
    checking.add_argument("--name")
    given = parser.parse_args()
    sys.path.insert(0, str(Path.cwd()))
    try:
        rows = read_leaderboard(given.file) if given.file.exists() else []
        if given.command == "add":
            add(rows, measure(given.name, given.entry, given.url, given.suite, given.cases), given.file)
            print(f"wrote {given.file}")
            return 0
        chosen = [one for one in rows if given.name in (None, one.name)]
        if not chosen:
            raise InputError(f"{given.file} has no row of {given.name or 'any policy'}")
        table = repeat(chosen, given.cases)
    except InputError as error:
        print(f"leaderboard: error: {error}", file=sys.stderr)
        return 2
    print(table.to_string(index=False))
    return 0 if table["same"].sum() >= LEAST_SAME * table["cases"].sum() else 1


if __name__ == "__main__":
    sys.exit(main())
