import os
import re
import signal
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from tests.jobs.jobs import FileJob
from tests.waiting import PATIENCE_S, is_alive, wait_until
from tint_sumo.core.errors import InputError, JobError
from tint_sumo.jobs import Local
from tint_sumo.jobs.process import read_log

STATES = ("begins", "written")


@pytest.fixture
def pool(tmp_path: Path) -> Iterator["subprocess.Popen[bytes]"]:
    """A program with two jobs in progress that take long."""
    command = [sys.executable, "-m", "tests.jobs.jobs", str(tmp_path)]
    process = subprocess.Popen(command, process_group=0)
    pids = [tmp_path / f"{name}.pid" for name in ("first", "second")]
    wait_until(lambda: all(path.exists() for path in pids))
    yield process
    process.kill()
    process.wait()


def test_jobs_wait_for_what_they_need(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    jobs = [FileJob("last", tmp_path, needs=("base", "other")), FileJob("base", tmp_path), FileJob("other", tmp_path)]
    Local(2).run(jobs)
    assert [job.path("done").read_text() for job in jobs] == ["", "", ""]
    told = re.sub(r" \(\d+ s\)", "", capsys.readouterr().err).splitlines()
    assert sorted(told[:4]) == sorted([f"{name}: {state}" for name in ("base", "other") for state in STATES])
    assert told[4:] == [f"last: {state}" for state in STATES]


def test_done_jobs_are_left_alone(tmp_path: Path) -> None:
    jobs = [FileJob("base", tmp_path), FileJob("last", tmp_path, needs=("base",))]
    (tmp_path / "base.done").write_text("")
    Local(1).run(jobs, progress=False)
    assert not jobs[0].path("pid").exists()
    assert jobs[1].is_done()


@pytest.mark.parametrize(
    ("needs", "line"),
    [
        ({"a": ("b",), "c": ()}, "job 'a' needs 'b', which is none of the jobs; run it with them"),
        ({"a": ("c",), "b": ("a",), "c": ("b",)}, "jobs need each other: a -> c -> b -> a"),
        ({"a": ("a",)}, "jobs need each other: a -> a"),
    ],
)
def test_jobs_that_would_wait_for_ever_are_refused(
    tmp_path: Path, needs: dict[str, tuple[str, ...]], line: str
) -> None:
    jobs = [FileJob(name, tmp_path, needed) for name, needed in needs.items()]
    with pytest.raises(InputError, match=f"^{re.escape(line)}$"):
        Local(1).run(jobs)
    assert not list(tmp_path.iterdir())


def test_jobs_with_the_same_name_are_refused(tmp_path: Path) -> None:
    jobs = [FileJob("same", tmp_path / "a"), FileJob("same", tmp_path / "b")]
    with pytest.raises(InputError, match=r"^two jobs are called 'same'; give each another name$"):
        Local(1).run(jobs)


@pytest.mark.parametrize(
    ("failure", "error", "tries"),
    [("refused", InputError, 1), ("diverged", JobError, 1), ("died", JobError, 3)],
)
def test_a_job_that_fails_is_named_and_the_others_finish(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], failure: str, error: type[Exception], tries: int
) -> None:
    bad, good = FileJob("bad", tmp_path, failure=failure), FileJob("good", tmp_path)
    needing = [FileJob("child", tmp_path, needs=("bad",)), FileJob("grandchild", tmp_path, needs=("child",))]
    with pytest.raises(error) as caught:
        Local(1).run([bad, good, *needing])
    reason = {"refused": "this is not for me", "diverged": "at step 7", "died": "ended with exit code 7"}[failure]
    told = "" if failure == "refused" else "jobs failed: "
    assert str(caught.value) == (
        f"{told}bad: {reason}; skipped, because they need these: child, grandchild. "
        "All other jobs are done; the same command tries these again"
    )
    assert (bad.tries, good.is_done(), needing[0].tries) == (tries, True, 0)
    lines = capsys.readouterr().err.splitlines()
    assert f"bad: {'failed' if failure == 'died' else failure}, {tries} of {tries} times: {reason}" in lines
    assert "grandchild: skipped, because it needs a job that was given up" in lines


def test_a_job_that_fails_once_is_tried_again(tmp_path: Path) -> None:
    job = FileJob("bad", tmp_path, failure="died once")
    Local(1).run([job, FileJob("child", tmp_path, needs=("bad",))], progress=False)
    assert (job.tries, job.is_done()) == (2, True)


def test_what_a_job_prints_is_in_its_log(tmp_path: Path) -> None:
    with pytest.raises(InputError):
        Local(1).run([FileJob("bad", tmp_path, failure="refused")], progress=False)
    assert read_log(tmp_path, "bad") == read_log(tmp_path.as_uri(), "bad") == "this is not for me\n"
    with pytest.raises(InputError, match=f"^no log of a job good in {tmp_path}; known are bad$"):
        read_log(tmp_path, "good")
    with pytest.raises(InputError, match="no job has run there"):
        read_log(tmp_path / "other", "good")


@pytest.mark.parametrize(
    ("send", "ending"),
    [(os.kill, signal.SIGINT), (os.killpg, signal.SIGINT), (os.killpg, signal.SIGTERM)],
    ids=["main process", "Ctrl-C", "timeout"],
)
def test_an_interruption_reaches_the_jobs(
    pool: "subprocess.Popen[bytes]", tmp_path: Path, send: Callable[[int, int], None], ending: signal.Signals
) -> None:
    send(pool.pid, ending)
    assert pool.wait(PATIENCE_S) == 130
    names = {path.name for path in tmp_path.iterdir()}
    states = ("pid", "tries", "interrupted")
    assert names == {"logs", *(f"{name}.{state}" for name in ("first", "second") for state in states)}


def test_a_killed_pool_leaves_nobody_behind(pool: "subprocess.Popen[bytes]", tmp_path: Path) -> None:
    pids = [int(path.read_text()) for path in tmp_path.glob("*.pid")]
    assert all(map(is_alive, pids))
    pool.kill()
    pool.wait()
    wait_until(lambda: not any(map(is_alive, pids)))
