"""Shares in percent: by people's rule, and never as all or nothing of what is neither."""

import pytest
from hypothesis import given
from hypothesis import strategies as st

from tint_sumo.core.percentages import percent, percent_and_ends


@pytest.mark.parametrize(
    ("share", "digits", "words"),
    [
        (0.995, 0, ">99"),  # Python's formatting makes 100 of it
        (0.985, 0, "99"),  # and 98 of this
        (0.985, 1, "98.5"),
        (0.9785, 1, "97.9"),  # and 97.8 of this, since its floating-point number is a little less
        (0.145, 0, "15"),
        (0.9996, 1, ">99.9"),
        (0.0004, 1, "<0.1"),
        (0.0005, 1, "0.1"),
        (1.0, 1, "100.0"),
        (0.0, 1, "0.0"),
        (1.0, 0, "100"),
        (0.99999, 3, "99.999"),
        (float("nan"), 1, "-"),
    ],
)
def test_shares_are_rounded_half_up_and_only_all_of_them_read_100(share: float, digits: int, words: str) -> None:
    assert percent(share, digits) == words


@given(st.integers(1, 5000), st.data(), st.integers(0, 3))
def test_what_is_read_is_near_what_is_meant(total: int, data: st.DataObject, digits: int) -> None:
    count = data.draw(st.integers(0, total))
    words = percent(count / total, digits)
    assert (words.strip("<>") == words) or 0 < count < total
    assert abs(float(words.strip("<>")) - 100 * count / total) <= 10.0**-digits
    assert (float(words) == 100) == (count == total) if not words.startswith((">", "<")) else True


def test_the_ends_of_an_interval_are_rounded_as_its_share() -> None:
    assert percent_and_ends(0.985, (0.97, 0.9996)) == "98.5 [97.0, >99.9]"
    assert percent_and_ends(0.985, (0.0, 1.0), digits=0) == "99 [0, 100]"
