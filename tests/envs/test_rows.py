"""Rows written after a step that is made by hand."""

import math
from collections.abc import Callable
from dataclasses import replace
from itertools import product
from typing import Any

import numpy as np
import pytest

from tests.scenes.networks import UserNetwork
from tint_sumo.config import REWARD_PRESETS
from tint_sumo.envs.rows import (
    BUILT_IN_OUTCOMES,
    TRACKS,
    TRUTH,
    Contents,
    Scales,
    TaskRules,
    add_up,
    copied,
    end_info,
    fields_of,
    full_info,
    judge,
    observation_of,
    observe,
    observe_tracks,
    outcome_name,
    outcome_names,
    reveal,
    row_type,
    start_info,
    step_info,
)
from tint_sumo.scenes import find_scene
from tint_sumo.scenes.drivers import NO_TOWN
from tint_sumo.scenes.geometry import BOX, Numbers

RULES = TaskRules(goal_m=30.0, step_limit=100, goal=2.5, collision=-2.0, speed_weight_per_mps=0.05, step=-0.25)
GOAL, BEYOND = 30.0, math.nextafter(30.0, math.inf)


def judged(
    front_m: float,
    collided: bool,
    steps: int,
    speed_mps: float = 2.0,
    *,
    ran_red: bool = False,
    lost: bool = False,
) -> tuple[np.ndarray, bool]:
    rows = np.zeros(1, row_type(2))
    rows["outcome"] = 3  # of an earlier episode
    ended = judge(
        np.array([front_m]),
        np.array([speed_mps]),
        np.array([collided]),
        np.array([ran_red]),
        np.array([lost]),
        np.array([steps]),
        RULES,
        rows,
    )
    return rows[0], ended


@pytest.mark.parametrize(
    ("front_m", "collided", "steps", "outcome"),
    [
        (GOAL, False, 99, ""),
        (BEYOND, False, 99, "success"),
        (BEYOND, False, 100, "success"),
        (GOAL, False, 100, "timeout"),
        (GOAL, False, 101, "timeout"),
        (GOAL, True, 99, "collision"),
        (GOAL, True, 100, "collision"),
        (BEYOND, True, 99, "collision"),  # in the very step in which it arrives
        (BEYOND, True, 100, "collision"),
    ],
)
def test_a_step_ends_in_a_collision_before_a_success_before_a_timeout(
    front_m: float, collided: bool, steps: int, outcome: str
) -> None:
    row, ended = judged(front_m, collided, steps)
    assert outcome_name(row["outcome"]) == outcome
    assert ended == bool(outcome)
    assert row["terminated"] == (outcome in ("success", "collision"))
    assert row["truncated"] == (outcome == "timeout")


@pytest.mark.parametrize("steps", [1, 100])
def test_an_ego_that_is_lost_has_neither_arrived_nor_run_out_of_time(steps: int) -> None:
    row, ended = judged(GOAL, False, steps, lost=True)
    assert ended
    assert outcome_name(row["outcome"]) == "lost"
    assert row["truncated"]
    assert not row["terminated"]
    assert (row["goal"], row["collision"], row["step"]) == (0.0, 0.0, RULES.step)


def test_driving_over_a_red_light_ends_an_episode_before_all_but_a_collision() -> None:
    for front_m, steps, lost in product((GOAL, BEYOND), (1, 100), (False, True)):
        row, ended = judged(front_m, False, steps, ran_red=True, lost=lost)
        assert ended
        assert outcome_name(row["outcome"]) == "red_light"
        assert row["terminated"] and not row["truncated"]
        assert row["reward"] == 0.0, "what it costs is a term of its own"
    assert outcome_name(judged(GOAL, True, 1, ran_red=True)[0]["outcome"]) == "collision"


@pytest.mark.parametrize(
    ("front_m", "collided", "steps", "terms"),
    [
        (0.0, False, 1, (0.0, 0.0, 0.1, -0.25)),
        (0.0, False, 100, (0.0, 0.0, 0.1, -0.25)),  # of a timeout as of any other step
        (BEYOND, False, 1, (2.5, 0.0, 0.0, 0.0)),
        (BEYOND, True, 1, (0.0, -2.0, 0.0, 0.0)),
    ],
)
def test_the_reward_is_the_sum_of_its_terms(front_m: float, collided: bool, steps: int, terms: Any) -> None:
    row, _ = judged(front_m, collided, steps)
    assert tuple(row[name] for name in ("goal", "collision", "speed", "step")) == pytest.approx(terms)
    assert row["reward"] == pytest.approx(sum(terms))


