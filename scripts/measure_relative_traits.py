"""Measure how well relative traits tell who yields, in all worlds, beside other methods; writes a table.

Usage: python scripts/measure_relative_traits.py [--out data/results/relative_traits.csv]

- relative: the beliefs of ``tint_sumo.traits.relative``, in which no label is used.
- one driver: a logistic regression of the latents of the shipped cross-window model, which looks at one driver alone.
- supervised: a GRU along each track whose state is compared with the mean over the other tracks of the episode; it
  learns from labels, from the same positions and gaps, and is the bound.

Both of the latter are fitted in the world ``strangers``.
"""

import argparse
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pandas
import torch
from torch import Tensor, nn

from tint_sumo.config import HELD_OUT_WORLDS, NO_LEADER_GAP_M, RelativeSettings
from tint_sumo.core.determinism import single_threaded
from tint_sumo.core.files import write_text
from tint_sumo.policy.gru import ResetGru
from tint_sumo.traits import load
from tint_sumo.traits.perceived import Perceived
from tint_sumo.traits.relative_fit import traffic_in
from tint_sumo.traits.relative_reading import Reading, Readings, beliefs, read
from tint_sumo.traits.streaming import TrackStream

SCENE = "t_intersection"
TRAINING = "strangers"
WORLDS = ("old", "towns", *HELD_OUT_WORLDS)
ROUNDS = 8  # of the supervised training, each with new traffic
PASSES = 3  # over the traffic of a round
PARTS = 6  # minibatches of a round's environments
HIDDEN = 32
TEST_SEED = 1_000_000  # of the traffic of tests


def one_driver(seen: Perceived) -> np.ndarray:
    """Return mean and standard deviation of the cross-window model's posteriors (T, N, V, 4)."""
    _, envs, slots = seen.present.shape
    stream, tracks = TrackStream(load("cross_window"), envs * slots), np.arange(envs * slots).reshape(envs, slots)
    found = np.zeros((*seen.present.shape, 4), np.float32)
    for step, present in enumerate(seen.present):
        stream.forget(tracks[~present | seen.begins[step][:, None]])
        mean, std = stream.advance(
            tracks[present], seen.position_m[step][present].astype(np.float32), seen.gap_m[step][present]
        )
        found[step][present] = np.concatenate([mean, std], axis=-1)
    return found


class Supervised(nn.Module):
    """The bound: the state of a track, and the mean of the others' states, give the logit of yielding."""

    def __init__(self) -> None:
        super().__init__()
        self.gru = ResetGru(2, HIDDEN)
        self.town = nn.Sequential(nn.Linear(HIDDEN, HIDDEN), nn.ReLU())
        self.logit = nn.Sequential(nn.Linear(2 * HIDDEN, HIDDEN), nn.ReLU(), nn.Linear(HIDDEN, 1))

    def forward(self, seen: Perceived) -> Tensor:
        """Return logits (T, N, V) from what has been seen up to each step."""
        steps, envs, slots = seen.present.shape
        present = torch.from_numpy(seen.present)
        begins = seen.begins_track | ~seen.present
        moved = np.zeros_like(seen.position_m)
        moved[1:] = np.where(begins[1:], 0.2, np.diff(seen.position_m, axis=0))
        features = np.stack([(moved - 0.2) / 0.1, (np.minimum(seen.gap_m, NO_LEADER_GAP_M) - 8.0) / 6.0], axis=-1)
        inputs = torch.from_numpy(features.astype(np.float32)).flatten(1, 2)
        starts = torch.from_numpy(begins).flatten(1).float()
        states, _ = self.gru(inputs, torch.zeros(envs * slots, HIDDEN), starts)
        states = states.view(steps, envs, slots, HIDDEN)
        shared = torch.cat([self.town(states), torch.ones(*present.shape, 1)], dim=-1) * present.unsqueeze(-1)
        others = _gone(shared, seen, begins).unsqueeze(2) + shared.sum(dim=2, keepdim=True) - shared
        town = others[..., :-1] / (others[..., -1:] + 1.0)
        logits: Tensor = self.logit(torch.cat([states, town], dim=-1)).squeeze(-1)
        return logits


def _gone(shared: Tensor, seen: Perceived, begins: np.ndarray) -> Tensor:
    """Return sums (T, N, F) over the last values of tracks that have ended in the episode so far."""
    ended = torch.zeros_like(shared)
    ended[1:] = shared[:-1] * torch.from_numpy(begins[1:]).unsqueeze(-1)
    new = torch.from_numpy(seen.begins)
    total = ended.sum(dim=2).masked_fill(new.unsqueeze(-1), 0.0).cumsum(dim=0)
    first = torch.where(new, torch.arange(len(total)).unsqueeze(1), 0).cummax(dim=0).values
    return total - total.gather(0, first.unsqueeze(-1).expand_as(total))


def _parts(seen: Perceived, rng: np.random.Generator) -> Iterator[Perceived]:
    for envs in np.array_split(rng.permutation(seen.begins.shape[1]), PARTS):
        yield Perceived(**{name: values[:, envs] for name, values in vars(seen).items()})


def supervised() -> Supervised:
    """Return the bound, trained in the training world."""
    torch.manual_seed(0)
    model, rng = Supervised(), np.random.default_rng(0)
    optimiser, updates = torch.optim.Adam(model.parameters(), 3e-3), ROUNDS * PASSES * PARTS
    schedule = torch.optim.lr_scheduler.LinearLR(optimiser, 1.0, 0.01, updates)
    for number in range(ROUNDS):
        seen = traffic_in(TRAINING, SCENE, 10 + number)
        for _ in range(PASSES):
            for part in _parts(seen, rng):
                shown = torch.from_numpy(part.present)
                yields = torch.from_numpy(part.traits == 0).float()
                loss = nn.functional.binary_cross_entropy_with_logits(model(part)[shown], yields[shown])
                optimiser.zero_grad()
                torch.autograd.backward(loss)
                optimiser.step()
                schedule.step()
        print(f"supervised: round {number + 1} of {ROUNDS}, loss {loss.item():.3f}", flush=True)
    return model.eval().requires_grad_(False)


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
        training = traffic_in(TRAINING, SCENE, 1)
        latents, bound, rows = Readings.of(training, one_driver(training)), supervised(), []
        for number, world in enumerate(WORLDS):
            seen = traffic_in(world, SCENE, TEST_SEED + number)
            rows.append(row(world, "relative", beliefs(RelativeSettings(), seen)))
            rows.append(row(world, "one driver", read(latents, Readings.of(seen, one_driver(seen)))))
            guess = torch.sigmoid(bound(seen)).numpy()[..., None]
            found = Readings.of(seen, guess)
            rows.append(row(world, "supervised", Reading(found.values[:, 0], found.yields)))
            print(*rows[-3:], sep="\n", flush=True)
    write_text(out, pandas.DataFrame(rows).to_csv(index=False))
    print(f"wrote {out}")


if __name__ == "__main__":
    main()
