from typing import Any

import numpy as np
import pytest

from tint_sumo.config import Sensor
from tint_sumo.core.errors import InputError
from tint_sumo.envs import TaskSettings
from tint_sumo.envs.sb3 import SceneVecEnv
from tint_sumo.policy import ActionRepeat, OracleTraits
from tint_sumo.policy.trait_sources import StreamingTraits
from tint_sumo.policy.wrappers import policy_venv
from tint_sumo.traits import load

GO, STOP = 2, 0


def test_a_decision_is_so_many_steps_and_the_sum_of_their_rewards() -> None:
    plain, repeated = SceneVecEnv(3, seed=0), ActionRepeat(SceneVecEnv(3, TaskSettings(backend="traci"), seed=0), 4)
    plain.reset()
    repeated.reset()
    for action in (GO, STOP, GO):
        actions = np.full(3, action)
        steps = [plain.step(actions) for _ in range(4)]
        expected, _, done, _ = steps[-1]
        observation, total, ended, infos = repeated.step(actions)
        np.testing.assert_allclose(total, sum(step[1] for step in steps), rtol=1e-5)
        for index, info in enumerate(infos):
            assert sum(info["reward_terms"].values()) == pytest.approx(total[index], rel=1e-5)
            for term, value in info["reward_terms"].items():
                assert value == pytest.approx(sum(step[3][index]["reward_terms"][term] for step in steps))
        assert not (done | ended).any()
        for key, value in expected.items():
            np.testing.assert_array_equal(observation[key], value)
    plain.close()
    repeated.close()


def test_an_episode_ends_the_decision_and_the_next_one_waits() -> None:
    venv = ActionRepeat(SceneVecEnv(2, TaskSettings(time_limit_s=0.6), seed=0), 4)
    venv.reset()
    assert not venv.step(np.full(2, GO))[2].any()
    observation, rewards, done, infos = venv.step(np.full(2, GO))
    assert done.all()
    assert infos[0]["outcome"] == "timeout"
    assert infos[0]["TimeLimit.truncated"]
    assert infos[0]["terminal_observation"]["ego"][1] > -0.25  # had driven
    np.testing.assert_allclose(observation["ego"], [[0.0, -0.25, 0.0, 0.0]] * 2)  # the fresh ego has not
    speeds_mps = np.array([1.5, 1.8])  # of the last two steps: 3 m/s2 from standing
    assert rewards[0] == pytest.approx((0.05 * speeds_mps - 0.0013).sum(), abs=1e-5)
    venv.close()


def test_at_least_one_step() -> None:
    venv = SceneVecEnv(1)
    with pytest.raises(InputError, match="at least 1 step, not 0"):
        ActionRepeat(venv, 0)
    venv.close()


def test_every_step_is_shown_until_an_episode_s_very_end() -> None:
    """The end is shown at the end, not the beginning of the next episode."""
    shown: list[tuple[Any, Any]] = []
    task = TaskSettings(time_limit_s=0.6)
    venv = policy_venv(2, OracleTraits(), [task], action_repeat=4, on_step=lambda *step: shown.append(step))
    venv.seed(0)
    first = venv.reset()
    venv.step(np.array([2, 0]))
    *_, done, _ = venv.step(np.array([2, 0]))
    venv.close()
    assert done.all()
    assert isinstance(first, dict) and first.keys() == shown[0][0].keys()
    np.testing.assert_array_equal(shown[0][0]["ego"], first["ego"])
    assert [info.get("outcome", "") for _, infos in shown[:7] for info in infos] == [""] * 12 + ["timeout"] * 2
    observation, infos = shown[6]
    for env, info in enumerate(infos):
        for key, value in info["terminal_observation"].items():
            np.testing.assert_array_equal(observation[key][env], value)
        np.testing.assert_array_equal(info["traits"], info["terminal_slots"]["traits"])
    assert (np.diff([step["ego"][0, 1] for step, _ in shown[:7]]) > 0).all()  # it never starts anew


def test_a_vehicle_that_the_sensor_has_lost_is_another_driver_when_it_is_seen_again() -> None:
    """The fifth number of streaming traits is how long a driver has been seen, in units of 10 s."""
    sensor = Sensor(dropouts_per_s=1.0, dropout_s=0.3, occlusion=True)
    venv = policy_venv(3, StreamingTraits(load("cross_window")), [TaskSettings(sensor=sensor)])
    base = venv.unwrapped
    assert isinstance(base, SceneVecEnv)
    venv.seed(4)
    observation = venv.reset()
    ages: dict[tuple[int, int], int] = {}
    for _ in range(60):
        assert isinstance(observation, dict)
        track = base.slots["track"]
        for env, slot in np.argwhere(track >= 0).tolist():
            known = (env, int(track[env, slot]))
            ages[known] = ages.get(known, 0) + 1
            assert round(observation["traits"][env, slot, 4] * 100) == ages[known]
        assert not observation["traits"][track < 0].any()
        observation, _, done, _ = venv.step(np.full(3, STOP))
        assert not done.any()
    venv.close()
    assert len(ages) > 60  # tracks of some thirty vehicles
