"""Posteriors from several windows of a driver."""

import math

import numpy as np
import pytest
import torch

from tint_sumo.dataset.windows import cut_windows
from tint_sumo.traits import load
from tint_sumo.traits.cross_window import CrossWindow
from tint_sumo.traits.evaluation import Latents, encode_windows
from tint_sumo.traits.streaming import TrackStream, evidence, fuse_so_far, posterior


def fused(mean: list[float], log_var: list[float]) -> tuple[float, float]:
    """Mean and variance from several windows with one latent."""
    found_mean, std = posterior(evidence(torch.tensor(mean), torch.tensor(log_var)).sum(dim=1))
    return float(found_mean), float(std) ** 2


def test_gaussians_multiply_with_the_prior_counted_once() -> None:
    # Two windows with means 1 and 2 and variance 1/4 each: evidence of precision 3 each on top of the prior's 1.
    assert fused([1.0, 2.0], [math.log(0.25)] * 2) == pytest.approx(((4.0 * 1.0 + 4.0 * 2.0) / 7.0, 1.0 / 7.0))


def test_a_single_window_is_its_own_posterior_and_none_leaves_the_prior() -> None:
    assert fused([1.5], [math.log(0.1)]) == pytest.approx((1.5, 0.1))
    assert fused([], []) == (0.0, 1.0)


def test_windows_that_know_less_than_the_prior_do_not_make_it_less_sure() -> None:
    assert fused([5.0, 1.0], [2.0, math.log(0.5)]) == pytest.approx(((5.0 + 2.0) / 2.0, 0.5))


def test_each_window_is_fused_with_those_before_it_of_its_vehicle() -> None:
    mean = np.array([[1.0], [4.0], [2.0], [9.0]], np.float32)
    std = np.full((4, 1), 0.5, np.float32)
    found = fuse_so_far(Latents(mean, std), np.array([0, 7, 0, 7]))
    np.testing.assert_allclose(found.mean[:, 0], [1.0, 4.0, 12.0 / 7.0, 52.0 / 7.0], rtol=1e-6)
    np.testing.assert_allclose(found.std[:, 0], [0.5, 0.5, 7.0**-0.5, 7.0**-0.5], rtol=1e-6)


@pytest.mark.parametrize("steps", [20, 21, 22, 47, 60])
def test_a_stream_says_the_same_as_the_windows_of_the_tracks_so_far(steps: int) -> None:
    """Three tracks, of which one has no leader."""
    model = load("cross_window")
    assert isinstance(model, CrossWindow)
    position_m = 7.0 + np.cumsum(np.random.default_rng(0).uniform(0.2, 0.3, (3, steps)), axis=1)
    gap_m = np.broadcast_to([[6.0], [np.inf], [25.0]], (3, steps))
    stream, tracks = TrackStream(model, 3), np.arange(3)
    for step in range(steps):
        mean, std = stream.advance(tracks, position_m[:, step].astype(np.float32), gap_m[:, step])

    track = np.repeat(tracks, steps)
    windows = cut_windows(track, track, position_m.flatten(), gap_m.flatten())
    expected = fuse_so_far(encode_windows(model, windows), windows.driver)
    last = np.flatnonzero(np.diff(windows.driver, append=3))
    np.testing.assert_allclose(mean, expected.mean[last], atol=1e-4)
    np.testing.assert_allclose(std, expected.std[last], atol=1e-4)


def test_a_track_that_is_forgotten_starts_anew_and_others_go_on() -> None:
    model = load("cross_window")
    assert isinstance(model, CrossWindow)
    stream, fresh = TrackStream(model, 2), TrackStream(model, 2)
    for step in range(30):
        stream.advance(np.arange(2), np.full(2, 0.2 * step, np.float32), np.full(2, np.inf))
    stream.forget(np.array([1]))
    assert stream.steps.tolist() == [30.0, 0.0]
    for step in range(20):
        position_m = np.array([6.0 + 0.2 * step, 9.0 + 0.3 * step], np.float32)
        mean, std = stream.advance(np.arange(2), position_m, np.full(2, np.inf))
        new_mean, new_std = fresh.advance(np.arange(1, 2), position_m[1:], np.full(1, np.inf))
        np.testing.assert_allclose(mean[1], new_mean[0], atol=1e-6)
        np.testing.assert_allclose(std[1], new_std[0], atol=1e-6)
    assert stream.steps.tolist() == [50.0, 20.0]
