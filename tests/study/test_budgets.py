import json
from dataclasses import replace

import pytest

from tint_sumo import traits
from tint_sumo.config import (
    ALL_MIXES,
    HELD_OUT_WORLDS,
    P_CONSERVATIVE,
    PERFECT,
    POPULATIONS,
    SENSORS,
    TRAINING_SENSORS,
    TRAIT_BUDGETS,
    Idm,
    Mix,
    PpoSettings,
    TraitSettings,
)
from tint_sumo.core.errors import InputError
from tint_sumo.core.structures import plain
from tint_sumo.envs import TaskSettings
from tint_sumo.methods.registry import Learned, find_method
from tint_sumo.methods.training import SNAPSHOTS_PERCENT
from tint_sumo.scenes import find_scene
from tint_sumo.study.budgets import BUDGETS, Conditions, Trials


@pytest.mark.parametrize("name", BUDGETS)
def test_every_budget_can_be_run(name: str) -> None:
    budget = BUDGETS[name]
    assert any(isinstance(find_method(method), Learned) for method in budget.methods)
    assert len(set(budget.methods)) == len(budget.methods)
    assert budget.ppo.n_minibatches <= budget.ppo.n_envs
    assert (budget.traits is None) == (budget.windows == 0), "windows are recorded for trait models alone"
    assert json.loads(json.dumps(plain(budget)))["seeds"] == list(budget.seeds)


@pytest.mark.parametrize("name", BUDGETS)
def test_every_policy_is_tested_somewhere_after_a_part_of_the_training_that_is_kept(name: str) -> None:
    budget = BUDGETS[name]
    conditions = [one for trials in budget.trials for one in trials.conditions]
    assert len(set(conditions)) == len(conditions)
    assert {one.percent for one in conditions} <= {100, *SNAPSHOTS_PERCENT}
    for mix in budget.mixes:
        assert any(mix.contains(one.p_conservative) for one in conditions)


@pytest.mark.parametrize("name", BUDGETS)
def test_what_shares_a_training_comes_with_it(name: str) -> None:
    methods = BUDGETS[name].methods
    learned = [method for method in map(find_method, methods) if isinstance(method, Learned)]
    assert all(method.trained_as in (None, *methods) for method in learned)


def test_the_paper_s_budget_is_the_paper_s() -> None:
    paper = BUDGETS["paper"]
    assert paper.ppo == PpoSettings()
    assert paper.traits == TraitSettings()
    assert (paper.mixes, len(paper.seeds), paper.windows) == (tuple(map(Mix, P_CONSERVATIVE)), 3, 696_000)
    assert [(trials.conditions, trials.episodes) for trials in paper.trials] == [
        (tuple(Conditions(Mix(p)) for p in (0.25, 0.4, 0.6)), 500)
    ]


def test_the_full_budget_compares_all_methods_with_four_seeds_in_other_conditions_too() -> None:
    full = BUDGETS["full"]
    assert len(full.seeds) == 4 and full.mixes == (ALL_MIXES,)
    trained = [method for method in map(find_method, full.methods) if isinstance(method, Learned)]
    assert {method.encoder for method in trained} - {None} == set(traits.TRAIT_METHODS)
    conditions = {one for trials in full.trials for one in trials.conditions}
    assert {one.position_noise_m for one in conditions} > {0.0, 0.1}
    headways_s = [one.tau_s for one in conditions if one.tau_s is not None]
    assert min(headways_s) < Idm.tau_s < max(headways_s)
    assert {one.percent for one in conditions} == {25, 50, 100}


def test_trait_budgets_are_networks_of_one_kind() -> None:
    assert set(TRAIT_BUDGETS) <= set(BUDGETS)
    assert TRAIT_BUDGETS["quick"].hidden_size == TRAIT_BUDGETS["full"].hidden_size


