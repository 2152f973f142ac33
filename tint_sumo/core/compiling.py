"""Functions of numbers and arrays compiled to machine code (Numba), for the work of every step.

A compiled function may use only functions and constants of its own file, and takes all else as arguments: Numba keeps
the machine code beside that file and makes it anew when that file changes, and when no other does.
"""

from collections.abc import Callable
from typing import Any, TypeVar, cast

import numba

F = TypeVar("F", bound=Callable[..., object])


def compiled(function: F) -> F:
    """Compile a function when it is first called, and keep the machine code for other processes where files can be."""
    return _compiled(function)


def fused(function: F) -> F:
    """Compile as ``compiled`` does, but a product and the sum it goes into are rounded once: twice as fast."""
    return _compiled(function, fastmath={"contract"})


def _compiled(function: F, **options: Any) -> F:
    try:
        return cast(F, numba.njit(cache=True, **options)(function))
    except RuntimeError:  # neither beside the file nor in the user's cache folder
        return cast(F, numba.njit(**options)(function))
