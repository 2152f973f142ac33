"""The way that a vehicle drives is measured along the way, whatever the noise of its positions."""

import numpy as np
import pytest

from tests.tracks.test_inspection import made
from tint_sumo.tracks.motion import Steps, steps_of

STEP_S = 0.04


def steps(x_m: np.ndarray, y_m: np.ndarray, speed_mps: float) -> Steps:
    """Steps of one vehicle with these positions at 25 Hz."""
    return steps_of(
        made(*(("a", STEP_S * row, x, y, speed_mps) for row, (x, y) in enumerate(zip(x_m, y_m, strict=True))))
    )


def noise(rows: int, seed: int) -> np.ndarray:
    return np.random.default_rng(seed).normal(0.0, 0.05, rows)


def test_noise_of_a_standing_vehicle_is_no_driving() -> None:
    found = steps(noise(750, 0), noise(750, 1), 0.0)
    assert abs(found.driven_m.sum()) < 0.5
    approached = np.concatenate([np.linspace(-20.0, 0.0, 100), np.zeros(750), np.linspace(0.0, 20.0, 100)])
    assert steps(approached + noise(950, 0), noise(950, 1), 5.0).driven_m.sum() == pytest.approx(40.0, abs=0.3)


def test_noise_of_a_moving_vehicle_is_no_driving() -> None:
    x_m = 0.5 * np.arange(1000)
    assert steps(x_m + noise(1000, 0), noise(1000, 1), 12.5).driven_m.sum() == pytest.approx(x_m[-1], abs=0.4)


def test_the_way_goes_round_bends() -> None:
    angle = 0.04 * np.arange(400)  # steps of 0.4 m on a circle of 10 m, more than twice round
    found = steps(10.0 * np.cos(angle), 10.0 * np.sin(angle), 10.0)
    np.testing.assert_allclose(found.driven_m, 0.4, rtol=0.02)


def test_steps_of_clean_tracks_keep_their_length() -> None:
    x_m = np.cumsum(np.abs(np.sin(0.01 * np.arange(600))))
    np.testing.assert_allclose(steps(x_m, 0.0 * x_m, 20.0).driven_m, np.diff(x_m), atol=1e-12)
    np.testing.assert_allclose(steps(-x_m, x_m, 40.0).driven_m, np.sqrt(2.0) * np.diff(x_m), atol=1e-12)


def test_a_jump_does_not_turn_the_way_before_it() -> None:
    x_m = 0.4 * np.arange(200.0)
    x_m[100:] -= 8.0
    found = steps(x_m, 0.0 * x_m, 10.0)
    assert np.flatnonzero(found.is_jump).tolist() == [99]
    np.testing.assert_allclose(np.delete(found.driven_m, 99), 0.4)
