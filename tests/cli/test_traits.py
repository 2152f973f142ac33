"""``tint-sumo traits``."""

import json
import re
import shutil
from pathlib import Path

import pandas
import pytest

from tests.cli.calls import refuse, run
from tests.drivers.recordings import population, simulated_pair, write_pairs
from tint_sumo.cli import main
from tint_sumo.config import RelativeSettings
from tint_sumo.core.files import write_text
from tint_sumo.drivers import fitting
from tint_sumo.drivers.pairs import Pair
from tint_sumo.traits import identification


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
    assert printed["outside"] is None  # this model's card does not say
    assert main(["traits", "infer", "--fcd", str(dataset), "--model", "vae", "--out", str(out)]) == 0
    text = capsys.readouterr().out
    assert re.search(r"\n<?\d+\.\d% of the windows lie outside what the model was trained on\n", text)


@pytest.mark.slow
def test_relative_traits_are_fitted_and_become_a_budget(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = tmp_path / "relative.yaml"
    assert main(["traits", "relative", "--world", "towns", "--test", "old", "--out", str(out), "--json"]) == 0
    found = json.loads(capsys.readouterr().out.splitlines()[-1])
    assert 0.9 < found["worlds"]["old"]["accuracy"] < 1.0 and found["worlds"]["old"]["brier"] < 0.08
    weight = found["settings"]["latent"]["time_gap_weight"]
    assert weight != RelativeSettings().latent.time_gap_weight
    train = ["policy", "train", "--method", "relative", "--config", str(out), "--out", "run"]
    assert main([*train, "--print-config"]) == 0
    assert f"time_gap_weight: {weight}" in capsys.readouterr().out


@pytest.fixture(scope="module")
def tracks(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two encounters of 11 s of each of five drivers."""
    return write_pairs(tmp_path_factory.mktemp("tracks"), encounters(seed=3))


def encounters(seed: int) -> list[Pair]:
    return [
        simulated_pair(z, 2 * driver + number, 111, follower=str(driver))
        for driver, z in enumerate(population(5, seed))
        for number in range(2)
    ]


def test_traits_of_recorded_tracks(
    tracks: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(identification, "_FOLDS", 2)
    monkeypatch.setattr(identification, "_RESAMPLES", 100)
    monkeypatch.setattr(fitting, "_STARTS", 1)
    config = tmp_path / "tiny.yaml"
    write_text(config, "budget: {base: quick, epochs: 1}\n")
    train = ["traits", "train", "--tracks", tracks, "--method", "cross_window", "--config", config]
    card = run(capsys, *train, "--out", tmp_path / "model")
    recorded = {"tracks": tracks.name, "recordings": card["recorded"]["recordings"], "pairs": 10, "drivers": 5}
    assert card["recorded"] == recorded and len(recorded["recordings"]) == 1
    printed = run(
        capsys, "traits", "infer", "--tracks", tracks, "--model", tmp_path / "model", "--out", tmp_path / "table.csv"
    )
    assert (printed["vehicles"], printed["windows"], printed["outside"]) == (5, card["windows"], 0.0)
    identify = ["traits", "identify", "--model", tmp_path / "model", "--tracks"]
    found = run(capsys, *identify, _others(tmp_path))["measures"]
    assert {one["situation"] for one in found} == {"other encounters"}  # none is long enough to be halved
    assert {one["count"] for one in found if one["group"] == "identified"} == {10}
    renamed = tmp_path / "renamed"
    shutil.copytree(tracks, renamed)
    assert main([str(part) for part in (*identify, renamed)]) == 2
    assert "has learnt from these recorded drivers" in capsys.readouterr().err


def _others(folder: Path) -> Path:
    """Tracks of five other drivers."""
    (folder / "others").mkdir()
    return write_pairs(folder / "others", encounters(seed=4))


@pytest.mark.parametrize(
    ("argv", "message"),
    [
        (["train", "--out", "OUT"], "give either --data or --tracks"),
        (["train", "--data", "T", "--tracks", "T", "--out", "OUT"], "give either --data or --tracks"),
        (["train", "--data", "T", "--fit", "T", "--out", "OUT"], "--fit and --format belong to tracks"),
        (["train", "--tracks", "T", "--streaming", "--out", "OUT"], "--streaming is for datasets"),
        (["infer", "--model", "vae", "--out", "OUT.csv"], "give either --fcd or --tracks"),
        (
            ["infer", "--fcd", "T", "--format", "ngsim", "--model", "vae", "--out", "OUT.csv"],
            "--format is that of tracks",
        ),
        (["infer", "--tracks", "T", "--net", "T", "--model", "vae", "--out", "OUT.csv"], "--net and --vtypes belong"),
        (["infer", "--tracks", "T", "--model", "vae", "--out", "OUT.csv"], "lie outside what vae was trained on"),
        (["identify", "--tracks", "T", "--model", "vae"], "vae predicts nothing; give a model of method cross_window"),
        (["identify", "--tracks", "T", "--model", "cross_window"], "lie outside what cross_window was trained on"),
    ],
)
def test_unusable_tracks_and_flags_are_refused(
    argv: list[str], message: str, tracks: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    places = {"T": tracks, "OUT": tmp_path / "out", "OUT.csv": tmp_path / "out.csv"}
    assert message in refuse(capsys, "traits", *(places.get(word, word) for word in argv))
    assert not (tmp_path / "out").exists()
    assert not (tmp_path / "out.csv").exists()
