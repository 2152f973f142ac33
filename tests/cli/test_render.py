"""``tint-sumo render``."""

from pathlib import Path

import pytest

from tests.cli.calls import run


def test_render(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    argv = ("render", "--model", "always_go", "--p-conservative", 0.4, "--case", 3, "--out", tmp_path / "film.gif")
    printed = run(capsys, *argv)
    assert {key: printed[key] for key in ("case", "outcome", "time_s", "frames")} == {
        "case": 3, "outcome": "collision", "time_s": 2.4, "frames": 25
    }  # fmt: skip
    assert [path.name for path in tmp_path.iterdir()] == ["film.gif"]
