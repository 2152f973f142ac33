import json
from collections.abc import Sequence
from dataclasses import replace

import pytest

from tests.study.scenes import given, trained
from tint_sumo.config import ALL_MIXES, Mix
from tint_sumo.core.statistics import Rate, rate_interval
from tint_sumo.methods.evaluation import Case, Evaluation
from tint_sumo.methods.registry import METHODS
from tint_sumo.study.budgets import Conditions
from tint_sumo.study.results import TRAINED
from tint_sumo.study.summary import (
    Row,
    at_mixes,
    by_line,
    in_other_conditions,
    in_worlds,
    labels,
    looks,
    tabulate,
    varied,
)

AS_TRAINED = Conditions(ALL_MIXES)
NOISY, SLOW, FAST = Conditions(ALL_MIXES, 0.1), Conditions(ALL_MIXES, tau_s=1.5), Conditions(ALL_MIXES, tau_s=0.7)
HALF = Conditions(ALL_MIXES, percent=50)

SOME_RESULTS = [
    trained("oracle", 1, {Conditions(Mix(0.4)): (8, 1, 1), AS_TRAINED: (5, 0, 0)}),
    given("ttc", {Conditions(Mix(0.25)): (5, 4, 1), Conditions(Mix(0.4)): (6, 4, 0)}),
    trained("oracle", 0, {Conditions(Mix(0.4)): (9, 1, 0), AS_TRAINED: (4, 0, 1)}),
    given("always_go", {Conditions(Mix(0.4)): (0, 0, 10)}),
]


def find(rows: Sequence[Row], method: str, conditions: Conditions) -> Row:
    (row,) = [row for row in rows if (row.method, row.conditions) == (method, conditions)]
    return row


@pytest.fixture
def oracle() -> Row:
    return find(tabulate(SOME_RESULTS), "oracle", Conditions(Mix(0.4)))


def test_the_seeds_of_a_method_make_one_row(oracle: Row) -> None:
    assert oracle.seeds == (0, 1)
    assert [one.rate("success").count for one in oracle.evaluations] == [9, 8]
    assert oracle.episodes == 10
    assert oracle.hits("success").shape == (2, 10)
    assert (oracle.rate("success"), oracle.rate("timeout"), oracle.rate("collision")) == (0.85, 0.1, 0.05)
    assert oracle.collisions == {"aggressive, lower": 1}


def test_the_time_is_the_mean_of_all_successes(oracle: Row) -> None:
    assert oracle.navigation_time_s == pytest.approx((sum(range(10, 19)) + sum(range(10, 18))) / 17)
    assert find(tabulate(SOME_RESULTS), "always_go", Conditions(Mix(0.4))).navigation_time_s is None


def test_rows_go_by_conditions_and_then_in_the_order_of_the_registry() -> None:
    assert [(row.method, row.conditions) for row in tabulate(SOME_RESULTS)] == [
        ("ttc", Conditions(Mix(0.25))),
        ("always_go", Conditions(Mix(0.4))),
        ("ttc", Conditions(Mix(0.4))),
        ("oracle", Conditions(Mix(0.4))),
        ("oracle", AS_TRAINED),
    ]


def test_the_training_s_conditions_come_first_and_shorter_trainings_last() -> None:
    conditions = (HALF, SLOW, NOISY, FAST, AS_TRAINED, Conditions(Mix(0.4)))
    rows = tabulate([trained("oracle", 0, dict.fromkeys(conditions, (1, 0, 0)))])
    assert [row.conditions for row in rows] == [Conditions(Mix(0.4)), AS_TRAINED, FAST, SLOW, NOISY, HALF]


def test_trainings_for_other_mixes_and_shipped_policies_are_rows_of_their_own() -> None:
    fared = {Conditions(Mix(0.4)): (1, 0, 1)}
    rows = tabulate([trained("vae", 0, fared), given("vae", fared), trained("vae", 0, fared, mix=Mix(0.4))])
    assert [(row.origin, row.mix) for row in rows] == [("given", None), ("trained", ALL_MIXES), ("trained", Mix(0.4))]
    assert [row.title for row in rows] == [
        "paper's method (shipped)",
        "paper's method (trained at P 0.1 to 0.9)",
        "paper's method (trained at P 0.4)",
    ]
    assert [row.title for row in tabulate([trained("vae", 0, fared, mix=Mix(0.4))])] == ["paper's method"]
    in_world = Conditions(ALL_MIXES, world="towns")  # where policies of several worlds are shipped
    assert [row.title for row in tabulate([given("vae", {in_world: (1, 0, 1)})])] == ["paper's method (old world)"]
    assert find(tabulate(SOME_RESULTS), "ttc", Conditions(Mix(0.25))).title == "time to collision"


def test_a_method_that_is_no_longer_known_keeps_its_name_and_comes_last() -> None:
    rows = tabulate([trained("forgotten", 0, {AS_TRAINED: (1, 0, 0)}), *SOME_RESULTS])
    assert rows[-1].title == "forgotten"


def test_the_spread_is_the_standard_deviation_between_seeds(oracle: Row) -> None:
    assert oracle.spread("success") == pytest.approx(0.1 / 2**0.5)
    assert oracle.spread("timeout") == 0.0
    assert find(tabulate(SOME_RESULTS), "ttc", Conditions(Mix(0.4))).spread("success") is None


