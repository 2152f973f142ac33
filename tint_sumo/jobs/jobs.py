"""Jobs: their order, and how often those are repeated that fail."""

from collections import Counter
from collections.abc import Iterable, Iterator, Sequence
from contextlib import AbstractContextManager
from dataclasses import dataclass, field
from graphlib import CycleError, TopologicalSorter
from pathlib import Path
from typing import Literal, Protocol, TypeVar

from tint_sumo.core.errors import InputError, JobError
from tint_sumo.core.progress import Progress, Report
from tint_sumo.jobs.table import JobTable, job_table

T = TypeVar("T")
T_co = TypeVar("T_co", covariant=True)

THREADS_PER_JOB = 1  # threads of torch: the jobs share the cores among them
# Attempts that may end like this before work is given up; it is lost with the machine that did it.
MAX_ATTEMPTS = {"refused": 1, "diverged": 1, "failed": 3, "lost": 20}
REFRESH_S = 1.0


class Job(Protocol):
    """A piece of work that leaves files in a folder; a frozen dataclass, so that another machine can be handed it.

    It has a process to itself, and goes on where it was interrupted. It works in any folder ``out`` that holds its
    inputs, and writes nothing there but its outputs, each file whole.
    """

    @property
    def out(self) -> Path:
        """The folder; ``dataclasses.replace(job, out=...)`` is the same job in another."""

    @property
    def name(self) -> str:
        """The name that it is shown by and that its log has; its first word is the task, such as "train"."""

    @property
    def needs(self) -> tuple[str, ...]:
        """Names of the jobs, run together with it, that must be done before."""

    @property
    def inputs(self) -> tuple[str, ...]:
        """Files and folders in ``out`` that it reads, as paths relative to it."""

    @property
    def outputs(self) -> tuple[str, ...]:
        """Files and folders in ``out`` that it writes, and from which it goes on, likewise."""

    @property
    def uses_gpu(self) -> bool:
        """Whether a GPU makes it faster."""

    def is_done(self) -> bool: ...

    def run(self, report: Report) -> str:
        """Do the work and return its result in a few words; nothing if the last report has it."""


class Work(Protocol[T_co]):
    """Numbered pieces of work; a frozen dataclass, so that another machine can be handed it."""

    @property
    def out(self) -> Path:
        """The folder it works in, as in jobs."""

    def paths(self, number: int, /) -> tuple[str, ...]:
        """The files in ``out`` that a piece goes on from and writes, as paths relative to it."""

    def __call__(self, number: int, /) -> T_co:
        """Do one piece, as far as its files are not there, and return its result."""


class Executor(Protocol):
    """Processes or machines that do work."""

    @property
    def slots(self) -> int:
        """Number of jobs that are done at a time."""

    def run(self, jobs: Sequence[Job], progress: bool = True) -> None:
        """Run the jobs that are not done, in the given order as far as their needs allow.

        A job that fails three times, is refused or diverges once, is given up, and so are those that need it.

        Raises:
            InputError: needs are of no job, or go round in a circle; nothing is done.
            InputError, JobError: jobs were refused, or failed; all others are done.
        """

    def map(self, work: Work[T], numbers: Iterable[int]) -> AbstractContextManager[Iterator[T]]:
        """Give, in the block, the results of the pieces of work in order; few are done ahead of their use.

        Raises:
            InputError, RuntimeError: a piece was refused, or failed.
        """


@dataclass(frozen=True)
class Started:
    """A job runs from now on."""


How = Literal["done", "refused", "diverged", "failed", "lost"]  # lost: with its machine


@dataclass(frozen=True)
class Ended:
    """End of an attempt at a job, and the result or the reason."""

    how: How
    text: str = ""


Event = Started | Progress | Ended


class Host(Protocol):
    """Processes or a cluster that do jobs for ``run_jobs``."""

    @property
    def room(self) -> float:
        """Number of jobs that it takes at a time."""

    def start(self, job: Job) -> None: ...

    def listen(self, patience_s: float) -> Sequence[tuple[Job, Event]]:
        """Return the new events of the jobs that were started; wait for so long if there is none."""

    def interrupt(self) -> None:
        """Let the jobs that run save their work and end."""


