"""Work on a Ray cluster (https://docs.ray.io); the only module that imports Ray.

No disk is shared. A job's inputs, and what it has left so far, travel through Ray's object store to a scratch folder of
the node that does it, and what changes among its outputs travels back every few seconds, so that a job whose node dies
begins again with its last checkpoint. Pieces of work travel likewise, as a whole.
"""

import logging
import os
import socket
import tempfile
import time
from collections import Counter, deque
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from functools import cache
from importlib import import_module
from importlib.metadata import version
from itertools import count, islice
from pathlib import Path
from typing import Any, Generic, TypeVar

import ray
from ray.exceptions import RayError, RayTaskError

from tint_sumo.core.errors import InputError, JobError
from tint_sumo.core.file_changes import Changes, FileState, file_states, read_files, write_files
from tint_sumo.core.processes import WorkResult, interrupt_on_sigterm, result_of
from tint_sumo.core.progress import Progress
from tint_sumo.core.provenance import PACKAGES
from tint_sumo.jobs.jobs import MAX_ATTEMPTS, Ended, Event, How, Job, Started, Work, last_line, run_jobs
from tint_sumo.jobs.process import INTERRUPT_S, JobProcess, log_path

T = TypeVar("T")

LOOK_INTERVAL_S = 2.0  # between two looks at a job's outputs, with which its events are sent
ANSWER_S = 5.0  # the longest time that a cluster may take to answer
PIECES_PER_CPU = 2  # pieces that are done or wait on a CPU: nobody is idle while results travel
_OPTIONS: dict[str, Any] = {"log_to_driver": False, "logging_level": logging.CRITICAL}
_HEAD = {"node:__internal_head__": 0.001}  # Ray's resource that only the head node has

Files = Mapping[str, bytes | None]  # contents by path relative to a folder


@contextmanager
def ray_cluster(address: str = "auto", gpus_per_job: float = 0.0) -> Iterator["RayCluster"]:
    """Give, in the block, an executor on the Ray cluster at an address.

    Args:
        address: ``ray://host:port`` of a cluster, ``host:port`` of one that this machine is a node of, ``"local"`` for
            Ray on this machine alone, where no other machine reaches it, or ``"auto"``: the cluster that this machine
            is a node of or, if there is none, ``"local"``.
        gpus_per_job: share of a GPU that each job has that a GPU makes faster, if the cluster has GPUs.

    Raises:
        InputError: there is no cluster at the address, no such share of a GPU, or Ray is of another version.
    """
    if not 0.0 <= gpus_per_job < float("inf"):
        raise InputError(f"gpus_per_job must be 0 or more, not {gpus_per_job:g}")
    dashboard_url = _connect(address)
    interrupt_on_sigterm()  # Ray has set another handler
    try:
        yield RayCluster(gpus_per_job, dashboard_url)
    except RayError as error:
        raise JobError(f"the Ray cluster failed ({_first_line(error)}); the same command goes on") from None
    finally:
        ray.shutdown()


def _connect(address: str) -> str:
    """Connect this process; return the address of the cluster's dashboard."""
    os.environ.setdefault("RAY_USAGE_STATS_ENABLED", "0")  # nothing about what runs here is sent to Ray's makers
    if address == "local":
        return _start()
    if address != "auto":
        _require_answer(address)
    try:
        return ray.init(address, **_OPTIONS).dashboard_url or ""
    except ConnectionError:
        if address != "auto":
            raise
        return _start()


def _start() -> str:
    """Start Ray on the loopback interface of this machine, as by default on macOS; return its dashboard's address."""
    with _on_loopback_alone():
        return ray.init("local", **_OPTIONS).dashboard_url or ""


@contextmanager
def _on_loopback_alone() -> Iterator[None]:
    """Keep a Ray that starts in the block on the loopback interface, for which it has a private switch alone.

    Raises:
        InputError: this version of Ray has no such switch.
    """
    try:
        constants: Any = import_module("ray._private.ray_constants")
        variable = constants.ENABLE_RAY_CLUSTERS_ENV_VAR  # for the processes that Ray starts
        before = os.environ.get(variable), constants.ENABLE_RAY_CLUSTER
    except (ImportError, AttributeError):
        raise InputError(
            f"Ray {ray.__version__} cannot be kept from other machines by this version of tint_sumo; install ray 2.60, "
            "or start a cluster and give its `address`"
        ) from None
    os.environ[variable], constants.ENABLE_RAY_CLUSTER = "0", False
    try:
        yield
    finally:
        _, constants.ENABLE_RAY_CLUSTER = before
        if before[0] is None:
            del os.environ[variable]
        else:
            os.environ[variable] = before[0]


def _require_answer(address: str) -> None:
    """Raise InputError unless somebody listens at an address; Ray itself tries for minutes."""
    host, _, port = address.removeprefix("ray://").partition(":")
    try:
        socket.create_connection((host, int(port)), ANSWER_S).close()
    except (OSError, ValueError) as error:
        raise InputError(f"no Ray cluster answers at {address} ({error}); check `address`") from None


