"""Measure how beliefs about drivers grow better while an ego is in a town; writes a table.

Usage: python scripts/measure_adaptation.py [--out data/results/adaptation.csv]

Each row of episodes is in one unseen town: five of 15 s, between which the ego remembers the town or forgets it, or one
of 50 s. A line of the table is a part of the time: how often the likelier trait is right, and the calibration error.
"""

import argparse
from dataclasses import replace
from itertools import pairwise
from pathlib import Path

import numpy as np
import pandas

from tint_sumo.config import ALL_MIXES, POPULATIONS, STEP_S, RelativeSettings
from tint_sumo.core.determinism import single_threaded
from tint_sumo.core.files import write_text
from tint_sumo.envs import TaskSettings
from tint_sumo.scenes import paper_scene
from tint_sumo.traits.perceived import Perceived
from tint_sumo.traits.relative_fit import follow, traffic
from tint_sumo.traits.relative_reading import EVERY_STEPS, Reading

TEST_SEED = 2_000_000
EPISODES, SHORT_S, LONG_S = 5, 15.0, 50.0
PARTS_S = (0.0, 10.0, 25.0, LONG_S)
NUM_ENVS = 96


def in_one_town(episodes: int, episode_s: float) -> Perceived:
    """Return traffic whose episodes follow one another in a town, in rows of ``episodes``."""
    population = POPULATIONS["held_out_towns"]
    assert population.towns is not None
    towns = replace(population, towns=replace(population.towns, episodes=episodes))
    task = TaskSettings(replace(paper_scene(), population=towns), ALL_MIXES, time_limit_s=episode_s)
    return traffic([task], TEST_SEED, steps=round(episodes * episode_s / STEP_S), num_envs=NUM_ENVS)


def remembering(seen: Perceived) -> Perceived:
    """Return the same traffic as one long episode, at the breaks of which nobody is seen for a step."""
    breaks = seen.begins & (np.arange(len(seen.begins)) > 0)[:, None]
    return replace(seen, begins=seen.begins & ~breaks, present=seen.present & ~breaks[:, :, None])


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("--out", type=Path, default=Path("data/results/adaptation.csv"))
    out = parser.parse_args().out
    rows: list[dict[str, object]] = []

    def add(kind: str, seen: Perceived, parts: dict[str, np.ndarray]) -> None:
        belief = follow(RelativeSettings(), seen)[0][..., 0]
        every = (np.arange(len(seen.present)) % EVERY_STEPS == EVERY_STEPS - 1)[:, None, None]
        for part, when in parts.items():
            chosen = seen.present & every & when[:, :, None]
            reading = Reading((belief[chosen].astype(np.float64) + 1.0) / 2.0, seen.traits[chosen] == 0)
            scores = {"accuracy": f"{reading.accuracy:.4f}", "calibration_error": f"{reading.calibration_error:.4f}"}
            rows.append({"kind": kind, "part": part, "readings": len(reading.yields), **scores})
            print(rows[-1], flush=True)

    with single_threaded():
        short = in_one_town(EPISODES, SHORT_S)
        number = np.cumsum(short.begins, axis=0)
        of_episodes = {f"episode {episode}": number == episode for episode in range(1, EPISODES + 1)}
        add("forgets", short, of_episodes)
        add("remembers", remembering(short), of_episodes)
        long = in_one_town(1, LONG_S)
        time_s = np.broadcast_to(STEP_S * np.arange(len(long.begins))[:, None], long.begins.shape)
        spans = pairwise(PARTS_S)
        of_times = {f"{low:g} to {high:g} s": (time_s >= low) & (time_s < high) for low, high in spans}
        whole = np.cumsum(long.begins, axis=0) == 1
        add("long", long, {part: when & whole for part, when in of_times.items()})
    write_text(out, pandas.DataFrame(rows).to_csv(index=False))
    print(f"wrote {out}")


if __name__ == "__main__":
    main()