def run_jobs(jobs: Sequence[Job], host: Host, progress: bool = True) -> None:
    """Run jobs on a host, as ``Executor.run``."""
    require_order(jobs)
    ledger = _Ledger([job for job in jobs if not job.is_done()])
    names = [job.name for job in ledger.waiting]
    with job_table(names, len(jobs) - len(names), progress=progress) as table:
        try:
            while ledger.waiting or ledger.started:
                for job in ledger.take(host.room):
                    host.start(job)
                for job, event in host.listen(REFRESH_S):
                    _note(table, ledger, job, event)
                table.refresh()
        finally:
            host.interrupt()
    ledger.require_all_done()


def require_order(jobs: Sequence[Job]) -> None:
    """Raise InputError unless every job has its own name and can wait for what it needs."""
    needs = {job.name: job.needs for job in jobs}
    twice = [name for name, count in Counter(job.name for job in jobs).items() if count > 1]
    if twice:
        raise InputError(f"two jobs are called {twice[0]!r}; give each another name")
    for job, needed in needs.items():
        if missing := [name for name in needed if name not in needs]:
            raise InputError(f"job {job!r} needs {missing[0]!r}, which is none of the jobs; run it with them")
    try:
        TopologicalSorter(needs).prepare()
    except CycleError as error:
        raise InputError(f"jobs need each other: {' -> '.join(reversed(error.args[1]))}") from None


def _note(table: JobTable, ledger: "_Ledger", job: Job, event: Event) -> None:
    if isinstance(event, Started):
        table.begin(job.name)
    elif isinstance(event, Progress):
        table.report(job.name, event)
    elif event.how == "done":
        ledger.close(job)
        table.end(job.name, event.text)
    else:
        count, allowed = ledger.note_failure(job, event)
        table.fail(job.name, f"{event.how}, {count} of {allowed} times: {last_line(event.text)}", again=count < allowed)
        for skipped in ledger.skip():
            table.fail(skipped.name, "skipped, because it needs a job that was given up", again=False)


@dataclass
class _Ledger:
    """The jobs that wait, that are started, and that were given up."""

    waiting: list[Job]
    started: list[Job] = field(default_factory=list)
    _failures: Counter[tuple[str, str]] = field(default_factory=Counter)  # by a job's name, and how an attempt ended
    _given_up: dict[str, Ended] = field(default_factory=dict)  # by a job's name
    _skipped: list[str] = field(default_factory=list)

    def take(self, room: float) -> list[Job]:
        """Return the jobs that can be started now, with so many at a time."""
        open_names = {job.name for job in (*self.waiting, *self.started)}
        ready = [job for job in self.waiting if not open_names.intersection(job.needs)]
        free = room - len(self.started)
        taken = [job for number, job in enumerate(ready) if number < free]
        for job in taken:
            self.waiting.remove(job)
        self.started += taken
        return taken

    def close(self, job: Job) -> None:
        self.started.remove(job)

    def note_failure(self, job: Job, ended: Ended) -> tuple[int, int]:
        """Return how often a job has ended like this, and after how many times it is given up."""
        self.started.remove(job)
        self._failures[job.name, ended.how] += 1
        count = self._failures[job.name, ended.how]
        allowed = MAX_ATTEMPTS[ended.how]
        if count < allowed:
            self.waiting.insert(0, job)
        else:
            self._given_up[job.name] = ended
        return count, allowed

    def skip(self) -> list[Job]:
        """Give up the jobs that need what was given up."""
        skipped = []
        for job in list(self.waiting):
            if any(need in self._given_up or need in self._skipped for need in job.needs):
                self.waiting.remove(job)
                self._skipped.append(job.name)
                skipped.append(job)
        return skipped

    def require_all_done(self) -> None:
        if not self._given_up:
            return
        reasons = "; ".join(f"{name}: {last_line(ended.text)}" for name, ended in self._given_up.items())
        skipped = f"; skipped, because they need these: {', '.join(self._skipped)}" if self._skipped else ""
        text = f"{reasons}{skipped}. All other jobs are done; the same command tries these again"
        if all(ended.how == "refused" for ended in self._given_up.values()):
            raise InputError(text)
        raise JobError(f"jobs failed: {text}")


def last_line(text: str) -> str:
    """Return the last line of a text: the error of a traceback."""
    return (text.strip().splitlines() or ["no reason is known"])[-1]
