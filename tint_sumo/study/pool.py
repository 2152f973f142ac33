"""Jobs in worker processes that end cleanly: with Ctrl-C, with an error, or with the main process."""

import signal
import time
from collections.abc import Sequence
from contextlib import suppress
from multiprocessing import connection
from multiprocessing.connection import Connection
from types import FrameType
from typing import NoReturn, Protocol

from tint_sumo.errors import InputError
from tint_sumo.job_table import job_table
from tint_sumo.processes import answer, start_worker, told
from tint_sumo.progress import Progress, Report
from tint_sumo.standings import Title

REFRESH_S = 1.0
REPORT_INTERVAL_S = 0.2  # at most so often a job tells where it stands
THREADS_PER_JOB = 1  # threads of torch: the jobs share the cores among them
INTERRUPT_S = 30.0  # more than enough to save a checkpoint


class Job(Protocol):
    """A piece of work; must survive pickling, and go on where it was interrupted. It has a process to itself."""

    @property
    def name(self) -> str: ...

    @property
    def title(self) -> Title:
        """How it is shown."""

    @property
    def needs(self) -> tuple[str, ...]:
        """Names of the jobs that must be done before."""

    def is_done(self) -> bool: ...

    def run(self, report: Report) -> str:
        """Do the work and say in a few words what came out; nothing if the last report says it."""


def run_jobs(jobs: Sequence[Job], workers: int, progress: bool = True) -> None:
    """Run the jobs that are not done, up to ``workers`` at a time, in the given order as far as their needs allow.

    Raises:
        InputError, RuntimeError: a job failed; the others were interrupted.
    """
    waiting = [job for job in jobs if not job.is_done()]
    running: list[_Worker] = []
    with job_table([job.title for job in waiting], len(jobs) - len(waiting), progress=progress) as table:
        try:
            while waiting or running:
                open_names = {job.name for job in waiting} | {worker.job.name for worker in running}
                ready = [job for job in waiting if not open_names.intersection(job.needs)]
                for job in ready[: workers - len(running)]:
                    waiting.remove(job)
                    running.append(_Worker(job))
                    table.begin(job.title)
                for worker in _heard_from(running):
                    news = worker.listen()
                    if isinstance(news, Progress):
                        table.report(worker.job.title, news)
                    else:
                        running.remove(worker)
                        table.end(worker.job.title, news)
                table.refresh()
        finally:
            for worker in running:
                worker.interrupt()
            for worker in running:
                worker.join()


def _heard_from(running: "Sequence[_Worker]") -> "list[_Worker]":
    """Workers with news; waits a moment for some."""
    heard = connection.wait([worker.pipe for worker in running], REFRESH_S)
    return [worker for worker in running if worker.pipe in heard]


class _Worker:
    """A process that does one job."""

    def __init__(self, job: Job) -> None:
        self.job = job
        self.pipe, self._process = start_worker(_work, job)

    def listen(self) -> Progress | str:
        """Take one message: where the job stands or, if it was the last, the job's closing line.

        Raises:
            InputError, RuntimeError: the job failed.
        """
        try:
            kind, content = self.pipe.recv()
        except EOFError:
            kind, content = "died", None
        if kind == "progress":
            assert isinstance(content, Progress)
            return content
        self._process.join()
        if kind == "died":
            raise RuntimeError(f"{self.job.name} ended with exit code {self._process.exitcode}")
        if kind == "refused":
            raise InputError(f"{self.job.name}: {content}")
        return str(answer((kind, content), self.job.name))

    def interrupt(self) -> None:
        """Tell the process to save its work and end."""
        self._process.terminate()

    def join(self) -> None:
        """Wait for the process to end."""
        self._process.join(INTERRUPT_S)
        self._process.kill()


def _work(pipe: Connection, job: Job) -> None:
    """The worker process."""
    signal.signal(signal.SIGTERM, _raise_interrupt)

    sent_s = -REPORT_INTERVAL_S

    def report(progress: Progress) -> None:
        nonlocal sent_s
        if progress.done == progress.total or time.monotonic() - sent_s >= REPORT_INTERVAL_S:
            sent_s = time.monotonic()
            pipe.send(("progress", progress))

    with suppress(KeyboardInterrupt):
        pipe.send(told(lambda: job.run(report)))


def _raise_interrupt(_signal: int, _frame: FrameType | None) -> NoReturn:
    raise KeyboardInterrupt
