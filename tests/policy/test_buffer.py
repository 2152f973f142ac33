import numpy as np
import pytest
import torch
from gymnasium import spaces

from tint_sumo.policy.buffer import DictSequenceBuffer, SequenceBuffer, buffer_class

from .tasks import STREET_WITH_TRAITS, box

GAMMA, LAMBDA = 0.9, 0.8


def test_advantages_by_hand() -> None:
    """Two environments, three steps; the second's episode ends after its first step, the first's after the last."""
    buffer = SequenceBuffer(3, box(1), spaces.Discrete(2), device="cpu", gamma=GAMMA, gae_lambda=LAMBDA, n_envs=2)
    rewards = np.array([[1.0, 5.0], [2.0, 6.0], [3.0, 7.0]])
    values = np.array([[0.5, 0.1], [0.6, 0.2], [0.7, 0.3]])
    starts = np.array([[1.0, 0.0], [0.0, 1.0], [0.0, 0.0]])
    for step in range(3):
        buffer.add(
            np.zeros((2, 1)), np.zeros(2), rewards[step], starts[step], torch.tensor(values[step]), torch.zeros(2)
        )
    buffer.compute_returns_and_advantage(torch.tensor([[9.0], [0.4]]), dones=np.array([True, False]))

    first = [0.0] * 3
    first[2] = 3.0 - 0.7  # the episode ends: nothing follows
    first[1] = (2.0 + GAMMA * 0.7 - 0.6) + GAMMA * LAMBDA * first[2]
    first[0] = (1.0 + GAMMA * 0.6 - 0.5) + GAMMA * LAMBDA * first[1]
    second = [0.0] * 3
    second[2] = 7.0 + GAMMA * 0.4 - 0.3  # goes on after the rollout
    second[1] = (6.0 + GAMMA * 0.3 - 0.2) + GAMMA * LAMBDA * second[2]
    second[0] = 5.0 - 0.1
    expected = np.array([first, second]).T
    np.testing.assert_allclose(buffer.advantages, expected, rtol=1e-5)
    np.testing.assert_allclose(buffer.returns, expected + values, rtol=1e-5)


@pytest.mark.parametrize("n_minibatches", [1, 2, 3])
def test_minibatches_are_whole_sequences(n_minibatches: int) -> None:
    steps, envs = 4, 5
    buffer = DictSequenceBuffer(steps, STREET_WITH_TRAITS, spaces.Discrete(100), device="cpu", n_envs=envs)
    buffer.states = torch.arange(envs).float()[:, None]
    for step in range(steps):
        tag = 10.0 * np.arange(envs) + step
        obs = {key: np.zeros((envs, *space.shape), np.float32) for key, space in STREET_WITH_TRAITS.items()}
        obs["ego"][:, 0] = tag
        buffer.add(obs, tag, tag, tag, torch.tensor(tag), torch.tensor(tag))
    buffer.returns = buffer.rewards

    seen = []
    for batch in buffer.sequences(n_minibatches):
        group = batch.states[:, 0]
        expected = 10.0 * group + torch.arange(steps)[:, None]
        assert torch.equal(batch.episode_starts, expected)
        for flat in (batch.observations["ego"][:, 0], batch.actions, batch.log_probs, batch.returns):
            assert torch.equal(flat.view(steps, -1).float(), expected)
        seen += group.tolist()
    assert sorted(seen) == list(range(envs))
    assert len(list(buffer.sequences(n_minibatches))) == n_minibatches


def test_advantages_are_normalised_over_the_rollout() -> None:
    buffer = SequenceBuffer(4, box(1), spaces.Discrete(2), device="cpu", n_envs=6)
    buffer.states = torch.zeros(6, 1)
    buffer.advantages = np.random.default_rng(0).normal(3.0, 2.0, (4, 6)).astype(np.float32)
    advantages = torch.cat([batch.advantages for batch in buffer.sequences(3)])
    assert abs(float(advantages.mean())) < 1e-5
    assert abs(float(advantages.std(correction=0)) - 1.0) < 1e-4


def test_buffer_follows_the_space() -> None:
    assert buffer_class(box(2)) is SequenceBuffer
    assert buffer_class(STREET_WITH_TRAITS) is DictSequenceBuffer
