"""Loads, in the server that workers are forked from, what each of them would load when it first needs it.

The server imports this module last. Nothing else does: loading takes seconds.
"""

import sys
from importlib import import_module

from tint_sumo.core.compiling import compiled

if "torch" in sys.modules:
    import_module("torch._dynamo")  # every optimizer loads it


@compiled
def _nothing() -> None:
    """Return; the first compiled function that is called loads Numba's registries."""


_nothing()
