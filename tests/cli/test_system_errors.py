"""Refusals of the system end a command in one line; whole files stay whole: real processes, full disks."""

import os
import re
import resource
import subprocess
import sys
import tempfile
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pyarrow.parquet as pq
import pytest

from tint_sumo.cli import main
from tint_sumo.core import files
from tint_sumo.scenes import network
from tint_sumo.scenes.network import build_network

PROGRAM = (sys.executable, "-m", "tint_sumo.cli")
DISK_BYTES = 4_000_000


def start(*argv: Any, **options: Any) -> subprocess.CompletedProcess[str]:
    options = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE, "text": True, **options}
    ended: subprocess.CompletedProcess[str] = subprocess.run([*PROGRAM, *map(str, argv)], check=False, **options)
    return ended


def limit(kind: int, value: int) -> Callable[[], None]:
    return lambda: resource.setrlimit(kind, (value, value))


def require_one_line(printed: str, problem: str) -> None:
    """Check what a command has printed on stderr, beside the lines that its work begins and is done."""
    lines = [line for line in printed.splitlines() if not re.search(r": (begins|done \(\d+ s\))$", line)]
    assert len(lines) == 1, printed
    assert lines[0].startswith("tint-sumo: error: ")
    assert problem in lines[0]


@pytest.fixture
def closed_pipe() -> Iterator[int]:
    """The writing end of a pipe whose reader has gone, as ``head`` goes."""
    theirs, ours = os.pipe()
    os.close(theirs)
    yield ours
    os.close(ours)


@pytest.fixture
def disk(tmp_path: Path) -> Iterator[Path]:
    """A disk of 4 MB."""
    folder = tmp_path / "disk"
    folder.mkdir()
    mounted = subprocess.run(
        ["mount", "-t", "tmpfs", "-o", f"size={DISK_BYTES}", "tmpfs", str(folder)], capture_output=True, check=False
    )
    if mounted.returncode != 0:
        pytest.skip("no file system can be mounted here")
    yield folder
    subprocess.run(["umount", "--lazy", str(folder)], check=True)


