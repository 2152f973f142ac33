"""The bound of inference: beliefs about who yields that are learnt with labels, from what relative traits see, too.

Usage: python scripts/supervised.py RUNS [--seeds 0 1 2]

RUNS gets the network, supervised.safetensors, and for each seed a policy, RUNS/supervised.SEED, trained as the policies
of ``scripts/measure_strangers.py`` are. An interrupted training goes on. If these policies drive better than those with
relative traits, the difference is all that better inference without labels could gain.

A driver's inputs are its relative traits; five statistics of its track so far; their means over the other drivers of
the episode, those who have left included; the differences; and how many steps they come from.
"""

import argparse
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray
from safetensors.torch import load_file, save
from torch import Tensor, nn

from tint_sumo.config import ALL_MIXES, NO_LEADER_GAP_M, PPO_BUDGETS, STEP_S, RelativeSettings, Steady
from tint_sumo.core.determinism import single_threaded
from tint_sumo.core.files import write_bytes
from tint_sumo.envs.worlds import find_world, scene_in
from tint_sumo.jobs.table import one_job
from tint_sumo.methods.registry import Learned, register
from tint_sumo.methods.training import train_policy
from tint_sumo.policy.trait_sources import NeighbourTraits
from tint_sumo.scenes import T_INTERSECTION, paper_scene
from tint_sumo.traits.perceived import Perceived
from tint_sumo.traits.relative import LATENTS, RelativeStream
from tint_sumo.traits.relative_fit import traffic_in
from tint_sumo.traits.relative_reading import Readings

METHOD, TRAINING = "supervised", "strangers"
NETWORK_FILE = f"{METHOD}.safetensors"
STATISTICS = 5  # time gap and gap while following steadily, mean speed, mean change of the gap, present speed
INPUTS = 5 * STATISTICS + LATENTS
HIDDEN = 64
TRAFFICS, FIRST_TRAFFIC = 6, 20  # of 288 environments and 50 s each
EPOCHS, BATCH, LEARNING_RATE = 4, 1024, 2e-3
_KNOWN_STEPS = 20.0  # that tell half of what can be known
_FIRST_STEPS, _NEW_LEADER_M = 4, 3.0  # of steps that count

Floats = NDArray[np.float64]


class Comparison(RelativeStream):
    """Relative traits, and statistics of the tracks in N x V slots compared with the others in each episode."""

    def __init__(self, num_envs: int, slots: int) -> None:
        shape, statistics = (num_envs, slots), (num_envs, slots, STATISTICS)
        super().__init__(RelativeSettings(), num_envs, slots)
        self._tracks = {key: np.zeros(shape) for key in ("steps", "position", "gap", "speed", "moved")}
        self._tracks |= {"sums": np.zeros((*shape, 2)), "mean": np.zeros(statistics), "weight": np.zeros(statistics)}
        self._gone = np.zeros((num_envs, 2, STATISTICS))  # weighted sums over tracks that have ended, and their weights

    def memory(self) -> dict[str, NDArray[np.generic]]:
        compared = {f"compared_{name}": part for name, part in self._tracks.items()}
        return {**super().memory(), **compared, "gone": self._gone}

    def begin(self, envs: NDArray[np.int64]) -> None:
        super().begin(envs)
        self._gone[envs] = 0.0
        self._tracks["steps"][envs] = 0.0

    def compare(
        self, envs: NDArray[np.int64], present: NDArray[np.bool_], position_m: Floats, gap_m: Floats
    ) -> NDArray[np.float32]:
        """Take one step in K environments, arrays (K, V); return the network's inputs (K, V, 27)."""
        relative = super().advance(envs, present, position_m, gap_m)
        t = {name: part[envs] for name, part in self._tracks.items()}
        ended = ((t["steps"] > 0) & ~present)[..., None]
        self._gone[envs, 0] += np.sum(ended * t["weight"] * t["mean"], axis=1)
        self._gone[envs, 1] += np.sum(ended * t["weight"], axis=1)
        _extend(t, present, position_m, np.minimum(gap_m, NO_LEADER_GAP_M))
        _summarise(t, present, self.total[envs], self.count[envs])
        for name, part in t.items():
            self._tracks[name][envs] = part
        return np.concatenate([relative, _compare(t["mean"], t["weight"], self._gone[envs])], axis=-1)


