import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from tint_sumo.core.statistics import (
    Hits,
    Rate,
    difference_interval,
    improvement,
    improvement_interval,
    interquartile_interval,
    interquartile_mean,
    rate_interval,
)


def hits(*rates: float, cases: int = 400, seed: int = 0) -> Hits:
    """Policies of one training seed each, with about these rates of successes in cases that have nothing in common."""
    return np.random.default_rng(seed).random((len(rates), cases)) < np.array(rates)[:, None]


def width(interval: tuple[float, float]) -> float:
    return interval[1] - interval[0]


@pytest.mark.parametrize(
    ("count", "total", "low", "high"),
    [  # Wilson's formula (1927) with z = 1.959964
        (5, 10, 0.236593, 0.763407),
        (0, 10, 0.0, 0.277533),
        (10, 10, 0.722467, 1.0),
        (455, 500, 0.881691, 0.932057),
    ],
)
def test_known_wilson_intervals(count: int, total: int, low: float, high: float) -> None:
    assert Rate(count, total).interval == pytest.approx((low, high), abs=1e-6)


@given(st.integers(1, 2000).flatmap(lambda total: st.tuples(st.integers(0, total), st.just(total))))
def test_a_wilson_interval_holds_the_rate_and_mirrors(case: tuple[int, int]) -> None:
    count, total = case
    rate = Rate(count, total)
    low, high = rate.interval
    assert 0.0 <= low <= rate.value + 1e-12 and rate.value - 1e-12 <= high <= 1.0
    assert Rate(total - count, total).interval == pytest.approx((1.0 - high, 1.0 - low), abs=1e-9)


def test_more_cases_make_a_wilson_interval_narrower() -> None:
    widths = [width(Rate(n // 4, n).interval) for n in (20, 200, 2000)]
    assert widths == sorted(widths, reverse=True)


def test_seeds_that_differ_make_the_interval_wider() -> None:
    agreeing, differing = rate_interval(hits(0.8, 0.8, 0.8)), rate_interval(hits(0.6, 0.8, 1.0))
    assert width(differing) > 2.0 * width(agreeing)


def test_an_interval_over_seeds_and_cases_holds_the_rate_and_the_seeds_between_them() -> None:
    some = hits(0.5, 0.8, 0.9)
    low, high = rate_interval(some)
    assert 0.0 <= low < some.mean() < high <= 1.0
    assert low < 0.6 and high > 0.85, "a new study could have had worse seeds, or better ones"


def test_with_seeds_that_do_the_very_same_only_the_cases_count() -> None:
    one = hits(0.8, cases=1000)
    assert rate_interval(np.tile(one, (3, 1))) == pytest.approx(Rate(int(one.sum()), 1000).interval, abs=0.005)


@pytest.mark.parametrize("always", [True, False])
def test_what_always_or_never_happens_has_an_interval_of_no_width(always: bool) -> None:
    assert rate_interval(np.full((3, 50), always)) == (float(always), float(always))


def test_the_only_case_has_an_interval_over_the_seeds() -> None:
    hits = np.array([[True], [False], [True]])
    low, high = rate_interval(hits)
    assert 0.0 <= low < 2 / 3 < high <= 1.0
    assert difference_interval(hits, hits)[0] < 0.0 < difference_interval(hits, hits)[1]
    assert rate_interval(np.ones((2, 1), bool)) == (1.0, 1.0)


def test_intervals_are_the_same_every_time() -> None:
    some, other = hits(0.6, 0.8, 0.9), hits(0.7, 0.7, seed=1)
    assert rate_interval(some) == rate_interval(some.copy())
    assert difference_interval(some, other) == difference_interval(some.copy(), other.copy())


def test_a_method_does_not_differ_from_itself() -> None:
    some = hits(0.75, 0.8, 0.85)
    low, high = difference_interval(some, some)
    assert low < 0.0 < high


def test_clearly_different_methods_differ_in_the_right_direction() -> None:
    better, worse = hits(0.94, 0.95, 0.96), hits(0.6, 0.62, seed=1)  # with different numbers of seeds, too
    low, high = difference_interval(better, worse)
    assert 0.0 < low < better.mean() - worse.mean() < high
    assert difference_interval(worse, better) == pytest.approx((-high, -low), abs=0.02)


def test_cases_that_are_hard_for_both_methods_do_not_blur_their_difference() -> None:
    solvable = np.random.default_rng(0).random(400) < 0.5  # the other half nobody solves
    better, worse = hits(0.98, 0.98, 0.98), hits(0.9, 0.9, 0.9, seed=1)
    on_the_same_cases = difference_interval(better & solvable, worse & solvable)
    elsewhere = difference_interval(better & solvable, worse & ~solvable)
    assert width(on_the_same_cases) < 0.6 * width(elsewhere)
    assert on_the_same_cases[0] > 0.0


def test_the_interquartile_mean_is_that_of_the_middle_half() -> None:
    scores = np.array([[0.9, 0.0], [0.8, 0.7], [0.6, 0.5], [1.0, 0.4]])
    assert interquartile_mean(scores) == pytest.approx((0.5 + 0.6 + 0.7 + 0.8) / 4)
    failed = np.array([[0.9, 0.9], [0.9, 0.9], [0.9, 0.9], [0.1, 0.9]])
    assert interquartile_mean(failed) == pytest.approx(0.9), "a training that failed changes it little"


def test_a_draw_counts_half_of_an_improvement() -> None:
    scores, others = np.array([[0.5], [0.7]]), np.array([[0.5], [0.6], [0.9]])
    # Of the six pairs, the first training draws once, and the second wins twice.
    assert improvement(scores, others) == pytest.approx((0.5 + 2) / 6)
    assert improvement(others, scores) == pytest.approx(1.0 - (0.5 + 2) / 6)
    two_tasks = np.concatenate([scores, scores + 1.0], axis=1)
    assert improvement(two_tasks, np.concatenate([others, others], axis=1)) == pytest.approx(((0.5 + 2) / 6 + 1.0) / 2)


def test_intervals_over_seeds_hold_the_value_and_shrink_with_their_number() -> None:
    rng = np.random.default_rng(0)
    few, many, others = rng.normal(0.7, 0.1, (3, 4)), rng.normal(0.7, 0.1, (30, 4)), rng.normal(0.6, 0.1, (5, 4))
    for scores in (few, many):
        low, high = interquartile_interval(scores)
        assert low < interquartile_mean(scores) < high
        low, high = improvement_interval(scores, others)
        assert low <= improvement(scores, others) <= high
    assert width(interquartile_interval(many)) < 0.6 * width(interquartile_interval(few))
    assert width(improvement_interval(many, others)) < width(improvement_interval(few, others))
    same = np.full((4, 3), 0.5)
    assert interquartile_interval(same) == (0.5, 0.5) and improvement_interval(same, same) == (0.5, 0.5)
