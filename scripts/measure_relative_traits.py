"""Measure how well relative traits tell who yields, in all worlds, beside other methods; writes a table.

Usage: python scripts/measure_relative_traits.py [--out data/results/relative_traits.csv]

- relative: the beliefs of ``tint_sumo.traits.relative``, in which no label is used.
- one driver: a logistic regression of the latents of the shipped cross-window model, which looks at one driver alone.
- supervised: the network of ``scripts/supervised.py``, which learns from labels and is the bound.

Both of the latter are fitted in the world ``strangers``.
"""

import argparse
from pathlib import Path

import numpy as np
import pandas
import torch
from supervised import TRAINING, compared, fit

from tint_sumo.config import HELD_OUT_WORLDS, RelativeSettings
from tint_sumo.core.determinism import single_threaded
from tint_sumo.core.files import write_text
from tint_sumo.scenes import T_INTERSECTION
from tint_sumo.traits import load
from tint_sumo.traits.cross_window import CrossWindow
from tint_sumo.traits.perceived import Perceived
from tint_sumo.traits.relative_fit import traffic_in
from tint_sumo.traits.relative_reading import Reading, Readings, beliefs, read
from tint_sumo.traits.streaming import TrackStream

WORLDS = ("old", "towns", *HELD_OUT_WORLDS)
TEST_SEED = 1_000_000  # of the traffic of tests


def one_driver(seen: Perceived) -> np.ndarray:
    """Return mean and standard deviation of the cross-window model's posteriors (T, N, V, 4)."""
    _, envs, slots = seen.present.shape
    model = load("cross_window")
    assert isinstance(model, CrossWindow)
    stream, tracks = TrackStream(model, envs * slots), np.arange(envs * slots).reshape(envs, slots)
    found = np.zeros((*seen.present.shape, 4), np.float32)
    for step, present in enumerate(seen.present):
        stream.forget(tracks[~present | seen.begins[step][:, None]])
        mean, std = stream.advance(
            tracks[present], seen.position_m[step][present].astype(np.float32), seen.gap_m[step][present]
        )
        found[step][present] = np.concatenate([mean, std], axis=-1)
    return found


def row(world: str, method: str, reading: Reading) -> dict[str, object]:
    scores = {"accuracy": reading.accuracy, "brier": reading.brier, "calibration_error": reading.calibration_error}
    return {"world": world, "method": method, "readings": len(reading.yields)} | {
        name: round(value, 4) for name, value in scores.items()
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("--out", type=Path, default=Path("data/results/relative_traits.csv"))
    out = parser.parse_args().out
    with single_threaded():
        training = traffic_in(TRAINING, T_INTERSECTION, 1)
        latents, bound, rows = Readings.of(training, one_driver(training)), fit(), []
        for number, world in enumerate(WORLDS):
            seen = traffic_in(world, T_INTERSECTION, TEST_SEED + number)
            rows.append(row(world, "relative", beliefs(RelativeSettings(), seen)))
            rows.append(row(world, "one driver", read(latents, Readings.of(seen, one_driver(seen)))))
            found = Readings.of(seen, compared(seen))
            guess = torch.sigmoid(bound(torch.from_numpy(found.values))).numpy()
            rows.append(row(world, "supervised", Reading(guess, found.yields)))
            print(*rows[-3:], sep="\n", flush=True)
    write_text(out, pandas.DataFrame(rows).to_csv(index=False))
    print(f"wrote {out}")


if __name__ == "__main__":
    main()