def _resources() -> dict[str, float]:
    """Return the resources of all nodes of the cluster."""
    found: dict[str, float] = ray.cluster_resources()  # type: ignore[no-untyped-call]
    return found


def _first_line(error: Exception) -> str:
    return (str(error).strip().splitlines() or [type(error).__name__])[0].strip()


@dataclass(frozen=True)
class RayCluster:
    """An executor; ``ray_cluster`` makes one."""

    gpus_per_job: float = 0.0
    dashboard_url: str = ""  # of Ray's page about the cluster; empty if there is none

    @property
    def slots(self) -> int:
        return max(1, int(_resources().get("CPU", 1)))

    def run(self, jobs: Sequence[Job], progress: bool = True) -> None:
        run_jobs(jobs, _Tasks(self.gpus_per_job), progress)

    @contextmanager
    def map(self, work: Work[T], numbers: Iterable[int]) -> Iterator[Iterator[T]]:
        # Pieces that nobody takes run to their end. Ray 2.60 has ended the whole program, now and then, where one was
        # cancelled at the moment at which it ended.
        yield self._ahead(work, iter(numbers))

    def _ahead(self, work: Work[T], numbers: Iterator[int]) -> Iterator[T]:
        pending: deque[_Piece[T]] = deque()
        while True:
            free = PIECES_PER_CPU * self.slots - len(pending)  # nodes come and go
            pending.extend(_Piece(work, number) for number in islice(numbers, max(free, 0)))
            if not pending:
                return
            yield pending[0].result()
            pending.popleft()


class _Piece(Generic[T]):
    """A piece of work on its way."""

    def __init__(self, work: Work[T], number: int) -> None:
        self._work = work
        self._number = number
        self._ends: Counter[str] = Counter()  # how often it was lost, and failed
        paths = work.paths(number)
        is_here = bool(paths) and all((work.out / path).exists() for path in paths)
        self.task: Any = None if is_here else self._submit()  # what is there already need not travel

    def _submit(self) -> Any:
        files = read_files(self._work.out, self._work.paths(self._number))
        return _do_piece.remote(self._work, self._number, files, _versions())

    def result(self) -> T:
        """Wait for its result and return it.

        Raises:
            InputError, JobError: it was refused, or it failed or was lost again and again.
        """
        if self.task is None:
            return self._work(self._number)
        while True:
            how, content = _end_of(self.task, self._work.out)
            if how == "done":
                return content  # type: ignore[no-any-return]
            if how == "refused":
                raise InputError(str(content))
            self._ends[how] += 1
            if self._ends[how] >= MAX_ATTEMPTS[how]:
                raise JobError(f"piece {self._number} {how} {self._ends[how]} times: {last_line(str(content))}")
            self.task = self._submit()


def _end_of(task: Any, out: Path) -> tuple[How, Any]:
    """Write the files that a task has left; return how it ended, with its result or the reason."""
    try:
        (how, content), files = ray.get(task)
    except RayTaskError as error:
        return "failed", str(error.cause)
    except RayError as error:
        return "lost", _first_line(error)
    write_files(out, files)
    return how, content


@ray.remote(num_cpus=1, max_retries=0)  # pieces that are lost are counted, and submitted with what is there by then
def _do_piece(work: Work[Any], number: int, files: Files, versions: Mapping[str, str]) -> tuple[WorkResult, Files]:
    """Do a piece in a scratch folder that holds some files; return its result, and the files that it has left."""
    with tempfile.TemporaryDirectory(prefix="tint_sumo-") as scratch:
        folder = Path(scratch)
        write_files(folder, files)
        changes = Changes(folder, work.paths(number))
        return result_of(lambda: _moved(work, folder, versions)(number)), changes.take()


@cache
def _versions() -> dict[str, str]:
    """Return the versions that may change a result; builds of one version, such as ``2.13.0+cpu``, are the same."""
    return {name: version(name).partition("+")[0] for name in PACKAGES}


def _moved(work: Any, folder: Path, versions: Mapping[str, str]) -> Any:
    """Return a job, or pieces of work, with another folder.

    Raises:
        InputError: this node has other versions than the driver, and its results might differ.
    """
    here = _versions()
    differing = [name for name in here if versions[name] != here[name]]
    if differing:
        node, driver = (", ".join(f"{name} {found[name]}" for name in differing) for found in (here, versions))
        raise InputError(
            f"a node of the cluster has {node}, and this machine has {driver}; install the same everywhere"
        )
    return replace(work, out=folder)


@dataclass(frozen=True)
class _Task:
    """A job that was submitted."""

    job: Job
    ref: Any  # Ray's reference to its result


class _FileStore:
    """Files in Ray's object store, where many jobs can read them; of each file its last state alone is kept."""

    def __init__(self) -> None:
        self._held: dict[Path, tuple[FileState, Any]] = {}

    def put(self, file: Path, state: FileState) -> Any:
        """Put a file there unless it is there in this state; return Ray's reference to its content."""
        if file not in self._held or self._held[file][0] != state:
            self._held[file] = state, ray.put(file.read_bytes())
        return self._held[file][1]


