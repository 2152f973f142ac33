"""The comparison of trait models between scenes, in small."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest

from tint_sumo.comparisons.scenes import SceneStudy, plan, report_markdown, run_scene_study
from tint_sumo.config import TraitSettings
from tint_sumo.core.errors import InputError
from tint_sumo.dataset.recorder import record
from tint_sumo.dataset.windows import joined, load_windows
from tint_sumo.traits.datasets import evaluate_traits, train_traits

SMALL = TraitSettings(embedding_sizes=(), hidden_size=8, encoder_output_size=8, decoder_output_size=8, epochs=1)
STUDY = SceneStudy(
    windows=800,
    methods=("classifier",),
    settings=replace(SMALL, learning_rate=1e-2, batch_size=128, epochs=6),
    seeds=(0, 1),
    scenes=("t_intersection", "on_ramp"),
)


def test_models_are_trained_on_one_scene_and_on_all_and_tested_in_each(tmp_path: Path) -> None:
    table = run_scene_study(STUDY, tmp_path, workers=1, progress=False)
    assert table.groupby(["trained_on", "seed"])["scene"].apply(list).map(tuple).unique().tolist() == [STUDY.scenes]
    assert set(table["trained_on"]) == {"t_intersection", "all"}
    assert table["accuracy"].min() > 0.7
    assert table["speed_r2"].between(-1.0, 1.0).all()
    assert all(job.is_done() for job in plan(STUDY, tmp_path))
    markdown = (tmp_path / "scenes.md").read_text()
    assert markdown == report_markdown(table)
    assert "| classifier | t_intersection |" in markdown
    finished = {file: file.stat().st_mtime_ns for file in (tmp_path / "results").iterdir()}
    again = run_scene_study(STUDY, tmp_path, workers=1, progress=False)
    assert again.equals(table)
    assert finished == {file: file.stat().st_mtime_ns for file in (tmp_path / "results").iterdir()}


@pytest.mark.parametrize(
    ("wrong", "message"),
    [
        ({"methods": ("magic",)}, "unknown trait method 'magic'"),
        ({"scenes": ("t_intersection", "moon")}, "unknown scene 'moon'"),
        ({"scenes": ("roundabout", "on_ramp")}, "scenes must be t_intersection, .* and at least one other"),
        ({"scenes": ("t_intersection",)}, "scenes must be t_intersection, .* and at least one other"),
        ({"seeds": (1, 1)}, "seeds must be one or more, each of them once"),
    ],
)
def test_settings_that_cannot_be_compared_are_refused(wrong: dict[str, Any], message: str) -> None:
    with pytest.raises(InputError, match=message):
        replace(STUDY, **wrong)


def test_a_single_seed_has_no_spread() -> None:
    row = {"method": "vae", "trained_on": "all", "scene": "on_ramp", "seed": 0, "accuracy": 0.9, "speed_r2": 0.5}
    one, two = (report_markdown(pd.DataFrame([row, {**row, "seed": 1, "accuracy": 0.8}][:seeds])) for seeds in (1, 2))
    assert "| 90.00 " in one and "| 0.50 " in one and "±" not in one
    assert "| 85.00 ± 7.07 |" in two


@pytest.fixture(scope="module")
def recordings(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    folder = tmp_path_factory.mktemp("scenes")
    for scene in ("t_intersection", "roundabout"):
        record(folder / scene, 600, scene=scene, progress=False)
    return {scene: folder / scene for scene in ("t_intersection", "roundabout")}


def test_a_model_of_another_scene_is_refused_unless_it_is_asked_for(
    recordings: dict[str, Path], tmp_path: Path
) -> None:
    train_traits(recordings["roundabout"], tmp_path / "model", method="vae", settings=SMALL)
    model = tmp_path / "model"
    assert evaluate_traits(recordings["roundabout"], model)["windows"] > 0
    with pytest.raises(
        InputError, match=r"was trained in scene roundabout, .* is of scene t_intersection; give `other_scene`"
    ):
        evaluate_traits(recordings["t_intersection"], model)
    assert evaluate_traits(recordings["t_intersection"], model, other_scene=True)["windows"] > 0


def test_joined_windows_keep_drivers_and_episodes_apart(recordings: dict[str, Path]) -> None:
    parts = [load_windows(data) for data in recordings.values()]
    both = joined(parts)
    assert len(both) == sum(map(len, parts))
    assert len(np.unique(both.driver)) == sum(len(np.unique(part.driver)) for part in parts)
    assert len(np.unique(both.episode)) == sum(len(np.unique(part.episode)) for part in parts)
    np.testing.assert_array_equal(both.states[: len(parts[0])], parts[0].states)
