"""Work in processes of this machine."""

import os
from collections.abc import Iterable, Iterator, Sequence
from concurrent.futures import Future, ProcessPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass, field
from multiprocessing import connection
from typing import TypeVar

from tint_sumo.core.processes import begin_work, worker_context
from tint_sumo.core.ranges import Processes, require_ranges
from tint_sumo.jobs.jobs import Ended, Event, Job, Started, Work, run_jobs
from tint_sumo.jobs.process import JobProcess

T = TypeVar("T")


@dataclass(frozen=True)
class Local:
    """An executor of so many processes; with one worker, this process does pieces of work itself."""

    workers: Processes = 1

    def __post_init__(self) -> None:
        require_ranges(self)

    @property
    def slots(self) -> int:
        return self.workers

    def run(self, jobs: Sequence[Job], progress: bool = True) -> None:
        run_jobs(jobs, _Processes(self.workers), progress)

    @contextmanager
    def map(self, work: Work[T], numbers: Iterable[int]) -> Iterator[Iterator[T]]:
        if self.workers == 1:
            yield map(work, numbers)
            return
        context, environment = worker_context(), (dict(os.environ),)
        with ProcessPoolExecutor(self.workers, context, initializer=begin_work, initargs=environment) as pool:
            try:
                yield _ahead(pool, work, numbers, self.workers)
            finally:
                pool.shutdown(cancel_futures=True)


@dataclass
class _Processes:
    """A host of so many jobs at a time."""

    room: int
    _new: list[Job] = field(default_factory=list)  # jobs whose start was not reported yet
    _running: list[JobProcess] = field(default_factory=list)

    def start(self, job: Job) -> None:
        self._running.append(JobProcess(job))
        self._new.append(job)

    def listen(self, patience_s: float) -> list[tuple[Job, Event]]:
        if self._new:
            started, self._new = self._new, []
            return [(job, Started()) for job in started]
        heard = connection.wait([process.pipe for process in self._running], patience_s)
        events: list[tuple[Job, Event]] = [
            (process.job, process.receive()) for process in self._running if process.pipe in heard
        ]
        ended = [job for job, event in events if isinstance(event, Ended)]
        self._running = [process for process in self._running if process.job not in ended]
        return events

    def interrupt(self) -> None:
        for process in self._running:
            process.interrupt()
        for process in self._running:
            process.join()


def _ahead(pool: ProcessPoolExecutor, work: Work[T], numbers: Iterable[int], workers: int) -> Iterator[T]:
    pending: list[Future[T]] = []
    for number in numbers:
        pending.append(pool.submit(work, number))
        if len(pending) > workers:
            yield pending.pop(0).result()
    for future in pending:
        yield future.result()
