"""Marks for the part of an environment step that a method does; ``tint-sumo bench`` puts clocks around such methods.

A mark costs nothing: the method stays as it is, and moves along with its mark when it is renamed.
"""

import inspect
from collections.abc import Callable, Iterator
from enum import StrEnum
from typing import Any, TypeVar

_MARK = "step_part"

Method = TypeVar("Method", bound=Callable[..., Any])


class StepPart(StrEnum):
    """The parts of an environment step, in the order in which the benchmark shows them."""

    SUMO = "sumo"
    GETTERS = "getters"
    SPAWNING = "spawning"
    CLAIMS = "claims"
    SAFETY_CHECK = "safety_check"
    OBSERVATION = "observation"
    ADAPTER = "adapter"
    OTHER = "other"  # driving the egos, rewards, the end of episodes


def does(part: StepPart) -> Callable[[Method], Method]:
    """Mark a method that does a part of an environment step; what it calls for other parts does not count for it."""

    def mark(method: Method) -> Method:
        setattr(method, _MARK, part)
        return method

    return mark


def marked_methods(owner: object) -> Iterator[tuple[str, StepPart]]:
    """Yield the names of an object's marked methods, and the parts that they do."""
    for name, method in inspect.getmembers(type(owner), inspect.isfunction):
        if hasattr(method, _MARK):
            yield name, getattr(method, _MARK)
