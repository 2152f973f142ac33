"""Control of two things that results must not depend on: global random state, and the number of torch's threads."""

import random
from collections.abc import Iterator
from contextlib import contextmanager

import numpy as np
import torch


@contextmanager
def preserved_random_state() -> Iterator[None]:
    """Give Python's, NumPy's and torch's global random generators their states back when the block ends.

    Stable-Baselines3 seeds all three, and every network that is built draws its first weights, even if they are
    overwritten at once. Code that only looks at a training, or loads a network, runs in such a block.
    """
    python, numpy, pytorch = random.getstate(), np.random.get_state(), torch.get_rng_state()  # noqa: NPY002
    try:
        yield
    finally:
        random.setstate(python)
        np.random.set_state(numpy)  # noqa: NPY002
        torch.set_rng_state(pytorch)


@contextmanager
def single_threaded() -> Iterator[None]:
    """Let torch compute in one thread in the block: sums in several threads have other last bits."""
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(threads)
