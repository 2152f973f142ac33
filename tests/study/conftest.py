from dataclasses import replace
from pathlib import Path

import pytest
import torch

from tint_sumo import traits
from tint_sumo.config import PolicySettings, PpoSettings, TraitSettings
from tint_sumo.traits.storage import save


@pytest.fixture(scope="session")
def tiny() -> PpoSettings:
    """A policy and a training of a moment."""
    network = PolicySettings(
        embedding_sizes=(8,), score_sizes=(8,), context_size=8, joint_sizes=(8,), hidden_size=8, head_sizes=(8,)
    )
    return PpoSettings(n_envs=4, n_steps=16, n_epochs=1, n_minibatches=1, total_steps=128, policy=network)


@pytest.fixture(scope="session")
def brief(tiny: PpoSettings) -> PpoSettings:
    """The same with episodes so short that some end in every rollout."""
    return replace(tiny, time_limit_s=0.8)


@pytest.fixture(scope="session")
def encoders(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with a trait model of each method, which nobody trained; do not write there."""
    folder = tmp_path_factory.mktemp("encoders")
    small = TraitSettings(embedding_sizes=(), hidden_size=4, encoder_output_size=4, decoder_output_size=4)
    torch.manual_seed(0)
    for name, method in traits.TRAIT_METHODS.items():
        save(method(small), folder / name, {"seed": 0})
    return folder