class _Tasks:
    """A host whose jobs are tasks of Ray, which queues those that there is no room for yet."""

    room = float("inf")

    def __init__(self, gpus_per_job: float) -> None:
        self._gpus_per_job = gpus_per_job if _resources().get("GPU", 0) > 0 else 0.0
        self._mailbox = _Mailbox.remote()  # type: ignore[attr-defined]
        self._numbers = count()
        self._tasks: dict[int, _Task] = {}  # by number: late messages of an earlier attempt do not count
        self._running: set[int] = set()
        self._store = _FileStore()

    def start(self, job: Job) -> None:
        number = next(self._numbers)
        files = {path: self._store.put(job.out / path, state) for path, state in file_states(job.out, _paths(job))}
        task = _do_job.options(name=job.name, num_gpus=self._gpus_per_job if job.uses_gpu else 0.0)
        ref = task.remote(job, number, self._mailbox, _versions(), list(files), list(files.values()))
        self._tasks[number] = _Task(job, ref)

    def listen(self, patience_s: float) -> list[tuple[Job, Event]]:
        refs = {task.ref: number for number, task in self._tasks.items()}
        if not refs:
            return []
        ended, _ = ray.wait(list(refs), num_returns=1, timeout=patience_s)
        if ended:
            ended, _ = ray.wait(list(refs), num_returns=len(refs), timeout=0)
        messages = ray.get(self._mailbox.take.remote())  # all of those that have ended: a job posts before it ends
        events = [event for message in messages for event in self._read(*message)]
        for ref in ended:
            number = refs[ref]
            task = self._tasks.pop(number)
            self._running.discard(number)
            events.append((task.job, Ended(*_end_of(task.ref, task.job.out))))
        return events

    def _read(self, number: int, event: Event | None, files: Files) -> list[tuple[Job, Event]]:
        if number not in self._tasks:
            return []
        if isinstance(event, Started):
            self._running.add(number)
        job = self._tasks[number].job
        write_files(job.out, files)
        return [] if event is None else [(job, event)]

    def interrupt(self) -> None:
        if not self._tasks:
            return
        ray.get(self._mailbox.stop.remote())
        for number in self._tasks.keys() - self._running:
            ray.cancel(self._tasks[number].ref)
        end_s = time.monotonic() + INTERRUPT_S
        while self._tasks and time.monotonic() < end_s:
            self.listen(1.0)
        for task in self._tasks.values():
            ray.cancel(task.ref, force=True)


def _paths(job: Job) -> tuple[str, ...]:
    """Return the paths of what a job reads and goes on from."""
    return (*job.inputs, *job.outputs, log_path(job.name))


@ray.remote(num_cpus=0, resources=_HEAD)
class _Mailbox:
    """Messages of jobs until the driver takes them. It is on the head node, without which there is no cluster."""

    def __init__(self) -> None:
        self._messages: list[tuple[int, Event | None, Files]] = []
        self._is_over = False

    def post(self, number: int, event: Event | None, files: Files) -> bool:
        """Leave a message; return whether the job shall save its work and end."""
        self._messages.append((number, event, files))
        return self._is_over

    def take(self) -> list[tuple[int, Event | None, Files]]:
        taken, self._messages = self._messages, []
        return taken

    def stop(self) -> None:
        self._is_over = True


@ray.remote(num_cpus=1, max_retries=0)  # jobs that are lost are counted, and submitted with their last checkpoint
def _do_job(
    job: Job, number: int, mailbox: Any, versions: Mapping[str, str], paths: Sequence[str], contents: Sequence[Any]
) -> tuple[tuple[How, str], Files]:
    """Do a job in a scratch folder that holds some files; return how it ended, and its files since its last message."""
    with tempfile.TemporaryDirectory(prefix="tint_sumo-") as scratch:
        folder = Path(scratch)
        for path, content in zip(paths, contents, strict=True):  # in memory one after the other
            write_files(folder, {path: _wait_for(content)})
        try:
            moved = _moved(job, folder, versions)
        except InputError as error:
            return ("refused", str(error)), {}
        changes = Changes(folder, (*job.outputs, log_path(job.name)))

        def post(event: Event | None) -> bool:
            return bool(_wait_for(mailbox.post.remote(number, event, changes.take(time.time()))))

        process = JobProcess(moved)
        try:
            ended = _attend(process, post)
        finally:
            process.interrupt()
            process.join()
        return (ended.how, ended.text), changes.take()


def _wait_for(reference: Any) -> Any:
    """Return what a reference of Ray stands for. In ``ray.get`` a job lends its CPU, which another one keeps."""
    return reference.future().result()


def _attend(process: JobProcess, post: Callable[[Event | None], bool]) -> Ended:
    """Pass on the events of a job until it ends."""
    latest: Progress | None = None
    looked_s = time.monotonic()
    post(Started())
    while True:
        if process.pipe.poll(max(0.0, looked_s + LOOK_INTERVAL_S - time.monotonic())):
            event = process.receive()
            if isinstance(event, Ended):
                return event
            latest = event
        else:
            looked_s = time.monotonic()
            if post(latest):
                return Ended("lost", "interrupted")
