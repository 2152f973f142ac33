"""Flags with which commands drive in a SUMO configuration."""

from collections.abc import Callable
from pathlib import Path

import pytest

from tests.cli.calls import refuse, run
from tests.scenes.networks import UserNetwork
from tint_sumo.cli.command_line import parse
from tint_sumo.cli.policy import TrainPolicy
from tint_sumo.config import EgoController
from tint_sumo.policy.storage import read_policy_card
from tint_sumo.scenes import SumocfgScene

TASK = ("--ego-route", "ramp", "out", "--start-m", 20, "--goal-m", 130, "--speeds-mps", 0, 3, 8, "--time-limit-s", 2)
QUICK = "budget: {n_envs: 1, n_steps: 4, n_minibatches: 1, n_epochs: 1}\n"


@pytest.fixture(scope="module")
def merge(user_network: Callable[[str], UserNetwork]) -> UserNetwork:
    return user_network("merge")


def test_a_policy_is_trained_and_evaluated_in_a_configuration(
    merge: UserNetwork, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out, file = tmp_path / "run", tmp_path / "quick.yaml"
    file.write_text(QUICK)
    road = ("--perceives", "traffic_light", "lane", "--red-light", "end")
    network = ("--sumocfg", merge.sumocfg, *TASK, "--warm-up-s", 1, "--warm-starts", 2, *road)
    trained = run(
        capsys, *("policy", "train", "--method", "no_labels", *network, "--steps", 8, "--out", out, "--config", file)
    )
    assert trained["p_conservative"] is None
    settings = read_policy_card(out / "policy")["scene_settings"]
    assert (settings["ego_route"], settings["warm_starts"]) == (["ramp", "out"], 2)
    assert settings["controller"]["desired_speeds_mps"] == [0.0, 3.0, 8.0]
    assert (settings["perceives"], settings["red_light"]) == (["traffic_light", "lane"], "end")
    blind = ("--sumocfg", merge.sumocfg, *TASK)
    refused = refuse(capsys, "policy", "evaluate", "--model", out, "--episodes", 1, *blind)
    assert "needs perceives of traffic_light, lane, and scene merge has nothing" in refused
    found = run(capsys, "policy", "evaluate", "--model", out, "--episodes", 1)
    assert (found["scene"], found["timeout"]) == ("merge", 1.0)
    for rule in ("always_go", "ttc", "sumo"):
        assert run(capsys, "policy", "evaluate", "--model", rule, *network, "--episodes", 1)["timeout"] == 1.0


def test_names_of_edges_may_begin_with_a_minus(merge: UserNetwork, monkeypatch: pytest.MonkeyPatch) -> None:
    asked: list[list[str]] = []
    monkeypatch.setattr("tint_sumo.scenes.from_sumocfg", lambda _, ego_route, **__: asked.append(ego_route))
    for route in (["--ego-route", "-3", "-3.22"], ["--ego-route=-E1 -E2"], ["--ego-route", "E1", "E2"]):
        words = ["policy", "train", "--method", "no_labels", "--out", "run", "--goal-m", "9", *route]
        command = parse([*words, "--sumocfg", str(merge.sumocfg)])
        assert isinstance(command, TrainPolicy)
        command.scene_of(command.scene)
    assert asked == [["-3", "-3.22"], ["-E1", "-E2"], ["E1", "E2"]]


def test_flags_are_the_arguments_of_the_scene(merge: UserNetwork) -> None:
    words = ["policy", "evaluate", "--model", "ttc", "--sumocfg", str(merge.sumocfg), *map(str, TASK)]
    command = parse(words)
    scene = command.scene_of(command.scene)  # type: ignore[attr-defined]
    assert isinstance(scene, SumocfgScene)
    assert scene == merge.scene(controller=EgoController((0.0, 3.0, 8.0)), time_limit_s=2.0, warm_up_s=30.0)


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (("--goal-m", 9), "--goal-m goes with --sumocfg; give that, or leave it out"),
        (("--sumocfg", "MERGE"), "--sumocfg needs --ego-route and --goal-m"),
        (("--sumocfg", "MERGE", "--ego-route", "ramp"), "--sumocfg needs --goal-m"),
        (("--sumocfg", "MERGE", *TASK, "--scene", "on_ramp"), "--scene does not go with --sumocfg"),
        (("--sumocfg", "MERGE", *TASK, "--p-conservative", 0.2), "leave p_conservative out"),
        (("--sumocfg", "MERGE", "--ego-route", "out", "--goal-m", 1e5), "goal (100000 m) must lie on its route"),
        (("--sumocfg", "MERGE", *TASK, "--budget", "quick"), "n_envs must be at most 32"),
    ],
)
def test_flags_that_do_not_fit_are_refused(
    words: tuple[object, ...], message: str, merge: UserNetwork, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    given = [merge.sumocfg if word == "MERGE" else word for word in words]
    out = tmp_path / "run"
    assert message in refuse(capsys, "policy", "train", "--method", "no_labels", "--out", out, *given)
    assert not out.exists()
