import math
from dataclasses import replace

import numpy as np
import pytest
import torch

from tint_sumo.traits.batches import TrainingWindows, WindowBatch
from tint_sumo.traits.cross_window import SAMPLES, CrossWindow
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


def test_what_noise_leaves_open_shows_as_uncertainty(small, tmp_path):
    """A noisy window of three steps hardly distinguishes 2.4 from 3 m/s, one of twenty does."""
    windows, _ = two_populations(600, windows_each=4, shortest=3)
    settings = replace(small, hidden_size=16, learning_rate=1e-2, epochs=12, noise_m=0.1)
    model = train(windows, settings, tmp_path, method="cross_window")
    std = encode_windows(model, windows, noise_m=0.1).std.prod(axis=1)
    short, full = std[windows.length <= 4], std[windows.length == 20]
    assert np.median(short) > 1.2 * np.median(full)


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
