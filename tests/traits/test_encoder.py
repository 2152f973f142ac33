import pytest
import torch
from torch import nn

from tint_sumo.config import TraitSettings
from tint_sumo.traits.encoder import WindowEncoder, last_states, sample


def test_last_states_are_those_of_torchs_gru():
    torch.manual_seed(0)
    gru = nn.GRU(3, 5)
    inputs, length = torch.randn(9, 40, 3), torch.randint(1, 10, (40,))
    with torch.no_grad():
        expected = gru(inputs)[0][length - 1, torch.arange(40)]
        torch.testing.assert_close(last_states(gru, inputs, length), expected, atol=2e-6, rtol=0.0)


@pytest.mark.parametrize("embedding", [(), (6, 7)])
def test_encoding_with_and_without_gradients_agrees(embedding):
    torch.manual_seed(0)
    encoder = WindowEncoder(2, TraitSettings(embedding, hidden_size=8, encoder_output_size=5), latent_size=3)
    features, length = torch.randn(30, 20, 2), torch.randint(1, 21, (30,))
    learning = encoder(features, length)
    with torch.inference_mode():
        fast = encoder(features, length)
    for one, other in zip(learning, fast, strict=True):
        assert one.requires_grad
        torch.testing.assert_close(one.detach(), other, atol=2e-6, rtol=0.0)


def test_samples_have_the_gaussians_mean_and_variance():
    mean, log_var = torch.tensor([[1.0, -2.0]]), torch.log(torch.tensor([[0.25, 4.0]]))
    drawn = sample(mean, log_var, torch.Generator().manual_seed(0), 50_000)[:, 0]
    assert drawn.mean(dim=0).tolist() == pytest.approx([1.0, -2.0], abs=0.03)
    assert drawn.var(dim=0).tolist() == pytest.approx([0.25, 4.0], rel=0.03)
