import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from tint_sumo.config import WINDOW_STEPS
from tint_sumo.dataset.windows import Windows, joined
from tint_sumo.traits.input_range import MARGIN_M, InputRange
from tint_sumo.traits.storage import read_card


def windows_of(speed_mps: float, gap_m: float, length: int = WINDOW_STEPS) -> Windows:
    """One window of a driver at a constant speed and gap."""
    states = np.zeros((1, WINDOW_STEPS, 2), np.float32)
    states[0, :length, 0] = 0.1 * speed_mps * np.arange(length)
    states[0, :length, 1] = gap_m
    zero = np.zeros(1, np.int64)
    return Windows(states, np.array([length]), zero, zero, np.ones(1, bool))


REACH = InputRange.of([windows_of(2.0, 3.0), windows_of(6.0, 10.0, length=5), windows_of(4.0, 6.0)])


@pytest.mark.parametrize(
    ("window", "is_outside"),
    [
        (windows_of(3.0, 5.0), False),
        (windows_of(2.0, 3.0), False),
        (windows_of(1.9, 5.0), True),  # after two seconds the slowest one is 0.2 m ahead
        (windows_of(5.0, 5.0), True),  # nobody drove so fast for a whole window
        (windows_of(5.0, 5.0, length=5), False),  # but for half a second
        (windows_of(3.0, 2.8), True),
        (windows_of(3.0, 3.0 - MARGIN_M / 2), False),
        (windows_of(3.0, 10.2, length=2), True),
    ],
)
def test_a_window_is_outside_if_a_step_is_like_none_of_the_training(window: Windows, is_outside: bool) -> None:
    assert REACH.outside(window).tolist() == [is_outside]


@given(st.lists(st.tuples(st.floats(0.0, 15.0), st.floats(0.0, 20.0), st.integers(2, 20)), min_size=1, max_size=6))
def test_no_window_of_the_training_is_outside(given_windows: list[tuple[float, float, int]]) -> None:
    parts = [windows_of(*one) for one in given_windows]
    assert not any(InputRange.of(parts).outside(part).any() for part in parts)


def test_longer_windows_than_those_of_the_training_are_outside() -> None:
    short = InputRange.of([windows_of(2.0, 3.0, length=4)])
    assert [short.outside(windows_of(2.0, 3.0, length=length)).item() for length in (3, 4, 5)] == [False, False, True]


@pytest.mark.parametrize("name", ["vae", "cross_window", "morton", "classifier"])
def test_shipped_models_know_theirs(name: str) -> None:
    reach = read_card(name).input_range
    assert reach is not None
    assert not reach.outside(windows_of(2.5, 8.0)).any()
    assert reach.outside(windows_of(30.0, 8.0)).all()


def test_the_input_that_is_the_farthest_outside_is_named() -> None:
    windows = joined([windows_of(3.0, 5.0), windows_of(9.0, 5.0), windows_of(3.0, 12.0, length=4)])
    table = REACH.farthest_outside(windows)
    assert table["outside"].tolist() == [False, True, True]
    assert table["outside_input"].tolist() == ["none", "offset", "gap"]
    assert table["outside_step"].tolist() == [0, 20, 1]
    np.testing.assert_allclose(table["outside_m"], [np.nan, 0.1 * 9.0 * 19, 12.0], atol=1e-3)
    np.testing.assert_allclose(table["trained_high_m"], [np.nan, 0.1 * 4.0 * 19, 10.0], atol=1e-3)
    np.testing.assert_allclose(table["trained_low_m"], [np.nan, 0.1 * 2.0 * 19, 3.0], atol=1e-3)
    longer = InputRange.of([windows_of(2.0, 3.0, length=4)]).farthest_outside(windows_of(2.0, 3.0, length=5))
    assert longer[["outside_input", "outside_step"]].to_numpy().tolist() == [["offset", 5]]
    assert np.isnan(longer["trained_high_m"]).all()
