"""``tint-sumo net``."""

import shlex
from pathlib import Path

import pytest

from tests.cli.calls import run
from tests.maps.files import commonroad
from tint_sumo.cli import main


def test_net(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    printed = run(capsys, "net", "--out", tmp_path / "net", "--replicas", 2)
    assert printed["replicas"] == 2
    assert {Path(file).name for file in printed["files"]} >= {"tint.net.xml", "tint.sumocfg"}
    assert all(Path(file).is_file() for file in printed["files"])


def test_the_command_that_runs_a_network_can_be_typed_as_it_stands(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["net", "--out", str(tmp_path / "my net")]) == 0
    shown = capsys.readouterr().out.partition("run them with: ")[2]
    assert shlex.split(shown) == ["sumo", "-c", str(tmp_path / "my net" / "tint.sumocfg")]


def test_a_map_is_imported(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    command = ["net", "import", str(commonroad(tmp_path / "map.xml")), "--out", str(tmp_path / "net")]
    printed = run(capsys, *command)
    assert (printed["format"], printed["roads"], printed["left_hand"]) == ("commonroad", 4, False)
    assert all(Path(file).is_file() for file in printed["files"])
    assert main(command) == 2
    assert "choose another --out, or allow to --overwrite" in capsys.readouterr().err
    assert main([*command, "--overwrite"]) == 0
