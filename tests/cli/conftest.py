"""A dataset, a trait model and a short training for all tests of commands."""

from pathlib import Path

import pytest
import torch

from tint_sumo import traits
from tint_sumo.config import TraitSettings
from tint_sumo.dataset.recorder import record
from tint_sumo.traits.storage import save


@pytest.fixture(scope="session")
def dataset(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("data") / "dataset"
    record(folder, 100, workers=2, progress=False)  # in other processes: this one's libsumo stays free
    return folder


@pytest.fixture(scope="session")
def trait_model(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A trait model nobody trained."""
    torch.manual_seed(0)
    settings = TraitSettings(embedding_sizes=(8, 8), hidden_size=8, encoder_output_size=8, decoder_output_size=8)
    folder = tmp_path_factory.mktemp("model")
    save(traits.TRAIT_METHODS["vae"](settings), folder / "model", {"seed": 0})
    save(traits.TRAIT_METHODS["vae"](settings, latent_size=3), folder / "wide", {"seed": 0})
    return folder / "model.safetensors"


@pytest.fixture(scope="session")
def small_training(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A configuration whose rollouts and films take a moment."""
    file = tmp_path_factory.mktemp("small") / "config.yaml"
    file.write_text("scene: {time_limit_s: 1.0}\nbudget: {n_envs: 8, n_steps: 16, n_minibatches: 2}\n")
    return file
