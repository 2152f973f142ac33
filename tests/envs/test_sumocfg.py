"""Environments of SUMO configurations, and snapshots of episodes."""

import hashlib
import pickle
from collections.abc import Callable, Iterator
from contextlib import closing, contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import psutil
import pytest
from gymnasium.utils.env_checker import check_env
from stable_baselines3.common.env_checker import check_env as check_env_sb3

from tests.envs.test_workers import assert_infos_equal
from tests.scenes.networks import USER_NETWORKS, UserNetwork
from tint_sumo import SCENE_ENV_ID
from tint_sumo.config import SENSORS, EgoController
from tint_sumo.core.errors import InputError
from tint_sumo.envs import TaskSettings
from tint_sumo.envs.sb3 import SceneVecEnv
from tint_sumo.envs.scene_env import SceneEnv
from tint_sumo.envs.vector import SceneVectorEnv
from tint_sumo.scenes import T_INTERSECTION, SumocfgScene

Make = Callable[[str], UserNetwork]
STEPS = 100


@contextmanager
def made(scene: SumocfgScene, **settings: Any) -> Iterator[SceneEnv]:
    env = SceneEnv(TaskSettings(scene, **settings))
    try:
        yield env
    finally:
        env.close()


def returned(answer: tuple[Any, ...]) -> list[Any]:
    """Return all that an environment returned, as values that can be compared."""
    observation, *rest = answer
    info = rest.pop()
    terms = info.pop("reward_terms", {})
    return [*(one.tolist() for one in observation.values()), *rest, terms, {k: str(v) for k, v in info.items()}]


def play(env: SceneEnv, seed: int, steps: int = STEPS) -> list[Any]:
    """Take random actions, also beyond an episode's end, so that all plays are equally long."""
    actions = np.random.default_rng(seed).integers(3, size=steps)
    return [returned(env.step(action)) for action in actions]


@pytest.mark.parametrize("name", USER_NETWORKS)
def test_gymnasium_makes_and_checks_them(name: str, user_network: Make) -> None:
    scene = user_network(name).scene(warm_up_s=5.0)
    env = gymnasium.make(SCENE_ENV_ID, scene=scene, render_mode="rgb_array", tracks=True)
    try:
        check_env(env.unwrapped, skip_render_check=True)
        check_env_sb3(env.unwrapped)
        observation, info = env.reset(seed=1)
        np.testing.assert_allclose(observation["ego"], 0.0, atol=1e-6)
        image = env.render()
        assert isinstance(image, np.ndarray)
        assert image.shape == (490, 736, 3)
        present = observation["mask"] > 0.5
        np.testing.assert_array_equal(info["traits"] >= 0, present)
        assert (info["traits"] < len(scene.vtypes)).all()
        assert (info["position_m"][~present] == 0.0).all()
        assert not info["passed"].any()
    finally:
        env.close()


@pytest.mark.parametrize("name", ["autobahn", "braunschweig"])
def test_configurations_that_sumo_ships_run_for_20_episodes_and_stay_as_they_are(name: str, user_network: Make) -> None:
    network = user_network(name)
    before = contents_of(network.sumocfg.parent)
    with made(network.scene(warm_up_s=5.0), max_episode_steps=10) as env:
        for seed in range(20):
            env.reset(seed=seed)
            while not any(env.step(2)[2:4]):
                pass
    assert contents_of(network.sumocfg.parent) == before


def contents_of(folder: Path) -> dict[Path, tuple[str, int]]:
    """Return the digests and times of change of all files in a folder."""
    return {
        file: (hashlib.sha256(file.read_bytes()).hexdigest(), file.stat().st_mtime_ns)
        for file in folder.rglob("*")
        if file.is_file()
    }


@pytest.mark.long
def test_resets_need_no_more_memory(user_network: Make) -> None:
    scene = user_network("merge").scene(warm_up_s=10.0, warm_starts=2)
    rss_bytes = []
    with made(scene) as env:
        for seed in range(500):
            env.reset(seed=seed)
            env.step(2)
            if seed in (99, 499):
                rss_bytes.append(psutil.Process().memory_info().rss)
    assert rss_bytes[1] - rss_bytes[0] < 2 * 2**20


def test_the_traits_are_the_numbers_of_the_vtypes(user_network: Make) -> None:
    with made(user_network("merge").scene(), time_limit_s=20.0) as env:
        seen = {int(trait) for trait in env.reset(seed=1)[1]["traits"]}
        for _ in range(199):
            observation, _, terminated, truncated, info = env.step(0)
            seen |= {int(trait) for trait in info["traits"]}
            assert env.observation_space.contains(observation)
            if terminated:
                break
        else:
            assert not truncated
            assert env.step(0)[3]
            assert env.snapshot().actions == (0,) * 200
    assert seen == {-1, 0, 1}


