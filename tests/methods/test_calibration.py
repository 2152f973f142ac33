from collections.abc import Callable
from contextlib import closing
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from stable_baselines3.common.vec_env import VecEnv
from torch import nn

from tests.methods import runs
from tests.simulation.scenes import T
from tint_sumo.config import PERFECT, SENSORS, Mix, PpoSettings
from tint_sumo.core.determinism import single_threaded
from tint_sumo.core.errors import InputError
from tint_sumo.methods.calibration import calibrate
from tint_sumo.methods.registry import find_learned
from tint_sumo.methods.training import calibrated, new_model, train_policy, training_venv
from tint_sumo.policy import GruPolicy
from tint_sumo.policy.storage import load_policy_network, read_policy_card

METHOD = find_learned("no_labels")
EPISODES, SEED = 12, 77


def environments(p_conservative: float, settings: PpoSettings) -> Callable[[int], VecEnv]:
    return lambda num_envs: training_venv(METHOD, None, Mix(p_conservative), replace(settings, n_envs=num_envs), [T])


def policy_with(logits: tuple[float, float, float]) -> GruPolicy:
    """A policy with these logits of standing, creeping and going, whatever it observes."""
    with closing(environments(0.5, runs.SETTINGS)(2)) as venv:
        policy = new_model(venv, 0, replace(runs.SETTINGS, n_envs=2)).policy
    assert isinstance(policy.action_net, nn.Linear)
    with torch.no_grad():
        policy.action_net.weight.zero_()
        policy.action_net.bias.copy_(torch.tensor(logits))
    return policy


def logits_of(policy: GruPolicy) -> list[float]:
    assert isinstance(policy.action_net, nn.Linear)
    return [round(value, 6) for value in policy.action_net.bias.tolist()]


def test_among_drivers_who_yield_the_least_bias_with_which_it_goes_is_added() -> None:
    policy, settings = policy_with((0.8, -5.0, 0.0)), replace(runs.SETTINGS, action_repeat=4, time_limit_s=20.0)
    found = calibrate(policy, environments(1.0, settings), SEED, EPISODES, 4)
    earned = found.returns
    assert earned["0"] == earned["0.5"] < earned["1"] == earned["1.5"] == earned["2"]
    assert found.bias == 1.0 and logits_of(policy) == [0.8, -4.0, 1.0]


def test_where_going_costs_more_than_waiting_nothing_is_added() -> None:
    policy, settings = policy_with((0.8, -5.0, 0.0)), replace(runs.SETTINGS, action_repeat=4, time_limit_s=20.0)
    found = calibrate(policy, environments(0.0, replace(settings, reward="careful")), SEED, EPISODES, 4)
    assert found.bias == 0.0 and found.returns["1"] < found.returns["0"]
    assert logits_of(policy) == [0.8, -5.0, 0.0]


@pytest.mark.parametrize("batch", [1, 5])
def test_the_result_does_not_depend_on_the_batch(batch: int) -> None:
    settings = replace(runs.SETTINGS, action_repeat=4, time_limit_s=10.0)
    found = [calibrate(policy_with((0.8, -5.0, 0.0)), environments(0.5, settings), SEED, 5, n) for n in (batch, 3)]
    assert found[0] == found[1]


@pytest.mark.parametrize("episodes", [2, 4])
def test_a_training_ends_with_its_calibration(tmp_path: Path, episodes: int) -> None:
    settings = replace(runs.SETTINGS, n_minibatches=4, calibration_episodes=episodes, time_limit_s=5.0)
    with_it, without = (
        train_policy("no_labels", Mix(0.5), 100, 1, tmp_path / str(used.calibration_episodes), settings=used)
        for used in (settings, replace(settings, calibration_episodes=0))
    )
    policy = load_policy_network(without.with_suffix(""))
    with single_threaded():
        found = calibrated(policy, lambda: environments(0.5, settings)(settings.n_envs), 1, settings)
    card = read_policy_card(with_it.with_suffix(""))
    assert card["calibration"] == {"bias": found.bias, "returns": found.returns}
    assert "calibration" not in read_policy_card(without.with_suffix(""))
    trained = load_policy_network(with_it.with_suffix("")).state_dict()
    assert all(torch.equal(trained[key], value) for key, value in policy.state_dict().items())


def test_all_sensors_of_a_training_have_their_share_of_the_calibration(tmp_path: Path) -> None:
    settings = replace(runs.SETTINGS, calibration_episodes=6)
    message = r"calibration_episodes must be 0 or a multiple of n_envs \(4\), .* not 6"
    with pytest.raises(InputError, match=message):
        train_policy("no_labels", Mix(0.5), 64, 0, tmp_path, settings=settings, sensors=[PERFECT, SENSORS["range_15"]])
    assert not list(tmp_path.iterdir())
