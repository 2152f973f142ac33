import math
from dataclasses import replace

import pytest
import torch

from tint_sumo.traits.batches import WindowBatch
from tint_sumo.traits.encoder import kl_divergence
from tint_sumo.traits.model import valid_steps
from tint_sumo.traits.vae import Vae


@pytest.fixture
def batch(street) -> tuple[torch.Tensor, torch.Tensor]:
    """64 windows of many lengths."""
    windows, _ = street
    order = windows.length.argsort(kind="stable")[:64]
    return torch.from_numpy(windows.states[order]), torch.from_numpy(windows.length[order])


@pytest.fixture
def model(small, batch) -> Vae:
    with torch.random.fork_rng():
        torch.manual_seed(0)
        model = Vae(small)
    model.fit_features([WindowBatch(*batch)])
    return model.eval()


def loss_terms(model, states, length) -> dict[str, float]:
    terms = model.loss(WindowBatch(states, length), torch.Generator().manual_seed(3))
    return {name: term.item() for name, term in terms.items()}


@pytest.mark.parametrize("rubbish", [1e6, math.nan])
def test_steps_after_the_length_have_no_influence(model, batch, rubbish):
    states, length = batch
    spoilt = states.clone()
    spoilt[~valid_steps(states, length)] = rubbish
    for clean, dirty in zip(model.encode(states, length), model.encode(spoilt, length), strict=True):
        assert torch.equal(clean, dirty)
    assert loss_terms(model, states, length) == loss_terms(model, spoilt, length)
    refitted = Vae(model.settings)
    refitted.fit_features([WindowBatch(spoilt, length)])
    assert torch.equal(refitted.feature_scale, model.feature_scale)


def test_every_valid_step_has_influence(model, batch):
    states, length = batch
    last = torch.arange(len(length)), length - 1
    changed = states.clone()
    changed[last] += 1.0
    before, after = model.encode(states, length)[0], model.encode(changed, length)[0]
    assert torch.all((before - after).abs().amax(dim=1) > 1e-6)


def test_a_window_is_encoded_the_same_in_any_company(model, batch):
    states, length = batch
    together, _ = model.encode(states, length)
    order = torch.randperm(len(length), generator=torch.Generator().manual_seed(0))
    assert torch.allclose(model.encode(states[order], length[order])[0], together[order], atol=1e-6)
    for window in (0, 63):
        steps = int(length[window])
        alone, _ = model.encode(states[window : window + 1, :steps], length[window : window + 1])
        assert torch.allclose(alone[0], together[window], atol=1e-6)


def test_decoder_sees_its_own_reconstruction_and_the_latent_at_every_step(model):
    latent = torch.randn(5, 2, generator=torch.Generator().manual_seed(0))
    state, hidden, expected = torch.full((5, 2), -2.0), torch.zeros(5, 8), []
    for _ in range(4):
        hidden = model.decoder(model.decoder_embed(torch.cat((state, latent), dim=1)), hidden)
        state = model.decoder_output(hidden)
        expected.append(state)
    assert torch.allclose(model.decode(latent, 4), torch.stack(expected, dim=1), atol=1e-6)


def test_kl_divergence_against_a_computation_by_hand():
    # KL(N(m, s^2) || N(0, 1)) = (m^2 + s^2 - 1) / 2 - ln s: here (4 + 9 - 1) / 2 - ln 3, and 0 for the prior itself.
    mean, log_var = torch.tensor([[2.0, 0.0], [0.0, 0.0]]), torch.tensor([[math.log(9.0), 0.0], [0.0, 0.0]])
    assert kl_divergence(mean, log_var).tolist() == pytest.approx([6.0 - math.log(3.0), 0.0])


def test_loss_is_the_weighted_sum_of_its_terms_over_valid_steps(model, batch, monkeypatch):
    states, length = batch
    monkeypatch.setattr(model, "decode", lambda latent, steps: torch.zeros(len(latent), steps, 2))
    terms = loss_terms(model, states, length)
    features = model.features(states, length)
    assert terms["reconstruction"] == pytest.approx((features.square().sum() / (2 * length.sum())).item(), rel=1e-5)
    assert terms["kl"] == pytest.approx(kl_divergence(*model.encode(states, length)).mean().item(), rel=1e-5)
    settings = model.settings
    weighted = settings.kl_weight * terms["kl"] + settings.reconstruction_weight * terms["reconstruction"]
    assert terms["total"] == pytest.approx(weighted)


def test_latent_noise_comes_from_the_generator_alone(model, batch):
    torch.manual_seed(1)
    first = loss_terms(model, *batch)
    torch.manual_seed(2)
    assert loss_terms(model, *batch) == first
    other = model.loss(WindowBatch(*batch), torch.Generator().manual_seed(4))["reconstruction"].item()
    assert other != first["reconstruction"]


def test_offsets_are_decoded_as_running_sums_of_displacements(model, monkeypatch):
    """Of two windows of three and four steps; what is decoded is given by hand."""
    states = torch.tensor(
        [[[0.0, 9.0], [0.5, 8.0], [1.5, 7.0], [0.0, 0.0]], [[0.0, 6.0], [1.0, 5.0], [2.0, 4.0], [3.0, 3.0]]]
    )
    length = torch.tensor([3, 4])
    with torch.no_grad():
        model.feature_mean.copy_(torch.tensor([0.25, 10.0]))
        model.feature_scale.copy_(torch.tensor([0.5, 4.0]))
    decoded = torch.tensor(
        [[[7.0, 0.0], [1.5, 0.5], [0.5, -0.5], [9.0, 9.0]], [[7.0, 1.0], [0.5, 0.0], [1.5, 0.0], [2.5, 2.0]]]
    )
    asked = []

    def decode(latent, steps):
        asked.append((latent, steps))
        return decoded

    monkeypatch.setattr(model, "decode", decode)
    found = model.reconstruct(states, length)
    assert torch.equal(asked[0][0], model.encode(states, length)[0]) and asked[0][1] == 4
    assert found[..., 0].tolist() == [[0.0, 1.0, 1.5, 6.25], [0.0, 0.5, 1.5, 3.0]]
    assert found[..., 1].tolist() == [[10.0, 12.0, 8.0, 46.0], [14.0, 10.0, 10.0, 18.0]]
    errors_m2 = model.squared_errors_m2(WindowBatch(states, length))
    assert errors_m2.tolist() == [0.25, 0.0, 0.25, 0.25, 0.0]  # the first step is no error, nor is what stands behind


def test_the_decoder_has_the_sizes_of_the_settings(small):
    model = Vae(replace(small, embedding_sizes=(6, 5), hidden_size=7, decoder_output_size=4), latent_size=3)
    assert (model.decoder.input_size, model.decoder.hidden_size) == (5, 7)
    layers = [
        (layer.in_features, layer.out_features)
        for part in (model.decoder_embed, model.decoder_output)
        for layer in part
        if hasattr(layer, "in_features")
    ]
    assert layers == [(5, 6), (6, 5), (7, 4), (4, 2)]
    assert model.decode(torch.zeros(2, 3), 6).shape == (2, 6, 2)
