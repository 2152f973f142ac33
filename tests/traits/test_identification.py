"""Prediction, identification and correlation of drivers, on recordings in which the truth is known."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from tests.drivers.recordings import population, simulated_pair
from tint_sumo.config import TraitSettings
from tint_sumo.core.errors import InputError
from tint_sumo.core.progress import Progress
from tint_sumo.drivers import fitting
from tint_sumo.drivers.pairs import Pair
from tint_sumo.traits import TRAIT_METHODS
from tint_sumo.traits import identification as module
from tint_sumo.traits.cross_window import CrossWindow
from tint_sumo.traits.identification import (
    CONSTANT,
    FITTED,
    ICC,
    LATENTS,
    OTHER,
    PREDICTION,
    PREDICTORS,
    RANK_ONE,
    SAME,
    WITHOUT,
    Measure,
    identify,
    report_text,
)

REAL = Path(__file__).parents[3] / "shared" / "real" / "car_following"
DRIVERS = 6


@pytest.fixture(scope="module")
def pairs() -> list[Pair]:
    """Two encounters of each driver, who keep their parameters and differ much."""
    parameters = population(DRIVERS, 2, spread=0.5)
    return [
        simulated_pair(z, 2 * driver + number, 201, follower=str(driver))
        for driver, z in enumerate(parameters)
        for number in range(2)
    ]


@pytest.fixture(scope="module")
def measures(pairs: list[Pair], small: TraitSettings) -> dict[tuple[str, str, str], Measure]:
    model = TRAIT_METHODS["cross_window"](small).eval()
    assert isinstance(model, CrossWindow)
    reports: list[Progress] = []
    seen: list[set[str]] = []

    def model_of(fold: int, _population: object, others: object) -> CrossWindow:
        seen.append({pair.driver for pair in others})
        return model

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(module, "_FOLDS", 2)
        patch.setattr(module, "_RESAMPLES", 200)
        patch.setattr(fitting, "_STARTS", 1)
        found = identify(pairs, model_of, reports.append)
    assert [(one.done, one.total) for one in reports] == [(number, 2) for number in range(3)]
    assert sum(DRIVERS - len(drivers) for drivers in seen) == DRIVERS  # each is left out once
    assert len(report_text(found).splitlines()) > len(found)
    return {(one.group, one.situation, one.name): one for one in found}


def test_drivers_that_keep_their_parameters_are_known_by_them(measures: dict[tuple[str, str, str], Measure]) -> None:
    for situation in (SAME, OTHER):
        assert measures[RANK_ONE, situation, FITTED].value > 0.8
        assert measures[RANK_ONE, situation, module.CHANCE].value == pytest.approx(1 / DRIVERS)
    assert measures[RANK_ONE, OTHER, FITTED].count == 2 * DRIVERS
    assert measures[ICC, OTHER, FITTED].value > 0.8


def test_they_are_predicted_best_by_them(measures: dict[tuple[str, str, str], Measure]) -> None:
    for situation in (SAME, OTHER):
        likely = {name: measures[PREDICTION, situation, name].value for name in PREDICTORS}
        assert likely[module.POSTERIOR] > likely[module.POPULATION] > likely[CONSTANT]
        gained = measures[f"{PREDICTION} gained", situation, WITHOUT]
        assert gained.value == pytest.approx(likely[module.WITH] - likely[WITHOUT], abs=1e-9)


def test_intervals_hold_their_values(measures: dict[tuple[str, str, str], Measure]) -> None:
    for key, one in measures.items():
        assert one.low <= one.value + 1e-9, key
        if one.group not in (ICC, module.ICC_LESS_SPEED):
            assert one.value <= one.high + 1e-9, key
    assert (ICC, OTHER, LATENTS) in measures


def test_correlation_is_that_of_the_analysis_of_variance() -> None:
    rng = np.random.default_rng(0)
    drivers = [rng.normal(0.0, 2.0) + rng.normal(0.0, 1.0, (rng.integers(2, 6), 1)) for _ in range(2000)]
    assert module._of_drivers([drivers[:900], [part + 50.0 for part in drivers[900:]]]) == pytest.approx(0.8, abs=0.02)
    alone = [part[:1] for part in drivers]
    assert np.isnan(module._of_drivers([alone]))


def test_likelihoods_take_their_scale_from_the_other_drivers() -> None:
    errors_m = np.array([1.0, -1.0, 3.0, -5.0])
    driver = np.array(["a", "a", "b", "b"])
    scale_m = np.array([4.0, 4.0, 1.0, 1.0])
    expected = np.log(np.exp(-np.abs(errors_m) / scale_m) / (2.0 * scale_m))
    np.testing.assert_allclose(module._likelihoods(errors_m, driver), expected)


def test_a_single_long_encounter_is_not_halved_for_want_of_others(
    pairs: list[Pair], small: TraitSettings, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(module, "_FOLDS", 2)
    monkeypatch.setattr(module, "_RESAMPLES", 100)
    monkeypatch.setattr(fitting, "_STARTS", 1)
    model = TRAIT_METHODS["cross_window"](small).eval()
    assert isinstance(model, CrossWindow)
    shorter = [module._cut(pair, 0, 111) for pair in pairs[1:]]
    found = identify([pairs[0], *shorter], lambda *_: model)
    assert {one.situation for one in found} == {OTHER}
    assert all(np.isfinite([one.value, one.low, one.high]).all() for one in found)


def test_a_fold_is_measured_by_a_model_that_has_learnt_from_the_other_drivers_alone(
    pairs: list[Pair], small: TraitSettings, monkeypatch: pytest.MonkeyPatch
) -> None:
    followed: list[Pair] = []

    def drawn(_model: object, _population: object, others: list[Pair], *_: object, **__: object) -> list[Pair]:
        followed.extend(others)
        return others

    monkeypatch.setattr(module, "_FOLDS", 2)
    monkeypatch.setattr(module, "_RESAMPLES", 100)
    monkeypatch.setattr(module, "_LEARNING", small)
    monkeypatch.setattr(fitting, "_STARTS", 1)
    monkeypatch.setattr(module, "drawn_pairs", drawn)
    found = identify(pairs)
    assert (RANK_ONE, OTHER, LATENTS) in {(one.group, one.situation, one.name) for one in found}
    assert sorted(pair.name for pair in followed) == sorted(pair.name for pair in pairs)  # each in the other fold alone


def test_too_few_drivers_are_refused(pairs: list[Pair]) -> None:
    def nobody(*_: object) -> CrossWindow:
        raise AssertionError

    with pytest.raises(InputError, match=r"0 of 6 drivers follow several leaders for 10 s; two such drivers of 5"):
        identify(pairs[::2], nobody)
    with pytest.raises(InputError, match=r"0 of 0 drivers"):
        identify([replace(pair, leader="") for pair in pairs], nobody)
