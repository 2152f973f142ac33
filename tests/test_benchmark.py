"""The benchmark for others: the study's cases for any policy, and the leaderboard."""

import subprocess
import sys
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pandas
import pytest

from tint_sumo.benchmark import (
    SUITES,
    evaluate,
    find_entry,
    leaderboard_markdown,
    measure,
    read_leaderboard,
    repeat,
    worlds_suite,
)
from tint_sumo.config import HELD_OUT_WORLDS, P_CONSERVATIVE, Mix
from tint_sumo.core.errors import InputError
from tint_sumo.envs.rows import BUILT_IN_OUTCOMES
from tint_sumo.methods import evaluation
from tint_sumo.methods.loading import load_policy

ROOT = Path(__file__).parents[1]
FILE = ROOT / "data" / "results" / "leaderboard.csv"
SCRIPT = ROOT / "scripts" / "leaderboard.py"
CASES = 4


def go(observation: dict[str, np.ndarray]) -> int:
    """A policy for an entry: always the fastest speed."""
    assert observation["mask"].shape == (12,)
    return 2


class AlwaysGoes:
    """The same as Stable-Baselines3 has it."""

    def predict(
        self, observation: Any, state: Any = None, episode_start: Any = None, deterministic: bool = False
    ) -> Any:
        assert deterministic
        return np.full(len(observation["mask"]), 2), None


def test_suites_are_the_mixes_of_the_paper_and_the_held_out_worlds() -> None:
    assert [trial.p_conservative for trial in SUITES["paper"].trials] == list(map(Mix, P_CONSERVATIVE))
    assert {trial.world for trial in SUITES["paper"].trials} == {"old"}
    assert [trial.world for trial in SUITES["strangers"].trials] == list(HELD_OUT_WORLDS)
    with pytest.raises(InputError, match="unknown suite 'towns'; choose one of: paper, strangers"):
        evaluate("ttc", "towns")
    with pytest.raises(InputError, match="a policy is a name, a path, a function, or has a method predict, not 3"):
        evaluate(3, "paper")  # type: ignore[arg-type]


def test_functions_objects_and_names_drive_the_same_cases(tmp_path: Path) -> None:
    named, function, thing = (evaluate(policy, "paper", cases=CASES) for policy in ("always_go", go, AlwaysGoes()))
    assert named.letters() == function.letters() == thing.letters()
    table = named.table
    assert list(table["world"]) == ["P 0.25", "P 0.4", "P 0.6"]
    shares = table[[f"{outcome}_percent" for outcome in BUILT_IN_OUTCOMES]]
    assert (shares.sum(axis=1) == 100.0).all()
    assert (
        (table.success_low_percent <= table.success_percent) & (table.success_percent <= table.success_high_percent)
    ).all()
    named.to_csv(tmp_path / "table.csv")
    pandas.testing.assert_frame_equal(pandas.read_csv(tmp_path / "table.csv"), table)


def test_cases_are_those_of_policy_evaluate() -> None:
    contender = load_policy("no_labels")
    task = replace(contender.task, p_conservative=Mix(0.4))
    expected = evaluation.evaluate(contender.policy, partial(contender.make_venv, task=task), CASES, 0)
    assert evaluate("no_labels", "paper", cases=CASES).evaluations["P 0.4"] == expected


def test_strangers_are_measured_as_in_the_results_of_the_study() -> None:
    measured = pandas.read_csv(ROOT / "data" / "results" / "leaderboard.csv")
    row = measured[(measured.name == "ttc") & (measured.world == "krauss")].iloc[0]
    found = evaluate("ttc", worlds_suite("one", ["krauss"]), cases=CASES)
    assert found.letters() == {"krauss": row.outcomes[:CASES]}


# The leaderboard


def test_rows_are_written_read_and_repeated_and_others_refused(tmp_path: Path) -> None:
    file = tmp_path / "board.csv"
    rows = measure("mine", f"{__name__}:go", "https://example.org/mine/tree/abc", "paper", CASES)
    pandas.DataFrame([vars(row) for row in rows]).to_csv(file, index=False)
    assert read_leaderboard(file) == rows
    table = repeat(rows, 3)
    assert list(table["cases"]) == list(table["same"]) == [3, 3, 3]
    other = {"s": "c", "t": "c", "c": "s"}
    false = replace(rows[0], outcomes="".join(other[letter] for letter in rows[0].outcomes))
    assert list(repeat([false], CASES)["same"]) == [0]
    assert "| [mine](https://example.org/mine/tree/abc) |" in leaderboard_markdown(rows, "paper")
    first, *others = (
        replace(rows[0], outcomes="s" * 2999 + "c"),
        *(replace(row, outcomes="s" * 3000) for row in rows[1:]),
    )
    assert "| >99.9 | 0.0 | <0.1 | >99 (" in leaderboard_markdown([first, *others], "paper")
    for changed, message in (
        ("world", "needs a world of suite paper"),
        ("outcomes", "outcomes of the letters s, t, c"),
    ):
        pandas.DataFrame([vars(replace(rows[0], **{changed: "x"}))]).to_csv(file, index=False)
        with pytest.raises(InputError, match=message):
            read_leaderboard(file)
    (tmp_path / "other.csv").write_text("a,b\n1,2\n")
    with pytest.raises(InputError, match="is no leaderboard"):
        read_leaderboard(tmp_path / "other.csv")
    with pytest.raises(InputError, match="cannot be imported"):
        find_entry("nowhere_at_all:policy")


def check(*flags: str) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, str(SCRIPT), *flags]
    return subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False)


def test_the_leaderboard_is_whole_and_an_entry_of_it_is_what_it_says() -> None:
    rows = read_leaderboard(FILE)
    by_name: dict[tuple[str, str], list[str]] = {}
    for row in rows:
        by_name.setdefault((row.name, row.suite), []).append(row.world)
    for (_, suite), worlds in by_name.items():
        assert worlds == [trial.name for trial in SUITES[suite].trials]
    first = [row for row in rows if (row.name, row.suite) == ("no_labels", "paper")]
    table = repeat(first, 2)
    assert list(table["same"]) == list(table["cases"]) == [2, 2, 2]


@pytest.mark.long
def test_all_entries_of_the_leaderboard_are_what_they_say() -> None:
    checked = check("check", "--cases", "5")
    assert checked.returncode == 0, checked.stdout + checked.stderr
