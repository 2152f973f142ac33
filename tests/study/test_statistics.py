import pytest
from hypothesis import given
from hypothesis import strategies as st

from tint_sumo.study.statistics import Rate, wilson_interval


@pytest.mark.parametrize(
    ("count", "total", "low", "high"),
    [  # scipy.stats.binomtest(count, total).proportion_ci(method="wilson")
        (5, 10, 0.236593, 0.763407),
        (0, 10, 0.0, 0.277533),
        (10, 10, 0.722467, 1.0),
        (455, 500, 0.881691, 0.932057),
    ],
)
def test_known_intervals(count: int, total: int, low: float, high: float) -> None:
    assert wilson_interval(count, total) == pytest.approx((low, high), abs=1e-6)


@given(st.integers(1, 2000).flatmap(lambda total: st.tuples(st.integers(0, total), st.just(total))))
def test_the_interval_holds_the_rate_and_mirrors(case: tuple[int, int]) -> None:
    count, total = case
    low, high = wilson_interval(count, total)
    assert 0.0 <= low <= count / total <= high <= 1.0
    assert wilson_interval(total - count, total) == pytest.approx((1.0 - high, 1.0 - low), abs=1e-12)


def test_more_cases_make_it_narrower() -> None:
    widths = [high - low for low, high in (wilson_interval(n // 4, n) for n in (20, 200, 2000))]
    assert widths == sorted(widths, reverse=True)


@pytest.mark.parametrize(("count", "total"), [(0, 0), (-1, 10), (11, 10)])
def test_no_rate(count: int, total: int) -> None:
    with pytest.raises(ValueError, match="no rate"):
        wilson_interval(count, total)


def test_rate() -> None:
    rate = Rate(455, 500)
    assert rate.value == 0.91
    assert rate.interval == wilson_interval(455, 500)
