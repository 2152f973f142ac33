"""Compiled functions."""

from typing import Any

from tint_sumo.core.compiling import compiled


def test_a_function_that_no_file_holds_is_compiled_all_the_same() -> None:
    """As where neither the package's folder nor the user's may be written: Numba then refuses to keep machine code."""
    namespace: dict[str, Any] = {}
    exec("def twice(x): return 2 * x", namespace)
    twice = compiled(namespace["twice"])
    assert twice(3) == 6
    assert twice.nopython_signatures
