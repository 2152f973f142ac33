"""Origin of runs: command, commit and versions in their folders."""

import json
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

from tint_sumo.cli.command_line import main, parse
from tint_sumo.core.errors import InputError
from tint_sumo.core.files import claim_folder
from tint_sumo.core.provenance import Origin, commit, made_by
from tint_sumo.dataset.recorder import record

ORIGIN = Origin(("record", "--out", "my data"), lambda: "out: my data\n")


def git(folder: Path, *words: str) -> str:
    identity = ("-c", "user.name=nobody", "-c", "user.email=nobody@example.org")
    command = ["git", "-C", str(folder), *identity, *words]
    return subprocess.run(command, capture_output=True, text=True, check=True).stdout.strip()


def files(folder: Path) -> dict[str, bytes]:
    return {str(path.relative_to(folder)): path.read_bytes() for path in folder.rglob("*") if path.is_file()}


def test_the_commit_of_a_checkout_and_whether_files_differ(tmp_path: Path) -> None:
    checkout = tmp_path / "checkout"
    checkout.mkdir()
    (checkout / "code.py").write_text("one")
    git(checkout, "init", "--quiet")
    git(checkout, "add", ".")
    git(checkout, "commit", "--quiet", "-m", "one")
    git(checkout, "tag", "v1")
    clean = commit(checkout)
    assert clean == git(checkout, "rev-parse", "HEAD")
    (checkout / "code.py").write_text("two")
    commit.cache_clear()
    assert commit(checkout) == f"{clean}-dirty"


def test_an_installed_package_has_no_commit_even_in_the_checkout_of_something_else(tmp_path: Path) -> None:
    git(tmp_path, "init", "--quiet")
    installed = tmp_path / "site-packages"
    installed.mkdir()
    assert commit(installed) is None


def test_no_commit_without_git(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / ".git").mkdir()
    assert commit(tmp_path) is None
    monkeypatch.setenv("PATH", str(tmp_path))
    commit.cache_clear()
    assert commit(tmp_path) is None


def claim(folder: Path, **options: Any) -> None:
    with claim_folder(folder, {"seed": 1}, **options):
        pass


def test_a_new_run_tells_of_its_command(tmp_path: Path) -> None:
    with made_by(ORIGIN):
        claim(tmp_path / "run")
        claim(tmp_path / "other", with_versions=False)
    content = json.loads((tmp_path / "run" / "provenance.json").read_text())
    assert set(content) == {"command", "commit", "versions"}
    assert content["command"] == "tint-sumo record --out 'my data'"
    assert content["versions"]["python"] == sys.version.split()[0]
    assert (tmp_path / "run" / "config.yaml").read_text() == "out: my data\n"
    assert set(json.loads((tmp_path / "other" / "provenance.json").read_text())) == {"command", "commit"}
    assert json.loads((tmp_path / "run" / "run.json").read_text()) == {"seed": 1}


def test_what_is_there_already_and_what_no_command_makes_is_left_as_it_is(tmp_path: Path) -> None:
    claim(tmp_path / "run")
    before = files(tmp_path)
    assert set(before) == {"run/run.json", "run/.lock"}
    with made_by(ORIGIN):
        claim(tmp_path / "run")
    assert files(tmp_path) == before


def test_parts_of_a_run_are_told_of_once(tmp_path: Path) -> None:
    with made_by(ORIGIN), claim_folder(tmp_path / "study", {"seed": 1}):
        claim(tmp_path / "study" / "dataset")
    assert {path.parent.name for path in tmp_path.rglob("provenance.json")} == {"study"}


def test_a_command_begins_no_run_in_the_folder_of_another(tmp_path: Path) -> None:
    claim(tmp_path / "study")
    (tmp_path / "link").symlink_to(tmp_path / "study")
    with made_by(ORIGIN):
        for folder in (tmp_path / "study" / "logs" / "mine", tmp_path / "link" / "mine"):
            with pytest.raises(InputError, match=r"study.* the folder of a run; choose another `out`"):
                claim(folder)
    assert set(files(tmp_path / "study")) == {"run.json", ".lock"}


def test_a_run_killed_at_its_beginning_does_not_stand_in_the_way_and_a_file_of_the_user_does(tmp_path: Path) -> None:
    run, mine = tmp_path / "run", tmp_path / "mine"
    for folder in (run, mine):
        folder.mkdir()
        (folder / "config.yaml").write_text("seed: 3")
    (run / "provenance.json").write_text("{}")
    with made_by(ORIGIN):
        claim(run)
        with pytest.raises(InputError, match="already holds other files"):
            claim(mine)
    assert (run / "config.yaml").read_text() == "out: my data\n"
    assert (mine / "config.yaml").read_text() == "seed: 3"


def test_a_recorded_dataset_can_be_recorded_again_from_its_own_configuration(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    words = ["record", "--out", "data", "--windows", "40", "--p-conservative", "0.2", "0.8", "--workers", "2"]
    assert main(words) == 0
    content = json.loads(Path("data/provenance.json").read_text())
    assert content == {"command": f"tint-sumo {' '.join(words)}", "commit": commit()}
    assert "versions" in json.loads(Path("data/manifest.json").read_text())
    assert parse(["record", "--config", "data/config.yaml"]).windows == 40
    assert main(["record", "--config", "data/config.yaml", "--out", "again", "--workers", "1"]) == 0
    one, two = files(Path("data")), files(Path("again"))
    for name in ("provenance.json", "config.yaml"):
        assert one.pop(name) != two.pop(name)
    assert one == two
    record(Path("plain"), 40, p_conservative=(0.2, 0.8), progress=False)
    assert files(Path("plain")) == one


def test_a_training_and_its_configuration(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    Path("train.yaml").write_text(
        "method: no_labels\nout: run\nsteps: 1\nbudget: {n_envs: 2, n_steps: 8, n_minibatches: 1}\n"
        "scene: {base: on_ramp, time_limit_s: 1}"
    )
    assert main(["policy", "train", "--config", "train.yaml"]) == 0
    assert "versions" not in json.loads(Path("run/provenance.json").read_text())  # they stand in the card
    before = files(Path("run"))
    assert main(["policy", "train", "--config", "run/config.yaml"]) == 0
    assert files(Path("run")) == before
    assert main(["policy", "evaluate", "--model", "run", "--episodes", "2", "--json"]) == 0
    found = json.loads(capsys.readouterr().out.splitlines()[-1])
    assert found["scene"].startswith("on_ramp-")
    assert found["timeout"] == 1.0  # nobody arrives within a second
