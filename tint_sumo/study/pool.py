"""Jobs in worker processes that end cleanly: with Ctrl-C, with an error, or with the main process."""

import signal
import sys
from collections.abc import Sequence
from contextlib import suppress
from multiprocessing import connection
from multiprocessing.connection import Connection
from types import FrameType
from typing import Any, NoReturn, Protocol

from tqdm import tqdm

from tint_sumo.errors import InputError
from tint_sumo.processes import answer, start_worker, told
from tint_sumo.progress import Report, make_bar

REFRESH_S = 1.0
THREADS_PER_JOB = 1  # of torch: the jobs share the cores among them
INTERRUPT_S = 30.0  # more than enough to save a checkpoint


class Job(Protocol):
    """A piece of work; must survive pickling, and go on where it was interrupted. It has a process to itself."""

    @property
    def name(self) -> str: ...

    @property
    def needs(self) -> tuple[str, ...]:
        """Names of the jobs that must be done before."""

    def is_done(self) -> bool: ...

    def run(self, report: Report) -> str:
        """Do the work and say in a line what came out."""


def run_jobs(jobs: Sequence[Job], workers: int, progress: bool = True) -> None:
    """Run the jobs that are not done, up to ``workers`` at a time, in the given order as far as their needs allow.

    Raises:
        InputError, RuntimeError: a job failed; the others were interrupted.
    """
    waiting = [job for job in jobs if not job.is_done()]
    running: list[_Worker] = []
    free = list(range(1, workers + 1))  # lines of the terminal below the global bar
    with _global_bar(len(jobs), len(waiting), progress) as bar:
        try:
            while waiting or running:
                open_names = {job.name for job in waiting} | {worker.job.name for worker in running}
                ready = [job for job in waiting if not open_names.intersection(job.needs)]
                for job, line in zip(ready, tuple(free), strict=False):
                    waiting.remove(job)
                    free.remove(line)
                    running.append(_Worker(job, line, progress))
                for worker in _heard_from(running):
                    outcome = worker.listen()
                    if outcome is not None:
                        running.remove(worker)
                        free.append(worker.line)
                        free.sort()
                        if progress:
                            tqdm.write(f"{worker.job.name}: {outcome}", file=sys.stderr)
                        bar.update()
                if sys.stderr.isatty():
                    bar.refresh()
        finally:
            for worker in running:
                worker.interrupt()
            for worker in running:
                worker.join()


def _global_bar(jobs: int, waiting: int, progress: bool) -> "tqdm[NoReturn]":
    return make_bar(desc="study", total=jobs, initial=jobs - waiting, unit="job", disable=not progress)


def _heard_from(running: "Sequence[_Worker]") -> "list[_Worker]":
    """Workers with news; waits a moment for some, and keeps the bars' clocks going."""
    heard = connection.wait([worker.pipe for worker in running], REFRESH_S)
    for worker in running:
        worker.bar.refresh()
    return [worker for worker in running if worker.pipe in heard]


class _Worker:
    """A process that does one job, and its progress bar."""

    def __init__(self, job: Job, line: int, progress: bool) -> None:
        self.job = job
        self.line = line
        # Where bars cannot be redrawn in place, as in a log file, the global one is enough.
        hidden = not (progress and sys.stderr.isatty())
        self.bar: tqdm[NoReturn] = make_bar(desc=job.name, total=1, position=line, leave=False, disable=hidden)
        self.pipe, self._process = start_worker(_work, job)

    def listen(self) -> str | None:
        """Take one message; the job's closing line if it was the last.

        Raises:
            InputError, RuntimeError: the job failed.
        """
        try:
            kind, content = self.pipe.recv()
        except EOFError:
            kind, content = "died", None
        if kind == "progress":
            self.bar.n, self.bar.total, note = content
            self.bar.set_postfix_str(note, refresh=False)
            return None
        self.bar.close()
        self._process.join()
        if kind == "died":
            raise RuntimeError(f"{self.job.name} ended with exit code {self._process.exitcode}")
        if kind == "refused":
            raise InputError(f"{self.job.name}: {content}")
        return str(answer((kind, content), self.job.name))

    def interrupt(self) -> None:
        """Tell the process to save its work and end."""
        self.bar.close()
        self._process.terminate()

    def join(self) -> None:
        """Wait for the process to end."""
        self._process.join(INTERRUPT_S)
        self._process.kill()


def _work(pipe: Connection, job: Job) -> None:
    """The worker process."""
    signal.signal(signal.SIGTERM, _raise_interrupt)

    def report(*content: Any) -> None:
        pipe.send(("progress", content))

    with suppress(KeyboardInterrupt):
        pipe.send(told(lambda: job.run(report)))


def _raise_interrupt(_signal: int, _frame: FrameType | None) -> NoReturn:
    raise KeyboardInterrupt
