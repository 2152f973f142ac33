"""``tint-sumo traits``."""

import json
import re
from pathlib import Path

import pandas
import pytest

from tests.cli.calls import run
from tint_sumo.cli import main
from tint_sumo.config import RelativeSettings


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
