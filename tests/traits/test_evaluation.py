from dataclasses import replace

import numpy as np
import pytest
import torch

from tint_sumo.config import TraitSettings
from tint_sumo.core.errors import InputError
from tint_sumo.dataset.windows import split_by_episode
from tint_sumo.traits.evaluation import TEST_FRACTION, Probe, encode_windows, evaluate, linear_r2
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


def test_separable_latents_are_classified(model, separable):
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
    with pytest.raises(InputError, match="drivers of two traits"):
        evaluate(model, windows, np.ones_like(conservative))


def test_latents_that_are_not_finite_are_refused(model, separable):
    with pytest.raises(InputError, match="latents of some windows are not finite"):
        evaluate(model, *separable, noise_m=1e308)


def test_encoding_in_parts_changes_nothing(separable, monkeypatch):
    model = Vae(TraitSettings(embedding_sizes=(4, 4), hidden_size=4)).eval()
    whole = encode_windows(model, separable[0], noise_m=0.1).mean
    monkeypatch.setattr("tint_sumo.traits.evaluation.ENCODING_BATCH", 100)
    np.testing.assert_allclose(encode_windows(model, separable[0], noise_m=0.1).mean, whole, atol=1e-6)
    assert whole.shape == (len(separable[1]), 2)


def test_the_neighbours_see_what_no_line_can(model, street):
    """A ring around a cluster: no straight line separates them."""
    windows, conservative = street
    angle = np.linspace(0.0, 40.0, len(conservative))
    ring = np.stack((np.cos(angle), np.sin(angle)), axis=1)
    result = evaluate(model, with_latents(windows, np.where(conservative[:, None], ring, 0.1 * ring)), conservative)
    assert result.accuracy < 0.9
    assert result.knn_accuracy == 1.0


class Unsure(FirstStep):
    """Gives the second latent as its uncertainty, too."""

    def encode(self, states, length):
        return states[:, 0], 2.0 * states[:, 0, 1:].abs().log().expand(-1, 2)


def test_errors_among_the_most_uncertain_windows_are_counted(street):
    windows, conservative = street
    wrong = np.arange(len(conservative)) % 20 == 0
    latents = np.stack((np.where(conservative ^ wrong, 1.0, -1.0), np.where(wrong, 0.5, 0.1)), axis=1)
    unsure = Unsure(TraitSettings(embedding_sizes=(4, 4), hidden_size=4)).eval()
    found = evaluate(unsure, with_latents(windows, latents), conservative)
    assert found.accuracy == pytest.approx(0.95, abs=0.03)
    assert found.errors_in_most_uncertain_tenth == 1.0


def test_a_probe_is_fitted_once_and_applied_to_other_windows(model, separable):
    windows, conservative = separable
    probe = Probe(model, windows, conservative)
    few = np.flatnonzero(conservative)[:7]
    assert probe.score(windows[few], conservative[few]).accuracy == 1.0
    assert probe.score(windows[few], ~conservative[few]).accuracy == 0.0
    with pytest.raises(InputError, match="no windows to evaluate on"):
        probe.score(windows[few[:0]], conservative[few[:0]])


def test_a_linear_map_recovers_what_is_linear_in_the_latents(model, street):
    windows, _ = street
    latents = np.random.default_rng(0).normal(size=(len(windows), 2))
    properties = np.stack((latents @ [2.0, -1.0] + 5.0, np.random.default_rng(1).normal(size=len(windows))), axis=1)
    r2 = linear_r2(model, with_latents(windows, latents), properties)
    assert r2[0] == pytest.approx(1.0, abs=1e-4)
    assert r2[1] < 0.1
