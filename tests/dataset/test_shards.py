"""Recordings that are really killed, at every kind of moment; the same command then gives the very same dataset."""

import gzip
import os
import signal
import subprocess
import sys
from pathlib import Path

import pandas as pd
import pytest

from tests.dataset.test_recorder import TWO_SHARDS, contents
from tests.waiting import wait_until
from tint_sumo.dataset.recorder import record
from tint_sumo.dataset.schema import FCD, MANIFEST, TABLES, TRAJECTORIES

# Workers import this, too. Where a file's name ends with the moment, it is cut in half, as if it were just being
# written, and nothing goes on. Where no moment is given, nothing goes on before the last file: a signal comes first.
RECORDING = """
import os, time
from pathlib import Path
from tint_sumo.dataset.recorder import record

replace = Path.replace

def replace_or_stop(partial, file):
    if "{moment}" and str(file).endswith("{moment}"):
        os.truncate(partial, partial.stat().st_size // 2)
        Path("{reached}").touch()
        time.sleep(600)
    elif str(file).endswith("manifest.json"):
        time.sleep(600)
    return replace(partial, file)

Path.replace = replace_or_stop
if __name__ == "__main__":
    record(Path("{out}"), {windows}, workers={workers}, fcd=True)
"""


class Recording:
    """A recording in a process of its own, which stops at ``moment``, if ever."""

    def __init__(self, folder: Path, workers: int, moment: str = "") -> None:
        self.out = folder / "killed"
        self.reached = folder / f"reached{moment.replace('/', '-')}"
        self._script = folder / f"recording{moment.replace('/', '-')}.py"
        self._script.write_text(
            RECORDING.format(moment=moment, reached=self.reached, out=self.out, windows=TWO_SHARDS, workers=workers)
        )
        marked = {**os.environ, "RECORDING": str(self._script)}  # inherited by the workers
        self._process = subprocess.Popen([sys.executable, str(self._script)], stderr=subprocess.DEVNULL, env=marked)

    def wait_for(self, file: Path) -> None:
        wait_until(file.exists, self._process)

    def end(self, sent: signal.Signals) -> None:
        os.kill(self._process.pid, sent)
        self._process.wait()
        wait_until(lambda: not self._is_running())

    def _is_running(self) -> bool:
        return any(str(self._script) in _environment(process) for process in Path("/proc").glob("[0-9]*"))


def _environment(process: Path) -> str:
    try:
        return (process / "environ").read_bytes().decode(errors="replace")
    except OSError:  # it has just ended
        return ""


def require_whole_files(folder: Path) -> None:
    for part in TABLES:
        for file in folder.glob(f"{part}/shard-*"):
            pd.read_parquet(file)
    for file in folder.glob(f"{FCD}/shard-*"):
        assert gzip.decompress(file.read_bytes()).endswith(b"</fcd-export>\n")


def require_resumed(killed: Path, uninterrupted: Path) -> None:
    record(killed, TWO_SHARDS, fcd=True, progress=False)
    assert contents(killed) == contents(uninterrupted)
    assert (killed / MANIFEST).read_bytes() == (uninterrupted / MANIFEST).read_bytes()
    assert not list(killed.rglob("*.partial"))


@pytest.mark.parametrize(
    ("workers", "moments"),
    [
        (1, ["run.json", "drivers/shard-00000.parquet", "fcd/shard-00000.xml.gz", "trajectories/shard-00001.parquet"]),
        (2, ["trajectories/shard-00000.parquet", "manifest.json"]),  # nobody knows how far the other worker comes
    ],
)
def test_killed_again_and_again_while_it_writes(
    workers: int, moments: list[str], tmp_path: Path, two_shards: Path
) -> None:
    for moment in moments:
        recording = Recording(tmp_path, workers, moment)
        recording.wait_for(recording.reached)
        recording.end(signal.SIGKILL)
        file = recording.out / moment
        assert not file.exists()
        assert list(file.parent.glob(f".{file.name}.*.partial"))
        require_whole_files(recording.out)
    require_resumed(recording.out, two_shards)


@pytest.mark.parametrize(("sent", "workers"), [(signal.SIGKILL, 1), (signal.SIGINT, 2)])
def test_killed_while_it_simulates(sent: signal.Signals, workers: int, tmp_path: Path, two_shards: Path) -> None:
    recording = Recording(tmp_path, workers)
    recording.wait_for(recording.out / TRAJECTORIES / "shard-00000.parquet")
    recording.end(sent)
    assert not (recording.out / MANIFEST).exists()
    require_whole_files(recording.out)
    require_resumed(recording.out, two_shards)
