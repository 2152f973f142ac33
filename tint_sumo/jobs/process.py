"""A process that does one job and ends cleanly: when it is interrupted, with an error, or with its parent."""

import os
import sys
import time
from contextlib import suppress
from multiprocessing.connection import Connection
from pathlib import Path
from typing import TextIO

from tint_sumo.core.errors import InputError
from tint_sumo.core.processes import interrupt_on_sigterm, result_of, start_worker
from tint_sumo.core.progress import Progress
from tint_sumo.core.redaction import redact
from tint_sumo.core.stores import Store
from tint_sumo.jobs.jobs import Ended, Job

REPORT_INTERVAL_S = 0.2  # the least time between two reports
INTERRUPT_S = 30.0  # more than enough to save a checkpoint
LOGS = "logs"  # folder of the jobs' logs in the folder they work in


def log_path(name: str) -> str:
    """Return the path of a job's log, relative to the folder it works in."""
    return f"{LOGS}/{name.replace(' ', '-').replace('/', '-')}.log"


def read_log(out: str | Path, name: str) -> str:
    """Return what a job that worked in ``out``, a folder or a URL, has printed, its error included if it failed.

    Raises:
        InputError: it has no log there.
    """
    store, path = Store.at(out), log_path(name)
    logs = store.files(LOGS)
    if path not in logs:
        known = f"known are {', '.join(Path(log).stem for log in logs)}" if logs else "no job has run there"
        raise InputError(f"no log of a job {name} in {redact(str(out))}; {known}")
    return store.read(path).decode("utf-8", errors="replace")


class JobProcess:
    """A process that does one job; what the job prints goes to its log."""

    def __init__(self, job: Job) -> None:
        self.job = job
        self.pipe, self._process = start_worker(_work, job)

    def receive(self) -> Progress | Ended:
        """Wait for one message."""
        try:
            event: Progress | Ended = self.pipe.recv()
        except EOFError:
            self._process.join()
            return Ended("failed", f"ended with exit code {self._process.exitcode}")
        if isinstance(event, Ended):
            self._process.join()
        return event

    def interrupt(self) -> None:
        """Ask the process to save its work and end."""
        self._process.terminate()

    def join(self) -> None:
        """Wait for the process to end."""
        self._process.join(INTERRUPT_S)
        self._process.kill()


def _work(pipe: Connection, job: Job) -> None:
    """Do the job in the worker process."""
    interrupt_on_sigterm()
    log = job.out / log_path(job.name)
    log.parent.mkdir(parents=True, exist_ok=True)
    with log.open("a", encoding="utf-8") as file:
        _print_into(file)
        sent_s = -REPORT_INTERVAL_S

        def report(progress: Progress) -> None:
            nonlocal sent_s
            if progress.done == progress.total or time.monotonic() - sent_s >= REPORT_INTERVAL_S:
                sent_s = time.monotonic()
                pipe.send(progress)

        with suppress(KeyboardInterrupt):
            how, text = result_of(lambda: job.run(report))
            if how != "done":
                print(text)
            pipe.send(Ended(how, text))


def _print_into(file: TextIO) -> None:
    """Send what this process and its libraries print into a file, line by line."""
    for stream in (sys.stdout, sys.stderr):
        stream.flush()
        os.dup2(file.fileno(), stream.fileno())
        stream.reconfigure(line_buffering=True)  # type: ignore[union-attr]