def test_rows_are_judged_one_by_one() -> None:
    cases = list(product((0.0, BEYOND), (False, True), (1, 100)))
    rows = np.zeros(len(cases), row_type(1))
    front_m, collided, steps = (np.array(part) for part in zip(*cases, strict=True))
    lost = np.zeros(len(cases), bool)
    assert judge(front_m, np.arange(len(cases), dtype=float), collided, lost, lost, steps, RULES, rows)
    for row, case, speed_mps in zip(rows, cases, range(len(cases)), strict=True):
        alone = judged(*case, speed_mps)[0]
        assert all(row[name] == alone[name] for name in ("outcome", "reward", "terminated", "truncated"))
    assert {outcome_name(row["outcome"]) for row in rows} == {"", *BUILT_IN_OUTCOMES}


def test_the_end_of_any_row_is_returned() -> None:
    for ended in ([False, False], [True, False], [False, True]):
        rows = np.zeros(2, row_type(1))
        still = np.zeros(2)
        sound, steps = np.zeros(2, bool), np.zeros(2, np.int64)
        assert judge(still, still, np.array(ended), sound, sound, steps, RULES, rows) == any(ended)
        assert judge(still, still, sound, sound, np.array(ended), steps, RULES, rows) == any(ended)
        assert judge(still, still, sound, np.array(ended), sound, steps, RULES, rows) == any(ended)


def boxes(*values: tuple[float, float, float, float]) -> np.ndarray:
    return np.array([(*value, 5.0, 2.0) for value in values], BOX)


def test_observations_are_scaled_and_bounded() -> None:
    rows = np.zeros(2, row_type(3))
    rows["vehicles"] = rows["mask"] = 9.0  # of an earlier step
    egos = boxes((2.0, -4.0, 0.6, 0.8), (100.0, -100.0, 0.0, -1.0))
    near, far, gone = (12.0, -14.0, 1.0, 0.0), (500.0, -500.0, 1.0, 0.0), (7.0, 7.0, 1.0, 0.0)
    vehicles = np.stack([boxes(near, far, gone), boxes(gone, gone, near)])
    present = np.array([[True, True, False], [False, False, True]])
    traits = np.array([[1, 0, -1], [-1, -1, 1]], np.int16)
    noise_m = np.zeros((2, 3, 2))
    noise_m[0, 0], noise_m[0, 2] = (1.0, -2.0), (5.0, 5.0)
    steps = np.array([7, 30])
    source = np.where(present, np.arange(3), -1)
    track = np.array([[4, 7, -1], [-1, -1, 2]])
    scales = Scales(20.0, 20.0, 3.0, 0.1)
    observe(egos, np.array([1.5, 30.0]), source, vehicles, traits, track, noise_m, steps, scales, rows)
    np.testing.assert_allclose(rows["ego"], [[0.1, -0.2, 0.3, 0.4], [2.0, -2.0, 0.0, -2.0]], atol=1e-7)
    np.testing.assert_allclose(rows["vehicles"][0], [[0.55, -0.6], [2.0, -2.0], [0.0, 0.0]], atol=1e-7)
    np.testing.assert_allclose(rows["vehicles"][1], [[0.0, 0.0], [0.0, 0.0], [-2.0, 2.0]], atol=1e-7)
    np.testing.assert_array_equal(rows["mask"], present.astype(float))
    np.testing.assert_array_equal(rows["traits"], traits)
    np.testing.assert_array_equal(rows["track"], track)
    np.testing.assert_array_equal(rows["slot"], source)
    np.testing.assert_allclose(rows["time_s"], [0.7, 3.0])


