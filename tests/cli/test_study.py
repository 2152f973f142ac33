"""``tint-sumo study``."""

import json
import signal
from pathlib import Path

import pytest

from tests.cli.calls import Started, copy, run
from tint_sumo.cli import main
from tint_sumo.config import Mix
from tint_sumo.core.stores import name_in
from tint_sumo.methods.evaluation import Case, Evaluation
from tint_sumo.study.budgets import Conditions
from tint_sumo.study.folders import RESULTS
from tint_sumo.study.results import GIVEN, Measured, Result


@pytest.fixture(scope="session")
def small_study(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A study of three cases."""
    out = tmp_path_factory.mktemp("results")
    cases = Evaluation((Case("success", 12.0),) * 3)
    result = Result("ttc", GIVEN, None, 0, (Measured(Conditions(Mix(0.4)), cases),))
    (out / RESULTS).mkdir()
    (out / RESULTS / "one.json").write_text(json.dumps(result.to_json()))
    assert main(["study", "report", "--out", str(out)]) == 0
    return out


@pytest.mark.parametrize("named", ["r/", "./", "e", "file"])
def test_study_report_names_its_files_as_the_user_does(
    named: str, small_study: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    folder = tmp_path if named == "./" else tmp_path / named
    copy(small_study, folder)
    monkeypatch.chdir(tmp_path)
    out = folder.as_uri() if named == "file" else named
    printed = run(capsys, "study", "report", "--out", out)
    assert list(printed) == ["results", "files"]
    assert [(row["method"], row["success"]) for row in printed["results"]] == [("ttc", 1.0)]
    names = ["results.csv", "results.md", "results.png", "report.html"]
    assert printed["files"] == [name_in(out, name) for name in names]
    assert all((folder / name).is_file() for name in names)
    assert main(["study", "report", "--out", out]) == 0
    text = capsys.readouterr().out
    assert "| time to collision |" in text
    assert all(f"wrote {file}\n" in text for file in printed["files"])


def test_an_interrupted_study_leaves_whole_files(tmp_path: Path) -> None:
    out = tmp_path / "study"
    printed = Started("study", "run", "--out", out).interrupt_at(r"[1-9]\d*% ", signal.SIGINT)
    assert "Traceback" not in printed
    assert "the same command goes on from here" in printed
    assert not list(out.rglob("*.partial"))
    assert (out / "run.json").exists()
    assert not (out / "dataset" / "manifest.json").exists()
    for shard in (out / "dataset" / "trajectories").iterdir():
        assert shard.read_bytes().endswith(b"PAR1")
