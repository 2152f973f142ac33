"""The benchmark on tiny sizes: what it prints, not how fast anything is."""

import json
import sys
from dataclasses import replace

import pytest

from tint_sumo import ENV_IDS
from tint_sumo.bench import Sizes, run_benchmark
from tint_sumo.bench.measuring import Clocks
from tint_sumo.bench.policies import TrainingSpeed, training_speed
from tint_sumo.scenes import T_INTERSECTION
from tint_sumo.simulation.timing import StepPart, does
from tint_sumo.study.budgets import BUDGETS
from tint_sumo.traits import TRAIT_METHODS

TINY_PPO = replace(BUDGETS["full"].ppo, n_envs=4, n_steps=3, n_minibatches=2)
TINY = Sizes(
    replicas=4,
    turns=2,
    turn_steps=3,
    gym_turn_steps=5,
    network_steps=5,
    windows=20,
    training_windows=50,
    ppo=TINY_PPO,
    paper_ppo=TINY_PPO,
    training_turns=2,
    decisions=3,
    memory_env_steps=(12, 24),
)


@pytest.mark.slow
def test_the_benchmark_measures_everything() -> None:
    found = run_benchmark(TINY, progress=False)
    printed = json.loads(json.dumps(found.to_json()))
    assert printed.keys() == {
        "floor_env_steps_per_s",
        "env_steps_per_s",
        "env_to_floor",
        "checking_floor_env_steps_per_s",
        "env_to_checking_floor",
        "gym_env_steps_per_s",
        "cores",
        "networks",
        "network_workers",
        "record_windows_per_s",
        "peak_memory_mib",
        "windows",
        "memory_growth_mib",
        "train_windows_per_s",
        "encode_ms",
        "scenes_to_t_intersection",
        "policy_trainings",
        "decision_ms",
        "breakdown_us",
    }
    assert [cores["replicas"] for cores in printed["cores"]] == [4, 8]
    for cores in printed["cores"]:
        assert cores.keys() == {"replicas", "one", "two", "ratio"}
        assert min(cores.values()) > 0.0
    assert [network.pop("name") for network in printed["networks"]] == ["fokr_bs_demo", "grid"]
    assert all(min(network.values()) > 0.0 for network in printed["networks"])
    assert list(printed["breakdown_us"]) == list(StepPart)
    speeds = [printed[key] for key in printed if key.endswith("steps_per_s")]
    assert min(speeds + list(printed["breakdown_us"].values())) > 0.0
    assert [training.pop("budget") for training in printed["policy_trainings"]] == ["full", "paper"]
    assert all(min(training.values()) > 0.0 for training in printed["policy_trainings"])
    assert printed["decision_ms"] > 0.0
    for part in ("train_windows_per_s", "encode_ms"):
        assert printed[part].keys() == TRAIT_METHODS.keys()
        assert min(printed[part].values()) > 0.0
    assert printed["scenes_to_t_intersection"].keys() == ENV_IDS.keys() - {T_INTERSECTION}
    assert min(printed["scenes_to_t_intersection"].values()) > 0.0
    assert printed["windows"] >= 20
    assert printed["peak_memory_mib"] > 50.0  # three Pythons
    table = found.table()
    assert all(part in table for part in StepPart)
    assert "clocks around the functions that do these parts" in table
    assert "our speed to its" in table
    assert "trait inference at every simulation step" in table


def test_training_is_measured_without_sb3_contrib(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "sb3_contrib", None)  # as if it were not installed
    found = training_speed("quick", TINY_PPO, turns=1)
    assert found.decisions_per_s > 0.0
    assert found == TrainingSpeed("quick", found.decisions_per_s, None, None)
    assert found.rows()[1:] == [
        ("  with sb3-contrib's RecurrentPPO", "sb3-contrib is not installed: pip install sb3-contrib")
    ]


class Work:
    """Takes its time from a fake clock."""

    def __init__(self) -> None:
        self.now_s = 0.0

    @does(StepPart.OTHER)
    def outer(self) -> str:
        self.now_s += 1.0
        self.inner()
        self.inner()
        return "done"

    @does(StepPart.SUMO)
    def inner(self) -> None:
        self.now_s += 10.0


def test_time_in_a_watched_method_counts_once(monkeypatch: pytest.MonkeyPatch) -> None:
    work = Work()
    monkeypatch.setattr("time.perf_counter", lambda: work.now_s)
    clocks = Clocks()
    clocks.watch(work)
    assert work.outer() == "done"
    assert (clocks.spent_s[StepPart.OTHER], clocks.spent_s[StepPart.SUMO]) == (1.0, 20.0)


def test_a_marked_method_costs_nothing_until_it_is_watched() -> None:
    """A mark wraps nothing, and clocks are put around the methods of the watched objects alone."""

    def step() -> None:
        pass

    assert does(StepPart.OTHER)(step) is step
    watched, other = Work(), Work()
    Clocks().watch(watched)
    assert vars(watched).keys() - vars(other).keys() == {"outer", "inner"}
