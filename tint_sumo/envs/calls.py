"""Checks of the calls of an environment: its phase, actions, seeds and masks, before anything is done."""

import operator
from collections.abc import Mapping
from enum import Enum
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tint_sumo.core.errors import InputError, shown
from tint_sumo.core.ranges import Range


class Phase(Enum):
    """The phase of an environment between creation and closing; the value says why it cannot step."""

    NEW = "no episode has begun; reset the environment first"
    READY = ""
    BUSY = "an earlier call has failed or was interrupted; reset the environment first"  # seen between calls
    CLOSED = "the environment is closed; make a new one"


class Calls:
    """The phase of an environment. ``with calls:`` stands around work that leaves an episode to go on with.

    If it fails or is interrupted, the environment must be reset first.
    """

    def __init__(self) -> None:
        self.phase = Phase.NEW

    def __enter__(self) -> None:
        self.phase = Phase.BUSY

    def __exit__(self, kind: type[BaseException] | None, *_: object) -> None:
        if kind is None:
            self.phase = Phase.READY

    def require_open(self) -> None:
        """Raise InputError after ``close()``."""
        if self.phase is Phase.CLOSED:
            raise InputError(self.phase.value)

    def require_episode(self) -> None:
        """Raise InputError where there is no episode to go on with."""
        if self.phase is not Phase.READY:
            raise InputError(self.phase.value)


def checked_count(name: str, value: Any, most: int) -> int:
    """Return a number of things as Python's integer.

    Raises:
        InputError: it is no integer from 1 to ``most``.
    """
    number = _integer(value)
    if number is None:
        raise InputError(f"{name} must be an integer, not {shown(value)}")
    Range(1, most).require(name, number)
    return number


def checked_actions(actions: Any, shape: tuple[int, ...], choices: int) -> NDArray[np.integer]:
    """Return actions as an array of this shape, () for one environment or (N,).

    Integers of any width are taken, also those of numpy and torch.

    Raises:
        InputError: they are no such integers, out of range, or as many as there are not.
    """
    if not shape and (type(actions) is int or isinstance(actions, np.integer)) and 0 <= actions < choices:
        return np.asarray(actions)  # the usual case of a single environment, whose steps are short
    array = _as_array(actions)
    if (
        array.dtype.kind not in "iu"
        or array.shape != shape
        or not ((array >= 0) & (array < choices)).all()
        or (isinstance(actions, list | tuple) and any(isinstance(action, bool | np.bool_) for action in actions))
    ):
        allowed = ", ".join(map(str, range(choices)))
        wanted = f"actions must be {shape[0]} of {allowed}" if shape else f"an action must be one of {allowed}"
        raise InputError(f"{wanted}, not {shown(actions)}")
    return array


def checked_seed(seed: Any) -> int | None:
    """Return a seed as Python's integer; integers of numpy and torch are taken, too.

    Raises:
        InputError: it is no integer of at least 0, nor None.
    """
    if seed is None:
        return None
    number = _integer(seed)
    if number is None or number < 0:
        raise InputError(f"a seed must be an integer of at least 0, not {shown(seed)}")
    return number


def checked_seeds(seed: Any, num_envs: int) -> list[int | None]:
    """Return a seed for each environment: one number stands for itself and those after it.

    Raises:
        InputError: there are not as many as environments, or one is no seed.
    """
    try:
        seeds = [checked_seed(value) for value in seed]
    except TypeError:  # not iterable
        first = checked_seed(seed)
        return [None if first is None else first + index for index in range(num_envs)]
    if len(seeds) != num_envs:
        raise InputError(f"{len(seeds)} seeds do not fit {num_envs} environments; give one number or as many")
    return seeds


def checked_options(options: Any, known: tuple[str, ...] = ()) -> Mapping[str, Any]:
    """Return the options of a reset; none where they are None.

    Raises:
        InputError: they are no dictionary, or one of them is not known.
    """
    allowed = f"known are: {', '.join(known)}" if known else "this environment knows none"
    if options is not None and not isinstance(options, Mapping):
        raise InputError(f"options must be a dictionary or None, not {shown(options)}; {allowed}")
    unknown = [name for name in options or () if name not in known]
    if unknown:
        raise InputError(f"there is no reset option {shown(unknown[0])}; {allowed}")
    return options or {}


def checked_case(options: Any, cases: int) -> int | None:
    """Return the case that a reset's options choose among so many; None without a choice.

    Raises:
        InputError: there is no such option or case.
    """
    case = checked_options(options, ("case",) if cases else ()).get("case")
    if case is None:
        return None
    number = _integer(case)
    if number is None or not 0 <= number < cases:
        raise InputError(f"case must be an integer from 0 to {cases - 1}, not {shown(case)}")
    return number


def checked_mask(mask: Any, num_envs: int) -> NDArray[np.bool_]:
    """Return which environments to reset, (N,); all where the mask is None.

    Raises:
        InputError: it is not one boolean per environment, or none of them is true.
    """
    if mask is None:
        return np.ones(num_envs, bool)
    array = _as_array(mask)
    if array.dtype.kind != "b" or array.shape != (num_envs,) or not array.any():
        raise InputError(
            f"reset_mask must be {num_envs} booleans, one for each environment, at least one of them true; "
            f"not {shown(mask)}"
        )
    return array


def _integer(value: Any) -> int | None:
    """Return an integer of Python, numpy or torch as Python's; None where it is none, as booleans are."""
    try:
        return None if _as_array(value).dtype.kind == "b" else operator.index(value)
    except TypeError:
        return None


def _as_array(value: Any) -> NDArray[Any]:
    """Return what numpy makes of a value; an object where it can make nothing of it."""
    try:
        return np.asarray(value)
    except (TypeError, ValueError, RuntimeError):
        return np.array(None)