def fill(disk: Path, left_bytes: int) -> Path:
    """Leave so much of a disk."""
    filler = disk / "filler"
    filler.write_bytes(bytes(DISK_BYTES // 4096 * 4096 - left_bytes))
    return filler


@pytest.mark.parametrize(
    "argv",
    ["--help", "policy train --help", "record --out x --print-config", "--print-completion bash", "net --out OUT"],
)
def test_a_closed_pipe_ends_a_command_quietly(argv: str, closed_pipe: int, tmp_path: Path) -> None:
    words = [str(tmp_path / "net") if word == "OUT" else word for word in argv.split()]
    ended = start(*words, stdout=closed_pipe)
    assert (ended.returncode, ended.stderr) == (141, "")


def test_a_closed_pipe_of_stderr_ends_the_work(closed_pipe: int, tmp_path: Path) -> None:
    ended = start("record", "--out", tmp_path / "data", "--windows", 20_000, stderr=closed_pipe)
    assert ended.returncode == 141
    assert not list(tmp_path.rglob("*.partial"))


@pytest.mark.parametrize("closed", [1, 2], ids=["stdout", "stderr"])
def test_a_command_works_where_it_was_started_with_closed_output(closed: int, tmp_path: Path) -> None:
    command = f"exec {sys.executable} -m tint_sumo.cli record --windows 50 --out {tmp_path / 'data'} {closed}>&-"
    ended = subprocess.run(["bash", "-c", command], capture_output=True, text=True, check=False)
    assert ended.returncode == 0
    assert bool(ended.stdout) == (closed == 2)
    assert (tmp_path / "data" / "manifest.json").exists()


@pytest.mark.parametrize("unbuffered", ["", "1"])
@pytest.mark.parametrize("argv", ["--help", "record --out x --print-config", "dataset inspect DATA"])
def test_output_that_cannot_be_written_is_an_error(argv: str, unbuffered: str, dataset: Path) -> None:
    words = [str(dataset) if word == "DATA" else word for word in argv.split()]
    with Path("/dev/full").open("w") as full:
        ended = start(*words, stdout=full, env=os.environ | {"PYTHONUNBUFFERED": unbuffered})
    assert ended.returncode == 1
    require_one_line(ended.stderr, "No space left on device; free some space, or choose another folder")


# A command of each kind that writes, and what it leaves
WRITERS = (
    "net --out OUT/net",
    "record --windows 100 --out OUT/data",
    "dataset inspect DATA --figure OUT/figure.png",
    "traits train --data DATA --out OUT/model",
    "traits plot --data DATA --model vae --out OUT/pictures",
    "traits infer --fcd DATA --model vae --out OUT/table.parquet",
    "policy train --method oracle --steps 1 --out OUT/policy",
    "policy sweep --set n_epochs=1 --out OUT/sweep",
    "study run --out OUT/study",
    "study scenes --out OUT/scenes",
    "traits study --out OUT/traits",
    "render --model ttc --out OUT/film.gif",
)


def words_of(argv: str, out: Path, dataset: Path, config: Path | None = None) -> list[str]:
    for name, path in (("OUT", out), ("DATA", dataset), ("CONFIG", config)):
        argv = argv.replace(name, str(path))
    return argv.split()


@pytest.mark.parametrize("argv", WRITERS)
def test_a_full_disk_is_found_before_the_work_begins(
    argv: str, disk: Path, dataset: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(words_of(argv, disk, dataset)) == 1
    require_one_line(capsys.readouterr().err, "No space left on device; free some space, or choose another folder")
    assert list(disk.iterdir()) == []


@pytest.mark.parametrize("argv", ["record --windows 100 --out OUT/data", "render --model ttc --out OUT/film.gif"])
def test_a_folder_that_nobody_may_write_to_is_found_before_the_work_begins(
    argv: str, disk: Path, dataset: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    subprocess.run(["mount", "-o", "remount,ro", str(disk)], check=True)
    assert main(words_of(argv, disk, dataset)) == 1
    require_one_line(capsys.readouterr().err, "Read-only file system; choose a folder that you may write to")


@pytest.mark.parametrize("argv", ["net --out OUT/net", "record --windows 100 --out OUT/data"])
def test_a_limit_of_file_sizes_is_an_error(argv: str, tmp_path: Path, dataset: Path) -> None:
    ended = start(*words_of(argv, tmp_path, dataset), preexec_fn=limit(resource.RLIMIT_FSIZE, 4096))
    assert ended.returncode == 1
    require_one_line(ended.stderr, "File too large; raise the limit of file sizes (ulimit -f)")
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    ("argv", "left_bytes"),
    [
        ("net --out OUT/net", 20_000),
        ("record --windows 3000 --out OUT/data", 300_000),
        ("dataset inspect DATA --figure OUT/figure.png", 8_000),
        ("traits train --data DATA --config CONFIG/traits.yaml --out OUT/model", 20_000),
        ("traits plot --data DATA --model vae --out OUT/pictures", 8_000),
        ("traits infer --fcd DATA --model vae --out OUT/table.parquet", 0),
        ("traits infer --fcd DATA --model vae --out OUT/table.csv", 0),
        ("policy train --method oracle --config CONFIG/policy.yaml --steps 1 --out OUT/policy", 20_000),
        ("render --model always_go --out OUT/film.gif", 20_000),
        ("render --model always_go --out OUT/film.mp4", 20_000),
        ("render --model always_go --out OUT/film.mp4", 0),
        ("render --model always_go --out OUT/film.png", 20_000),
    ],
)
def test_a_disk_that_gets_full_leaves_whole_files_alone(
    argv: str,
    left_bytes: int,
    disk: Path,
    dataset: Path,
    tmp_path: Path,
    capfd: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(files, "MIN_ROOM_BYTES", 1)
    filler = fill(disk, left_bytes + 4096)
    (tmp_path / "traits.yaml").write_text("budget: {base: quick, epochs: 1}")
    (tmp_path / "policy.yaml").write_text("budget: quick\nscene: {time_limit_s: 1.0}")  # films are short
    words = words_of(argv, disk, dataset, tmp_path)
    assert main(words) == 1
    require_one_line(capfd.readouterr().err, f"{disk}")
    assert not list(disk.rglob("*.partial"))
    for shard in disk.rglob("*.parquet"):
        pq.read_table(shard)
    filler.unlink()
    assert main(words) == 0


@pytest.mark.parametrize("left_bytes", [0, 4_096, 16_384, 24_576, 32_768])  # netconvert reports success on all of them
def test_a_full_temporary_folder_is_found_before_half_a_network_is_used(
    left_bytes: int, disk: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    build_network.cache_clear()
    monkeypatch.setattr(tempfile, "tempdir", str(disk))
    filler = fill(disk, left_bytes)
    argv = ["net", "--out", str(tmp_path / "net"), "--scene", "four_way", "--replicas", "8"]
    assert main(argv) == 1
    require_one_line(capsys.readouterr().err, "No space left on device; free some space, or choose another folder")
    assert not (tmp_path / "net").exists()
    filler.unlink()
    assert main(argv) == 0  # nothing of the failure is remembered


def test_a_netconvert_that_fails_is_reported_in_one_line(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    build_network.cache_clear()
    program = tmp_path / "netconvert"
    program.write_text("#!/bin/sh\necho 'Error: no room.' >&2; echo 'Quitting (on error).' >&2; exit 1\n")
    program.chmod(0o755)
    monkeypatch.setattr(network, "sumo_program", lambda _: str(program))
    assert main(["net", "--out", str(tmp_path / "net")]) == 1
    require_one_line(capsys.readouterr().err, "netconvert failed: Error: no room. Quitting (on error).")


@pytest.mark.parametrize("files_open", [8, 10, 12])
@pytest.mark.parametrize("argv", ["net --out OUT/net", "record --windows 20 --workers 2 --out OUT/data"])
def test_too_many_open_files_are_an_error(argv: str, files_open: int, tmp_path: Path, dataset: Path) -> None:
    ended = start(*words_of(argv, tmp_path, dataset), preexec_fn=limit(resource.RLIMIT_NOFILE, files_open))
    if ended.returncode != 0:
        assert ended.returncode == 1
        require_one_line(ended.stderr, "Too many open files; raise the limit of open files (ulimit -n)")
    assert not list(tmp_path.rglob("*.partial"))


@pytest.mark.parametrize("argv", WRITERS)
def test_a_name_that_is_no_text_is_refused(
    argv: str, tmp_path: Path, dataset: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(words_of(argv, tmp_path / "\udcff", dataset)) == 2
    flag = "--figure" if "--figure" in argv else "--out"
    assert f"is no text in UTF-8; choose another {flag}" in capsys.readouterr().err
    assert list(tmp_path.iterdir()) == []


def test_names_that_the_terminal_cannot_show_are_printed_all_the_same(tmp_path: Path) -> None:
    environment = os.environ | {"PYTHONIOENCODING": "ascii"}
    ended = start("net", "--out", tmp_path / "Straße", env=environment)
    assert (ended.returncode, ended.stderr) == (0, "")
    assert "Stra\\xdfe" in ended.stdout
