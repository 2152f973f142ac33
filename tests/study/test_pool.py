import os
import re
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from tests.study.jobs import FileJob
from tint_sumo.errors import InputError
from tint_sumo.study.pool import run_jobs

PATIENCE_S = 60.0
STATES = ("begins", "written")


def wait_until(condition: Callable[[], bool]) -> None:
    end = time.monotonic() + PATIENCE_S
    while not condition():
        assert time.monotonic() < end, "waited in vain"
        time.sleep(0.05)


def is_alive(pid: int) -> bool:
    try:
        os.kill(pid, 0)
    except ProcessLookupError:
        return False
    return Path(f"/proc/{pid}/stat").read_text().rsplit(")", 1)[1].split()[0] != "Z"


@pytest.fixture
def pool(tmp_path: Path) -> Iterator["subprocess.Popen[bytes]"]:
    """A program with two jobs in progress that take long."""
    process = subprocess.Popen([sys.executable, "-m", "tests.study.jobs", str(tmp_path)])
    pids = [tmp_path / f"{name}.pid" for name in ("first", "second")]
    wait_until(lambda: all(path.exists() for path in pids))
    yield process
    process.kill()
    process.wait()


def test_jobs_wait_for_what_they_need(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    jobs = [FileJob("last", tmp_path, needs=("base", "other")), FileJob("base", tmp_path), FileJob("other", tmp_path)]
    run_jobs(jobs, workers=2)
    assert [job.path("done").read_text() for job in jobs] == ["", "", ""]
    told = re.sub(r" \(\d+ s\)", "", capsys.readouterr().err).splitlines()
    assert sorted(told[:4]) == sorted([f"{name}: {state}" for name in ("base", "other") for state in STATES])
    assert told[4:] == [f"last: {state}" for state in STATES]


def test_done_jobs_are_left_alone(tmp_path: Path) -> None:
    jobs = [FileJob("base", tmp_path), FileJob("last", tmp_path, needs=("base",))]
    (tmp_path / "base.done").write_text("")
    run_jobs(jobs, workers=1, progress=False)
    assert not jobs[0].path("pid").exists()
    assert jobs[1].is_done()


@pytest.mark.parametrize(
    ("failure", "error", "message"),
    [("refused", InputError, "bad: this is not for me"), ("died", RuntimeError, "bad ended with exit code 7")],
)
def test_a_failure_ends_the_others(tmp_path: Path, failure: str, error: type[Exception], message: str) -> None:
    long = FileJob("long", tmp_path, patience_s=PATIENCE_S)
    with pytest.raises(error, match=message):
        run_jobs([long, FileJob("bad", tmp_path, failure=failure)], workers=2, progress=False)
    assert not long.is_done()
    assert not long.path("pid").exists() or not is_alive(int(long.path("pid").read_text()))


def test_an_interruption_reaches_the_jobs(pool: "subprocess.Popen[bytes]", tmp_path: Path) -> None:
    pool.send_signal(signal.SIGINT)
    assert pool.wait(PATIENCE_S) == 130
    names = {path.name for path in tmp_path.iterdir()}
    assert names == {f"{name}.{state}" for name in ("first", "second") for state in ("pid", "interrupted")}


def test_a_killed_pool_leaves_nobody_behind(pool: "subprocess.Popen[bytes]", tmp_path: Path) -> None:
    pids = [int(path.read_text()) for path in tmp_path.glob("*.pid")]
    assert all(map(is_alive, pids))
    pool.kill()
    pool.wait()
    wait_until(lambda: not any(map(is_alive, pids)))
