import pytest

from tint_sumo.config import PolicySettings, PpoSettings


@pytest.fixture(scope="session")
def tiny() -> PpoSettings:
    """A policy and a training of a moment."""
    network = PolicySettings(
        embedding_sizes=(8,), score_sizes=(8,), context_size=8, joint_sizes=(8,), hidden_size=8, head_sizes=(8,)
    )
    return PpoSettings(n_envs=4, n_steps=16, n_epochs=1, n_minibatches=1, total_steps=128, policy=network)
