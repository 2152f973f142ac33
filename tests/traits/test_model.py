import pytest
import torch

from tint_sumo.config import TraitSettings
from tint_sumo.core.errors import InputError
from tint_sumo.traits import TRAIT_METHODS
from tint_sumo.traits.batches import WindowBatch
from tint_sumo.traits.model import FEATURE_SPREAD, displacement_and_gap, find_trait_method, register, valid_steps
from tint_sumo.traits.vae import Vae


@pytest.fixture
def model() -> Vae:
    return Vae(TraitSettings())


@pytest.fixture
def states() -> torch.Tensor:
    """Two windows of five steps; the second has three valid ones."""
    offset = torch.tensor([[0.0, 0.2, 0.5, 0.9, 1.4], [0.0, 0.3, 0.6, 0.0, 0.0]])
    gap = torch.tensor([[3.0, 3.1, 3.2, 3.3, 3.4], [20.0, 20.0, 20.0, 0.0, 0.0]])
    return torch.stack((offset, gap), dim=2)


LENGTH = torch.tensor([5, 3])


def test_features_of_the_training_data_are_centred_and_scaled_over_valid_steps(model, states):
    model.fit_features([WindowBatch(states, LENGTH)])
    features = model.features(states, LENGTH)
    known = (torch.cat((features[0, 1:, 0], features[1, 1:3, 0])), torch.cat((features[0, :, 1], features[1, :3, 1])))
    for values, spread in zip(known, FEATURE_SPREAD, strict=True):
        assert float(values.mean()) == pytest.approx(0.0, abs=1e-5)
        assert float(values.std(correction=0)) == pytest.approx(spread, abs=1e-5)


def test_windows_in_parts_give_the_features_of_all_at_once(model):
    generator = torch.Generator().manual_seed(0)
    states = torch.randn(200, 20, 2, generator=generator).cumsum(dim=1) + torch.tensor([0.0, 1000.0])
    length = torch.randint(1, 21, (200,), generator=generator)
    parts = [
        WindowBatch(states[part], length[part]) for part in (slice(3), slice(3, 3), slice(3, 150), slice(150, 200))
    ]
    model.fit_features(parts)
    raw, valid = displacement_and_gap(states).double(), valid_steps(states, length)
    for feature, values in enumerate((raw[:, 1:, 0][valid[:, 1:]], raw[..., 1][valid])):
        assert model.feature_mean[feature].item() == pytest.approx(values.mean().item(), rel=1e-6, abs=1e-7)
        std = model.feature_scale[feature].item() * FEATURE_SPREAD[feature]
        assert std == pytest.approx(values.std(correction=0).item(), rel=1e-6)


def test_windows_of_one_step_leave_the_displacement_as_it_is(model, states):
    model.fit_features([WindowBatch(states, torch.ones(2, dtype=torch.int64))])
    assert (model.feature_mean[0], model.feature_scale[0]) == (0.0, 1.0 / FEATURE_SPREAD[0])


def test_features_can_be_turned_back_into_offset_and_gap(model, states):
    model.fit_features([WindowBatch(states, LENGTH)])
    raw = model.features(states, LENGTH) * model.feature_scale + model.feature_mean
    raw[:, 0, 0] = 0.0
    offset, gap = raw[..., 0].cumsum(dim=1), raw[..., 1]
    for window, length in enumerate(LENGTH):
        assert torch.allclose(offset[window, :length], states[window, :length, 0], atol=1e-6)
        assert torch.allclose(gap[window, :length], states[window, :length, 1], atol=1e-5)


def test_a_constant_feature_is_only_centred(model, states):
    states[..., 1] = 20.0
    model.fit_features([WindowBatch(states, LENGTH)])
    assert model.feature_scale[1] == 1.0
    assert torch.all(model.features(states, LENGTH)[..., 1] == 0.0)


def test_two_methods_of_one_name_are_refused():
    class Another(Vae):
        method = "vae"

    with pytest.raises(ValueError, match="two trait methods are called 'vae'"):
        register(Another)
    assert TRAIT_METHODS["vae"] is Vae


def test_an_unknown_method_is_answered_with_the_known_ones():
    with pytest.raises(InputError, match=r"unknown trait method 'theirs'; choose one of: .*vae"):
        find_trait_method("theirs")
