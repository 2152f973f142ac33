"""The command line from the outside: in-process where that shows the same, as a subprocess for signals."""

import json
import os
import platform
import re
import signal
import subprocess
import sys
import time
from importlib.metadata import version
from pathlib import Path
from typing import Any

import pandas
import pytest
import torch

from tests.terminal import look, open_terminal
from tint_sumo import __version__, traits
from tint_sumo.cli import main
from tint_sumo.config import TraitSettings
from tint_sumo.core.checkpoints import CHECKPOINT_FILE
from tint_sumo.core.files import shipped
from tint_sumo.core.stores import name_in
from tint_sumo.dataset.recorder import record
from tint_sumo.methods.evaluation import Case, Evaluation
from tint_sumo.methods.registry import METHODS, Learned
from tint_sumo.study.budgets import Conditions
from tint_sumo.study.folders import RESULTS
from tint_sumo.study.results import GIVEN, Measured, Result
from tint_sumo.traits.storage import save

PATIENCE_S = 100.0
COMMANDS = (
    "net",
    "record",
    "dataset inspect",
    "traits train",
    "traits evaluate",
    "traits plot",
    "traits infer",
    "traits study",
    "policy train",
    "policy evaluate",
    "study run",
    "study report",
    "render",
    "bench",
    "models",
)


