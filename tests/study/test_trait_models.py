from pathlib import Path
from typing import Any

import numpy as np
import pytest

from tint_sumo.config import VaeSettings
from tint_sumo.dataset.recorder import record
from tint_sumo.dataset.windows import Windows, load_labels, load_windows, split_by_episode
from tint_sumo.errors import InputError
from tint_sumo.study import trait_models
from tint_sumo.study.trait_models import evaluate_traits, train_traits
from tint_sumo.traits.evaluation import TEST_FRACTION

SMALL = VaeSettings(
    embedding_sizes=(8, 8), hidden_size=8, encoder_output_size=8, decoder_output_size=8, batch_size=64, epochs=1
)
SEED = 3


@pytest.fixture(scope="module")
def dataset(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("data") / "dataset"
    record(folder, 100, workers=2, progress=False)  # in other processes: this one's libsumo stays free
    return folder


@pytest.fixture(scope="module")
def model(dataset: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("model") / "run"
    train_traits(dataset, folder, settings=SMALL, seed=SEED, progress=False)
    return folder


def test_training_sees_the_training_episodes_only(
    dataset: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    seen: list[Windows] = []
    original = trait_models.train

    def train(windows: Windows, *args: Any, **kwargs: Any) -> Any:
        seen.append(windows)
        return original(windows, *args, **kwargs)

    monkeypatch.setattr(trait_models, "train", train)
    card = train_traits(dataset, tmp_path / "run", settings=SMALL, seed=SEED, progress=False)
    windows = load_windows(dataset)
    _, test = split_by_episode(windows, TEST_FRACTION, SEED)
    assert set(seen[0].episode).isdisjoint(windows.episode[test])
    assert card["windows"] == len(seen[0]) == len(windows) - len(test)
    assert card["data"] == {"p_conservative": 0.5, "seed": 0, "windows": len(windows)}


def test_evaluation_takes_the_episodes_left_out_by_the_model_s_seed(
    dataset: Path, model: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    drawn: list[np.ndarray] = []
    monkeypatch.setattr(trait_models, "plot_latents", lambda _, windows, labels, file: drawn.append(windows.episode))
    found = evaluate_traits(dataset, model, tmp_path / "latent.png")
    windows = load_windows(dataset)
    _, test = split_by_episode(windows, TEST_FRACTION, SEED)
    assert found["windows"] == len(test)
    np.testing.assert_array_equal(drawn[0], windows.episode[test])
    labels = load_labels(dataset, windows)[test]
    assert max(labels.mean(), 1 - labels.mean()) - 0.05 <= found["accuracy"] <= 1.0


def test_a_negative_seed_is_refused(dataset: Path, tmp_path: Path) -> None:
    with pytest.raises(InputError, match="seed"):
        train_traits(dataset, tmp_path / "run", settings=SMALL, seed=-1)
    assert not (tmp_path / "run").exists()
