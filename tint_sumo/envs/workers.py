"""A batch of environments spread over worker processes, each with a simulation of its own.

Actions, observations and rewards pass through shared memory; the pipes carry a word per step, and whatever there is to
tell of episodes that ended.
"""

import traceback
import weakref
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import replace
from itertools import pairwise
from multiprocessing.connection import Connection
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tint_sumo.envs.batch import Ended, LocalBatch
from tint_sumo.envs.episodes import TaskSettings
from tint_sumo.envs.rows import ROW, Rows
from tint_sumo.errors import InputError
from tint_sumo.processes import SPAWN, end_with_parent, interrupts_blocked

_ENDING_S = 10.0  # more than enough for a step, and to close a simulation


class WorkerBatch:
    """``num_envs`` environments shared out among ``workers`` processes, in order and as evenly as can be.

    An error in a worker, its death, or an interruption while waiting ends all of them.
    """

    def __init__(self, num_envs: int, settings: TaskSettings, workers: int) -> None:
        self._actions, self.rows, memory = _shared(num_envs)
        bounds = [num_envs * worker // workers for worker in range(workers + 1)]
        self._shares = [slice(*share) for share in pairwise(bounds)]
        self._pipes: list[Connection] = []
        self._processes: list[Any] = []
        self._finalizer = weakref.finalize(self, _end, self._pipes, self._processes)
        for share in self._shares:
            pipe, theirs = SPAWN.Pipe()
            process = SPAWN.Process(target=_serve, args=(theirs, memory, num_envs, share, settings), daemon=True)
            with interrupts_blocked():
                process.start()
            theirs.close()
            self._pipes.append(pipe)
            self._processes.append(process)
        self._listen()

    def reset(self, seeds: Sequence[int | None], mask: NDArray[np.bool_]) -> None:
        self._ask(*(("reset", seeds[share], mask[share]) for share in self._shares))

    def step(self, actions: NDArray[np.integer]) -> list[Ended]:
        self._actions[:] = actions
        answers = self._ask(*(("step",) for _ in self._shares))
        return [
            replace(one, index=one.index + share.start)
            for share, answer in zip(self._shares, answers, strict=True)
            for one in answer
        ]

    def render(self) -> list[NDArray[np.uint8]]:
        return [image for images in self._ask(*(("render",) for _ in self._shares)) for image in images]

    def close(self) -> None:
        self._finalizer()

    def _ask(self, *requests: tuple[Any, ...]) -> list[Any]:
        """Send each worker its request and return their answers."""
        if not self._finalizer.alive:
            raise RuntimeError("the environment is closed; make a new one")
        for pipe, request in zip(self._pipes, requests, strict=True):
            with suppress(ConnectionError):  # a worker that has died is found out when it is listened to
                pipe.send(request)
        return self._listen()

    def _listen(self) -> list[Any]:
        try:
            return [self._answer(worker) for worker in range(len(self._pipes))]
        except BaseException:
            self.close()
            raise

    def _answer(self, worker: int) -> Any:
        try:
            kind, content = self._pipes[worker].recv()
        except (EOFError, ConnectionError):
            process = self._processes[worker]
            process.join(_ENDING_S)
            raise RuntimeError(
                f"environment worker {worker} died with exit code {process.exitcode}; make a new environment"
            ) from None
        if kind == "refused":
            raise InputError(content)
        if kind == "failed":
            raise RuntimeError(f"environment worker {worker} failed:\n{content}")
        return content


def _shared(num_envs: int, memory: Any = None) -> tuple[NDArray[np.int64], Rows, Any]:
    """Actions (N,), rows (N,) of the environments, and the shared memory they lie in, new if none is given.

    The memory has no name in the file system: nothing is left of it when the last process ends, however it ends.
    """
    size = num_envs * np.dtype(np.int64).itemsize
    if memory is None:
        memory = SPAWN.RawArray("B", size + num_envs * ROW.itemsize)
    actions = np.frombuffer(memory, np.int64, num_envs)
    return actions, np.frombuffer(memory, ROW, num_envs, offset=size), memory


def _end(pipes: list[Connection], processes: list[Any]) -> None:
    for pipe in pipes:
        pipe.close()  # a worker ends when nobody is at the other end
    for process in processes:
        process.join(_ENDING_S)
        process.kill()
        process.join()


def _serve(pipe: Connection, memory: Any, num_envs: int, share: slice, settings: TaskSettings) -> None:
    """The worker process."""
    end_with_parent()
    with suppress(EOFError, ConnectionError):  # nobody is at the other end any more
        try:
            _answer_requests(pipe, memory, num_envs, share, settings)
        except InputError as error:
            pipe.send(("refused", str(error)))
        except (EOFError, ConnectionError):
            raise
        except Exception:
            pipe.send(("failed", traceback.format_exc()))


def _answer_requests(pipe: Connection, memory: Any, num_envs: int, share: slice, settings: TaskSettings) -> None:
    actions, rows, _ = _shared(num_envs, memory)
    actions, rows = actions[share], rows[share]
    batch = LocalBatch(len(rows), settings, rows)
    try:
        pipe.send(("ready", None))
        while True:
            request, *arguments = pipe.recv()
            answer: Any = None
            if request == "reset":
                batch.reset(*arguments)
            elif request == "step":
                answer = batch.step(actions)
            else:
                answer = batch.render()
            pipe.send(("done", answer))
    finally:
        batch.close()
