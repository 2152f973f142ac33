"""Tools of several measurements: clocks around functions, and turns in other processes.

cProfile makes an environment step a fifth slower, at the expense of what Python does; these clocks subtract their cost.
"""

import time
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager, suppress
from multiprocessing.connection import Connection
from typing import Any

from tint_sumo.core.processes import result_of, start_worker, value_of
from tint_sumo.simulation.timing import marked_methods

Turn = Callable[[], float]  # measures once more and returns the result


class Clocks:
    """Clocks around functions; time in a clocked function that another one calls counts for the inner one alone."""

    def __init__(self) -> None:
        self.spent_s: dict[str, float] = {}
        self._within_s = [0.0]  # spent in clocked functions, at every depth of calls
        self._cost_s = 0.0
        idle = self.around(lambda: None, "idle")
        self._cost_s = min(_call_s(idle) for _ in range(10))  # the least: other work may interrupt a clock

    def watch(self, *owners: object) -> None:
        """Put clocks around the methods of these objects that are marked as parts of a step, for good."""
        for owner in owners:
            for name, part in marked_methods(owner):
                setattr(owner, name, self.around(getattr(owner, name), part))

    def around(self, function: Callable[..., Any], part: str) -> Callable[..., Any]:
        self.spent_s.setdefault(part, 0.0)

        def clocked(*args: Any, **kwargs: Any) -> Any:
            self._within_s.append(0.0)
            start = time.perf_counter()
            result = function(*args, **kwargs)
            elapsed_s = time.perf_counter() - start
            self.spent_s[part] += elapsed_s - self._within_s.pop()
            self._within_s[-1] += elapsed_s + self._cost_s
            return result

        return clocked


def _call_s(function: Callable[[], Any], calls: int = 100) -> float:
    start = time.perf_counter()
    for _ in range(calls):
        function()
    return (time.perf_counter() - start) / calls


@contextmanager
def turns_apart(make: Callable[..., AbstractContextManager[Turn]], *arguments: Any) -> Iterator[Turn]:
    """Give the turns of ``make(*arguments)``, taken in another process, which waits between them."""
    pipe, process = start_worker(_serve_turns, make, *arguments, daemon=False)

    def turn() -> float:
        pipe.send("turn")
        return float(value_of(pipe.recv(), "the process that measures"))

    try:
        yield turn
    finally:
        pipe.close()
        process.join()


def _serve_turns(pipe: Connection, make: Callable[..., AbstractContextManager[Turn]], *arguments: Any) -> None:
    with make(*arguments) as turn, suppress(EOFError, ConnectionError):  # nobody is at the other end
        while pipe.recv():
            pipe.send(result_of(turn))
