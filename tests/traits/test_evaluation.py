from dataclasses import replace

import numpy as np
import pytest
import torch

from tint_sumo.config import TraitSettings
from tint_sumo.dataset.windows import split_by_episode
from tint_sumo.errors import InputError
from tint_sumo.traits.evaluation import TEST_FRACTION, encode_windows, evaluate
from tint_sumo.traits.vae import Vae


class FirstStep(Vae):
    """Takes a window's first step for its latent, so that a test can set latents at will."""

    def encode(self, states, length):
        return states[:, 0], torch.zeros(len(length), 2)


@pytest.fixture
def model() -> Vae:
    return FirstStep(TraitSettings(embedding_sizes=(4, 4), hidden_size=4)).eval()


def with_latents(windows, latents):
    states = windows.states.copy()
    states[:, 0] = latents
    return replace(windows, states=states)


@pytest.fixture
def separable(street):
    """Windows whose latent shows the trait, a hundred times smaller than the other latent's spread."""
    windows, conservative = street
    noise = np.random.default_rng(0).normal(size=(len(conservative), 2))
    return with_latents(windows, noise * [0.1, 100.0] + conservative[:, None] * [1.0, 0.0]), conservative


def test_separable_latents_are_told_apart(model, separable):
    result = evaluate(model, *separable)
    assert result.accuracy == 1.0
    assert result.windows == len(split_by_episode(separable[0], TEST_FRACTION, 0)[1])
    assert all(part.accuracy == 1.0 for part in (*result.by_length.values(), *result.by_leader.values()))


def test_latents_without_the_trait_are_near_chance(model, street):
    windows, conservative = street
    noise = np.random.default_rng(0).normal(size=(len(conservative), 2))
    assert evaluate(model, with_latents(windows, noise), conservative).accuracy == pytest.approx(0.5, abs=0.15)


def test_parts_count_each_test_window_once_and_name_where_errors_are(model, separable):
    windows, conservative = separable
    lost = windows.length <= 5
    latents = np.where(lost[:, None], -windows.states[:, 0] + [1.0, 0.0], windows.states[:, 0])
    result = evaluate(model, with_latents(windows, latents), conservative)
    assert list(result.by_length) == ["2-5", "6-10", "11-19", "20"]
    assert sum(part.windows for part in result.by_length.values()) == result.windows
    assert sum(part.windows for part in result.by_leader.values()) == result.windows
    assert result.by_length["2-5"].accuracy == 0.0
    assert result.by_length["20"].accuracy == 1.0
    weighted = sum(part.accuracy * part.windows for part in result.by_length.values()) / result.windows
    assert result.accuracy == pytest.approx(weighted)


def test_a_part_without_windows_has_no_accuracy(model, separable):
    windows, conservative = separable
    result = evaluate(model, replace(windows, has_leader=np.ones_like(windows.has_leader)), conservative)
    assert result.by_leader["without_leader"].accuracy is None
    assert result.by_leader["without_leader"].windows == 0


def test_one_trait_alone_cannot_be_evaluated(model, separable):
    windows, conservative = separable
    with pytest.raises(InputError, match="both traits"):
        evaluate(model, windows, np.ones_like(conservative))


def test_encoding_in_parts_changes_nothing(separable, monkeypatch):
    model = Vae(TraitSettings(embedding_sizes=(4, 4), hidden_size=4)).eval()
    whole = encode_windows(model, separable[0], noise_m=0.1).mean
    monkeypatch.setattr("tint_sumo.traits.evaluation.ENCODING_BATCH", 100)
    np.testing.assert_allclose(encode_windows(model, separable[0], noise_m=0.1).mean, whole, atol=1e-6)
    assert whole.shape == (len(separable[1]), 2)
