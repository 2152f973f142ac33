"""Measure what traits of human drivers are worth: prediction, identification and intraclass correlation.

The trait models learn from simulated drivers that are drawn from populations fitted to the other drivers. Reads the
recordings that stand beside the project, and writes ``real_traits.csv`` into data/results, in some minutes on one core:
python scripts/measure_real_traits.py [FOLDER]
"""

import csv
import io
import sys
import tempfile
from collections.abc import Sequence
from dataclasses import astuple, fields, replace
from pathlib import Path

from tint_sumo.config import TRAIT_BUDGETS
from tint_sumo.core.files import write_text
from tint_sumo.drivers.models import MODELS
from tint_sumo.drivers.pairs import Pair, read_pairs
from tint_sumo.drivers.population import Population
from tint_sumo.traits.cross_window import CrossWindow
from tint_sumo.traits.identification import Measure, identify
from tint_sumo.traits.recorded import RECORDED_GAP_M, drawn_pairs, windows_of
from tint_sumo.traits.training import train

ROOT = Path(__file__).parents[1]
RESULTS = ROOT / "data" / "results"
RECORDINGS = ROOT.parent / "shared" / "real" / "car_following"
DRIVERS, ENCOUNTERS = 400, 4
NOISE_M = 0.05


def train_for_fold(fold: int, population: Population, pairs: Sequence[Pair]) -> CrossWindow:
    """Train a model on drivers that are drawn from a population."""
    windows, _ = windows_of(drawn_pairs(MODELS["IDM"], population, pairs, DRIVERS, ENCOUNTERS, seed=fold))
    settings = replace(TRAIT_BUDGETS["quick"], noise_m=NOISE_M)
    with tempfile.TemporaryDirectory() as folder:
        model = train(windows, settings, Path(folder) / "model", method="cross_window", no_leader_gap_m=RECORDED_GAP_M)
    assert isinstance(model, CrossWindow)
    print(f"fold {fold + 1}: trained on {len(windows):,} windows", flush=True)
    return model


def main(folder: Path) -> None:
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow([field.name for field in fields(Measure)])
    for measure in identify(read_pairs(folder).pairs, train_for_fold):
        writer.writerow([f"{value:.4g}" if isinstance(value, float) else value for value in astuple(measure)])
        print(measure)
    write_text(RESULTS / "real_traits.csv", text.getvalue())


if __name__ == "__main__":
    main(Path(sys.argv[1]) if len(sys.argv) > 1 else RECORDINGS)
