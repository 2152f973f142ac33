"""Properties of the environments of all scenes."""

from collections.abc import Callable
from contextlib import closing
from typing import Any

import gymnasium
import numpy as np
import pytest

from tint_sumo import ENV_IDS, SCENE_ENV_ID
from tint_sumo.core.errors import InputError
from tint_sumo.envs import SceneEnv, SceneVectorEnv, TaskSettings
from tint_sumo.envs.parallel import ParallelSceneEnv
from tint_sumo.envs.sb3 import SceneVecEnv
from tint_sumo.scenes import SCENES, find_scene

GO = np.int64(2)
scenes = pytest.mark.parametrize("name", SCENES)


@scenes
def test_an_ego_on_empty_roads_reaches_its_goal(name: str) -> None:
    env = SceneEnv(TaskSettings(name))
    try:
        env.reset(seed=0)
        simulation = env._episodes.simulation
        simulation.reset_to(0, [])  # nobody else is there
        for _ in range(300):
            _, reward, terminated, truncated, info = env.step(GO)
            if terminated or truncated:
                break
        assert info["outcome"] == "success"
        assert reward == 2.5
    finally:
        env.close()


@scenes
def test_episodes_end_in_all_ways_and_what_is_observed_stays_in_bounds(name: str) -> None:
    env = SceneVectorEnv(24, TaskSettings(name, p_conservative=0.5, time_limit_s=20.0))
    outcomes: set[str] = set()
    try:
        observation, _ = env.reset(seed=0)
        for step in range(400):
            actions = np.where(np.arange(24) < 16, 2, 0) if step % 3 else np.full(24, 1)
            observation, _, terminated, truncated, infos = env.step(actions)
            if (terminated | truncated).any():
                outcomes |= set(infos["outcome"][terminated | truncated].tolist())
            assert env.observation_space.contains(observation)
            # Whoever is near is seen where it is, not at the bounds of the space.
            seen = observation["mask"] > 0.5
            assert (np.abs(observation["vehicles"][seen]) < 2.0).all(axis=1).mean() > 0.95
    finally:
        env.close()
    assert outcomes == {"success", "collision", "timeout"}


@scenes
def test_a_picture_shows_road_ego_and_drivers(name: str) -> None:
    env = SceneEnv(TaskSettings(name, p_conservative=0.5), render_mode="rgb_array")
    try:
        env.reset(seed=1)
        picture = env.render()
        assert picture is not None and picture.dtype == np.uint8
        view = find_scene(name).view
        height, width, _ = picture.shape
        assert height / width == pytest.approx((view.top_m - view.bottom_m) / (view.right_m - view.left_m), rel=0.01)
        for colour in ((240, 180, 0), (40, 90, 200), (200, 40, 40), (143, 149, 155)):
            assert (np.abs(picture.astype(int) - colour).max(axis=-1) < 10).sum() > 200
    finally:
        env.close()


def test_any_scene_has_an_environment_without_an_id() -> None:
    env = gymnasium.make(SCENE_ENV_ID, scene=find_scene("on_ramp"), time_limit_s=1.0)
    named = gymnasium.make(ENV_IDS["on_ramp"], time_limit_s=1.0, backend="traci")
    try:
        first, _ = env.reset(seed=3)
        second, _ = named.reset(seed=3)
        for key in first:
            np.testing.assert_array_equal(first[key], second[key])
    finally:
        env.close()
        named.close()


def test_environments_of_several_scenes_are_those_of_each_scene() -> None:
    """Two scenes share an environment, each in another process."""
    names = ["four_way", "roundabout"]
    both = SceneVectorEnv(4, [TaskSettings(name) for name in names])
    try:
        mixed = [both.reset(seed=5)[0], *(both.step(np.full(4, 2))[0] for _ in range(60))]
    finally:
        both.close()
    for number, name in enumerate(names):
        alone = SceneVectorEnv(2, TaskSettings(name))
        try:
            single = [alone.reset(seed=5 + 2 * number)[0], *(alone.step(np.full(2, 2))[0] for _ in range(60))]
        finally:
            alone.close()
        for one, other in zip(mixed, single, strict=True):
            for key in one:
                np.testing.assert_array_equal(one[key][2 * number : 2 * number + 2], other[key])


def test_several_scenes_need_as_many_workers() -> None:
    two = [TaskSettings("four_way"), TaskSettings("roundabout")]
    with pytest.raises(InputError, match=r"these are of 2 \(scenes or sensors\); leave workers out"):
        SceneVectorEnv(6, two, workers=3)
    with pytest.raises(InputError, match="num_envs must be at least 2, one for each scene or sensor, not 1"):
        SceneVectorEnv(1, two)
    with pytest.raises(InputError, match="give those of at least one scene"):
        SceneVectorEnv(1, [])


def test_settings_in_a_list_of_one_are_as_those_alone() -> None:
    with closing(SceneVectorEnv(2, [TaskSettings()], workers=2)) as env:
        assert len(env._settings) == 2


@pytest.mark.parametrize(
    "make",
    [
        SceneEnv,
        lambda name: SceneVectorEnv(2, name),
        lambda name: SceneVectorEnv(2, [name, name]),
        lambda name: SceneVecEnv(2, name),
        lambda name: ParallelSceneEnv({"ego": name}),
    ],
)
def test_the_name_of_a_scene_is_no_settings(make: Callable[[Any], Any]) -> None:
    with pytest.raises(InputError, match=r'settings must be TaskSettings, such as .*\("on_ramp"\), not \'on_ramp\''):
        make("on_ramp")


def test_gymnasium_takes_a_list_of_scenes() -> None:
    with closing(gymnasium.make_vec(SCENE_ENV_ID, 2, scene=["four_way", "roundabout"], time_limit_s=1.0)) as vector:
        assert isinstance(vector, SceneVectorEnv)
        assert [one.scene.name for one in vector._settings] == ["four_way", "roundabout"]
        assert {one.time_limit_s for one in vector._settings} == {1.0}
