"""The comparison of trait methods, small but real: simulations, trainings in worker processes, tables."""

import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from tint_sumo.comparisons.traits import CompareJob, TraitStudy, run_trait_study
from tint_sumo.comparisons.traits_report import aggregate, to_markdown, write_trait_report
from tint_sumo.config import TraitSettings
from tint_sumo.core.errors import InputError
from tint_sumo.core.files import read_json
from tint_sumo.study.folders import RESULTS

SMALL = TraitStudy(
    windows=100,
    settings=TraitSettings((), hidden_size=8, encoder_output_size=8, decoder_output_size=8, batch_size=64, epochs=1),
    methods=("cross_window", "classifier"),
    noises_m=(0.0, 0.1),
    seeds=(0, 1),
    other_p=(0.25,),
    other_windows=100,
    continuous_windows=100,
    continuous_methods=("cross_window",),
    continuous_latents=(3,),
    continuous_epochs=1,
)


@pytest.fixture(scope="module")
def finished(tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("traits") / "study"
    run_trait_study(SMALL, out, progress=False)
    return out


@pytest.mark.slow
def test_every_method_is_measured_at_every_noise(finished: Path) -> None:
    table = pd.read_csv(finished / "traits.csv")
    cells = list(zip(table["method"], table["noise_m"], strict=True))
    assert cells == [(method, noise) for method in ("classifier", "cross_window") for noise in (0.0, 0.1)]
    assert (table["seeds"] == 2).all()
    measures = ["svc_percent", "knn_percent", "svc_20_percent", "svc_without_leader_percent", "svc_P0.25_percent"]
    assert table[measures].stack().between(0.0, 100.0).all()
    assert table["error_m"].isna().tolist() == [True, True, False, False]
    seeds = pd.read_csv(finished / "traits_seeds.csv")
    mean = seeds.groupby(["method", "noise_m"])["svc_percent"].mean().to_numpy()
    np.testing.assert_allclose(table["svc_percent"], mean)
    continuous = pd.read_csv(finished / "traits_continuous.csv")
    assert continuous["latent_size"].tolist() == [3, 3]
    assert (continuous[["r2_desired_speed_mps", "r2_min_gap_m"]] <= 1.0).all(axis=None)
    assert (finished / "traits.png").read_bytes().startswith(b"\x89PNG")
    assert "| cross_window" in (finished / "traits.md").read_text()
    card = read_json(finished / "models" / "cross_window-noise0.1-seed1" / "model.json", "card")
    assert card["settings"]["noise_m"] == 0.1
    assert 0.0 <= card["accuracy"] <= 1.0


@pytest.mark.slow
def test_a_finished_part_is_not_repeated_and_a_missing_one_is_made_again(finished: Path) -> None:
    lost = finished / RESULTS / "cross_window-noise0.1-seed0.json"
    found = read_json(lost, "result")
    kept = {file: file.stat().st_mtime_ns for file in (finished / RESULTS).iterdir() if file != lost}
    lost.unlink()
    run_trait_study(SMALL, finished, progress=False)
    assert {file: file.stat().st_mtime_ns for file in kept} == kept
    again = read_json(lost, "result")
    assert again == {**found, "training_s": None}  # the model was there already


@pytest.mark.slow
def test_another_study_leaves_the_folder_alone(finished: Path) -> None:
    with pytest.raises(InputError, match="already holds another run"):
        run_trait_study(replace(SMALL, seeds=(0,)), finished, progress=False)


def test_bad_studies_are_refused_before_anything_is_written(tmp_path: Path) -> None:
    for wrong, message in (
        ({"methods": ("magic",)}, "unknown trait method 'magic'"),
        ({"continuous_methods": ("magic",)}, "unknown trait method 'magic'"),
        ({"seeds": (0, 0)}, "seeds must be one or more, each of them once"),
        ({"other_p": (0.4, 0.4)}, "other_p must be one or more, each of them once"),
        ({"p_conservative": 0.4, "other_p": (0.25, 0.4)}, "other_p has the mix of the training data, 0.4,"),
    ):
        with pytest.raises(InputError, match=message):
            replace(SMALL, **wrong)
    with pytest.raises(InputError, match="workers must lie in 1 to 1,024"):
        run_trait_study(SMALL, tmp_path / "out", workers=0)
    with pytest.raises(InputError, match="no results in"):
        write_trait_report(tmp_path)
    assert not (tmp_path / "out").exists()


def test_a_job_is_done_with_its_last_noise(tmp_path: Path) -> None:
    job = CompareJob(SMALL, "vae", 0, tmp_path)
    (tmp_path / RESULTS).mkdir()
    (tmp_path / RESULTS / "vae-noise0-seed0.json").write_text("{}")
    assert not job.is_done()
    (tmp_path / RESULTS / "vae-noise0.1-seed0.json").write_text("{}")
    assert job.is_done()


def test_means_and_spreads_are_over_the_seeds() -> None:
    row = {"method": "vae", "noise_m": 0.0, "windows": 10, "training_windows": 20, "error_m": None, "training_s": None}
    parts = {f"svc_{part}_percent": 90.0 for part in ("2_to_5", "6_to_10", "11_to_19", "20")}
    parts |= {"svc_with_leader_percent": 90.0, "svc_without_leader_percent": math.nan, "svc_P0.4_percent": 80.0}
    rows = [
        {**row, **parts, "seed": seed, "svc_percent": value, "knn_percent": 99.0}
        for seed, value in enumerate((90.0, 92.0, 94.0))
    ]
    table = aggregate(pd.DataFrame(rows))
    assert table["svc_percent"].tolist() == [92.0]
    assert table["svc_percent_sd"].tolist() == [2.0]
    text = to_markdown(table, pd.DataFrame())
    assert "92.000 ± 2.000" in text
    assert "3 training seeds; 20 training and 10 test windows" in text