def _extend(t: dict[str, Floats], present: NDArray[np.bool_], position_m: Floats, gap_m: Floats) -> None:
    """Add one step to K x V tracks."""
    goes_on = present & (t["steps"] > 0)
    t["steps"] = np.where(present, t["steps"] + 1, 0)
    speed = (position_m - t["position"]) / STEP_S
    averaged = np.where(t["steps"] > 2, t["speed"] + 0.3 * (speed - t["speed"]), speed)
    t["speed"] = np.where(goes_on, averaged, 0.0)
    change = (gap_m - t["gap"]) / STEP_S
    same_leader = np.abs(gap_m - t["gap"]) < _NEW_LEADER_M
    counts = goes_on & same_leader & (t["steps"] > _FIRST_STEPS) & (t["speed"] > Steady.least_speed_mps)
    step = np.stack([t["speed"], np.clip(change, -2.0, 2.0)], axis=-1)
    t["sums"] = np.where(goes_on[..., None], t["sums"] + step * counts[..., None], 0.0)
    t["moved"] = np.where(goes_on, t["moved"] + counts, 0.0)
    t["position"], t["gap"] = position_m, gap_m


def _summarise(t: dict[str, Floats], present: NDArray[np.bool_], total: Floats, count: Floats) -> None:
    """Write the statistics of K x V tracks, and their weights: 0 if unknown, 1 if well known."""
    follows = total / np.maximum(count, 1.0)[..., None]
    moves = t["sums"] / np.maximum(t["moved"], 1.0)[..., None]
    t["mean"] = np.concatenate([follows, moves, t["speed"][..., None]], axis=-1)
    steps = np.stack([count, count, t["moved"], t["moved"]], axis=-1)
    weight = np.concatenate([steps / (steps + _KNOWN_STEPS), np.ones((*count.shape, 1))], axis=-1)
    t["weight"] = weight * present[..., None]


def _compare(mean: Floats, weight: Floats, gone: Floats) -> NDArray[np.float32]:
    """Return the tracks' statistics beside those of the others, those that have ended included, (K, V, 25)."""
    weighted = weight * mean
    sums = gone[:, 0, None] + weighted.sum(axis=1, keepdims=True) - weighted
    weights = gone[:, 1, None] + weight.sum(axis=1, keepdims=True) - weight
    others = np.where(weights > 1e-6, sums / np.maximum(weights, 1e-6), 0.0)
    known = (weight > 0) & (weights > 1e-6)
    parts = [mean * (weight > 0), others, np.where(known, mean - others, 0.0), weight, np.minimum(weights, 4.0)]
    return np.concatenate(parts, axis=-1).astype(np.float32)


class Beliefs(nn.Module):
    """Give the logit of yielding of drivers, (...), from the inputs (..., 27) of ``Comparison``."""

    mean: Tensor
    std: Tensor

    def __init__(self) -> None:
        super().__init__()
        self.register_buffer("mean", torch.zeros(INPUTS))
        self.register_buffer("std", torch.ones(INPUTS))
        self.layers = nn.Sequential(
            nn.Linear(INPUTS, HIDDEN), nn.ReLU(), nn.Linear(HIDDEN, HIDDEN), nn.ReLU(), nn.Linear(HIDDEN, 1)
        )

    def forward(self, inputs: Tensor) -> Tensor:
        logits: Tensor = self.layers(((inputs - self.mean) / self.std).clamp(-4.0, 4.0)).squeeze(-1)
        return logits