def test_intervals_are_over_seeds_and_cases_or_over_the_cases_of_the_only_seed(oracle: Row) -> None:
    assert oracle.intervals["success"] == rate_interval(oracle.hits("success"))
    assert find(tabulate(SOME_RESULTS), "ttc", Conditions(Mix(0.4))).intervals["success"] == Rate(6, 10).interval


def test_the_paper_s_numbers_stand_beside_the_paper_s_own_conditions_alone() -> None:
    fared = dict.fromkeys(
        (Conditions(Mix(0.4)), Conditions(Mix(0.4), 0.1), Conditions(Mix(0.4), percent=50), AS_TRAINED), (1, 0, 0)
    )
    published = {
        (row.method, row.conditions): row.published for row in tabulate([trained("oracle", 0, fared), *SOME_RESULTS])
    }
    assert published.pop(("oracle", Conditions(Mix(0.4)))) == {"success": 90, "timeout": 4, "collision": 5}
    assert not any(published.values())


def test_the_main_table_has_the_mixes_and_another_one_the_conditions() -> None:
    fared = dict.fromkeys((Conditions(Mix(0.4)), Conditions(Mix(0.6)), AS_TRAINED, NOISY, HALF), (1, 0, 0))
    rows = tabulate([trained("oracle", 0, fared)])
    assert [row.conditions for row in at_mixes(rows)] == [Conditions(Mix(0.4)), Conditions(Mix(0.6))]
    assert [row.conditions for row in in_other_conditions(rows)] == [AS_TRAINED, NOISY, HALF]


def test_every_row_is_in_a_table_whatever_the_mix_of_its_cases() -> None:
    base, slow = Conditions(Mix(0.4)), Conditions(Mix(0.4), tau_s=1.5)
    world, half = Conditions(Mix(0.4), world="towns"), Conditions(ALL_MIXES, percent=50, world="towns")
    rows = tabulate([trained("oracle", 0, dict.fromkeys((base, slow, Conditions(Mix(0.6)), world, half), (1, 0, 0)))])
    assert [row.conditions for row in at_mixes(rows)] == [base, Conditions(Mix(0.6))]
    assert [row.conditions for row in in_other_conditions(rows)] == [base, slow], "beside the same mix as trained"
    assert [row.conditions for row in in_worlds(rows)] == [world, half]


def test_names_of_conditions_and_lines_have_the_mix_where_there_are_several() -> None:
    slow, other = Conditions(Mix(0.4), tau_s=1.5), Conditions(Mix(0.6), world="towns")
    rows = tabulate([given("ttc", {slow: (1, 0, 0), other: (1, 0, 0), Conditions(Mix(0.4)): (1, 0, 0)})])
    assert list(labels(rows).values()) == ["as trained, P 0.4", "headway 1.5 s, P 0.4", "128 towns, P 0.6"]
    assert list(by_line(rows)) == ["time to collision, P 0.4", "time to collision, P 0.6"]
    first, second = looks(by_line(rows))
    assert first == METHODS["ttc"].look and first.colour == second.colour and first.marker != second.marker
    assert list(labels(rows[:2]).values()) == ["as trained", "headway 1.5 s"]
    assert list(by_line(rows[:2])) == ["time to collision"]


def test_rows_tell_the_headway_of_the_scene_s_drivers_where_no_other_one_is_tested() -> None:
    close = Conditions(ALL_MIXES, tau_s=1.0)
    result = trained("oracle", 0, dict.fromkeys((close, SLOW, FAST, AS_TRAINED), (1, 0, 0)))
    rows = tabulate([replace(result, scene_tau_s=1.4)])
    assert [row.conditions for row in rows] == [AS_TRAINED, SLOW, close, FAST]
    assert [row.to_json()["tau_s"] for row in rows] == [1.4, 1.5, 1.0, 0.7]
    assert list(varied(rows, "tau_s")) == [0.7, 1.0, 1.4, 1.5]
    assert list(varied(rows, "position_noise_m")) == [0.0]


def test_an_only_mix_of_whole_numbers_is_in_the_main_table() -> None:
    rows = tabulate([given("ttc", {Conditions(Mix(1)): (1, 0, 0)})])
    assert at_mixes(rows) == rows


def test_rows_are_ready_for_json() -> None:
    lines = [json.loads(json.dumps(row.to_json())) for row in tabulate(SOME_RESULTS)]
    ttc, oracle, over_all = lines[0], lines[3], lines[4]
    assert (oracle["method"], oracle["success"], oracle["seeds"], oracle["episodes"]) == ("oracle", 0.85, [0, 1], 10)
    assert oracle["published_percent"]["success"] == 90
    low, high = oracle["intervals"]["success"]
    assert 0.0 < low < 0.85 < high <= 1.0
    assert (ttc["published_percent"], ttc["success_sd"], ttc["p_conservative"]) == (None, None, 0.25)
    assert over_all["p_conservative"] == [0.1, 0.9]


def test_collisions_are_counted_over_all_seeds() -> None:
    lower, upper = Case("collision", 4.0, "aggressive", "lower"), Case("collision", 4.0, "conservative", "upper")
    evaluations = (Evaluation((lower, lower)), Evaluation((lower, upper)))
    row = Row("oracle", TRAINED, ALL_MIXES, AS_TRAINED, (0, 1), 1.0, evaluations)
    assert row.collisions == {"aggressive, lower": 3, "conservative, upper": 1}
