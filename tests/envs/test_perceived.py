"""Further keys of the observation in SUMO configurations, and the consequences of red lights."""

from collections.abc import Iterator
from contextlib import closing
from dataclasses import replace
from typing import Any, get_args

import numpy as np
import pytest
from stable_baselines3.common.env_checker import check_env

from tests.envs.test_environments import assert_equal
from tests.scenes.networks import lights
from tint_sumo.config import Perceivable, Sensor
from tint_sumo.core.errors import InputError
from tint_sumo.envs import TaskSettings
from tint_sumo.envs.perceived import perceived_in, perceived_spaces
from tint_sumo.envs.sb3 import SceneVecEnv
from tint_sumo.envs.scene_env import SceneEnv
from tint_sumo.envs.vector import SceneVectorEnv
from tint_sumo.scenes import SumocfgScene
from tint_sumo.simulation.ego_way import EGO

ALL: tuple[Perceivable, ...] = get_args(Perceivable)
BUILT_IN_KEYS = ("ego", "vehicles", "mask")
GO, STOP = 2, 0
RED, GREEN = "r", "G"


@pytest.fixture(scope="module")
def scene(tmp_path_factory: pytest.TempPathFactory) -> SumocfgScene:
    """Two crossings with lights, in steps of 0.5 s."""
    return lights(tmp_path_factory.mktemp("lights"), 0.5).scene(warm_up_s=10.0, time_limit_s=40.0, sight_m=100.0)


def set_all(env: SceneEnv, state: str) -> None:
    """Give all signals of all lights this state."""
    signals = env.simulation.connection.trafficlight  # type: ignore[attr-defined]
    for name in signals.getIDList():
        signals.setRedYellowGreenState(name, state * len(signals.getRedYellowGreenState(name)))


def steps_of(env: SceneEnv, state: str = "") -> Iterator[tuple[Any, float, bool, bool, dict[str, Any]]]:
    """Yield the returns of an episode at top speed, with all lights in a state."""
    env.reset(seed=1)
    if state:
        set_all(env, state)
    ended = False
    while not ended:
        answer = env.step(GO)
        ended = answer[2] or answer[3]
        yield answer


def test_observations_have_the_keys_that_are_asked_for_and_are_as_ever_otherwise(scene: SumocfgScene) -> None:
    with (
        closing(SceneEnv(TaskSettings(scene))) as plain,
        closing(SceneEnv(TaskSettings(replace(scene, perceives=ALL)))) as rich,
    ):
        assert set(plain.observation_space.spaces) == set(BUILT_IN_KEYS)
        added = perceived_spaces(ALL, 12)
        assert set(rich.observation_space.spaces) == {*BUILT_IN_KEYS, *added}
        few, many = plain.reset(seed=3)[0], rich.reset(seed=3)[0]
        actions = np.random.default_rng(3).integers(3, size=30)
        for action in actions:
            assert set(few) == set(BUILT_IN_KEYS)
            assert_equal(few, {key: many[key] for key in BUILT_IN_KEYS})
            few, many = plain.step(action)[0], rich.step(action)[0]
    with closing(SceneEnv(TaskSettings(replace(scene, perceives=("lane",))))) as env:
        assert set(env.reset(seed=3)[0]) == {*BUILT_IN_KEYS, "lane"}


