"""Folders of models for others."""

import sys
from pathlib import Path

import numpy as np
import pytest

from tests.cli.calls import refuse, run
from tint_sumo import methods, traits
from tint_sumo.core.errors import InputError
from tint_sumo.methods.driving import drive
from tint_sumo.methods.evaluation import case_seed
from tint_sumo.methods.exporting import export_policy, export_traits
from tint_sumo.methods.loading import Contender, load_policy


def actions(contender: Contender) -> list[list[int]]:
    found = drive(contender.policy, lambda n: contender.make_venv(n, contender.task), case_seed(3), 6, 6)
    return [one.actions for one in sorted(found, key=lambda one: one.number)]


@pytest.mark.parametrize("name", ["streaming", "no_labels"])
def test_a_folder_is_the_same_policy(name: str, tmp_path: Path) -> None:
    contender = load_policy(name)
    files = export_policy(contender, tmp_path / "folder")
    assert {file.name for file in files} >= {"policy.json", "policy.safetensors"}
    assert (tmp_path / "folder" / "traits.safetensors" in files) == (name == "streaming")
    assert actions(load_policy(tmp_path / "folder")) == actions(contender)
    assert {file.name for file in export_policy(load_policy(tmp_path / "folder"), tmp_path / "again")} == {
        file.name for file in files
    }


def test_a_folder_is_the_same_trait_model(tmp_path: Path) -> None:
    export_traits("morton", tmp_path / "folder")
    one, other = traits.load("morton").state_dict(), traits.load(tmp_path / "folder").state_dict()
    assert all(np.array_equal(one[name], other[name]) for name in one)


def test_nothing_is_written_over_and_failures_leave_nothing(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "full").mkdir()
    (tmp_path / "full" / "mine").write_text("precious")
    for kind in ("policy", "traits"):
        message = refuse(capsys, kind, "export", "--model", "vae", "--out", tmp_path / "full")
        assert "already holds other files; choose another --out or an empty folder" in message
    with pytest.raises(InputError, match="ttc is a rule and has no network; give a learned policy"):
        export_policy(load_policy("ttc"), tmp_path / "new")
    monkeypatch.setitem(sys.modules, "onnx", None)
    monkeypatch.delitem(sys.modules, "tint_sumo.methods.onnx_files", raising=False)
    monkeypatch.delattr(methods, "onnx_files", raising=False)  # if another test has loaded it
    message = refuse(capsys, "traits", "export", "--model", "vae", "--out", tmp_path / "new", "--onnx")
    assert message == '--onnx needs onnx and onnxscript; install them: pip install "tint_sumo[onnx]"'
    assert [path.name for path in tmp_path.iterdir()] == ["full"]
    (tmp_path / "empty").mkdir()
    found = run(capsys, "traits", "export", "--model", "vae", "--out", tmp_path / "empty")
    assert found["files"] == [str(path) for path in sorted((tmp_path / "empty").iterdir())]
