"""Call commands, in this process or in one that can be interrupted."""

import json
import os
import re
import signal
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import pytest

from tests.terminal import look, open_terminal
from tests.waiting import PATIENCE_S
from tint_sumo.cli import main


def run(capsys: pytest.CaptureFixture[str], *argv: Any) -> dict[str, Any]:
    """Run a command that must succeed, and return the object that it prints last."""
    assert main([*map(str, argv), "--json"]) == 0
    printed = json.loads(capsys.readouterr().out.splitlines()[-1])
    assert isinstance(printed, dict)
    return printed


def refuse(capsys: pytest.CaptureFixture[str], *argv: Any) -> str:
    """Run a command that must be refused, and return the message that it prints."""
    assert main([*map(str, argv)]) == 2
    printed = capsys.readouterr()
    assert printed.out == ""
    lines = printed.err.strip().splitlines()
    assert len(lines) == 1
    assert lines[0].startswith("tint-sumo: error: ")
    return lines[0].removeprefix("tint-sumo: error: ")


def files(folder: Path) -> dict[Path, bytes]:
    return {path: path.read_bytes() for path in folder.rglob("*") if path.is_file()}


def copy(source: Path, target: Path) -> Path:
    for path, content in files(source).items():
        to = target / path.relative_to(source)
        to.parent.mkdir(parents=True, exist_ok=True)
        to.write_bytes(content)
    return target


class Started:
    """A ``tint-sumo`` of its own with a terminal, interrupted as soon as that shows a pattern."""

    def __init__(self, *argv: Any) -> None:
        command = [sys.executable, "-m", "tint_sumo.cli", *map(str, argv)]
        self.terminal, theirs = open_terminal()
        self.process = subprocess.Popen(command, stderr=theirs)
        os.close(theirs)

    def interrupt_at(self, pattern: str, sent: signal.Signals) -> str:
        """Return the lines that it printed after the interruption."""
        seen, end = "", time.monotonic() + PATIENCE_S
        while not re.search(pattern, seen):
            assert time.monotonic() < end, seen
            piece = self.read()
            assert piece, seen
            seen += piece
        self.process.send_signal(sent)
        rest = "".join(iter(self.read, ""))
        assert self.process.wait(PATIENCE_S) == 130
        return rest

    def read(self) -> str:
        return look(self.terminal, PATIENCE_S)
