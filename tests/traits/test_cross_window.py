import math
from dataclasses import replace

import numpy as np
import pytest
import torch

from tint_sumo.traits.batches import TrainingWindows, WindowBatch
from tint_sumo.traits.cross_window import SAMPLES, CrossWindow, fuse
from tint_sumo.traits.encoder import kl_divergence
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


class Predicted(CrossWindow):
    """Predicts given displacements and logarithms of standard deviations, (K, T - 1, N), whatever the windows."""

    given: tuple[torch.Tensor, torch.Tensor]

    def _predict(self, batch, latents):
        *_, target, valid = super()._predict(batch, latents)
        return (*self.given, target, valid)


@pytest.fixture
def predicted(small) -> tuple[Predicted, WindowBatch]:
    """Two windows whose others have 3 and 2 steps, with scaled displacements 2 and 3, and 1."""
    with torch.random.fork_rng():
        torch.manual_seed(0)
        model = Predicted(small)
    with torch.no_grad():
        model.feature_scale.copy_(torch.tensor([0.5, 1.0]))
    states = torch.tensor([[[0.0, 9.0], [1.0, 8.0], [2.5, 7.0]], [[0.0, 6.0], [0.5, 5.0], [9.0, 9.0]]])
    other = WindowBatch(states, torch.tensor([3, 2]))
    return model.eval(), WindowBatch(states, torch.tensor([3, 2]), other)


def test_the_loss_is_the_likelihood_of_the_other_window_over_all_latents(predicted):
    model, batch = predicted
    displacement = torch.zeros(SAMPLES, 2, 2)
    log_std = torch.full((SAMPLES, 2, 2), math.log(2.0))
    displacement[3:] = torch.tensor([[2.0, 1.0], [2.0, 50.0]])  # the last one is behind the second window's end
    model.given = displacement, log_std
    terms = model.loss(batch, torch.Generator().manual_seed(0))
    near, far = -2 * math.log(2.0) - 0.125, -2 * math.log(2.0) - 0.5 - 1.125
    first = math.log(8) - math.log(5 * math.exp(near) + 3 * math.exp(far))
    near, far = -math.log(2.0), -math.log(2.0) - 0.125
    second = math.log(8) - math.log(5 * math.exp(near) + 3 * math.exp(far))
    assert terms["prediction"].item() == pytest.approx((first + second) / 2, rel=1e-5)
    kl = kl_divergence(*model.encode(batch.states, batch.length)).mean().item()
    assert terms["kl"].item() == pytest.approx(kl)
    assert terms["total"].item() == pytest.approx(terms["prediction"].item() + 0.01 * kl)


def test_errors_are_those_of_valid_displacements_in_metres(predicted):
    model, batch = predicted
    model.given = torch.tensor([[[1.0, 4.0], [3.5, 50.0]]]), torch.zeros(1, 2, 2)
    assert model.squared_errors_m2(batch).tolist() == pytest.approx([0.25, 2.25, 0.0625])


def test_predictions_follow_the_other_window_and_know_the_latent(model):
    states = torch.rand(3, 6, 2, generator=torch.Generator().manual_seed(0)).cumsum(1)
    batch = WindowBatch(torch.zeros(3, 6, 2), torch.full((3,), 6), WindowBatch(states, torch.tensor([6, 4, 2])))
    latents = torch.randn(5, 3, 2, generator=torch.Generator().manual_seed(1))
    with torch.no_grad():
        displacement, log_std, target, valid = model._predict(batch, latents)
        features = model.features(states, torch.tensor([6, 4, 2]))
        hidden, expected = torch.zeros(1, 3, model.settings.hidden_size), []
        for step in range(5):
            followed, hidden = model.follower(features[None, :, step], hidden)
            expected.append(model.prediction((model.from_follower(followed) + model.from_latent(latents)).relu()))
    expected = torch.stack(expected, dim=1)
    assert torch.allclose(displacement, expected[..., 0], atol=1e-6)
    assert torch.allclose(log_std, expected[..., 1], atol=1e-6)
    assert torch.equal(target, features[:, 1:, 0].T)
    assert valid.T.tolist() == [[True] * 5, [True] * 3 + [False] * 2, [True] + [False] * 4]
    assert not model.from_latent(torch.zeros(1, 2)).any()  # a latent of zero, the prior's mean, changes nothing


@pytest.mark.parametrize(("bias", "log_std"), [(-100.0, -4.0), (100.0, 3.0)])
def test_predictions_are_neither_too_sure_nor_too_vague(model, bias, log_std):
    with torch.no_grad():
        model.prediction.bias[1] = bias
        batch = WindowBatch(
            torch.zeros(1, 3, 2), torch.tensor([3]), WindowBatch(torch.zeros(1, 3, 2), torch.tensor([3]))
        )
        assert set(model._predict(batch, torch.zeros(1, 1, 2))[1].flatten().tolist()) == {log_std}


def test_windows_that_know_less_than_the_prior_do_not_count():
    mean, log_var = torch.tensor([[[5.0], [1.0]]]), torch.tensor([[[2.0], [math.log(0.5)]]])
    fused, fused_log_var = fuse(mean, log_var, torch.tensor([[True, True]]))
    assert fused_log_var.exp().item() == pytest.approx(0.5)
    assert fused.item() == pytest.approx((5.0 + 2.0) / 2.0)
