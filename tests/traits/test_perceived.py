"""Windows as a sensor gives them."""

from contextlib import closing
from dataclasses import replace

import numpy as np
import pytest

from tint_sumo.config import POPULATIONS, SENSORS, Mix, Sensor
from tint_sumo.core.errors import InputError
from tint_sumo.dataset.windows import Windows
from tint_sumo.envs import SceneVectorEnv, TaskSettings
from tint_sumo.scenes import Scene, paper_scene
from tint_sumo.traits.perceived import perceived_windows

TASK = TaskSettings(p_conservative=Mix(0.5))
DROPOUTS = Sensor(dropouts_per_s=1.0, dropout_s=0.3)


def windows_with(sensor: Sensor, **changes: int) -> tuple[Windows, np.ndarray]:
    return perceived_windows(replace(TASK, sensor=sensor, time_limit_s=10.0), 130, num_envs=4, seed=5, **changes)


def test_windows_of_a_perfect_sensor_are_of_smooth_tracks_with_the_labels_of_their_drivers() -> None:
    windows, labels = windows_with(SENSORS["perfect"])
    assert len(windows) == len(labels) > 100 and set(labels.tolist()) == {0, 1}
    moved_m = np.diff(windows.states[..., 0], axis=1)[np.arange(1, 20) < windows.length[:, None]]
    assert (moved_m > -1e-5).all() and moved_m.max() < 0.31
    for driver in np.unique(windows.driver):
        assert len(set(labels[windows.driver == driver].tolist())) == 1
    fast = windows.states[np.arange(len(windows)), windows.length - 1, 0] > 2.6 * 0.1 * (windows.length - 1)
    assert (labels[fast] == 1).all()  # only aggressive drivers exceed 2.4 m/s
    assert set(windows.episode.tolist()) == set(range(8)), "a second episode begins in each environment"


def test_dropouts_make_shorter_tracks_and_noise_rougher_ones() -> None:
    whole, _ = windows_with(SENSORS["perfect"])
    parts, labels = windows_with(DROPOUTS)
    assert len(np.unique(parts.driver)) > 1.5 * len(np.unique(whole.driver))
    assert parts.length.mean() < whole.length.mean() and set(labels.tolist()) == {0, 1}
    rough, _ = windows_with(SENSORS["noisy_0.2"])
    full = rough.length == 20
    bend_m = np.diff(rough.states[full, :, 0], n=2, axis=1)
    assert bend_m.std() == pytest.approx(0.2 * np.sqrt(6.0), rel=0.1)


def test_a_window_has_the_label_of_its_last_step() -> None:
    """Attention lapses for seconds, so that one driver has windows of both labels."""
    drivers = replace(paper_scene(), population=POPULATIONS["inattentive"])
    windows, labels = perceived_windows(replace(TASK, scene=drivers, time_limit_s=10.0), 100, num_envs=4, seed=5)
    of_driver = [set(labels[windows.driver == driver].tolist()) for driver in np.unique(windows.driver)]
    assert {0, 1} in of_driver and {1} in of_driver
    seen = record_labels(drivers)
    for driver in np.unique(windows.driver):
        mine = labels[windows.driver == driver]
        shown = seen[int(driver)]
        ends = np.minimum(np.arange(1, len(mine) + 1) * 20, len(shown)) - 1
        np.testing.assert_array_equal(mine, np.array(shown)[ends])


def record_labels(drivers: Scene) -> dict[int, list[int]]:
    """The labels of each driver at every step at which it is seen, numbered as in windows."""
    found: dict[int, list[int]] = {}
    with closing(SceneVectorEnv(4, TaskSettings(drivers, TASK.p_conservative, time_limit_s=10.0))) as env:
        env.reset(seed=5)
        for _ in range(100):
            rows = env.batch.rows
            for index, slot in np.argwhere(rows["track"] >= 0).tolist():
                number = index * 100_000 + int(rows["track"][index, slot])
                found.setdefault(number, []).append(int(rows["traits"][index, slot]))
            env.step(np.zeros(4, np.int64))
    return found


def test_windows_follow_from_the_seed() -> None:
    first, again = windows_with(DROPOUTS)[0], windows_with(DROPOUTS)[0]
    np.testing.assert_array_equal(first.states, again.states)
    with pytest.raises(InputError, match=r"steps must lie in 1 to 10,000,000, not 0"):
        perceived_windows(TASK, 0)


def test_windows_have_no_other_steps_than_trait_models_read() -> None:
    slow = replace(paper_scene(), name="slow", base="t_intersection", step_s=0.2)
    with pytest.raises(InputError, match=r"scene slow has steps of 0\.2 s, and traits are inferred in steps of 0\.1 s"):
        perceived_windows(replace(TASK, scene=slow), 130, num_envs=1)
