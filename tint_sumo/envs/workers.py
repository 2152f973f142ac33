"""A batch of environments shared out among processes, each with a simulation of its own.

The rows of the environments lie in shared memory; the pipes carry the actions, and the ends of episodes.
"""

import os
import pickle
import time
import weakref
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import partial
from multiprocessing.connection import Connection
from multiprocessing.sharedctypes import RawArray
from typing import Any

import numpy as np
from gymnasium.vector import AutoresetMode
from numpy.typing import NDArray

from tint_sumo.core.processes import result_of, start_worker, value_of
from tint_sumo.envs.batch import Ended, LocalBatch, Snapshot
from tint_sumo.envs.episodes import TaskSettings, shares_of
from tint_sumo.envs.rows import Rows
from tint_sumo.simulation.connection import libsumo_is_free

_ENDING_S = 10.0  # more than enough for a step, and to close a simulation
_POLL_S = 1e-3  # about the time of a step; sleeping and waking up would cost a large part of it
_INTEGER = np.dtype(np.int64)


class WorkerBatch:
    """A batch of ``num_envs`` environments in several processes, each of which has its settings.

    The first of them is this process, which would have nothing else to do while the others step; unless it already runs
    a simulation of its own, since libsumo holds one per process. An error in one of them, its death, or an interruption
    ends all the others.
    """

    def __init__(self, num_envs: int, settings: Sequence[TaskSettings], autoreset_mode: AutoresetMode) -> None:
        workers = len(settings)
        shared = _Shared(num_envs, workers, settings[0].row_type)
        self._shares = shares_of(num_envs, workers)
        self.rows = shared.rows
        self._local: LocalBatch | None = None
        self._helpers: list[_Helper] = []
        weakref.finalize(self, _end, self._helpers)
        takes_part = settings[0].backend == "traci" or libsumo_is_free()
        try:
            for worker in range(int(takes_part), workers):
                self._helpers.append(_start(worker, shared, self._shares[worker], settings[worker], autoreset_mode))
            if takes_part:
                rows = self.rows[self._shares[0]]
                self._local = LocalBatch(self._shares[0].stop, settings[:1], autoreset_mode, rows)
            self._listen()
        except BaseException:
            self.close()
            raise

    def reset(self, seeds: Sequence[int | None], mask: NDArray[np.bool_]) -> None:
        self._ask("reset", lambda share: (seeds[share], mask[share]))

    def step(self, actions: NDArray[np.integer]) -> list[Ended]:
        answers = self._ask("step", lambda share: (actions[share],))
        return [
            replace(end, index=end.index + share.start)
            for share, answer in zip(self._shares, answers, strict=True)
            for end in answer
        ]

    def park(self, mask: NDArray[np.bool_]) -> None:
        self._ask("park", lambda share: (mask[share],))

    def snapshot(self) -> list[Snapshot]:
        return [snapshot for share in self._ask("snapshot", lambda _: ()) for snapshot in share]

    def restore(self, snapshots: Sequence[Snapshot]) -> None:
        self._ask("restore", lambda share: (snapshots[share],))

    def render(self) -> list[NDArray[np.uint8]]:
        return [image for images in self._ask("render", lambda _: ()) for image in images]

    def close(self) -> None:
        if self._local is not None:
            self._local.close()
        _end(self._helpers)

    def _ask(self, request: str, arguments: Callable[[slice], tuple[Any, ...]]) -> list[Any]:
        """Call a method of every process's batch, with arguments for its share; return their answers."""
        try:
            for helper in self._helpers:
                with suppress(ConnectionError):  # a worker that has died is noticed at the next answer
                    helper.line.send((request, *arguments(helper.share)))
            local = [] if self._local is None else [getattr(self._local, request)(*arguments(self._shares[0]))]
            return local + self._listen()
        except BaseException:
            self.close()
            raise

    def _listen(self) -> list[Any]:
        return [helper.answer() for helper in self._helpers]


@dataclass(frozen=True)
class _Helper:
    """Another process and its share of the environments."""

    worker: int
    share: slice
    line: "_Line"
    process: Any

    def answer(self) -> Any:
        try:
            message = self.line.receive()
        except (EOFError, ConnectionError):
            self.process.join(_ENDING_S)
            raise RuntimeError(
                f"environment worker {self.worker} died with exit code {self.process.exitcode}; "
                "reset all environments to start it anew"
            ) from None
        return value_of(message, f"environment worker {self.worker}")


def _start(
    worker: int, shared: "_Shared", share: slice, settings: TaskSettings, autoreset_mode: AutoresetMode
) -> _Helper:
    pipe, process = start_worker(_serve, shared, worker, share, settings, autoreset_mode)
    return _Helper(worker, share, _Line(pipe, shared.sent[worker]), process)


def _end(helpers: list[_Helper]) -> None:
    """End processes; safe to call twice, also if the first call was interrupted."""
    for helper in helpers:
        helper.line.close()  # it ends when the other end is closed
    for helper in helpers:
        helper.process.join(_ENDING_S)
        helper.process.kill()
        helper.process.join()


class _Shared:
    """Memory that all processes share.

    It has no name in the file system: nothing is left of it when the last process ends, however it ends.
    """

    def __init__(self, num_envs: int, workers: int, row: np.dtype[np.void]) -> None:
        self._num_envs = num_envs
        self._workers = workers
        self._row = row
        self._rows_at = 2 * workers * _INTEGER.itemsize
        self._memory = RawArray("B", self._rows_at + num_envs * self._row.itemsize)

    @property
    def sent(self) -> NDArray[np.int64]:
        """Numbers of messages to each worker, and from it; (W, 2)."""
        return np.frombuffer(self._memory, _INTEGER, 2 * self._workers).reshape(-1, 2)

    @property
    def rows(self) -> Rows:
        return np.frombuffer(self._memory, self._row, self._num_envs, self._rows_at)


class _Line:
    """One end of a pipe, whose receiver polls for a message for a while before it sleeps.

    Args:
        sent: (2,) in shared memory: how many messages this end has sent, and the other.
    """

    def __init__(self, pipe: Connection, sent: NDArray[np.int64]) -> None:
        self._pipe = pipe
        self._sent = sent.data
        self._received = 0

    def send(self, message: Any) -> None:
        self._pipe.send_bytes(pickle.dumps(message))  # Connection.send takes several times as long
        self._sent[0] += 1

    def receive(self) -> Any:
        end_s = time.perf_counter() + _POLL_S
        while self._sent[1] <= self._received and time.perf_counter() < end_s:
            os.sched_yield()
        self._received += 1
        return pickle.loads(self._pipe.recv_bytes())

    def close(self) -> None:
        self._pipe.close()


def _serve(
    pipe: Connection,
    shared: _Shared,
    worker: int,
    share: slice,
    settings: TaskSettings,
    autoreset_mode: AutoresetMode,
) -> None:
    """Run a worker process."""
    line = _Line(pipe, shared.sent[worker, ::-1])
    with suppress(EOFError, ConnectionError):  # the other end is closed
        make_batch = partial(LocalBatch, share.stop - share.start, [settings], autoreset_mode, shared.rows[share])
        line.send(result_of(lambda: _answer_requests(line, make_batch)))


def _answer_requests(line: _Line, make_batch: Callable[[], LocalBatch]) -> None:
    """Serve until the other end is gone, or a request goes wrong."""
    batch = make_batch()
    try:
        line.send(("done", None))
        while True:
            request, *arguments = line.receive()
            line.send(("done", getattr(batch, request)(*arguments)))
    finally:
        batch.close()
