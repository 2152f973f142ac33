"""No command writes over what it reads, or into the folder of a run that is not its own."""

import json
from dataclasses import fields
from pathlib import Path

import pytest

from tests.commands import commands
from tint_sumo.cli import main
from tint_sumo.core.files import PICTURE_SUFFIXES, RUN_FILE, write_json, write_text

# A call of each command that writes files; it must not touch OUT.
WRITING = {
    "net build": "net --out OUT",
    "net import": "net import DATA --out OUT",
    "scene check": "scene check DATA --figure OUT",
    "record": "record --windows 20 --out OUT",
    "dataset inspect": "dataset inspect DATA --figure OUT",
    "tracks inspect": "tracks inspect DATA --figure OUT",
    "tracks match": "tracks match DATA DATA --out OUT",
    "drivers fit": "drivers fit DATA --out OUT",
    "drivers export": "drivers export DATA --out OUT",
    "traits train": "traits train --data DATA --out OUT",
    "traits relative": "traits relative --out OUT",
    "traits plot": "traits plot --data DATA --model vae --out OUT",
    "traits infer": "traits infer --fcd DATA --model vae --out OUT",
    "traits export": "traits export --model vae --out OUT",
    "traits study": "traits study --out OUT",
    "policy train": "policy train --method oracle --out OUT",
    "policy record": "policy record --model ttc --episodes 1 --minari ttc-v0 --out OUT",
    "policy export": "policy export --model no_labels --out OUT",
    "policy sweep": "policy sweep --set n_epochs=1 --out OUT",
    "render": "render --model ttc --out OUT",
    "study run": "study run --out OUT",
    "study report": "study report --out OUT",
    "study scenes": "study scenes --out OUT",
}
READING = {"study log"}  # their --out is what they read
FILES = ("manifest.json", "trajectories/shard-00000.parquet", "provenance.json", "table.csv", "figure.png", "film.gif")
FOLDERS = ("", "trajectories")


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder of a run, with the files that commands could be asked to write over."""
    folder = tmp_path_factory.mktemp("run")
    write_json(folder / RUN_FILE, {"kind": "dataset"})
    for name in FILES:
        write_text(folder / name, json.dumps("precious"))
    return folder


def contents(folder: Path) -> dict[Path, bytes | None]:
    return {path: path.read_bytes() if path.is_file() else None for path in folder.rglob("*")}


def call(argv: str, out: Path, data: Path) -> int:
    places = {"OUT": str(out), "DATA": str(data)}
    return main([places.get(word, word) for word in argv.split()])


def test_every_command_that_writes_is_called() -> None:
    writing = {name for name, kind in commands() if {"out", "figure"} & {one.name for one in fields(kind)}}
    assert writing - READING == set(WRITING)


@pytest.mark.parametrize("name", WRITING)
def test_a_run_is_not_written_into_by_others(name: str, run: Path, capsys: pytest.CaptureFixture[str]) -> None:
    before = contents(run)
    outs = [run / path for path in (*FILES, *FOLDERS)]
    if name in (
        "net build",
        "net import",
        "dataset inspect",
        "tracks inspect",
        "tracks match",
        "drivers export",
        "traits plot",
        "traits infer",
        "traits export",
        "policy record",
        "policy export",
        "render",
    ):  # others have homes of their own
        outs += [run / "new.png", run / "new.csv", run / "new.gif", run / "new"]
    for out in outs:
        assert call(WRITING[name], out, run) == 2, out
    assert all(line.startswith("tint-sumo: error: ") for line in capsys.readouterr().err.splitlines())
    assert contents(run) == before


@pytest.mark.parametrize(
    "call_of", ["tracks match DATA net.xml --out OUT", "traits infer --tracks DATA --model vae --out OUT"]
)
def test_a_recording_is_not_replaced_by_a_table(
    call_of: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    recording, link = tmp_path / "recording.csv", tmp_path / "link.csv"
    write_text(recording, "precious")
    link.symlink_to(recording)
    for out in (recording, link):
        assert call(call_of, out, recording) == 2
        assert "holds the data that are read; choose another --out" in capsys.readouterr().err
    assert recording.read_text() == "precious"


def test_a_link_into_a_run_is_seen_through(run: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "link.png").symlink_to(run / "figure.png")
    (tmp_path / "folder").symlink_to(run)
    before = contents(run)
    for out in (tmp_path / "link.png", tmp_path / "folder" / "new.png"):
        assert call(WRITING["dataset inspect"], out, run) == 2
        assert "the folder of a run; choose another --figure" in capsys.readouterr().err
    assert contents(run) == before
    assert (tmp_path / "link.png").is_symlink()


@pytest.mark.parametrize("suffix", [*PICTURE_SUFFIXES, ".PNG", ".json", ".gif", ""])
def test_figures_are_pictures(suffix: str, inspected: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = tmp_path / f"figure{suffix}"
    allowed = suffix.lower() in PICTURE_SUFFIXES
    assert call(WRITING["dataset inspect"], out, inspected) == (0 if allowed else 2)
    assert out.exists() == allowed
    if not allowed:
        assert ".webp, .svg or .pdf; choose another --figure" in capsys.readouterr().err


@pytest.fixture(scope="module")
def inspected(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("data") / "dataset"
    assert call("record --windows 20 --workers 2 --out OUT", folder, folder) == 0
    return folder