def test_values_are_those_of_sumo_in_the_units_that_are_documented(scene: SumocfgScene) -> None:
    seen, first = set(), False
    with closing(SceneEnv(TaskSettings(replace(scene, perceives=ALL, red_light="ignore")))) as env:
        for seed in range(3):
            observation, _ = env.reset(seed=seed)
            connection, ended = env.simulation.connection, False  # type: ignore[attr-defined]
            while not ended:
                assert env.observation_space.contains(observation)
                lane, upcoming = connection.vehicle.getLaneID(EGO), connection.vehicle.getNextTLS(EGO)
                assert observation["speed_limit"] == pytest.approx(min(connection.lane.getMaxSpeed(lane) / 10.0, 2.0))
                edge, index = lane.rsplit("_", 1)
                assert observation["lane"].tolist() == [float(index), connection.edge.getLaneNumber(edge)]
                links = connection.vehicle.getNextLinks(EGO)
                if links and not lane.startswith(":"):
                    left_m = connection.lane.getLength(lane) - connection.vehicle.getLanePosition(EGO)
                    expected = [float(links[0][5] not in "MGOY"), min(left_m / 20.0, 5.0)]
                    assert observation["right_of_way"] == pytest.approx(expected, abs=1e-5)
                assert (observation["priority"] <= observation["mask"]).all()
                first |= bool(observation["priority"].any())
                assert not observation["pedestrian_mask"].any(), "nobody is on foot here"
                state, (distance, time) = observation["traffic_light"][:6], observation["traffic_light"][6:]
                if upcoming:
                    _, _, distance_m, letter = upcoming[0]
                    assert state.tolist() == [letter in letters for letters in ("ru", "yY", "G", "g", "s", "oO")]
                    assert distance == pytest.approx(min(distance_m / 20.0, 5.0), abs=1e-5)
                    assert 0.0 < time <= 10.0
                    seen.add(letter)
                else:
                    assert (state.tolist(), distance, time) == ([0.0] * 6, 5.0, 0.0)
                    seen.add("")
                observation, _, terminated, truncated, _ = env.step(GO)
                ended = terminated or truncated
            assert env.observation_space.contains(observation)
    assert seen >= {"r", ""}
    assert first, "somebody had priority"


def test_they_are_the_same_in_vectors_with_workers(scene: SumocfgScene) -> None:
    task = TaskSettings(replace(scene, perceives=ALL, red_light="cost"), decision_s=1.0)
    rng = np.random.default_rng(0)
    with closing(SceneVectorEnv(2, task, workers=2)) as vector, closing(SceneEnv(task)) as single:
        observations, _ = vector.reset(seed=5)
        one, _ = single.reset(seed=6)
        for _ in range(25):
            assert_equal({key: values[1] for key, values in observations.items()}, one)
            actions = rng.integers(1, 3, size=2)
            observations, rewards, _, _, infos = vector.step(actions)
            one, reward, terminated, truncated, info = single.step(actions[1])
            assert rewards[1] == reward
            assert infos["cost"][1] == info["cost"]
            assert infos["reward_terms"]["red_light"][1] == info["reward_terms"]["red_light"]
            if terminated or truncated:
                break


@pytest.mark.parametrize("decision_s", [0.5, 2.0])
def test_a_red_light_ends_an_episode_or_costs_or_is_ignored(scene: SumocfgScene, decision_s: float) -> None:
    def play(state: str, **rules: Any) -> list[tuple[Any, float, bool, bool, dict[str, Any]]]:
        with closing(SceneEnv(TaskSettings(replace(scene, **rules), decision_s=decision_s))) as env:
            return list(steps_of(env, state))

    ignored, green = play(RED), play(GREEN)
    assert [step[1] for step in ignored] == [step[1] for step in green]
    assert ignored[-1][4]["outcome"] == "success"
    assert "cost" not in ignored[0][4] and "red_light" not in ignored[0][4]["reward_terms"]

    costly = play(RED, red_light="cost", red_light_penalty=0.25)
    costs = [step[4]["cost"] for step in costly]
    assert sum(costs) == 2.0, "each of the two lights once"
    for (_, reward, *_, info), (_, before, *_) in zip(costly, ignored, strict=True):
        assert reward == pytest.approx(before - 0.25 * info["cost"])
        assert info["reward_terms"]["red_light"] == -0.25 * info["cost"]
        assert reward == pytest.approx(sum(info["reward_terms"].values()))
    assert [step[1] for step in play(GREEN, red_light="cost")] == [step[1] for step in green]

    _, reward, terminated, truncated, info = play(RED, red_light="end")[-1]
    assert (info["outcome"], terminated, truncated, info["is_success"]) == ("red_light", True, False, False)
    assert info["reward_terms"]["red_light"] == -2.0
    assert reward == pytest.approx(sum(info["reward_terms"].values()))
    assert "cost" not in info and "collision" not in info
    assert play(GREEN, red_light="end")[-1][4]["outcome"] == "success"