@pytest.fixture(scope="session")
def dataset(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("data") / "dataset"
    record(folder, 100, workers=2, progress=False)  # in other processes: this one's libsumo stays free
    return folder


@pytest.fixture(scope="session")
def trait_model(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A trait model nobody trained."""
    torch.manual_seed(0)
    settings = TraitSettings(embedding_sizes=(8, 8), hidden_size=8, encoder_output_size=8, decoder_output_size=8)
    folder = tmp_path_factory.mktemp("model")
    save(traits.TRAIT_METHODS["vae"](settings), folder / "model", {"seed": 0})
    save(traits.TRAIT_METHODS["vae"](settings, latent_size=3), folder / "wide", {"seed": 0})
    return folder / "model.safetensors"


def files(folder: Path) -> dict[Path, bytes]:
    return {path: path.read_bytes() for path in folder.rglob("*") if path.is_file()}


def run(capsys: pytest.CaptureFixture[str], *argv: Any) -> dict[str, Any]:
    """A command that must succeed; the object it prints last."""
    assert main([*map(str, argv), "--json"]) == 0
    printed = json.loads(capsys.readouterr().out.splitlines()[-1])
    assert isinstance(printed, dict)
    return printed


def refuse(capsys: pytest.CaptureFixture[str], *argv: Any) -> str:
    """A command that must be refused; the line it prints."""
    assert main([*map(str, argv)]) == 2
    printed = capsys.readouterr()
    assert printed.out == ""
    lines = printed.err.strip().splitlines()
    assert len(lines) == 1
    assert lines[0].startswith("tint-sumo: error: ")
    return lines[0]


# Help and arguments


@pytest.mark.parametrize("command", COMMANDS)
def test_every_command_has_help_and_json(command: str, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as stop:
        main([*command.split(), "--help"])
    assert stop.value.code == 0
    assert "--json" in capsys.readouterr().out


@pytest.mark.parametrize("columns", [60, 80])
@pytest.mark.parametrize("command", ["", *COMMANDS])
def test_help_boxes_fit_the_terminal(
    command: str, columns: int, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("COLUMNS", str(columns))
    with pytest.raises(SystemExit):
        main([*command.split(), "--help"])
    _, _, boxes = capsys.readouterr().out.split("\n\n", 2)  # behind the usage and what the command does
    assert max(map(len, boxes.splitlines())) == columns


def test_versions_are_told_at_once() -> None:
    script = (
        "import sys, tint_sumo.cli\n"
        "assert tint_sumo.cli.main(['--version']) == 0\n"
        "print([name for name in ('torch', 'libsumo') if name in sys.modules])"
    )
    printed = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=True).stdout
    assert printed.splitlines() == [
        f"tint-sumo {__version__}",
        f"SUMO {version('libsumo')}, torch {torch.__version__}, gymnasium {version('gymnasium')}, "
        f"Python {platform.python_version()}",
        "[]",
    ]


def test_models_are_listed_and_shown(capsys: pytest.CaptureFixture[str]) -> None:
    models = run(capsys, "models")["models"]
    kinds = {kind: {one["name"] for one in models if one["kind"] == kind} for kind in ("trait model", "policy")}
    learned = {name for name, method in METHODS.items() if isinstance(method, Learned)}
    assert kinds == {"trait model": set(traits.TRAIT_METHODS), "policy": learned}
    assert {one["scene"] for one in models} == {"t_intersection"}
    assert all("% of windows" in one["result"] or one["result"].startswith("success ") for one in models)
    assert main(["models"]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert lines[0].split() == ["name", "kind", "method", "scene", "training", "result"]
    assert len(lines) == 1 + len(models)
    cards = run(capsys, "models", "vae")["models"]
    assert [(one["kind"], one["card"]["method"]) for one in cards] == [("trait model", "vae"), ("policy", "vae")]
    assert "unknown shipped model 'nobody'; choose one of: classifier, " in refuse(capsys, "models", "nobody")


def test_help_is_quick() -> None:
    script = (
        "import sys, tint_sumo.cli\n"
        "try: tint_sumo.cli.main(['policy', 'train', '--help'])\n"
        "except SystemExit: print([name for name in ('torch', 'pandas', 'libsumo', 'sklearn') if name in sys.modules])"
    )
    printed = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=True).stdout
    assert printed.splitlines()[-1] == "[]"


def test_help_names_the_learned_methods(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit):
        main(["policy", "train", "--help"])
    printed = " ".join(capsys.readouterr().out.split())
    assert all(name in printed for name, method in METHODS.items() if isinstance(method, Learned))


@pytest.mark.parametrize(
    "argv", [[], ["fly"], ["record"], ["policy", "evaluate", "--model", "ttc", "--episodes", "many"], ["net", "--x"]]
)
def test_argument_errors_exit_with_2(argv: list[str], capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as stop:
        main(argv)
    assert stop.value.code == 2
    assert capsys.readouterr().out == ""


# What the commands do


def test_net(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    printed = run(capsys, "net", "--out", tmp_path / "net", "--replicas", 2)
    assert printed["replicas"] == 2
    assert {Path(file).name for file in printed["files"]} >= {"tint.net.xml", "tint.sumocfg"}
    assert all(Path(file).is_file() for file in printed["files"])


def test_record(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = tmp_path / "data"
    printed = run(capsys, "record", "--out", out, "--windows", 50, "--p-conservative", 0.3, "--seed", 4, "--workers", 2)
    assert printed["windows"] >= 50
    assert (printed["p_conservative"], printed["seed"]) == (0.3, 4)
    assert json.loads((out / "manifest.json").read_text()) == printed


def test_traits(dataset: Path, tmp_path: Path, trait_model: Path, capsys: pytest.CaptureFixture[str]) -> None:
    printed = run(capsys, "traits", "evaluate", "--data", dataset, "--model", trait_model, "--noise", 0.1)
    assert 0.0 <= printed["accuracy"] <= 1.0
    assert 0.5 <= printed["majority_share"] < 1.0
    assert printed["noise_m"] == 0.1
    assert 0 < printed["windows"] < json.loads((dataset / "manifest.json").read_text())["windows"]
    printed = run(capsys, "traits", "plot", "--data", dataset, "--model", trait_model, "--out", tmp_path)
    assert len(printed["files"]) == 2
    assert all(Path(file).read_bytes().startswith(b"\x89PNG") for file in printed["files"])


@pytest.mark.parametrize("name", ["table.csv", "below/table.parquet"])
def test_traits_infer(
    name: str, dataset: Path, tmp_path: Path, trait_model: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / name
    printed = run(capsys, "traits", "infer", "--fcd", dataset, "--model", trait_model, "--out", out)
    table = pandas.read_csv(out, dtype={"vehicle": str}) if out.suffix == ".csv" else pandas.read_parquet(out)
    assert printed["out"] == str(out)
    assert printed["columns"] == list(table)
    assert printed["windows"] == len(table) == json.loads((dataset / "manifest.json").read_text())["windows"]
    assert printed["vehicles"] == table["vehicle"].nunique()
    assert printed["outside"] is None  # this model's card does not tell
    assert main(["traits", "infer", "--fcd", str(dataset), "--model", "vae", "--out", str(out)]) == 0
    text = capsys.readouterr().out
    assert re.search(r"\n<?\d+\.\d% of the windows lie outside what the model was trained on\n", text)


def test_policy_evaluate(capsys: pytest.CaptureFixture[str]) -> None:
    printed = run(capsys, "policy", "evaluate", "--model", "always_go", "--episodes", 6, "--p-conservative", 0.9)
    assert printed["success"] + printed["collision"] + printed["timeout"] == pytest.approx(1.0)
    assert (printed["model"], printed["episodes"], printed["seed"]) == ("always_go", 6, 0)
    assert printed["p_conservative"] == 0.9
    assert "navigation_time_s" in printed
    low, high = printed["intervals"]["success"]
    assert low <= printed["success"] <= high


def test_render(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    argv = ("render", "--model", "always_go", "--p-conservative", 0.4, "--case", 3, "--out", tmp_path / "film.gif")
    printed = run(capsys, *argv)
    assert {key: printed[key] for key in ("case", "outcome", "time_s", "frames")} == {
        "case": 3, "outcome": "collision", "time_s": 2.4, "frames": 25
    }  # fmt: skip
    assert [path.name for path in tmp_path.iterdir()] == ["film.gif"]


def test_record_in_the_format_of_sumo(dataset: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = copy(dataset, tmp_path / "copy")
    run(capsys, "record", "--windows", 100, "--out", out, "--format", "fcd")
    assert (out / "fcd" / "shard-00000.xml.gz").exists()
    assert {path: content for path, content in files(out).items() if "fcd" not in path.parts} == {
        out / path.relative_to(dataset): content for path, content in files(dataset).items()
    }


def test_dataset_inspect(dataset: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    printed = run(capsys, "dataset", "inspect", dataset)
    manifest = json.loads((dataset / "manifest.json").read_text())
    assert printed["manifest"] == manifest
    assert sum(trait["rows"] for trait in printed["traits"].values()) == manifest["rows"]
    assert main(["dataset", "inspect", str(dataset), "--figure", str(tmp_path / "figure.png")]) == 0
    text = capsys.readouterr().out
    assert re.search(r"windows +\d+\n", text)
    assert "aggressive, gap to the leader (m)" in text
    assert f"wrote {tmp_path / 'figure.png'}" in text


@pytest.fixture(scope="session")
def small_training(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A configuration whose rollouts take a moment."""
    file = tmp_path_factory.mktemp("small") / "config.yaml"
    file.write_text("budget: {n_envs: 8, n_steps: 16, n_minibatches: 2}\n")
    return file


def test_policy_train(
    tmp_path: Path, trait_model: Path, small_training: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "run"
    train = ("policy", "train", "--method", "vae", "--config", small_training)
    argv = (*train, "--steps", 1, "--traits", trait_model, "--out", out)
    printed = run(capsys, *argv, "--p-conservative", 0.25)
    assert printed == {
        "model": str(out / "policy.safetensors"), "method": "vae", "p_conservative": [0.25], "steps": 1, "seed": 0
    }  # fmt: skip
    before = files(out)
    assert "another run" in refuse(capsys, *argv, "--p-conservative", 0.3)
    assert files(out) == before
    found = run(capsys, "policy", "evaluate", "--model", out, "--episodes", 2)
    assert found["p_conservative"] == [0.25, 0.25]


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


def test_policies_are_evaluated_in_other_worlds(capsys: pytest.CaptureFixture[str]) -> None:
    argv = ("policy", "evaluate", "--model", "ttc", "--episodes", 12, "--p-conservative", 0.2, 0.8)
    plain, other = run(capsys, *argv), run(capsys, *argv, "--noise", 0.2, "--tau", 0.5)
    assert plain["p_conservative"] == other["p_conservative"] == [0.2, 0.8]
    assert (other["position_noise_m"], other["tau_s"]) == (0.2, 0.5)
    assert plain["navigation_time_s"] != other["navigation_time_s"]


@pytest.fixture(scope="session")
def small_study(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A study of three cases."""
    out = tmp_path_factory.mktemp("results")
    cases = Evaluation((Case("success", 12.0),) * 3)
    result = Result("ttc", GIVEN, None, 0, (Measured(Conditions(0.4), cases),))
    (out / RESULTS).mkdir()
    (out / RESULTS / "one.json").write_text(json.dumps(result.to_json()))
    assert main(["study", "report", "--out", str(out)]) == 0
    return out


@pytest.mark.parametrize("named", ["r/", "./", "e", "file"])
def test_study_report_names_its_files_as_the_user_does(
    named: str, small_study: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    folder = tmp_path if named == "./" else tmp_path / named
    copy(small_study, folder)
    monkeypatch.chdir(tmp_path)
    out = folder.as_uri() if named == "file" else named
    printed = run(capsys, "study", "report", "--out", out)
    assert list(printed) == ["results", "files"]
    assert [(row["method"], row["success"]) for row in printed["results"]] == [("ttc", 1.0)]
    names = ["results.csv", "results.md", "results.png", "report.html"]
    assert printed["files"] == [name_in(out, name) for name in names]
    assert all((folder / name).is_file() for name in names)
    assert main(["study", "report", "--out", out]) == 0
    text = capsys.readouterr().out
    assert "| time to collision |" in text
    assert all(f"wrote {file}\n" in text for file in printed["files"])


# Bad input


@pytest.mark.parametrize(
    ("argv", "message"),
    [
        ("net --replicas 0 --out OUT", "replicas"),
        ("net --scene moon --out OUT", "unknown scene 'moon'"),
        ("record --p-conservative 1.5 --out OUT", "p_conservative"),
        ("record --windows 0 --out OUT", "windows"),
        ("record --scene moon --out OUT", "unknown scene 'moon'; choose one of: "),
        ("record --seed -1 --out OUT", "seed"),
        ("dataset inspect NOWHERE", "dataset"),
        ("traits train --data NOWHERE --out OUT", "dataset"),
        ("traits train --data DATA --method magic --out OUT", "unknown trait method 'magic'"),
        ("traits train --data DATA --seed -1 --out OUT", "seed"),
        ("traits train --data DATA --noise -0.1 --out OUT", "noise must lie in 0 to 1000"),
        ("traits evaluate --data NOWHERE --model MODEL", "dataset"),
        ("traits evaluate --data DATA --model MODEL --noise nan", "noise must lie in 0 to 1000"),
        ("traits evaluate --data DATA --model nobody", "no trait model nobody"),
        ("traits infer --fcd NOWHERE --model MODEL --out OUT.csv", "floating-car data: no file"),
        ("traits infer --fcd MODEL --model MODEL --out MODEL", "holds the data themselves"),
        ("traits infer --fcd DATA --model nobody --out OUT.csv", "no trait model nobody"),
        ("traits infer --fcd DATA --model MODEL --out OUT", "must end in .csv or .parquet"),
        ("traits infer --fcd DATA --model MODEL --out MODEL/table.csv", "cannot be a file there"),
        ("traits infer --fcd DATA --model MODEL --net NOWHERE --out OUT.csv", "knows its leaders"),
        ("traits infer --fcd MODEL --model MODEL --net NOWHERE --out OUT.csv", "SUMO network: no file"),
        ("traits infer --fcd MODEL --model MODEL --out OUT.csv", "is not whole XML"),
        (
            "traits infer --fcd DATA --model MODEL --vehicle-length 0 --out OUT.csv",
            "vehicle_length must lie in 0.5",
        ),
        ("policy train --method magic --out OUT", "unknown method 'magic'"),
        ("policy train --method ttc --out OUT", "hand-written rule"),
        ("policy train --method ours --out OUT", "ours is now called vae"),
        ("policy train --method oracle --p-conservative -0.1 --out OUT", "p_conservative"),
        ("policy train --method oracle --p-conservative 0.6 0.2 --out OUT", "from low to high"),
        ("policy train --method oracle --p-conservative 0.1 0.2 0.3 --out OUT", "one probability or two"),
        ("policy train --method streaming --traits MODEL --out OUT", "of a cross_window model, not of vae"),
        ("policy train --method oracle --steps 0 --out OUT", "steps"),
        ("policy train --method oracle --scene moon --out OUT", "unknown scene 'moon'"),
        ("policy train --method vae --traits nobody --out OUT", "no trait model nobody"),
        ("policy train --method vae --traits WIDE --out OUT", "3 latents where 2 are needed"),
        ("policy evaluate --model nobody", "no policy nobody"),
        ("policy evaluate --model ttc --p-conservative 2", "p_conservative"),
        ("policy evaluate --model ttc --scene moon", "unknown scene 'moon'"),
        ("policy evaluate --model ttc --noise -1", "noise must lie in 0 to 1000, not -1.0"),
        ("policy evaluate --model ttc --tau 0", "tau must lie in 0.01 to 20, not 0.0"),
        ("policy evaluate --model ttc --episodes 0", "episodes"),
        ("policy evaluate --model ttc --seed -1", "seed"),
        ("policy train --method oracle --out s3://bucket/run", "--out of this command is a path on this machine"),
        ("traits evaluate --data file:///data --model MODEL", "--data of this command is a path on this machine"),
        ("policy sweep --set n_epochs=2 --set gamma=0.9 --out OUT", "--set is given twice; give it once"),
        ("study run --workers 0 --out OUT", "workers"),
        ("study report --out NOWHERE", "no results in"),
        ("render --model always_go --out film.avi", "film.avi must end in .mp4, .gif or .png"),
        ("render --model always_go --out film.gif --case -1", "case must lie in 0 to 999,999, not -1"),
        ("render --model magic --out film.gif", "no policy magic"),
        ("render --model always_go --out film.gif --p-conservative 2", "p_conservative"),
    ],
)
def test_bad_values(
    argv: str, message: str, dataset: Path, trait_model: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    places = {
        "OUT": tmp_path / "out",
        "NOWHERE": tmp_path / "nowhere",
        "DATA": dataset,
        "MODEL": trait_model,
        "WIDE": trait_model.with_stem("wide"),
        "OUT.csv": tmp_path / "out.csv",
        "MODEL/table.csv": trait_model / "table.csv",
    }
    before = files(dataset)
    assert message in refuse(capsys, *(places.get(word, word) for word in argv.split()))
    assert not any(tmp_path.iterdir())
    assert files(dataset) == before


@pytest.mark.parametrize(
    "argv",
    [
        "record",
        "traits train --data DATA",
        "policy train --method oracle",
        "study run",
    ],
)
def test_a_folder_with_other_files_is_left_alone(
    argv: str, dataset: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "precious.txt").write_text("mine")
    words = (dataset if word == "DATA" else word for word in argv.split())
    assert "already holds other files" in refuse(capsys, *words, "--out", tmp_path)
    assert [path.name for path in tmp_path.iterdir()] == ["precious.txt"]


@pytest.mark.parametrize("argv", ["record", "policy train --method oracle", "study run", "net"])
def test_a_file_is_no_folder(argv: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = tmp_path / "file"
    out.write_text("mine")
    assert "choose another --out" in refuse(capsys, *argv.split(), "--out", out)
    assert "file" in refuse(capsys, *argv.split(), "--out", out / "below")
    assert out.read_text() == "mine"


def copy(source: Path, target: Path) -> Path:
    for path, content in files(source).items():
        to = target / path.relative_to(source)
        to.parent.mkdir(parents=True, exist_ok=True)
        to.write_bytes(content)
    return target


def test_a_dataset_of_another_schema_version(
    dataset: Path, trait_model: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    other = copy(dataset, tmp_path / "other")
    manifest = json.loads((other / "manifest.json").read_text())
    (other / "manifest.json").write_text(json.dumps({**manifest, "schema_version": 99}))
    for argv in (("evaluate", "--model", trait_model), ("train", "--out", tmp_path / "out")):
        assert "schema version 99" in refuse(capsys, "traits", *argv, "--data", other)
    assert not (tmp_path / "out").exists()


def test_a_damaged_dataset(
    dataset: Path, trait_model: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    other = copy(dataset, tmp_path / "other")
    shard = next((other / "trajectories").iterdir())
    shard.write_bytes(shard.read_bytes()[:100])
    assert "damaged" in refuse(capsys, "traits", "evaluate", "--model", trait_model, "--data", other)
    for argv in (f"dataset inspect {other}", f"record --windows 100 --out {other} --format fcd"):
        assert main(argv.split()) == 2
        assert "is damaged" in capsys.readouterr().err.splitlines()[-1]  # behind the progress bar


def test_damaged_models(dataset: Path, trait_model: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    broken = copy(trait_model.parent, tmp_path / "broken")
    (broken / "model.safetensors").write_bytes(b"nonsense")
    assert "damaged" in refuse(capsys, "traits", "evaluate", "--data", dataset, "--model", broken)
    policy = tmp_path / "policy.safetensors"
    policy.write_bytes(b"nonsense")
    policy.with_suffix(".json").write_bytes((shipped("models") / "policies" / "oracle.json").read_bytes())
    assert "damaged" in refuse(capsys, "policy", "evaluate", "--model", policy)


# Interruption


class Started:
    """A ``tint-sumo`` of its own with a terminal, interrupted as soon as that shows a pattern."""

    def __init__(self, *argv: Any) -> None:
        command = [sys.executable, "-m", "tint_sumo.cli", *map(str, argv)]
        self.terminal, theirs = open_terminal()
        self.process = subprocess.Popen(command, stderr=theirs)
        os.close(theirs)

    def interrupt_at(self, pattern: str, sent: signal.Signals) -> str:
        """What it printed after the interruption."""
        seen, end = "", time.monotonic() + PATIENCE_S
        while not re.search(pattern, seen):
            assert time.monotonic() < end, seen
            piece = self.read()
            assert piece, seen
            seen += piece
        self.process.send_signal(sent)
        rest = "".join(iter(self.read, ""))
        assert self.process.wait(PATIENCE_S) == 130
        return rest

    def read(self) -> str:
        return look(self.terminal, PATIENCE_S)


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


def test_an_interrupted_study_leaves_whole_files(tmp_path: Path) -> None:
    out = tmp_path / "study"
    printed = Started("study", "run", "--out", out).interrupt_at(r"record: +[1-9]", signal.SIGINT)
    assert "Traceback" not in printed
    assert "the same command goes on from here" in printed
    assert not list(out.rglob("*.partial"))
    assert (out / "run.json").exists()
    assert not (out / "dataset" / "manifest.json").exists()
    for shard in (out / "dataset" / "trajectories").iterdir():
        assert shard.read_bytes().endswith(b"PAR1")
