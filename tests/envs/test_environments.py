"""The single, the vector and the Stable-Baselines3 environment."""

import subprocess
import sys
from collections.abc import Iterator
from contextlib import closing
from dataclasses import replace
from typing import Any

import gymnasium
import numpy as np
import pytest
from stable_baselines3.common.vec_env import VecMonitor

from tests.simulation.scenes import LOWER
from tint_sumo import ENV_IDS
from tint_sumo.config import REWARD_PRESETS, SENSORS, Sensor
from tint_sumo.core.errors import InputError
from tint_sumo.envs import TaskSettings
from tint_sumo.envs.rows import TRACKS
from tint_sumo.envs.sb3 import SceneVecEnv
from tint_sumo.envs.scene_env import SceneEnv
from tint_sumo.envs.vector import SceneVectorEnv
from tint_sumo.scenes import T_INTERSECTION, find_scene

ENV_ID = ENV_IDS[T_INTERSECTION]
GO, STOP = 2, 0


@pytest.fixture
def env() -> Iterator[SceneEnv]:
    env = SceneEnv()
    yield env
    env.close()


def play(env: gymnasium.Env[Any, Any], seed: int, steps: int = 150) -> list[Any]:
    rng = np.random.default_rng(seed)
    observation, info = env.reset(seed=seed)
    record = [observation, info["traits"]]
    for _ in range(steps):
        observation, reward, terminated, truncated, info = env.step(rng.integers(3))
        record += [observation, reward, terminated, truncated, info["traits"], info["outcome"]]
        if terminated or truncated:
            observation, info = env.reset()
            record += [observation, info["traits"]]
    return record


def assert_equal(first: Any, second: Any) -> None:
    if isinstance(first, dict):
        assert first.keys() == second.keys()
        for key in first:
            assert_equal(first[key], second[key])
    else:
        np.testing.assert_array_equal(first, second)


@pytest.mark.parametrize("module", ["", "tint_sumo:"])
def test_gymnasium_makes_it_by_its_id(module: str) -> None:
    """After ``import tint_sumo``, or with the module before the id and no import, as gymnasium documents."""
    code = f"""
import gymnasium
{"" if module else "import tint_sumo"}
env = gymnasium.make("{module}{ENV_ID}")
env.reset(seed=0)
print(env.step(0)[1])
vector = gymnasium.make_vec("{module}{ENV_ID}", num_envs=64, vectorization_mode="vector_entry_point")
print(vector.reset(seed=0)[0]["vehicles"].shape)
"""
    result = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    reward, shape = result.stdout.split("\n")[:2]
    assert float(reward) == pytest.approx(-0.0013)
    assert shape == "(64, 12, 2)"


def test_the_first_version_is_retired_and_says_so() -> None:
    with (
        pytest.warns(DeprecationWarning, match="out of date"),
        pytest.raises(gymnasium.error.DeprecatedEnv, match="Please use `tint_sumo/TIntersection-v1` instead"),
    ):
        gymnasium.make("tint_sumo/TIntersection-v0")


def test_headways_are_those_asked_for() -> None:
    """Drivers that keep a longer headway need longer for the street."""
    shares = []
    for tau_s in (0.5, 2.5):
        vector = SceneVectorEnv(8, TaskSettings(tau_s=tau_s))
        vector.reset(seed=0)
        for _ in range(150):
            observation, *_ = vector.step(np.zeros(8, np.int64))
        shares.append(observation["mask"].mean())
        vector.close()
    assert shares[0] > 1.15 * shares[1]


def test_one_seed_gives_one_history(env: SceneEnv) -> None:
    first = play(env, seed=3)
    for a, b in zip(first, play(env, seed=3), strict=True):
        assert_equal(a, b)
    with pytest.raises(AssertionError):
        for a, b in zip(first, play(env, seed=4), strict=False):
            assert_equal(a, b)


@pytest.mark.parametrize("num_envs", [3, 10])
def test_each_environment_of_a_batch_lives_like_a_single_one(num_envs: int) -> None:
    settings: dict[str, Any] = {"time_limit_s": 8.0, "sensor": "noisy_0.1", "tracks": True}
    vector = SceneVectorEnv(num_envs, TaskSettings(**settings), autoreset_mode="SameStep")
    single = SceneEnv(TaskSettings(**settings))
    try:
        observations, infos = vector.reset(seed=20)
        observation, info = single.reset(seed=22)
        rng = np.random.default_rng(0)
        ended = 0
        for _ in range(250):
            assert_equal(observation, {key: value[2] for key, value in observations.items()})
            for key in ("traits", *TRACKS):
                assert_equal(info[key], infos[key][2])
            actions = rng.integers(3, size=num_envs)
            observations, rewards, terminated, truncated, infos = vector.step(actions)
            observation, reward, end, cut, info = single.step(actions[2])
            assert (reward, end, cut) == (rewards[2], terminated[2], truncated[2])
            if end or cut:
                assert_equal(observation, infos["final_obs"][2])
                assert info["outcome"] == infos["final_info"]["outcome"][2]
                observation, info = single.reset()
                ended += 1
        assert ended >= 2
    finally:
        vector.close()
        single.close()


