import math
from dataclasses import replace

import numpy as np
import pytest
import torch

from tint_sumo.traits.batches import TrainingWindows
from tint_sumo.traits.cross_window import CrossWindow, fuse
from tint_sumo.traits.evaluation import encode_windows
from tint_sumo.traits.training import train

from .scenes import two_populations


@pytest.fixture
def model(small, street) -> CrossWindow:
    windows, _ = street
    with torch.random.fork_rng():
        torch.manual_seed(0)
        model = CrossWindow(small)
    model.fit_features(TrainingWindows(windows).parts())
    return model.eval()


def test_fused_gaussians_are_their_product_with_the_prior_counted_once():
    # Two windows with means 1 and 2 and variance 1/4 each: evidence of precision 3 each on top of the prior's 1.
    mean, log_var = torch.tensor([[[1.0], [2.0]]]), torch.full((1, 2, 1), math.log(0.25))
    fused, fused_log_var = fuse(mean, log_var, torch.tensor([[True, True]]))
    assert fused.item() == pytest.approx((4.0 * 1.0 + 4.0 * 2.0) / 7.0)
    assert fused_log_var.exp().item() == pytest.approx(1.0 / 7.0)


def test_a_single_window_fuses_to_itself_and_none_to_the_prior():
    mean, log_var = torch.tensor([[[1.5], [9.0]]]), torch.tensor([[[math.log(0.1)], [0.0]]])
    alone, alone_log_var = fuse(mean, log_var, torch.tensor([[True, False]]))
    assert alone.item() == pytest.approx(1.5)
    assert alone_log_var.item() == pytest.approx(math.log(0.1))
    nothing, nothing_log_var = fuse(mean, log_var, torch.tensor([[False, False]]))
    assert (nothing.item(), nothing_log_var.item()) == (0.0, 0.0)


@pytest.mark.parametrize("steps", [20, 21, 22, 47, 60])
def test_tracks_of_any_length_are_the_fusion_of_their_windows(model, steps):
    generator = torch.Generator().manual_seed(0)
    track = torch.stack((torch.rand(3, steps, generator=generator).cumsum(1) * 0.3, torch.full((3, steps), 6.0)), dim=2)
    with torch.no_grad():
        mean, log_var = model.encode(track, torch.full((3,), steps))
        pieces = [track[:, start : start + 20] for start in range(0, steps, 20) if steps - start >= 2]
        parts = [model.encode(piece, torch.full((3,), piece.shape[1])) for piece in pieces]
        expected = fuse(
            torch.stack([part[0] for part in parts], 1),
            torch.stack([part[1] for part in parts], 1),
            torch.ones(3, len(parts), dtype=torch.bool),
        )
    assert torch.allclose(mean, expected[0], atol=1e-6)
    assert torch.allclose(log_var, expected[1], atol=1e-6)


def test_tracks_of_several_lengths_go_together(model):
    states, length = torch.rand(4, 50, 2).cumsum(1), torch.tensor([50, 20, 21, 7])
    with torch.no_grad():
        together, _ = model.encode(states, length)
        for track, steps in enumerate(length.tolist()):
            alone, _ = model.encode(states[track : track + 1, :steps], length[track : track + 1])
            assert torch.allclose(together[track], alone[0], atol=1e-5)


def test_what_noise_leaves_open_shows_as_uncertainty(small, tmp_path):
    """A noisy window of three steps hardly tells 2.4 from 3 m/s, one of twenty does, and three of them even more."""
    windows, _ = two_populations(600, windows_each=4, shortest=3)
    settings = replace(small, hidden_size=16, learning_rate=1e-2, epochs=12, noise_m=0.1)
    model = train(windows, settings, tmp_path, method="cross_window")
    std = encode_windows(model, windows, noise_m=0.1).std.prod(axis=1)
    short, full = std[windows.length <= 4], std[windows.length == 20]
    assert np.median(short) > 1.2 * np.median(full)

    track = np.stack((0.24 * np.arange(60, dtype=np.float32), np.full(60, 6.0, np.float32)), axis=1)
    with torch.no_grad():
        log_vars = [model.encode(torch.from_numpy(track[None, :steps]), torch.tensor([steps]))[1] for steps in (20, 60)]
    assert log_vars[1].sum() < log_vars[0].sum()
