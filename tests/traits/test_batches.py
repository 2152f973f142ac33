from dataclasses import replace

import pytest
import torch

from tint_sumo.config import NO_LEADER_GAP_M
from tint_sumo.traits.batches import Siblings, TrainingWindows, WindowBatch, add_position_noise


def test_siblings_are_all_the_other_windows_of_the_driver():
    driver = torch.tensor([7, 7, 7, 3, 3, 9])
    siblings = Siblings(driver)
    generator = torch.Generator().manual_seed(0)
    seen = {window: set() for window in range(6)}
    for _ in range(100):
        for window, other in enumerate(siblings.draw(torch.arange(6), generator).tolist()):
            seen[window].add(other)
    assert seen == {0: {1, 2}, 1: {0, 2}, 2: {0, 1}, 3: {4}, 4: {3}, 5: {5}}


def test_a_driver_whose_windows_are_scattered_is_refused():
    with pytest.raises(ValueError, match="all windows of a driver must stand in a row"):
        Siblings(torch.tensor([7, 3, 7]))


def test_a_batch_holds_another_window_of_each_driver(street):
    windows, _ = street
    windows = replace(windows, states=windows.states.copy())
    windows.states[:, 0, 0] = windows.driver  # so that a window's driver is known from its states
    index = torch.arange(0, len(windows), 3)
    batch = TrainingWindows(windows, with_other=True).batch(index, torch.Generator().manual_seed(0))
    assert batch.conservative is None
    assert torch.equal(batch.states[:, 0, 0], batch.other.states[:, 0, 0])
    assert (batch.states != batch.other.states).flatten(1).any(dim=1).float().mean() > 0.8


@pytest.fixture
def measured() -> tuple[torch.Tensor, torch.Tensor]:
    """Many standing windows behind a leader 5 m ahead, and as measured with 0.1 m noise."""
    states = torch.zeros(20_000, 20, 2)
    states[..., 1] = 5.0
    return states, add_position_noise(states, 0.1, torch.Generator().manual_seed(0))


def test_noise_stands_on_every_position_of_the_driver_and_of_its_leader(measured):
    states, noisy = measured
    error = (noisy - states).double()
    assert torch.all(error[:, 0, 0] == 0.0)  # offsets count from the first measured position
    # An offset differs by two noises of the driver, a gap by one of each vehicle; they share the driver's.
    assert error[:, 1:, 0].std().item() == pytest.approx(0.1 * 2**0.5, rel=0.01)
    assert error[..., 1].std().item() == pytest.approx(0.1 * 2**0.5, rel=0.01)
    covariance = (error[:, 1:, 0] * error[:, 1:, 1]).mean().item()
    assert covariance == pytest.approx(-(0.1**2), rel=0.05)
    displacement = error[:, :, 0].diff(dim=1)
    neighbours = (displacement[:, 1:-1] * displacement[:, 2:]).mean().item()
    assert neighbours == pytest.approx(-(0.1**2), rel=0.05)  # a step too long is followed by one too short


def test_without_a_leader_the_gap_stays_the_one_that_says_so():
    states = torch.full((1000, 20, 2), NO_LEADER_GAP_M)
    assert torch.all(add_position_noise(states, 0.2, torch.Generator())[..., 1] == NO_LEADER_GAP_M)
    states[..., 1] = NO_LEADER_GAP_M - 0.01
    assert add_position_noise(states, 0.2, torch.Generator())[..., 1].max() == NO_LEADER_GAP_M


def test_no_noise_changes_nothing_and_both_windows_get_their_own():
    states = torch.ones(50, 20, 2)
    batch = WindowBatch(states, torch.full((50,), 20), WindowBatch(states, torch.full((50,), 20)))
    assert batch.with_noise(0.0, torch.Generator()) is batch
    noisy = batch.with_noise(0.1, torch.Generator())
    assert not torch.allclose(noisy.states, noisy.other.states, atol=0.01)
    assert torch.equal(noisy.length, batch.length)
