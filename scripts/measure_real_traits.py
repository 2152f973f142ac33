"""Measure what traits of human drivers are worth: prediction, identification and intraclass correlation.

The trait models learn from simulated drivers that are drawn from populations fitted to the other drivers. Reads the
recordings that stand beside the project, and writes ``real_traits.csv`` into data/results, in some minutes on one core:
python scripts/measure_real_traits.py [FOLDER]
"""

import csv
import io
import sys
from dataclasses import astuple, fields
from pathlib import Path

from tint_sumo.core.determinism import single_threaded
from tint_sumo.core.files import write_text
from tint_sumo.drivers.pairs import read_pairs
from tint_sumo.jobs.table import one_job
from tint_sumo.traits.identification import Measure, identify, report_text

ROOT = Path(__file__).parents[1]
RESULTS = ROOT / "data" / "results"
RECORDINGS = ROOT.parent / "shared" / "real" / "car_following"


def main(folder: Path) -> None:
    with one_job("identify") as report, single_threaded():
        measures = identify(read_pairs(folder).pairs, report=report)
    print(report_text(measures))
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow([field.name for field in fields(Measure)])
    for measure in measures:
        writer.writerow([f"{value:.4g}" if isinstance(value, float) else value for value in astuple(measure)])
    write_text(RESULTS / "real_traits.csv", text.getvalue())


if __name__ == "__main__":
    main(Path(sys.argv[1]) if len(sys.argv) > 1 else RECORDINGS)
