"""The command line as a whole: help, versions, bad input, folders that are left alone, interruptions."""

import ast
import json
import platform
import subprocess
import sys
from importlib.metadata import version
from itertools import pairwise
from pathlib import Path

import pytest
import torch

from tests.cli.calls import copy, files, refuse
from tests.commands import commands
from tint_sumo import __version__, cli
from tint_sumo.cli import main

COMMANDS = tuple(name for name, _ in commands())


@pytest.mark.parametrize("command", COMMANDS)
def test_every_command_has_help_and_json(command: str, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as stop:
        main([*command.split(), "--help"])
    assert stop.value.code == 0
    assert "--json" in capsys.readouterr().out


def test_help_texts_of_flags_are_single_lines() -> None:
    """Tyro would keep the line breaks of the source, in the middle of a sentence."""
    for module in Path(cli.__file__).parent.glob("*.py"):
        for kind in ast.walk(ast.parse(module.read_text())):
            if isinstance(kind, ast.ClassDef):
                for field, text in pairwise(kind.body):
                    if isinstance(field, ast.AnnAssign) and isinstance(text, ast.Expr):
                        assert "\n" not in ast.literal_eval(text.value), f"{module.name}: {kind.name}"


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


def test_nothing_else_is_done_behind_the_version(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["--version", "models"]) == 0
    assert capsys.readouterr().out.splitlines()[0] == f"tint-sumo {__version__}"


def test_a_configuration_without_a_name_is_refused_as_other_flags_are(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as stop:
        main(["record", "--config"])
    assert stop.value.code == 2
    assert "Missing value for argument '--config'" in capsys.readouterr().err


def test_versions_are_printed_at_once() -> None:
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


def test_help_is_quick() -> None:
    script = (
        "import sys, tint_sumo.cli\n"
        "try: tint_sumo.cli.main(['policy', 'train', '--help'])\n"
        "except SystemExit: print([name for name in ('torch', 'pandas', 'libsumo', 'sklearn') if name in sys.modules])"
    )
    printed = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=True).stdout
    assert printed.splitlines()[-1] == "[]"


@pytest.mark.parametrize(
    "argv", [[], ["fly"], ["record"], ["policy", "evaluate", "--model", "ttc", "--episodes", "many"], ["net", "--x"]]
)
def test_argument_errors_exit_with_2(argv: list[str], capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as stop:
        main(argv)
    assert stop.value.code == 2
    assert capsys.readouterr().out == ""


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
        ("traits infer --fcd MODEL --model MODEL --out MODEL", "holds the data that are read"),
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
        ("policy train --method oracle --p-conservative -0.1 --out OUT", "p_conservative"),
        ("policy train --method oracle --p-conservative 0.6 0.2 --out OUT", "from low to high"),
        ("policy train --method oracle --p-conservative 0.1 0.2 0.3 --out OUT", "a probability in [0, 1], or two"),
        ("policy train --method streaming --traits MODEL --out OUT", "of the method cross_window, not of vae"),
        ("policy train --method oracle --steps 0 --out OUT", "steps"),
        ("policy train --method oracle --scene moon --out OUT", "unknown scene 'moon'"),
        ("policy train --method vae --traits nobody --out OUT", "no trait model nobody"),
        ("policy train --method vae --traits WIDE --out OUT", "3 latents where 2 are needed"),
        ("traits relative --test old twons --out OUT.yaml", "unknown world 'twons'"),
        ("policy export --model run.zip --out OUT", "run.zip is a pickle and is not exported"),
        ("policy evaluate --model nobody", "no policy nobody"),
        ("policy evaluate --model ttc --p-conservative 2", "p_conservative"),
        ("policy evaluate --model ttc --scene moon", "unknown scene 'moon'"),
        ("policy evaluate --model ttc --noise -1", "noise must lie in 0 to 1000, not -1.0"),
        ("policy evaluate --model ttc --world headway_2.0 --tau 1.5", "a world has the headways of its drivers"),
        ("policy evaluate --model ttc --tau 0", "tau must lie in 0.01 to 20, not 0.0"),
        ("policy evaluate --model ttc --episodes 0", "episodes"),
        ("policy evaluate --model ttc --seed -1", "seed"),
        ("policy train --method oracle --out s3://bucket/run", "--out of this command is a path on this machine"),
        ("record --out s3:/bucket/data", "--out is neither a folder nor a URL; give two slashes"),
        ("traits evaluate --data file:///data --model MODEL", "--data of this command is a path on this machine"),
        ("policy sweep --set n_epochs=2 --set gamma=0.9 --out OUT", "--set is given twice; give it once"),
        ("policy evaluate --model ttc --p_conservative 0.1 --p-conservative=0.9", "--p-conservative is given twice"),
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


def test_a_damaged_dataset(
    dataset: Path, trait_model: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    other = copy(dataset, tmp_path / "other")
    shard = next((other / "trajectories").iterdir())
    shard.write_bytes(shard.read_bytes()[:100])
    assert "damaged" in refuse(capsys, "traits", "evaluate", "--model", trait_model, "--data", other)
    for argv in (f"dataset inspect {other}", f"record --windows 100 --out {other} --format fcd"):
        assert main(argv.split()) == 2
        assert "is damaged" in capsys.readouterr().err.splitlines()[-1]  # behind the line that the work begins


def test_a_dataset_of_another_schema_version(
    dataset: Path, trait_model: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    other = copy(dataset, tmp_path / "other")
    manifest = json.loads((other / "manifest.json").read_text())
    (other / "manifest.json").write_text(json.dumps({**manifest, "schema_version": 99}))
    for argv in (("evaluate", "--model", trait_model), ("train", "--out", tmp_path / "out")):
        assert "schema version 99" in refuse(capsys, "traits", *argv, "--data", other)
    assert not (tmp_path / "out").exists()
