"""``tint-sumo policy``."""

import signal
import sys
from pathlib import Path

import minari
import pytest

from tests.cli.calls import Started, copy, files, refuse, run
from tint_sumo.cli import main
from tint_sumo.core.checkpoints import CHECKPOINT_FILE
from tint_sumo.core.files import shipped
from tint_sumo.methods.registry import METHODS, Learned
from tint_sumo.policy.storage import read_policy_card


def test_help_names_the_learned_methods(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit):
        main(["policy", "train", "--help"])
    printed = " ".join(capsys.readouterr().out.split())
    assert all(name in printed for name, method in METHODS.items() if isinstance(method, Learned))


def test_policy_train(
    tmp_path: Path, trait_model: Path, small_training: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "run"
    train = ("policy", "train", "--method", "vae", "--config", small_training)
    argv = (*train, "--steps", 1, "--traits", trait_model, "--out", out, "--sensor", "noisy_0.1")
    printed = run(capsys, *argv, "--p-conservative", 0.25)
    assert printed.pop("scene").startswith("t_intersection")
    assert printed == {
        "model": str(out / "policy.safetensors"), "method": "vae", "world": None, "sensors": ["noisy_0.1"],
        "p_conservative": [0.25], "steps": 1, "seed": 0,
    }  # fmt: skip
    before = files(out)
    assert "another run" in refuse(capsys, *argv, "--p-conservative", 0.3)
    assert files(out) == before
    found = run(capsys, "policy", "evaluate", "--model", out, "--episodes", 2)
    assert (found["p_conservative"], found["sensor"]) == (0.25, "noisy_0.1")
    argv = ("policy", "evaluate", "--model", out, "--episodes", 2, "--sensor", "perfect")
    assert run(capsys, *argv)["sensor"] == "perfect"


def test_a_pickled_policy_is_read_on_request_alone(
    tmp_path: Path, small_training: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "run"
    train = ("policy", "train", "--method", "oracle", "--config", small_training)
    run(capsys, *train, "--steps", 1, "--zip", "--out", out)
    argv = ("policy", "evaluate", "--model", out / "policy.zip", "--episodes", 2)
    assert "--allow-pickle if you trust the file" in refuse(capsys, *argv)
    assert main([*map(str, argv), "--allow-pickle"]) == 0
    printed = capsys.readouterr()
    assert "a pickle: it can run any code" in printed.err
    of_zip = printed.out
    assert main(["policy", "evaluate", "--model", str(out), "--episodes", "2"]) == 0
    assert capsys.readouterr().out == of_zip


def test_policy_evaluate(capsys: pytest.CaptureFixture[str]) -> None:
    printed = run(capsys, "policy", "evaluate", "--model", "always_go", "--episodes", 6, "--p-conservative", 0.9)
    assert printed["success"] + printed["collision"] + printed["timeout"] == pytest.approx(1.0)
    assert (printed["model"], printed["episodes"], printed["seed"]) == ("always_go", 6, 0)
    assert printed["p_conservative"] == 0.9
    assert "navigation_time_s" in printed
    low, high = printed["intervals"]["success"]
    assert low <= printed["success"] <= high


def test_policies_are_evaluated_in_other_traffic(capsys: pytest.CaptureFixture[str]) -> None:
    argv = ("policy", "evaluate", "--model", "ttc", "--episodes", 12, "--p-conservative", 0.2, 0.8)
    plain, other = run(capsys, *argv), run(capsys, *argv, "--noise", 0.2, "--tau", 0.5)
    assert plain["p_conservative"] == other["p_conservative"] == [0.2, 0.8]
    assert (other["position_noise_m"], other["tau_s"]) == (0.2, 0.5)
    assert plain["navigation_time_s"] != other["navigation_time_s"]


def test_policies_are_evaluated_with_other_sensors(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    argv = ("policy", "evaluate", "--model", "ttc", "--episodes", 6, "--p-conservative", 0.2, 0.8)
    near = run(capsys, *argv, "--sensor", "range_15", "--noise", 0.05)
    assert near["sensor"]["range_m"] == 15.0 and near["position_noise_m"] == near["sensor"]["noise_m"] == 0.05
    file = tmp_path / "config.yaml"
    file.write_text("sensor: {base: range_15, noise_m: 0.05}")
    assert run(capsys, *argv, "--config", file) == near
    file.write_text("sensor: {base: noisy_0.2, range: 3}")
    assert "sensor.range: there is no such setting" in refuse(capsys, *argv, "--config", file)
    assert "--noise is 0.1 m, and 0.2 m in the sensor" in refuse(capsys, *argv, "--sensor", "noisy_0.2", "--noise", 0.1)
    assert run(capsys, *argv, "--sensor", "noisy_0.2", "--noise", 0.2)["sensor"] == "noisy_0.2"


def test_policies_are_trained_and_tested_in_worlds(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out, small = tmp_path / "run", tmp_path / "small.yaml"
    small.write_text("scene: {time_limit_s: 1.0}\nbudget: {n_envs: 9, n_steps: 16, n_minibatches: 2}\n")
    train = ("policy", "train", "--method", "no_labels", "--config", small, "--steps", 1, "--out", out)
    trained = run(capsys, *train, "--world", "strangers")
    assert trained["scene"].startswith("t_intersection-")  # with the changed time limit and the world's drivers
    assert (trained["world"], len(trained["sensors"])) == ("strangers", 9)
    card = read_policy_card(out / "policy")
    assert len(card["sensors"]) == 9 and "sensor" not in card
    assert card["scene_settings"]["population"]["towns"]["count"] == 128
    tests = ("policy", "evaluate", "--model", out, "--episodes", 2)
    late = run(capsys, *tests, "--world", "headway_2.0", "--p-conservative", 0.3)
    assert (late["tau_s"], late["sensor"], late["p_conservative"]) == (2.0, "perfect", 0.3)
    assert run(capsys, *tests, "--world", "delay_0.2")["sensor"] == "delay_0.2"
    both = ("--world", "towns", "--sensor", "range_15")
    assert "a world has a sensor; give --world or --sensor" in refuse(capsys, *tests, *both)
    for sensor in ("range_15", "perfect"):
        wrong = refuse(capsys, *train, "--world", "towns", "--sensor", sensor)
        assert "a world has a sensor; give --world or --sensor" in wrong
    train_in_all = ("policy", "train", "--method", "no_labels", "--out", out, "--scene", "all", "--world", "towns")
    assert "a world is of one scene; give --world, or --scene all" in refuse(capsys, *train_in_all)
    assert run(capsys, *tests, "--world", "delay_0.2")["world"] == "delay_0.2"
    assert "are for training, and a test has one sensor" in refuse(capsys, *tests, "--world", "strangers")
    assert "unknown world 'moon'" in refuse(capsys, *tests, "--world", "moon")
    assert "unknown world 'moon'" in refuse(capsys, *train, "--world", "moon")


def test_damaged_models(dataset: Path, trait_model: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    broken = copy(trait_model.parent, tmp_path / "broken")
    (broken / "model.safetensors").write_bytes(b"nonsense")
    assert "damaged" in refuse(capsys, "traits", "evaluate", "--data", dataset, "--model", broken)
    policy = tmp_path / "policy.safetensors"
    policy.write_bytes(b"nonsense")
    policy.with_suffix(".json").write_bytes((shipped("models") / "policies" / "oracle.json").read_bytes())
    assert "damaged" in refuse(capsys, "policy", "evaluate", "--model", policy)


def test_an_interrupted_training_goes_on(
    tmp_path: Path, small_training: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    train = ("policy", "train", "--method", "oracle", "--config", small_training)
    argv = (*train, "--steps", 6_400, "--out", tmp_path / "run")
    printed = Started(*argv).interrupt_at(r"[1-9]\d*% ", signal.SIGTERM)
    assert "Traceback" not in printed
    assert "tint-sumo: interrupted" in printed
    names = {path.name for path in (tmp_path / "run").glob("[!.]*")}
    assert names >= {"run.json", CHECKPOINT_FILE, "curve.csv", "tensorboard"}
    assert "policy.safetensors" not in names
    run(capsys, *argv)
    assert (tmp_path / "run" / "policy.safetensors").exists()
    assert not (tmp_path / "run" / CHECKPOINT_FILE).exists()


def test_episodes_are_recorded_for_minari(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(tmp_path / "minari"))
    argv = ("policy", "record", "--model", "ttc", "--episodes", 2, "--world", "towns", "--seed", 4)
    found = run(capsys, *argv, "--minari", "ttc-v0", "--author", "Ada")
    assert found["folder"] == str(tmp_path / "minari" / "ttc-v0")
    dataset = minari.load_dataset("ttc-v0")
    assert (found["episodes"], found["decisions"]) == (len(dataset), dataset.total_steps)
    assert sum(found["outcomes"].values()) == 2
    assert dataset.storage.metadata["author"] == {"Ada"} and "towns" in dataset.env_spec.kwargs["scene"]["population"]
    before = files(tmp_path)
    assert "is there already; give another name or version as --minari" in refuse(capsys, *argv, "--minari", "ttc-v0")
    assert "--minari one as tint_sumo/streaming-v0" in refuse(capsys, *argv, "--minari", "ttc")
    monkeypatch.setitem(sys.modules, "minari", None)
    monkeypatch.delitem(sys.modules, "tint_sumo.methods.minari_dataset")
    assert 'install it: pip install "tint_sumo[minari]"' in refuse(capsys, *argv, "--minari", "ttc-v1")
    assert files(tmp_path) == before


@pytest.mark.slow
def test_recorded_episodes_do_not_depend_on_the_number_of_processes(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    argv = ("policy", "record", "--model", "oracle", "--episodes", 52, "--p-conservative", 0.9, "--minari", "oracle-v0")
    for workers in (1, 2):
        run(capsys, *argv, "--workers", workers, "--out", tmp_path / str(workers))
    one, two = ({path.name: content for path, content in files(tmp_path / str(count)).items()} for count in (1, 2))
    assert one == two and len(one) == 2


@pytest.mark.long
def test_an_interrupted_recording_of_episodes_leaves_nothing(tmp_path: Path) -> None:
    argv = ("policy", "record", "--model", "always_go", "--episodes", 5000, "--minari", "mine/b-v0", "--out", tmp_path)
    printed = Started(*argv).interrupt_at(r"[1-9]\d*% ", signal.SIGTERM)
    assert "Traceback" not in printed
    assert "interrupted; all files are whole, nothing was kept" in printed
    assert list(tmp_path.iterdir()) == []
