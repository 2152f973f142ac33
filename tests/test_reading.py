"""Files that are no files: pipes, devices, folders, and files that are too large."""

import os
import resource
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from tint_sumo.errors import InputError
from tint_sumo.files import shipped
from tint_sumo.reading import open_file, read_file

# Commands that read FILE, or a folder with FILE in it.
COMMANDS = (
    "bench --config FILE",
    "record --out out --sumocfg FILE",
    "traits infer --fcd FILE --model vae --out out.csv",
    "traits infer --fcd shipped.xml --net FILE --model vae --out out.csv",
    "traits evaluate --data DATA --model vae",
    "dataset inspect DATA",
    "traits infer --fcd DATA/trajectories --model vae --out out.csv",
    "policy evaluate --model CARD/policy.safetensors --episodes 1",
    "traits evaluate --data DATA --model CARD/model.safetensors",
    "study report --out RUN",
)


def test_a_regular_file_is_read(tmp_path: Path) -> None:
    file = tmp_path / "file"
    file.write_bytes(b"0123")
    assert read_file(file, "thing", 4) == b"0123"
    with pytest.raises(InputError, match=r"thing: .*file has 4 bytes, more than the 3 that are read"):
        read_file(file, "thing", 3)


@pytest.mark.parametrize("name", ["/dev/zero", "/dev/stdin", ".", "pipe"])
def test_what_is_no_regular_file_is_refused(name: str, tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "pipe")
    with pytest.raises(InputError, match=r"thing: .* is a folder, a pipe or a device; give a regular file"):
        open_file(tmp_path / name, "thing", 100)


def test_paths_that_cannot_be(tmp_path: Path) -> None:
    for name in ("a\0b", "x" * 5000):
        with pytest.raises(InputError, match=r"thing: .*check the path") as refused:
            open_file(tmp_path / name, "thing", 100)
        assert "\n" not in str(refused.value)


def test_no_descriptor_is_left_open(tmp_path: Path) -> None:
    before = len(list(Path("/proc/self/fd").iterdir()))
    for _ in range(3):
        with pytest.raises(InputError):
            open_file(tmp_path, "thing", 100)
    assert len(list(Path("/proc/self/fd").iterdir())) == before


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["pipe", "device"])
def test_no_command_waits_for_a_pipe_or_fills_memory(kind: str, tmp_path: Path) -> None:
    """All commands in one process, whose memory is limited; it is ended if one of them waits."""
    file = tmp_path / "FILE"
    if kind == "pipe":
        os.mkfifo(file)
    else:
        file.symlink_to("/dev/zero")
    for name in ("DATA/manifest.json", "CARD/policy.json", "CARD/model.json", "RUN/results/cases.json"):
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).symlink_to(file)
    shards = tmp_path / "DATA" / "trajectories"
    shards.mkdir()
    (shards / "shard-00000.parquet").symlink_to(file)
    for name in ("policy", "model"):
        shutil.copyfile(shipped("models") / "vae.safetensors", tmp_path / "CARD" / f"{name}.safetensors")
    (tmp_path / "shipped.xml").write_text("<fcd-export/>")
    code = f"""
import sys
from tint_sumo.cli import main
for line in {COMMANDS!r}:
    print(line, file=sys.stderr)
    assert main(line.split()) == 2, line
"""
    run = subprocess.run(
        [sys.executable, "-c", code],
        cwd=tmp_path,
        capture_output=True,
        text=True,
        timeout=120,
        check=False,
        preexec_fn=lambda: resource.setrlimit(resource.RLIMIT_DATA, (2**31, 2**31)),
    )
    assert run.returncode == 0, run.stderr
    lines = run.stderr.splitlines()
    assert len(lines) == 2 * len(COMMANDS), run.stderr
    assert all("a folder, a pipe or a device" in line for line in lines[1::2]), run.stderr
