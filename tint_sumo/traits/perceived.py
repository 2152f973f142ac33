"""Windows for trait models as the ego's sensor gives them, from environments in which the ego waits."""

from dataclasses import replace

import numpy as np
from gymnasium.vector import AutoresetMode
from numpy.typing import NDArray

from tint_sumo.core.ranges import Range
from tint_sumo.dataset.windows import Windows, cut_windows, window_rows
from tint_sumo.envs import SceneVectorEnv, TaskSettings

_WAIT = 0  # action
_FIELDS = ("position_m", "gap_m", "track", "traits")
_STEPS = Range(1, 10_000_000)
_TRACKS_PER_EPISODE = 100_000


def perceived_windows(
    task: TaskSettings, steps: int, *, num_envs: int = 64, seed: int = 0
) -> tuple[Windows, NDArray[np.int64]]:
    """Return windows (N,) of the tracks that a waiting ego perceives, and the labels (N,) of their drivers then.

    They come the same way as what a policy's trait model reads while it drives. A track ends where the sensor loses its
    vehicle, which is another driver in the windows when it is seen again. Where labels change with time, a window has
    that of its last step.

    Args:
        task: scene, drivers and sensor.
        steps: of the simulation in each environment; an episode follows another.
        num_envs: number of environments.
        seed: of the first environment; the others have those that follow.

    Raises:
        InputError: the number of steps makes no sense.
    """
    _STEPS.require("steps", steps)
    env = SceneVectorEnv(num_envs, replace(task, tracks=True, decision_s=None), None, None, AutoresetMode.SAME_STEP)
    seen: dict[str, list[NDArray[np.generic]]] = {field: [] for field in _FIELDS}
    episodes: list[NDArray[np.int64]] = []
    episode = np.arange(num_envs)
    try:
        env.reset(seed=seed)
        for _ in range(steps):
            for field, values in seen.items():
                values.append(env.batch.rows[field].copy())
            episodes.append(episode.copy())
            _, _, terminated, truncated, _ = env.step(np.full(num_envs, _WAIT))
            episode[terminated | truncated] += num_envs
    finally:
        env.close()
    position_m, gap_m, track, traits = (np.array(seen[field]) for field in _FIELDS)
    when, at_env, slot = np.nonzero(track >= 0)
    driver = np.array(episodes)[when, at_env] * _TRACKS_PER_EPISODE + track[when, at_env, slot]
    order = np.lexsort((when, driver))
    at = (when[order], at_env[order], slot[order])
    driver = driver[order]
    windows = cut_windows(driver, driver // _TRACKS_PER_EPISODE, position_m[at], gap_m[at])
    first, length = window_rows(driver)
    return windows, traits[at][first + length - 1].astype(np.int64)
