"""``tint-sumo record`` and ``tint-sumo dataset``."""

import json
import re
from pathlib import Path

import pytest

from tests.cli.calls import copy, files, run
from tint_sumo.cli import main


def test_record(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = tmp_path / "data"
    printed = run(capsys, "record", "--out", out, "--windows", 50, "--p-conservative", 0.3, "--seed", 4, "--workers", 2)
    assert printed["windows"] >= 50
    assert (printed["p_conservative"], printed["seed"]) == (0.3, 4)
    assert json.loads((out / "manifest.json").read_text()) == printed


def test_a_folder_may_have_a_colon_in_its_name(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    printed = run(capsys, "record", "--windows", 20, "--out", "run-06:12")
    assert run(capsys, "dataset", "inspect", "run-06:12", "--verify")["manifest"] == printed


def test_record_in_the_format_of_sumo(dataset: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = copy(dataset, tmp_path / "copy")
    run(capsys, "record", "--windows", 100, "--out", out, "--format", "fcd")
    assert (out / "fcd" / "shard-00000.xml.gz").exists()
    assert {path: content for path, content in files(out).items() if "fcd" not in path.parts} == {
        out / path.relative_to(dataset): content for path, content in files(dataset).items()
    }


def test_dataset_inspect(dataset: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    printed = run(capsys, "dataset", "inspect", dataset)
    manifest = json.loads((dataset / "manifest.json").read_text())
    assert printed["manifest"] == manifest
    assert sum(trait["rows"] for trait in printed["traits"].values()) == manifest["rows"]
    assert main(["dataset", "inspect", str(dataset), "--figure", str(tmp_path / "figure.png")]) == 0
    text = capsys.readouterr().out
    assert re.search(r"windows +\d+\n", text)
    assert "aggressive, gap to the leader (m)" in text
    assert f"wrote {tmp_path / 'figure.png'}" in text