def test_the_observation_is_what_the_table_says(env: SceneEnv) -> None:
    observation, info = env.reset(seed=0)
    simulation = env._episodes.simulation
    assert observation["ego"] == pytest.approx([0.0, -5.0 / 20.0, 0.0, 0.0])
    for _ in range(30):
        observation, *_, info = env.step(np.int64(GO))
    speed = simulation.egos.speed_mps[0] / 3.0
    box = simulation.egos.box[0]
    heading = np.array([box["heading_x"], box["heading_y"]])
    assert observation["ego"][:2] * 20.0 == pytest.approx([box["x_m"], box["y_m"]], abs=1e-5)
    assert observation["ego"][2:] == pytest.approx(speed * heading, abs=1e-6)
    slots = np.flatnonzero(observation["mask"])
    for slot in slots:
        seen = observation["vehicles"][slot] * 20.0 + observation["ego"][:2] * 20.0
        assert seen == pytest.approx(simulation.slots.box[["x_m", "y_m"]][0, slot].tolist(), abs=1e-4)
        assert info["traits"][slot] == (0 if simulation.yielding.yields[0, slot] else 1)
    empty = observation["mask"] == 0.0
    assert not observation["vehicles"][empty].any()
    assert (info["traits"][empty] == -1).all()
    assert len(slots) >= 6


def test_infos_contain_positions_on_routes_with_tracks(env: SceneEnv) -> None:
    """The ego has passed the lower lane once its centre is beyond the border at y = 4 m, and the upper one never."""
    assert not set(TRACKS) & env.reset(seed=5)[1].keys()
    env = SceneEnv(TaskSettings(tracks=True, backend="traci"))
    env.reset(seed=5)
    simulation, passed, claimed = env._episodes.simulation, [], []
    while True:
        observation, _, terminated, truncated, info = env.step(np.int64(GO))
        present, route = simulation.slots.present[0], simulation.slots.route[0]
        assert_equal(info["position_m"], np.where(present, simulation.slots.front_m[0], 0.0))
        (leader,), (gap_m,) = simulation.leaders()
        assert_equal(info["gap_m"], np.where(leader >= 0, gap_m, np.inf))
        passed.append(observation["ego"][1] * 20.0 > 4.0)
        assert_equal(info["passed"], present & (route == LOWER) & passed[-1])
        claims = simulation.yielding.has_claimed[0]
        assert_equal(info["claimed"], present & claims[route])
        to_stop_m = simulation.layout.zones.stop_line_m[route] - info["position_m"]
        assert_equal(info["to_stop_m"], np.where(present, to_stop_m, np.inf))
        claimed.append(bool(info["claimed"].any()))
        if terminated or truncated:
            break
    env.close()
    assert info["outcome"] == "success"
    assert not passed[0] and passed[-1]
    assert not claimed[0] and any(claimed)


def test_position_noise_has_its_standard_deviation_and_spares_the_ego() -> None:
    clear, noisy = (
        SceneEnv(TaskSettings(tracks=True)),
        SceneEnv(TaskSettings(tracks=True, sensor=SENSORS["noisy_0.2"], backend="traci")),
    )
    try:
        clear.reset(seed=1)
        noisy.reset(seed=1)
        errors = []
        for _ in range(100):
            (exact, *_, known), (measured, *_, seen) = clear.step(np.int64(STOP)), noisy.step(np.int64(STOP))
            assert_equal(exact["ego"], measured["ego"])
            assert_equal(exact["mask"], measured["mask"])
            real = exact["mask"] == 1.0
            error_m = (measured["vehicles"] - exact["vehicles"]) * 20.0
            errors.append(error_m[real])
            assert not measured["vehicles"][~real].any()
            along_m = np.where(clear._episodes.simulation.slots.route[0] == LOWER, -1.0, 1.0) * error_m[:, 0]
            np.testing.assert_allclose(seen["position_m"] - known["position_m"], along_m, atol=1e-5)
            (leader,), _ = clear._episodes.simulation.leaders()
            gap_error_m = np.where(leader >= 0, along_m[leader] - along_m, 0.0)
            np.testing.assert_allclose(seen["gap_m"], known["gap_m"] + gap_error_m, atol=1e-5)
        error = np.concatenate(errors)
        assert error.std() == pytest.approx(0.2, rel=0.1)
        assert abs(error.mean()) < 0.02
    finally:
        clear.close()
        noisy.close()


