"""The list of mutants that do the same as the code."""

import tomllib
from pathlib import Path

ROOT = Path(__file__).parents[1]
LISTED = tomllib.loads((ROOT / "tests" / "mutants.toml").read_text(encoding="utf-8"))["equivalent"]


def test_listed_mutants_are_of_code_that_is_still_there() -> None:
    for mutant in LISTED:
        code = (ROOT / "tint_sumo" / f"{mutant['module']}.py").read_text(encoding="utf-8")
        assert mutant["was"] in " ".join(code.split()), mutant
        assert mutant["now"] != mutant["was"] and mutant["reason"]
