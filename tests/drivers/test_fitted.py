"""The run of a fit goes on where it was interrupted, and its file is read back."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest

from tests.drivers.conftest import KnownFit
from tint_sumo.core.errors import InputError
from tint_sumo.core.files import write_text
from tint_sumo.core.progress import Progress
from tint_sumo.drivers import fitted as module
from tint_sumo.drivers.fitted import FITTED_FILE, fit_drivers, read_fitted, report_text
from tint_sumo.drivers.fitting import Estimate, fit_pair
from tint_sumo.drivers.models import MODELS, CarFollowing
from tint_sumo.drivers.pairs import Pair


def test_the_file_is_read_back(known: KnownFit) -> None:
    assert read_fitted(known.out) == read_fitted(known.out / FITTED_FILE) == known.fitted
    assert sorted(file.name for file in known.out.iterdir() if file.name[0] != ".") == [
        "drivers.csv",
        FITTED_FILE,
        "pairs.csv",
        "run.json",
    ]


@pytest.mark.parametrize("stop_at", [3, 7, 11])
def test_an_interrupted_fit_goes_on_to_the_same_result(
    known: KnownFit, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, stop_at: int
) -> None:
    """It is interrupted in the fits of pairs, in the first and in a later iteration of the population."""
    monkeypatch.setattr(module, "_KEEP_EVERY_S", 0.0)
    pairs = known.pairs[:4]
    reports = 0

    def interrupt(progress: Progress) -> None:
        nonlocal reports
        reports += 1
        if reports == stop_at:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        fit_drivers(pairs, MODELS["IDM"], tmp_path / "broken", interrupt)
    assert not (tmp_path / "broken" / FITTED_FILE).exists()
    gone_on = fit_drivers(pairs, MODELS["IDM"], tmp_path / "broken")
    assert gone_on == fit_drivers(pairs, MODELS["IDM"], tmp_path / "whole")


def test_a_fit_that_goes_on_does_not_begin_anew(
    known: KnownFit, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    fitted: list[str] = []

    def fit_or_stop(model: CarFollowing, pair: Pair) -> Estimate:
        fitted.append(pair.name)
        if len(fitted) == 3:
            raise KeyboardInterrupt
        return fit_pair(model, pair)

    monkeypatch.setattr(module, "_KEEP_EVERY_S", 0.0)
    monkeypatch.setattr(module, "fit_pair", fit_or_stop)
    with pytest.raises(KeyboardInterrupt):
        fit_drivers(known.pairs[:4], MODELS["IDM"], tmp_path)
    fit_drivers(known.pairs[:4], MODELS["IDM"], tmp_path)
    assert fitted == [known.pairs[number].name for number in (0, 1, 2, 2, 3)]


def test_a_folder_of_another_fit_is_refused(known: KnownFit) -> None:
    with pytest.raises(InputError, match=r"holds another run \(different: recording\)"):
        fit_drivers(known.pairs[:2], MODELS["IDM"], known.out)
    with pytest.raises(InputError, match=r"holds another run \(different: model\)"):
        fit_drivers(known.pairs, MODELS["Krauss"], known.out)


def test_an_unfinished_fit_is_not_read(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"has no fitted\.json; fit drivers first"):
        read_fitted(tmp_path)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda content: content.update(model="Wiedemann"), "unknown car-following model 'Wiedemann'"),
        (lambda content: content.update(parameters=["tau_s"]), "parameters must be desired_speed_mps"),
        (lambda content: content.update(drivers=[]), "must not be empty"),
        (lambda content: content["population"].update(within=[[1.0] * 5] * 5), "positive definite"),
        (lambda content: content["population"].update(between=[[1.0]]), "5 lists of 5 numbers"),
        (lambda content: content["pairs"][0]["fit"].update(log_parameters=[1.0]), "must have 5 numbers"),
        (lambda content: content.pop("step_s"), "step_s must be given"),
    ],
)
def test_damaged_files_are_refused(known: KnownFit, tmp_path: Path, change: Any, message: str) -> None:
    content = json.loads((known.out / FITTED_FILE).read_text())
    change(content)
    write_text(tmp_path / FITTED_FILE, json.dumps(content))
    with pytest.raises(InputError, match=message):
        read_fitted(tmp_path)


def test_the_tables_have_every_parameter_with_its_interval(known: KnownFit) -> None:
    drivers, pairs = (pd.read_csv(known.out / name) for name in ("drivers.csv", "pairs.csv"))
    assert drivers["driver"].tolist() == [driver.name for driver in known.fitted.drivers]
    assert pairs["pair"].tolist() == [pair.name for pair in known.pairs]
    for table in (drivers, pairs):
        for parameter in known.fitted.car_following.parameters:
            low, value, high = (table[f"{parameter.name}{end}"] for end in ("_low", "", "_high"))
            assert ((low <= value) & (value <= high)).all()
        truth = np.exp([known.log_parameters[name][1] for name in table["driver"]])
        np.testing.assert_allclose(table["tau_s"], truth, rtol=0.15)
    assert (pairs["gap_rmse_m"] < pairs["sumo_gap_rmse_m"]).all()


def test_the_report_names_all_parameters(known: KnownFit) -> None:
    text = report_text(known.fitted)
    assert "IDM: 12 pairs of 6 drivers, 479 s" in text
    for parameter in known.fitted.car_following.parameters:
        assert parameter.title in text