def test_the_speed_of_a_fast_ego_is_seen(user_network: Make) -> None:
    with made(user_network("merge").scene(controller=EgoController((0.0, 5.0, 12.0)))) as env:
        env.reset(seed=1)
        for _ in range(20):
            observation, *_ = env.step(2)
        egos = env.simulation.egos
        assert egos.speed_mps[0] > 4.0
        assert 12.0 * np.hypot(*observation["ego"][2:]) == pytest.approx(egos.speed_mps[0], rel=1e-5)


def test_the_position_of_the_ego_is_seen_all_along_its_way(user_network: Make) -> None:
    scene = user_network("merge").scene(controller=EgoController((0.0, 5.0, 12.0)))
    with made(scene) as env:
        env.reset(seed=1)
        for _ in range(80):
            observation, *_ = env.step(2)
        box = env.simulation.egos.box[0]
        assert box["x_m"] > 40.0
        assert observation["ego"][:2] * 55.0 == pytest.approx([box["x_m"], box["y_m"]], rel=1e-5)


def test_a_vector_has_as_many_workers_as_environments(user_network: Make) -> None:
    scene = user_network("merge").scene(warm_up_s=5.0, warm_starts=2)
    with pytest.raises(InputError, match="set workers to num_envs"):
        SceneVectorEnv(2, TaskSettings(scene))
    with pytest.raises(InputError, match="set workers to num_envs"):
        SceneVectorEnv(3, TaskSettings(scene), workers=2)
    rng = np.random.default_rng(0)
    vector = SceneVectorEnv(2, TaskSettings(scene), workers=2)
    try:
        first, _ = vector.reset(seed=5)
        actions = rng.integers(3, size=(20, 2))
        rewards = [vector.step(both)[1] for both in actions]
    finally:
        vector.close()
    for index in range(2):
        with made(scene) as env:
            observation, _ = env.reset(seed=5 + index)
            np.testing.assert_array_equal(observation["vehicles"], first["vehicles"][index])
            for action, reward in zip(actions[:, index], rewards, strict=True):
                assert env.step(action)[1] == reward[index]


def test_stable_baselines_has_them_too(user_network: Make) -> None:
    env = SceneVecEnv(1, TaskSettings(scene=user_network("merge").scene(warm_up_s=5.0), tracks=True), seed=3)
    try:
        env.reset()
        for _ in range(20):
            env.step(np.array([2]))
        assert set(env.slots) == {"traits", "position_m", "gap_m", "passed", "claimed", "to_stop_m"}
        env.env_method("park", indices=[0])
        env.step(np.array([2]))
    finally:
        env.close()


def test_an_ego_that_sumo_takes_away_ends_an_episode_as_lost(user_network: Make) -> None:
    network = user_network("merge")
    impatient = network.sumocfg.with_name("impatient.sumocfg")
    text = network.sumocfg.read_text()
    impatient.write_text(text.replace("</configuration>", '<time-to-teleport value="2"/></configuration>'))
    settings = TaskSettings(replace(network, sumocfg=impatient).scene(warm_up_s=1.0))
    with made(settings.played) as env:
        env.reset(seed=1)
        answer = env.step(0)
        while not (answer[2] or answer[3]):
            answer = env.step(0)
        _, reward, terminated, truncated, info = answer
    assert (info["outcome"], info["is_success"], terminated, truncated) == ("lost", False, False, True)
    assert reward == sum(info["reward_terms"].values()) <= 0.0
    with closing(SceneVectorEnv(1, settings)) as vector:
        vector.reset(seed=1)
        end = next(answer for answer in iter(lambda: vector.step(np.array([0])), None) if answer[2][0] or answer[3][0])
        assert (end[4]["outcome"][0], end[2][0], end[3][0]) == ("lost", False, True)
    venv = SceneVecEnv(1, settings, seed=1)
    try:
        venv.reset()
        done = np.array([False])
        while not done[0]:
            _, _, done, (info,) = venv.step(np.array([0]))
        assert (info["outcome"], info["TimeLimit.truncated"]) == ("lost", True)
    finally:
        venv.close()


@pytest.mark.parametrize("settings", [{"p_conservative": 0.5}, {"tau_s": 1.5}])
def test_the_mix_of_a_configuration_cannot_be_changed(settings: dict[str, float], user_network: Make) -> None:
    with pytest.raises(InputError, match=r"leave (p_conservative|tau_s) out"):
        SceneEnv(TaskSettings(user_network("merge").scene(), **settings))