def compared(seen: Perceived) -> NDArray[np.float32]:
    """Return the inputs (T, N, V, 27) of all drivers in traffic, from what has been seen up to each step."""
    steps, num_envs, slots = seen.present.shape
    comparison, envs = Comparison(num_envs, slots), np.arange(num_envs)
    found = np.zeros((steps, num_envs, slots, INPUTS), np.float32)
    for step in range(steps):
        comparison.begin(np.flatnonzero(seen.begins[step]))
        found[step] = comparison.compare(envs, seen.present[step], seen.position_m[step], seen.gap_m[step])
    return found


def _readings(seed: int) -> Readings:
    seen = traffic_in(TRAINING, T_INTERSECTION, seed)
    return Readings.of(seen, compared(seen))


def fit() -> Beliefs:
    """Return the network, trained with labels in the world of the policies' training."""
    parts = [_readings(FIRST_TRAFFIC + number) for number in range(TRAFFICS)]
    inputs = torch.from_numpy(np.concatenate([part.values for part in parts]))
    yields = torch.from_numpy(np.concatenate([part.yields for part in parts])).float()
    generator = torch.Generator().manual_seed(0)
    with torch.random.fork_rng():
        torch.manual_seed(0)
        model = Beliefs()
    model.mean.copy_(inputs.mean(dim=0))
    model.std.copy_(inputs.std(dim=0) + 1e-6)
    optimiser = torch.optim.Adam(model.parameters(), LEARNING_RATE, weight_decay=1e-5)
    orders = (torch.randperm(len(inputs), generator=generator) for _ in range(EPOCHS))
    batches = [batch for order in orders for batch in torch.split(order, BATCH)]
    schedule = torch.optim.lr_scheduler.LinearLR(optimiser, 1.0, 0.01, len(batches))
    for batch in batches:
        loss = nn.functional.binary_cross_entropy_with_logits(model(inputs[batch]), yields[batch])
        optimiser.zero_grad()
        torch.autograd.backward(loss)
        optimiser.step()
        schedule.step()
    return model.eval().requires_grad_(False)


class SupervisedStream(Comparison):
    """Relative traits with beliefs that are learnt with labels."""

    def __init__(self, model: Beliefs, num_envs: int, slots: int) -> None:
        super().__init__(num_envs, slots)
        self._model = model

    def advance(
        self, envs: NDArray[np.int64], present: NDArray[np.bool_], position_m: Floats, gap_m: Floats
    ) -> NDArray[np.float32]:
        inputs = self.compare(envs, present, position_m, gap_m)
        traits = inputs[..., :LATENTS].copy()
        traits[present, 0] = torch.tanh(0.5 * self._model(torch.from_numpy(inputs[present]))).numpy()
        return traits


class SupervisedTraits(NeighbourTraits):
    """Traits from a ``SupervisedStream``."""

    def __init__(self, model: Beliefs) -> None:
        super().__init__(RelativeSettings())
        self.model = model

    def make_stream(self, num_envs: int, max_vehicles: int) -> SupervisedStream:
        return SupervisedStream(self.model, num_envs, max_vehicles)


def register_supervised(network: Path) -> None:
    """Make the method known whose policies drive with the beliefs of a network in a file."""
    model = Beliefs().eval().requires_grad_(False)
    model.load_state_dict(load_file(network))
    register(Learned(METHOD, "supervised", lambda _: SupervisedTraits(model), world=TRAINING))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("runs", type=Path)
    parser.add_argument("--seeds", type=int, nargs="+", default=[0, 1, 2])
    given = parser.parse_args()
    file = given.runs / NETWORK_FILE
    if not file.exists():
        with single_threaded():
            state = fit().state_dict()
        write_bytes(file, save(state))
        print(f"wrote {file}", flush=True)
    register_supervised(file)
    world, settings = find_world(TRAINING), PPO_BUDGETS[TRAINING]
    for seed in given.seeds:
        out = given.runs / f"{METHOD}.{seed}"
        with one_job(f"train {out.name}") as report:
            train_policy(
                METHOD,
                ALL_MIXES,
                settings.total_steps,
                seed,
                out,
                settings=settings,
                scene=scene_in(world, paper_scene()),
                sensors=world.sensors,
                report=report,
            )


if __name__ == "__main__":
    main()
