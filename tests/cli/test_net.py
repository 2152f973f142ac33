"""``tint-sumo net``."""

from pathlib import Path

import pytest

from tests.cli.calls import run


def test_net(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    printed = run(capsys, "net", "--out", tmp_path / "net", "--replicas", 2)
    assert printed["replicas"] == 2
    assert {Path(file).name for file in printed["files"]} >= {"tint.net.xml", "tint.sumocfg"}
    assert all(Path(file).is_file() for file in printed["files"])