def test_stable_baselines_gets_keys_costs_and_outcomes(scene: SumocfgScene) -> None:
    task = TaskSettings(replace(scene, perceives=ALL, red_light="end"))
    with closing(SceneEnv(task)) as env:
        check_env(env)
    with closing(SceneVecEnv(1, task, seed=1)) as venv:
        venv.reset()
        done = np.array([False])
        while not done[0]:
            _, _, done, infos = venv.step(np.array([GO]))
        assert infos[0]["outcome"] in ("red_light", "success", "collision")
        assert set(infos[0]["terminal_observation"]) == set(venv.observation_space.spaces)  # type: ignore[attr-defined]
    with closing(SceneVecEnv(1, replace(task, scene=replace(scene, red_light="cost")), seed=1)) as venv:
        venv.reset()
        assert venv.step(np.array([STOP]))[3][0]["cost"] == 0.0


def test_costs_of_an_episode_s_last_step_are_kept(scene: SumocfgScene) -> None:
    costly = replace(scene, red_light="cost")
    with closing(SceneEnv(TaskSettings(costly))) as env:
        last_s = next(info["time_s"] for *_, info in steps_of(env) if info["cost"])
    task = TaskSettings(costly, time_limit_s=last_s)
    with closing(SceneVecEnv(1, task, seed=1)) as venv:
        venv.reset()
        done, costs = np.array([False]), []
        while not done[0]:
            _, _, done, infos = venv.step(np.array([GO]))
            costs.append(infos[0]["cost"])
    assert costs == [0.0] * (len(costs) - 1) + [1.0]
    with closing(SceneVectorEnv(1, task, autoreset_mode="SameStep")) as vector:
        vector.reset(seed=1)
        for _ in costs:
            *_, last = vector.step(np.array([GO]))
    assert last["final_info"]["cost"].tolist() == [1.0]


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"perceives": "lane"}, r"perceives must be names such as \('traffic_light', 'lane'\), not 'lane'"),
        ({"perceives": ("lane", "weather")}, "perceives must be one of traffic_light, .*, not 'weather'"),
        ({"red_light": "stop"}, "red_light must be one of ignore, cost, end, not 'stop'"),
        ({"red_light_penalty": -1.0}, "red_light_penalty must lie in 0 to 1000, not -1"),
    ],
)
def test_settings_that_make_no_sense_are_refused(scene: SumocfgScene, changes: dict[str, Any], message: str) -> None:
    with pytest.raises(InputError, match=message):
        replace(scene, **changes)


def test_scenes_of_one_vector_must_observe_the_same(scene: SumocfgScene) -> None:
    tasks = [TaskSettings(scene), TaskSettings(replace(scene, perceives=("lane",)))]
    with pytest.raises(InputError, match="must have the same `tracks`, `perceives` and `red_light`"):
        SceneVectorEnv(2, tasks)


def test_names_are_found_by_their_keys() -> None:
    for names in ((), ("lane",), ("right_of_way", "pedestrians"), ALL):
        assert perceived_in([*BUILT_IN_KEYS, *perceived_spaces(names, 3)]) == names


def test_priorities_are_delayed_with_their_slots(scene: SumocfgScene) -> None:
    watchful = replace(scene, perceives=("right_of_way",))
    found = []
    for sensor in (Sensor(), Sensor(delay_s=1.0)):
        with closing(SceneEnv(TaskSettings(watchful, sensor=sensor))) as env:
            first = env.reset(seed=1)[0]
            found.append([first, *(env.step(0)[0] for _ in range(40))])
    for step, late in enumerate(found[1]):
        for key in ("priority", "mask", "vehicles"):
            np.testing.assert_array_equal(late[key], found[0][max(step - 2, 0)][key])
        np.testing.assert_array_equal(late["right_of_way"], found[0][step]["right_of_way"])
    assert any(one["priority"].any() for one in found[0])


def test_names_are_put_in_order_and_each_once(scene: SumocfgScene) -> None:
    assert replace(scene, perceives=("lane", "traffic_light", "lane")).perceives == ("traffic_light", "lane")