@pytest.mark.parametrize("preset", ["paper", "authors"])
def test_rewards_and_outcomes(preset: str) -> None:
    env = SceneEnv(TaskSettings(p_conservative=0.6, reward=preset, time_limit_s=15.0))
    numbers = REWARD_PRESETS[preset]
    outcomes = set()
    try:
        for seed in range(25):
            env.reset(seed=seed)
            terminated = truncated = False
            while not (terminated or truncated):
                _, reward, terminated, truncated, info = env.step(np.int64(STOP if seed == 0 else GO))
                terms = info["reward_terms"]
                assert reward == pytest.approx(sum(terms.values()))
                speed_mps = env._episodes.simulation.egos.speed_mps[0]
                expected = {
                    "success": numbers.goal,
                    "collision": numbers.collision,
                }.get(info["outcome"], numbers.speed_weight_per_mps * speed_mps + numbers.step)
                assert reward == pytest.approx(expected)
            outcome = info["outcome"]
            outcomes.add(outcome)
            assert terminated is (outcome in ("success", "collision"))
            assert truncated is (outcome == "timeout")
            assert ("collision" in info) is (outcome == "collision")
            if outcome == "success":
                assert env._episodes.simulation.egos.box["x_m"][0] > 8.0
            if outcome == "timeout":
                assert info["time_s"] == pytest.approx(15.0)
        assert outcomes == {"success", "collision", "timeout"}
    finally:
        env.close()


def test_the_stable_baselines3_adapter() -> None:
    venv = VecMonitor(SceneVecEnv(4, TaskSettings(time_limit_s=1.0, tracks=True), seed=0))
    observation: Any = venv.reset()
    assert observation["vehicles"].shape == (4, 12, 2)
    assert len(venv.reset_infos) == 4
    kept = {key: value.copy() for key, value in observation.items()}
    for _ in range(10):
        following, _, dones, infos = venv.step(np.full(4, STOP))
        assert_equal(observation, kept)  # returned arrays are not reused
        observation, kept = following, {key: value.copy() for key, value in following.items()}
    assert dones.all()
    for info in infos:
        assert info["TimeLimit.truncated"]
        assert info["outcome"] == "timeout"
        assert info["episode"]["l"] == 10
        assert_equal(info["terminal_observation"]["mask"], info["terminal_slots"]["traits"] >= 0)
        assert info["terminal_slots"].keys() == venv.slots.keys() == {"traits", *TRACKS}
    assert_equal(observation["mask"], venv.slots["traits"] >= 0)
    assert_equal(venv.slots["traits"], [info["traits"] for info in infos])
    assert venv.get_attr("render_mode") == [None] * 4
    venv.close()


def test_the_adapter_says_what_the_rewards_consist_of_at_ends_too() -> None:
    with closing(SceneVecEnv(2, TaskSettings(time_limit_s=0.3), seed=0)) as venv:
        venv.reset()
        for _ in range(3):
            _, rewards, dones, infos = venv.step(np.array([GO, STOP]))
            for reward, info in zip(rewards, infos, strict=True):
                assert info["reward_terms"].keys() == {"goal", "collision", "speed", "step"}
                assert sum(info["reward_terms"].values()) == pytest.approx(reward, rel=1e-5)
        assert dones.all()


def test_parked_environments_are_empty_until_the_next_reset() -> None:
    venv, other = SceneVecEnv(3, seed=5), SceneVecEnv(3, seed=5)
    venv.reset(), other.reset()
    venv.env_method("park", indices=[1])
    for _ in range(20):
        observation, _, done, _ = venv.step(np.array([0, 0, 2]))
        expected, *_ = other.step(np.array([0, 2, 2]))
        assert not observation["mask"][1].any()
        assert not done[1]
        for key in observation:
            np.testing.assert_array_equal(observation[key][[0, 2]], expected[key][[0, 2]])
    assert venv.reset()["mask"].any(axis=1).all()
    with pytest.raises(NotImplementedError, match="no methods of their own but park"):
        venv.env_method("fly")
    venv.close()
    other.close()


def test_the_adapter_seeds_like_the_vector_environment() -> None:
    venv, vector = SceneVecEnv(3, seed=11), SceneVectorEnv(3)
    assert_equal(venv.reset(), vector.reset(seed=11)[0])
    venv.close()
    vector.close()