def test_slots_of_the_observation_show_the_vehicles_that_they_are_given() -> None:
    rows = np.zeros(1, row_type(3))
    egos, vehicles = (
        boxes((0.0, 0.0, 1.0, 0.0)),
        boxes((2.0, 0.0, 1.0, 0.0), (4.0, 0.0, 1.0, 0.0), (6.0, 0.0, 1.0, 0.0)),
    )
    noise_m = np.array([[[0.0, 0.0], [0.0, 1.0], [0.5, 0.0]]])
    traits, source = np.array([[0, 1, 0]], np.int16), np.array([[2, -1, 1]])
    scales = Scales(20.0, 20.0, 3.0, 0.1)
    track, steps = np.array([[5, -1, 3]]), np.array([1])
    observe(egos, np.zeros(1), source, vehicles[None], traits, track, noise_m, steps, scales, rows)
    np.testing.assert_allclose(rows["vehicles"][0] * 20.0, [[6.5, 0.0], [0.0, 0.0], [4.0, 1.0]], atol=1e-6)
    assert (rows["mask"].tolist(), rows["traits"].tolist()) == ([[1.0, 0.0, 1.0]], [[0, -1, 1]])
    reveal(egos, np.array([[True, True, False]]), vehicles[None], np.array([[0, 1, -1]], np.int16), scales, rows)
    np.testing.assert_allclose(rows["true_vehicles"][0] * 20.0, [[2.0, 0.0], [4.0, 0.0], [0.0, 0.0]], atol=1e-6)
    assert (rows["true_mask"].tolist(), rows["true_traits"].tolist()) == ([[1, 1, 0]], [[0, 1, -1]])


def test_tracks_are_seen_with_the_noise_along_the_way() -> None:
    rows = np.zeros(1, row_type(4))
    rows["position_m"] = rows["gap_m"] = 9.0
    west, north = (0.0, 0.0, -1.0, 0.0), (0.0, 0.0, 0.6, 0.8)
    vehicles = boxes(west, north, west, north)[None]
    present = np.array([[True, True, True, False]])
    noise_m = np.array([[[0.5, 9.0], [1.0, 2.0], [-0.25, 0.0], [4.0, 4.0]]])
    front_m, gap_m = np.array([[10.0, 20.0, 30.0, 40.0]]), np.array([[3.0, 4.0, 0.0, 0.0]])
    leader = np.array([[1, 0, -1, -1]])
    route, passed_m, stop_line_m = np.array([[0, 1, 1, 0]]), np.array([5.0, 6.0]), np.array([12.0, np.inf])

    def look(ego_front_m: float, source: Numbers) -> None:
        ego, claims = np.array([ego_front_m]), np.array([[False, True]])
        traffic = (source, route, vehicles, front_m, leader, gap_m, noise_m)
        observe_tracks(ego, claims, passed_m, stop_line_m, *traffic, rows)

    look(6.0, np.where(present, np.arange(4), -1))
    # Along their ways the noise is -0.5, 2.2, 0.25 and 5.6 m.
    np.testing.assert_allclose(rows["position_m"], [[9.5, 22.2, 30.25, 0.0]])
    np.testing.assert_allclose(rows["gap_m"], [[3.0 + 0.5 + 2.2, 4.0 - 2.2 - 0.5, np.inf, np.inf]])
    np.testing.assert_array_equal(rows["passed"], [[1, 0, 0, 0]])
    np.testing.assert_array_equal(rows["claimed"], [[0, 1, 1, 0]])
    np.testing.assert_allclose(rows["to_stop_m"], [[2.5, np.inf, np.inf, np.inf]])
    look(4.0, np.where(present, np.arange(4), -1))
    assert not rows["passed"].any()
    look(6.0, np.array([[-1, 2, 0, -1]]))
    np.testing.assert_allclose(rows["position_m"], [[0.0, 30.25, 9.5, 0.0]])
    np.testing.assert_allclose(rows["gap_m"], [[np.inf, np.inf, 5.7, np.inf]])
    np.testing.assert_array_equal(rows["passed"], [[0, 0, 1, 0]])
    np.testing.assert_array_equal(rows["claimed"], [[0, 1, 0, 0]])
    np.testing.assert_allclose(rows["to_stop_m"], [[np.inf, np.inf, 2.5, np.inf]])


def test_a_decision_s_rewards_are_summed_up_and_its_end_is_kept() -> None:
    names = ("goal", "collision", "speed", "step", "reward")
    before, rows = np.zeros(2, row_type(1)), np.zeros(2, row_type(1))
    for number, name in enumerate(names, start=1):
        before[name], rows[name] = number, 10.0 * number
    before["outcome"], before["time_s"], rows["time_s"] = [0, 3], 0.1, 0.2
    add_up(before, rows)
    assert [rows[name].tolist() for name in names] == [[11.0 * number, number] for number in range(1, 6)]
    assert rows["outcome"].tolist() == [0, 3] and rows["time_s"].tolist() == [0.2, 0.1]


