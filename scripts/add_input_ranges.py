"""Add to the cards of the shipped trait models what their training windows reach, without training them again.

The recording has the settings that each card names, and may be smaller than the one of the training: the card then says
of how many windows the range is. ``traits train`` writes the range by itself.
"""

import argparse
import json
from dataclasses import asdict
from pathlib import Path
from tempfile import TemporaryDirectory

from tint_sumo.core.files import shipped
from tint_sumo.dataset.recorder import record
from tint_sumo.dataset.windows import load_windows
from tint_sumo.traits.input_range import InputRange
from tint_sumo.traits.storage import add_to_card, read_card


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--windows", type=int, default=700_000)
    parser.add_argument("--workers", type=int, default=2)
    asked = parser.parse_args()
    ranges: dict[str, dict[str, object]] = {}
    for weights in sorted(shipped("models").glob("*.safetensors")):
        data = read_card(weights).data or {}
        settings = {key: data[key] for key in ("p_conservative", "population", "seed", "scene")}
        key = json.dumps(settings)
        if key not in ranges:
            with TemporaryDirectory() as folder:
                record(Path(folder) / "data", asked.windows, workers=asked.workers, **settings)
                windows = load_windows(Path(folder) / "data")
            reach = asdict(InputRange.of(windows.parts()))
            ranges[key] = {"input_range": reach, "input_range_windows": len(windows)}
        add_to_card(weights, ranges[key])


if __name__ == "__main__":
    main()
