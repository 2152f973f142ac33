"""KeyboardInterrupt at any moment of a call leaves an environment whose next reset makes it as good as new."""

import sys
from collections.abc import Callable, Iterator
from contextlib import closing, contextmanager
from types import FrameType
from typing import Any

import numpy as np
import pytest

from tests.envs.test_resets import assert_same_answers
from tint_sumo.core.errors import InputError
from tint_sumo.envs import SceneEnv, SceneVectorEnv, TaskSettings

TASK: dict[str, Any] = {"sensor": "noisy_0.1", "tracks": True, "time_limit_s": 0.8}
Make = Callable[[], Any]
KINDS: dict[str, tuple[Make, int]] = {
    "single": (lambda: SceneEnv(TaskSettings(**TASK)), 200),
    "traci": (lambda: SceneEnv(TaskSettings(**TASK, backend="traci")), 10),
    "vector": (lambda: SceneVectorEnv(3, TaskSettings(**TASK)), 200),
    "workers": (lambda: SceneVectorEnv(3, TaskSettings(**TASK), workers=2), 3),
}


@contextmanager
def interrupt_at(line: int) -> Iterator[list[int]]:
    """Raise KeyboardInterrupt before the line of Python with this number runs; the list holds how many have run."""
    lines = [0]

    def trace(_frame: FrameType, event: str, _argument: Any) -> Any:
        lines[0] += event == "line"
        if lines[0] == line:
            sys.settrace(None)
            raise KeyboardInterrupt
        return trace

    before = sys.gettrace()
    sys.settrace(trace)
    try:
        yield lines
    finally:
        sys.settrace(before)


def count_lines(call: Callable[[], Any]) -> int:
    with interrupt_at(-1) as lines:
        call()
    return lines[0]


def first_steps(env: Any) -> list[tuple[Any, ...]]:
    action = 2 if isinstance(env, SceneEnv) else np.full(3, 2)
    return [env.reset(seed=7), *(env.step(action) for _ in range(2))]


@pytest.mark.filterwarnings("ignore::pytest.PytestUnraisableExceptionWarning")  # interrupts of finalizers
@pytest.mark.parametrize("kind", ["single", "traci", "vector", pytest.param("workers", marks=pytest.mark.slow)])
def test_interrupts_leave_an_environment_that_can_be_reset(kind: str) -> None:
    make, interrupts = KINDS[kind]
    with closing(make()) as env:
        fresh = first_steps(env)
    rng = np.random.default_rng(0)
    done, refused = 0, 0
    with closing(make()) as env:
        action = 2 if kind in ("single", "traci") else np.full(3, 2)
        calls = [lambda: env.reset(seed=3), lambda: env.step(action), lambda: env.step(action)]
        for call in calls:
            call()
        most = [count_lines(call) for call in calls]
        while done < interrupts:
            number = int(rng.integers(len(calls)))
            try:
                with interrupt_at(int(rng.integers(1, most[number]))):
                    calls[number]()
            except KeyboardInterrupt:
                done += 1
            except InputError as error:  # the interrupt before was in a call that now has to be made good
                assert "interrupted; reset the environment first" in str(error)
                refused += 1
            if rng.random() < 0.3:  # else the next interrupt may hit a reset that starts the simulations anew
                for one, other in zip(first_steps(env), fresh, strict=True):
                    assert_same_answers(one, other)
    assert refused or interrupts < 50  # a few interrupts may all be followed by a reset
    with closing(SceneEnv(TaskSettings(backend="libsumo"))) as env:  # whatever was interrupted has given libsumo free
        assert_same_answers(env.reset(seed=7), env.reset(seed=7))
