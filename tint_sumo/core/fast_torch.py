"""Two settings of torch's surroundings with which it computes faster on a processor, and to the same precision."""

import ctypes
from collections.abc import Iterator
from contextlib import AbstractContextManager, contextmanager, nullcontext, suppress
from functools import cache

import torch

_TRIM_THRESHOLD, _MMAP_THRESHOLD = -1, -3  # glibc's malloc.h
_KEPT_BYTES = 2**30


def wide_products(wanted: bool = True) -> AbstractContextManager[None]:
    """Let torch multiply large float32 matrices with oneDNN in the block, where that stays float32.

    torch prefers MKL, which uses AVX-512 on Intel's processors alone: on an AMD EPYC, oneDNN is twice as fast. The only
    switch for it is a lower precision, which oneDNN makes use of where a processor has units for it (AMX); there, and
    where ``wanted`` is false, nothing changes. oneDNN compiles code for every shape, so shapes should be few.
    """
    return _precision("medium") if wanted and _stays_float32() else nullcontext()


@contextmanager
def _precision(name: str) -> Iterator[None]:
    before = torch.get_float32_matmul_precision()
    torch.set_float32_matmul_precision(name)
    try:
        yield
    finally:
        torch.set_float32_matmul_precision(before)


@cache
def _stays_float32() -> bool:
    """Return whether oneDNN keeps all digits of numbers that bfloat16 and TF32 would round."""
    values = torch.full((256, 256), 1.0 + 2.0**-20)
    with _precision("medium"):
        return torch.equal(values @ torch.eye(256), values)


@cache
def keep_freed_memory() -> None:
    """Make malloc keep the memory of freed arrays for the next ones, for the rest of the process, with glibc.

    It would give megabytes back to the system at once and take them anew, page by page: with the arrays of a gradient
    step that takes a third of its time.
    """
    with suppress(AttributeError, OSError, TypeError):  # another C library
        mallopt = ctypes.CDLL(None).mallopt
        mallopt(_MMAP_THRESHOLD, _KEPT_BYTES)
        mallopt(_TRIM_THRESHOLD, _KEPT_BYTES)