def test_rendering_shows_every_vehicle() -> None:
    env = SceneEnv(render_mode="rgb_array")
    _, info = env.reset(seed=0)
    image = env.render()
    assert image is not None and image.dtype == np.uint8 and image.shape == (320, 736, 3)
    image[0] = 0  # users may draw on it, and the next picture is without that
    again = env.render()
    assert again is not None and again[0].any()
    for value, colour in enumerate(((40, 90, 200), (200, 40, 40))):
        pixels = np.isclose(image, colour, atol=3).all(axis=2).sum()
        vehicles = int((info["traits"] == value).sum())
        assert pixels == pytest.approx(vehicles * 5 * 2 * 16 * 16 * 0.85, rel=0.2)  # less the windscreens
    env.close()


@pytest.mark.parametrize(("step_s", "decision_s", "fps"), [(0.1, None, 10.0), (0.5, None, 2.0), (0.5, 1.0, 1.0)])
def test_pictures_are_shown_in_real_time_whatever_the_step(step_s: float, decision_s: float | None, fps: float) -> None:
    scene = replace(find_scene(T_INTERSECTION), name="other", base=T_INTERSECTION, step_s=step_s)
    task = TaskSettings(scene, decision_s=decision_s)
    for made in (SceneEnv(task), SceneVectorEnv(1, task)):
        made.close()
        assert made.metadata["render_fps"] == fps


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"scene": "moon"}, "unknown scene 'moon'; choose one of: .*t_intersection"),
        ({"p_conservative": 1.5}, r"P\(conservative\) must be a probability .*, not 1.5"),
        ({"p_conservative": (0.6, 0.2)}, r"from low to high, not \(0.6, 0.2\)"),
        ({"p_conservative": (0.1, 0.2, 0.3)}, "must be a probability"),
        ({"tau_s": 0.0}, "tau_s must lie in 0.01 to 20, not 0.0"),
        ({"reward": "mine"}, "unknown reward preset 'mine'; choose one of paper, authors"),
        ({"time_limit_s": 0.01}, "time_limit_s must be at least a step"),
        ({"time_limit_s": float("inf")}, "time_limit_s must lie in 0.01 to 86400, not inf"),
        ({"sensor": "blind"}, "unknown sensor 'blind'; choose one of: perfect, noisy_0.1"),
        ({"sensor": 0.1}, r"sensor must be a Sensor or a name \(perfect, .*\), not 0.1"),
        ({"sensor": Sensor(delay_s=0.25)}, "delay_s must be a multiple of the step of 0.1 s, not 0.25"),
        ({"decision_s": 0.25}, "decision_s must be a multiple of the step of 0.1 s, not 0.25"),
        ({"decision_s": 0.0}, "decision_s must lie in 0.01 to 86400, not 0.0"),
        ({"decision_s": float("inf")}, "decision_s must lie in 0.01 to 86400, not inf"),
        ({"decision_s": float("nan")}, "decision_s must lie in 0.01 to 86400, not nan"),
        ({"decision_s": True}, "decision_s must lie in 0.01 to 86400, not True"),
        ({"max_episode_steps": 0}, "max_episode_steps must lie in 1 to "),
        ({"max_episode_steps": "3"}, "max_episode_steps must lie in 1 to "),
        ({"tracks": "yes"}, "tracks must be True or False, not 'yes'"),
    ],
)
def test_bad_arguments(arguments: dict[str, Any], message: str) -> None:
    with pytest.raises(InputError, match=message):
        SceneEnv(TaskSettings(**arguments))


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"position_noise_m": -0.1}, "position_noise_m must lie in 0 to 1000, not -0.1"),
        ({"position_noise_m": float("nan")}, "position_noise_m must lie in 0 to 1000, not nan"),
        ({"position_noise_m": "little"}, "position_noise_m must lie in 0 to 1000, not 'little'"),
        ({"position_noise_m": 0.1, "sensor": "range_15"}, "position_noise_m is noise_m of the sensor; leave it out"),
    ],
)
def test_bad_noise_of_gymnasium_s_shorthand(arguments: dict[str, Any], message: str) -> None:
    with pytest.raises(InputError, match=message):
        gymnasium.make(ENV_IDS[T_INTERSECTION], **arguments)


def test_gymnasium_s_shorthand_for_noise_is_a_sensor() -> None:
    env = gymnasium.make(ENV_IDS[T_INTERSECTION], position_noise_m=0.2)
    assert env.unwrapped._settings == TaskSettings(sensor=Sensor(noise_m=0.2))  # type: ignore[attr-defined]
    env.close()


def test_bad_render_modes() -> None:
    with pytest.raises(InputError, match="unknown render_mode 'ansi'; choose one of None, 'human', 'rgb_array'"):
        SceneEnv(render_mode="ansi")


def test_seeds_must_fit_the_environments() -> None:
    vector = SceneVectorEnv(2)
    with pytest.raises(InputError, match="3 seeds do not fit 2 environments"):
        vector.reset(seed=[1, 2, 3])
    vector.close()