@pytest.mark.parametrize(
    ("conditions", "label"),
    [
        (Conditions(Mix(0.4)), "as trained"),
        (Conditions(ALL_MIXES), "as trained"),
        (Conditions(Mix(0.4), position_noise_m=0.05), "noise 0.05 m"),
        (Conditions(Mix(0.4), tau_s=1.5), "headway 1.5 s"),
        (Conditions(Mix(0.4), tau_s=Idm.tau_s), "headway 1 s"),
        (Conditions(Mix(0.4), percent=25), "25 % of training"),
        (Conditions(ALL_MIXES, percent=50, world="range_15"), "range 15 m, 50 % of training"),
        (Conditions(Mix(0.4), 0.1, 0.7, 50), "noise 0.1 m, headway 0.7 s, 50 % of training"),
    ],
)
def test_conditions_are_called_by_what_differs_from_the_training(conditions: Conditions, label: str) -> None:
    assert conditions.label == label


def test_a_headway_that_is_not_given_is_the_scene_s() -> None:
    own, given = Conditions(Mix(0.4)), Conditions(Mix(0.4), tau_s=Idm.tau_s)
    scene = find_scene("t_intersection")
    assert own.task(scene) == TaskSettings(p_conservative=0.4)
    assert given.task(scene) == TaskSettings(p_conservative=0.4, tau_s=Idm.tau_s)
    assert own.resolved(1.5).tau_s == 1.5
    assert given.resolved(1.5) == given.relative_to(1.5) == given
    assert given.relative_to(Idm.tau_s) == own.relative_to(Idm.tau_s) == own


def test_conditions_are_the_same_with_whole_numbers_as_with_floats() -> None:
    whole, floats = Conditions(Mix(0, 1), 2, 3), Conditions(Mix(0.0, 1.0), 2.0, 3.0)
    assert whole == floats and repr(whole) == repr(floats)
    assert Conditions(Mix(1)).is_single_mix and not Conditions(Mix(0, 1)).is_single_mix


def test_strangers_are_driven_among_in_worlds_that_no_training_has_met() -> None:
    budget = BUDGETS["strangers"]
    scene = find_scene("t_intersection")
    assert budget.trained_in(scene).population == POPULATIONS["towns"]
    assert budget.sensors == TRAINING_SENSORS and budget.ppo.motion
    worlds = [one.world for trials in budget.trials for one in trials.conditions]
    assert set(worlds) == {"old", "towns", *HELD_OUT_WORLDS}
    assert BUDGETS["full"].trained_in(scene) == scene and BUDGETS["full"].sensors == (PERFECT,)


def test_a_world_is_the_drivers_and_the_sensor_of_a_test() -> None:
    scene = find_scene("t_intersection")
    slow, near = (Conditions(ALL_MIXES, world=name).task(scene) for name in ("headway_1.5", "range_15"))
    assert (slow.played.tau_s, slow.sensor) == (1.5, PERFECT)
    assert (near.played.tau_s, near.sensor) == (Idm.tau_s, SENSORS["range_15"])
    elsewhere = Conditions(Mix(0.4), world="old")
    assert elsewhere.resolved(1.5) == elsewhere and not elsewhere.is_single_mix
    for unfit, words in (
        ({"world": "mars"}, "mars"),
        ({"world": "strangers"}, "are for training"),
        ({"world": "old", "tau_s": 1.5}, "leave position_noise_m and tau_s out"),
        ({"world": "old", "position_noise_m": 0.1}, "leave position_noise_m and tau_s out"),
    ):
        with pytest.raises(InputError, match=words):
            Conditions(ALL_MIXES, **unfit)  # type: ignore[arg-type]
    with pytest.raises(InputError, match="mars"):
        replace(BUDGETS["full"], world="mars")


def test_a_budget_without_tests_is_refused() -> None:
    with pytest.raises(InputError, match="trials must be one or more"):
        replace(BUDGETS["quick"], trials=())
    with pytest.raises(InputError, match="conditions must be one or more"):
        Trials((), 100)
