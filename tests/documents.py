"""Run the commands and the code on a page of the documentation: ``python -m tests.documents PAGE.md``.

Blocks marked ``python`` and ``bash`` run in the page's order, in the present folder; Python blocks share their names.
A ``text`` block after one of them is what it prints, where ``...`` stands for anything. A block that is followed by a
comment ``<!-- not run: REASON -->`` is left out.
"""

import doctest
import io
import os
import re
import subprocess
import sys
from collections.abc import Iterator
from contextlib import redirect_stdout
from dataclasses import dataclass
from pathlib import Path
from typing import Any

_BLOCK = re.compile(r"^```(\w+)[^\n]*\n(.*?)^```$(\s*<!-- not run: [^>]+ -->)?", re.MULTILINE | re.DOTALL)
_FLAGS = doctest.ELLIPSIS | doctest.NORMALIZE_WHITESPACE


@dataclass(frozen=True)
class Block:
    """A fenced block of a page."""

    language: str
    text: str
    line: int


def blocks(page: Path) -> Iterator[Block]:
    """The blocks of a page that are run, and those that say what comes out."""
    text = page.read_text(encoding="utf-8")
    for match in _BLOCK.finditer(text):
        language, content, left_out = match.groups()
        if language in ("python", "bash", "text") and not left_out:
            yield Block(language, content, text.count("\n", 0, match.start()) + 1)


def run(page: Path) -> None:
    """Run a page from its first block to its last.

    Raises:
        AssertionError: a command failed, or something else came out than the page says.
    """
    names: dict[str, Any] = {"__name__": "__main__"}
    printed = ""
    for block in blocks(page):
        where = f"{page}:{block.line}"
        if block.language == "text":
            same = doctest.OutputChecker().check_output(block.text, printed, _FLAGS)
            assert same, f"{where}: the page says\n{block.text}\nbut what came out is\n{printed}"
        elif block.language == "python":
            printed = _run_python(block, where, names)
        else:
            printed = _run_bash(block, where)


def _run_python(block: Block, where: str, names: dict[str, Any]) -> str:
    out = io.StringIO()
    with redirect_stdout(out):
        exec(compile("\n" * block.line + block.text, where, "exec"), names)
    return out.getvalue()


def _run_bash(block: Block, where: str) -> str:
    command = ["bash", "-euo", "pipefail", "-c", block.text]
    beside_python = {"PATH": f"{Path(sys.executable).parent}:{os.environ['PATH']}"}  # where tint-sumo is, too
    result = subprocess.run(command, env=os.environ | beside_python, capture_output=True, text=True, check=False)
    assert result.returncode == 0, f"{where}: exit code {result.returncode}\n{result.stdout}\n{result.stderr}"
    return result.stdout


if __name__ == "__main__":
    run(Path(sys.argv[1]))
