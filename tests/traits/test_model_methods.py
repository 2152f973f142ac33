"""Promises of every trait method, whatever it learns."""

import math
from dataclasses import replace

import pytest
import torch

from tint_sumo.traits import TRAIT_METHODS, TraitModel
from tint_sumo.traits.batches import TrainingWindows, WindowBatch
from tint_sumo.traits.cross_window import KL_WEIGHT
from tint_sumo.traits.model import valid_steps


@pytest.fixture(params=sorted(TRAIT_METHODS))
def model(request, small, street) -> TraitModel:
    windows, _ = street
    with torch.random.fork_rng():
        torch.manual_seed(0)
        model = TRAIT_METHODS[request.param](small)
    model.fit_features(TrainingWindows(windows).parts())
    return model.eval()


@pytest.fixture
def batch(street):
    """64 windows, the shortest ones among them, and another window of each driver."""
    windows, conservative = street
    data = TrainingWindows(windows, torch.from_numpy(conservative), with_other=True)
    order = torch.from_numpy(windows.length).argsort(stable=True)[:64]
    return data.batch(order, torch.Generator().manual_seed(0))


def spoil(batch, rubbish):
    """The same windows with rubbish where they do not count."""
    states = batch.states.clone()
    states[~valid_steps(states, batch.length)] = rubbish
    other = None if batch.other is None else spoil(batch.other, rubbish)
    return WindowBatch(states, batch.length, other, batch.conservative)


@pytest.mark.parametrize("rubbish", [1e6, math.nan])
def test_steps_after_the_length_have_no_influence(model, batch, rubbish):
    spoilt = spoil(batch, rubbish)
    for clean, dirty in zip(
        model.encode(batch.states, batch.length), model.encode(spoilt.states, batch.length), strict=True
    ):
        assert torch.equal(clean, dirty)
    clean_loss = model.loss(batch, torch.Generator().manual_seed(1))["total"]
    assert clean_loss.isfinite()
    assert torch.equal(model.loss(spoilt, torch.Generator().manual_seed(1))["total"], clean_loss)
    assert torch.equal(model.squared_errors_m2(spoilt), model.squared_errors_m2(batch))


def test_a_window_is_encoded_the_same_in_any_company(model, batch):
    with torch.no_grad():
        together, _ = model.encode(batch.states, batch.length)
        for window in (0, 63):
            steps = int(batch.length[window])
            alone, _ = model.encode(batch.states[window : window + 1, :steps], batch.length[window : window + 1])
            assert torch.allclose(alone[0], together[window], atol=1e-6)


def test_where_the_street_lies_does_not_matter(model, batch):
    """Only differences between positions are seen."""
    with torch.no_grad():
        here, _ = model.encode(batch.states, batch.length)
        there, _ = model.encode(batch.states + torch.tensor([100.0, 0.0]), batch.length)
    assert torch.allclose(here, there, atol=1e-3)


def test_every_parameter_learns(model, batch):
    terms = model.loss(batch, torch.Generator().manual_seed(1))
    terms["total"].backward()
    idle = {name for name, parameter in model.named_parameters() if parameter.grad is None}
    assert idle == ({"encoder.log_var_head.weight", "encoder.log_var_head.bias"} if model.uses_labels else set())


def test_every_term_of_the_loss_is_minimised(model, batch):
    """With weights that let each be seen: in the paper's settings the divergence is a millionth of the loss."""
    model.settings = replace(model.settings, kl_weight=3.0, reconstruction_weight=2.0)
    weights = {"kl": 3.0, "reconstruction": 2.0, "imitation": 2.0}
    if model.method == "cross_window":
        weights = {"kl": KL_WEIGHT, "prediction": 1.0}
    terms = {name: term.item() for name, term in model.loss(batch, torch.Generator().manual_seed(1)).items()}
    total = terms.pop("total")
    assert total > 0.0
    assert model.uses_labels or terms["kl"] > 0.0
    if not model.uses_labels:
        assert total == pytest.approx(sum(weights[name] * term for name, term in terms.items()), rel=1e-5)


def test_windows_of_two_steps_can_be_learnt_from(model, batch):
    states, length = batch.states[:, :2], torch.full((64,), 2)
    shortest = WindowBatch(states, length, WindowBatch(states, length), batch.conservative)
    total = model.loss(shortest, torch.Generator().manual_seed(1))["total"]
    total.backward()
    assert total.isfinite()
    assert all(p.grad is None or p.grad.isfinite().all() for p in model.parameters())
