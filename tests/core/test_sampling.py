import pytest

from tint_sumo.core.sampling import evenly_spread


@pytest.mark.parametrize(
    ("size", "count", "chosen"),
    [(9, 3, [0, 4, 8]), (5, 5, [0, 1, 2, 3, 4]), (3, 7, [0, 1, 2]), (4, 1, [0]), (0, 5, []), (5, 0, [])],
)
def test_indices_are_evenly_spread_and_differ(size: int, count: int, chosen: list[int]) -> None:
    assert evenly_spread(size, count).tolist() == chosen
