"""Files that are no files: pipes, devices, folders, and files that are too large."""

import gzip
import os
import random
import resource
import shutil
import subprocess
import sys
import time
import tracemalloc
import zipfile
from collections.abc import Callable
from contextlib import nullcontext
from pathlib import Path
from typing import Any

import pytest

from tint_sumo.core.errors import InputError
from tint_sumo.core.files import shipped
from tint_sumo.core.reading import open_file, read_file, require_file, require_zip
from tint_sumo.dataset.fcd_reader import read_fcd
from tint_sumo.scenes.sumocfg import read_net

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


def test_gzipped_files_are_refused_by_what_they_unpack_to(tmp_path: Path) -> None:
    """A file of some size of its own may unpack to much; one that is all zeros may not, whoever reads it."""
    plain = random.Random(0).randbytes(2**12) + b"\0" * 2**16
    good = tmp_path / "good.gz"
    good.write_bytes(gzip.compress(plain))
    require_file(good, "thing", len(plain))
    with pytest.raises(InputError, match=rf"thing: .*good\.gz unpacks to more than {len(plain) - 1:,} bytes or"):
        require_file(good, "thing", len(plain) - 1)
    good.write_bytes(gzip.compress(plain)[:-9])
    require_file(good, "thing", len(plain))  # damaged: its reader says so


@pytest.mark.parametrize(
    ("name", "start", "read"),
    [
        ("fcd.xml.gz", b"<fcd-export>", read_fcd),
        ("fcd.csv.gz", b"timestep_time;vehicle_id;vehicle_lane;vehicle_pos;vehicle_speed\n", read_fcd),
        ("a.net.xml.gz", b"<net>", read_net),
    ],
)
def test_a_gzip_bomb_is_refused_at_once(name: str, start: bytes, read: Callable[[Path], Any], tmp_path: Path) -> None:
    """2 GB of spaces; members of a gzipped file may follow each other."""
    file, spaces = tmp_path / name, gzip.compress(b" " * 2**26)
    file.write_bytes(gzip.compress(start) + spaces * 32)
    began = time.process_time()
    tracemalloc.start()
    with pytest.raises(InputError, match=r"unpacks to more than .* or 200 times its size") as refused:
        read(file)
    peak_bytes = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert "\n" not in str(refused.value)
    assert time.process_time() - began < 1.0
    assert peak_bytes < 2**25


def test_zip_files_are_refused_by_what_they_unpack_to(tmp_path: Path) -> None:
    file = tmp_path / "thing.zip"
    for count, most_bytes, is_refused in ((1, 2**16, False), (2, 2**16, True), (2**10, 2**30, True)):
        with zipfile.ZipFile(file, "w", zipfile.ZIP_DEFLATED) as packed:
            for number in range(count):
                packed.writestr(str(number), bytes(2**16))
        with pytest.raises(InputError, match=r"thing\.zip unpacks to more") if is_refused else nullcontext():
            require_zip(file, "thing", most_bytes)


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