def test_infos_of_a_row() -> None:
    rows = np.zeros(2, row_type(2))
    rows["outcome"], rows["time_s"], rows["traits"], rows["goal"] = [0, 1], 0.3, [[1, -1], [0, 0]], 2.5
    rows["town"] = NO_TOWN
    going_on, over = map(fields_of, rows)
    assert set(observation_of(going_on, Contents())) == {"ego", "vehicles", "mask"}
    begun = start_info(going_on, Contents(slot_infos=("traits", "passed")))
    assert begun["traits"].tolist() == [1, -1] and begun["passed"].tolist() == [0, 0]
    assert {name: begun[name] for name in ("outcome", "time_s")} == {"outcome": "", "time_s": 0.3}
    assert set(begun) == {"traits", "passed", "outcome", "time_s"}
    begun["traits"][:] = 5
    assert rows["traits"][0].tolist() == [1, -1], "an info keeps its values"
    terms = {"goal": 2.5, "collision": 0.0, "speed": 0.0, "step": 0.0}
    assert set(step_info(going_on, Contents(), {})) == {
        "traits",
        "outcome",
        "time_s",
        "reward_terms",
        "is_success",
    }
    info = step_info(over, Contents(slot_infos=()), {"trait": "aggressive"})
    assert info.pop("reward_terms") == terms
    assert info == {"outcome": "success", "time_s": 0.3, "is_success": True, "collision": {"trait": "aggressive"}}
    assert end_info("timeout", {}) == {"is_success": False}
    assert outcome_names(np.array([0, 3, 2, 1])).tolist() == ["", "collision", "timeout", "success"]
    copies = copied(rows)
    assert set(copies) == set(rows.dtype.names or ()) and copies["goal"].tolist() == [2.5, 2.5]
    assert set(copied(rows)) - set(copied(rows, ("traits", "passed"))) == {*TRACKS, *TRUTH} - {"passed"}
    copies["goal"][:] = 0.0
    assert rows["goal"].tolist() == [2.5, 2.5]


def test_rules_are_those_of_the_scene_and_of_the_preset() -> None:
    scene, preset = find_scene("four_way"), REWARD_PRESETS["authors"]
    assert TaskRules.of(scene, preset) == TaskRules(34.0, 500, 2.5, -2.0, 0.05 / 3.0, -0.013)
    assert TaskRules.of(replace(scene, time_limit_s=0.3), preset).step_limit == 3
    assert TaskRules.of(replace(scene, time_limit_s=3.0, step_s=0.2), preset).step_limit == 15


def test_the_way_in_a_sumo_configuration_is_worth_as_much_whatever_its_length_and_the_step(
    user_network: Callable[[str], UserNetwork],
) -> None:
    preset, paper = REWARD_PRESETS["paper"], find_scene("t_intersection")
    whole = (paper.ego.goal_m - paper.ego.start_m) * 0.05 / 0.1
    for name, step_s in (("merge", 0.1), ("grid", 1.0), ("autobahn", 0.5)):
        scene = user_network(name).scene()
        rules = TaskRules.of(scene, preset)
        assert rules.speed_weight_per_mps / step_s * (scene.goal_m - scene.start_m) == pytest.approx(whole, rel=1e-3)
        assert rules.step / step_s == pytest.approx(-0.0013 / 0.1)
        assert (rules.goal, rules.collision) == (2.5, -2.0)


@pytest.mark.parametrize("contents", [Contents(), Contents(step_infos=("cost",), terms=("goal", "red_light"))])
def test_a_full_info_has_the_same_keys_in_every_step(contents: Contents) -> None:
    rows = np.zeros((), row_type(3, [("cost", np.float64, ()), ("red_light", np.float64, ())]))
    rows["town"] = NO_TOWN
    fields = fields_of(rows)
    begun, going_on = start_info(fields, contents), step_info(fields, contents, {})
    hit = {"trait": "aggressive", "route": "lower", "slot": 2, "ego_m": (1.0, 2.0)}
    ended = step_info({**fields, "outcome": 3}, contents, hit)
    full = [full_info(info, contents) for info in (begun, going_on, ended)]
    assert {tuple(sorted(info)) for info in full} == {tuple(sorted(full[0]))}
    assert {tuple(info["reward_terms"]) for info in full} == {contents.terms}
    assert {tuple(info["collision"]) for info in full} == {tuple(hit)}
    assert full[2]["collision"] == hit and full[0]["collision"]["trait"] == ""
    assert [info["is_success"] for info in full] == [False, False, False]
    assert [name for name in ("cost",) if name in full[0]] == list(contents.step_infos)
