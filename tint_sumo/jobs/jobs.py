"""Jobs, in which order they run, and what becomes of those that fail."""

from collections import Counter
from collections.abc import Iterable, Iterator, Sequence
from contextlib import AbstractContextManager
from dataclasses import dataclass, field
from graphlib import CycleError, TopologicalSorter
from pathlib import Path
from typing import Literal, Protocol, TypeVar

from tint_sumo.core.errors import InputError, JobError
from tint_sumo.core.progress import Progress, Report
from tint_sumo.jobs.status import Title
from tint_sumo.jobs.table import JobTable, job_table

T = TypeVar("T")
T_co = TypeVar("T_co", covariant=True)

THREADS_PER_JOB = 1  # threads of torch: the jobs share the cores among them
# After how many runs that have ended like this work is given up; it is lost with the machine that did it.
ALLOWED = {"refused": 1, "diverged": 1, "failed": 3, "lost": 20}
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
    def name(self) -> str: ...

    @property
    def title(self) -> Title:
        """How it is shown."""

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
        """Do the work and say in a few words what came out; nothing if the last report says it."""


class Work(Protocol[T_co]):
    """Numbered pieces of work; a frozen dataclass, so that another machine can be handed it."""

    @property
    def out(self) -> Path:
        """The folder it works in, as in jobs."""

    def paths(self, number: int, /) -> tuple[str, ...]:
        """The files in ``out`` that a piece goes on from and writes, as paths relative to it."""

    def __call__(self, number: int, /) -> T_co:
        """Do one piece, as far as its files are not there, and say what came out."""


class Executor(Protocol):
    """Where work is done."""

    @property
    def slots(self) -> int:
        """How many jobs are done at a time."""

    def run(self, jobs: Sequence[Job], progress: bool = True) -> None:
        """Run the jobs that are not done, in the given order as far as their needs allow.

        A job that fails three times, is refused or diverges once, is given up, and so are those that need it.

        Raises:
            InputError: needs are of no job, or go round in a circle; nothing is done.
        InputError, JobError: jobs were refused, or failed; all others are done.
        """

    def map(self, work: Work[T], numbers: Iterable[int]) -> AbstractContextManager[Iterator[T]]:
        """In the block, what the pieces of work give, in order; few are done ahead of their use.

        Raises:
            InputError, RuntimeError: a piece was refused, or failed.
        """


@dataclass(frozen=True)
class Begun:
    """A job is being done from now on."""


How = Literal["done", "refused", "diverged", "failed", "lost"]  # lost: with its machine


@dataclass(frozen=True)
class Ended:
    """How a run of a job ended, and what is to be said of it."""

    how: How
    text: str = ""


News = Begun | Progress | Ended


class Host(Protocol):
    """What does jobs for ``run_jobs``."""

    @property
    def room(self) -> float:
        """How many jobs it takes at a time."""

    def start(self, job: Job) -> None: ...

    def listen(self, patience_s: float) -> Sequence[tuple[Job, News]]:
        """What is new of the jobs that were started; waits for so long if there is nothing."""

    def interrupt(self) -> None:
        """Let the jobs that are being done save their work and end."""


def run_jobs(jobs: Sequence[Job], host: Host, progress: bool = True) -> None:
    """``Executor.run`` on a host."""
    require_order(jobs)
    ledger = _Ledger([job for job in jobs if not job.is_done()])
    titles = [job.title for job in ledger.waiting]
    with job_table(titles, len(jobs) - len(titles), progress=progress) as table:
        try:
            while ledger.waiting or ledger.started:
                for job in ledger.take(host.room):
                    host.start(job)
                for job, news in host.listen(REFRESH_S):
                    _tell(table, ledger, job, news)
                table.refresh()
        finally:
            host.interrupt()
    ledger.require_all_done()


def require_order(jobs: Sequence[Job]) -> None:
    """Raise InputError unless every job has its own name and can wait for what it needs."""
    needs = {job.name: job.needs for job in jobs}
    twice = [name for name, count in Counter(job.name for job in jobs).items() if count > 1]
    if twice:
        raise InputError(f"two jobs are called {twice[0]!r}; give each its own name")
    for name, needed in needs.items():
        if missing := [one for one in needed if one not in needs]:
            raise InputError(f"job {name!r} needs {missing[0]!r}, which is none of the jobs; run it with them")
    try:
        TopologicalSorter(needs).prepare()
    except CycleError as error:
        raise InputError(f"jobs need each other: {' -> '.join(reversed(error.args[1]))}") from None


def _tell(table: JobTable, ledger: "_Ledger", job: Job, news: News) -> None:
    if isinstance(news, Begun):
        table.begin(job.title)
    elif isinstance(news, Progress):
        table.report(job.title, news)
    elif news.how == "done":
        ledger.close(job)
        table.end(job.title, news.text)
    else:
        count, allowed = ledger.note_failure(job, news)
        table.fail(job.title, f"{news.how}, {count} of {allowed} times: {last_line(news.text)}", again=count < allowed)
        for skipped in ledger.skip():
            table.fail(skipped.title, "skipped, because it needs a job that was given up", again=False)


@dataclass
class _Ledger:
    """Which jobs wait, are started, and were given up."""

    waiting: list[Job]
    started: list[Job] = field(default_factory=list)
    _failures: Counter[tuple[str, str]] = field(default_factory=Counter)  # by a job's name, and how its run ended
    _given_up: dict[str, Ended] = field(default_factory=dict)  # by a job's name
    _skipped: list[str] = field(default_factory=list)

    def take(self, room: float) -> list[Job]:
        """The jobs that can be started now, with so many at a time."""
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
        """How often a job's runs have ended like this, and after how many times it is given up."""
        self.started.remove(job)
        self._failures[job.name, ended.how] += 1
        count = self._failures[job.name, ended.how]
        allowed = ALLOWED[ended.how]
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
    """Of a traceback, the error."""
    return (text.strip().splitlines() or ["no reason is known"])[-1]