@pytest.mark.parametrize("name", [*USER_NETWORKS, T_INTERSECTION])
def test_an_episode_goes_on_from_a_snapshot_as_it_did(name: str, user_network: Make) -> None:
    scene: Any = name if name == T_INTERSECTION else user_network(name).scene(warm_up_s=5.0)
    with made(scene, sensor=SENSORS["noisy_0.1"], tracks=True, time_limit_s=500.0) as env:
        env.reset(seed=1)
        play(env, 0, 10)
        here = env.step(1)
        snapshot = pickle.loads(pickle.dumps(env.snapshot()))
        went_on = play(env, 1)
        drawn = env.np_random.integers(1000)
        env.reset(seed=2)
        play(env, 2, 5)
        observation, info = env.restore(snapshot)
        assert returned((observation, info))[:3] == returned(here)[:3]
        assert play(env, 1) == went_on
        assert env.np_random.integers(1000) == drawn
        with made(scene, sensor=SENSORS["noisy_0.1"], tracks=True, time_limit_s=500.0, backend="traci") as other:
            other.restore(snapshot)
            assert play(other, 1) == went_on


@pytest.mark.parametrize("kind", ["one process", "workers", "scenes", "own network"])
def test_the_episodes_of_a_vector_go_on_from_a_snapshot_as_they_did(kind: str, user_network: Make) -> None:
    scenes: list[Any] = {
        "own network": [user_network("merge").scene(warm_up_s=5.0)] * 2,
        "scenes": ["roundabout", T_INTERSECTION],
    }.get(kind, [T_INTERSECTION])
    tasks = [TaskSettings(scene, sensor=SENSORS["noisy_0.1"], tracks=True, time_limit_s=12.0) for scene in scenes]
    further: dict[str, Any] = {"workers": 2, "autoreset_mode": "SameStep"} if kind == "workers" else {}
    settings = tasks[0] if kind == "workers" else tasks
    actions = np.random.default_rng(0).integers(3, size=(300, 4))
    with closing(SceneVectorEnv(4 if kind != "own network" else 2, settings, **further)) as vector:
        count = vector.num_envs
        vector.reset(seed=1)
        for action in actions[:50]:
            vector.step(action[:count])
        vector.reset(options={"reset_mask": np.arange(count) == 0})
        for action in actions[50:159]:
            vector.step(action[:count])
        here = vector.step(actions[159, :count])
        snapshots = pickle.loads(pickle.dumps(vector.snapshot()))
        went_on = [vector.step(action[:count]) for action in actions[160:]]
    assert len({len(one.actions) for one in snapshots}) > 1, "the episodes began at different times"
    with closing(SceneVectorEnv(count, settings, **further)) as other:
        observation, _ = other.restore(snapshots)
        assert_infos_equal(observation, here[0])
        goes_on = [other.step(action[:count]) for action in actions[160:]]
    for before, after in zip(went_on, goes_on, strict=True):
        for first, second in zip(before, after, strict=True):
            assert_infos_equal(first, second)
    assert any((one[2] | one[3]).any() for one in went_on)


def test_there_is_nothing_to_come_back_to_before_the_first_reset() -> None:
    with closing(SceneEnv()) as env, pytest.raises(InputError, match="reset the environment first"):
        env.snapshot()
    with closing(SceneVectorEnv(2)) as vector:
        with pytest.raises(InputError, match="reset the environment first"):
            vector.snapshot()
        vector.reset(seed=0)
        with pytest.raises(InputError, match="1 snapshots do not fit 2 environments"):
            vector.restore(vector.snapshot()[:1])


OTHERS: tuple[dict[str, Any], ...] = (
    {"scene": "four_way"},
    {"p_conservative": 0.5},
    {"time_limit_s": 20.0},
    {"tau_s": 1.5},
    {"sensor": "noisy_0.1"},
    {"decision_s": 0.2},
)


@pytest.mark.parametrize("task", OTHERS, ids=lambda task: next(iter(task)))
def test_a_snapshot_of_other_settings_is_refused(task: dict[str, Any]) -> None:
    with closing(SceneEnv()) as env, closing(SceneVectorEnv(2)) as vector:
        env.reset(seed=0), vector.reset(seed=0)
        snapshot, snapshots = env.snapshot(), vector.snapshot()
    with (
        closing(SceneEnv(TaskSettings(**task))) as env,
        pytest.raises(InputError, match="is of another scene or other"),
    ):
        env.restore(snapshot)
    with (
        closing(SceneVectorEnv(2, TaskSettings(**task))) as vector,
        pytest.raises(InputError, match="is of another scene or other"),
    ):
        vector.restore(snapshots)


def test_settings_that_leave_an_episode_as_it_is_may_differ() -> None:
    with closing(SceneEnv(TaskSettings(reward="authors", tracks=True))) as env:
        env.reset(seed=0)
        env.step(np.int64(2))
        snapshot = env.snapshot()
    with closing(SceneVectorEnv(1)) as vector:
        assert vector.restore([snapshot])[1]["time_s"].tolist() == [0.1]


def test_each_environment_of_a_vector_has_the_snapshots_of_its_scene() -> None:
    with closing(SceneVectorEnv(2, [TaskSettings("four_way"), TaskSettings()])) as vector:
        vector.reset(seed=0)
        first, second = vector.snapshot()
        with pytest.raises(InputError, match="is of another scene or other settings"):
            vector.restore([second, first])
        vector.restore([first, second])
