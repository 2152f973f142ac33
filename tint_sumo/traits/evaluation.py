"""How well traits can be read from a model's latents: labels are used here and nowhere else on this floor."""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from matplotlib.figure import Figure
from numpy.typing import NDArray
from sklearn.pipeline import make_pipeline
from sklearn.preprocessing import StandardScaler
from sklearn.svm import LinearSVC

from tint_sumo.config import AGGRESSIVE, CONSERVATIVE, DriverProfile
from tint_sumo.dataset.windows import Windows, split_by_episode
from tint_sumo.errors import InputError
from tint_sumo.files import whole_file
from tint_sumo.traits.model import TraitModel

TEST_FRACTION = 1 / 3  # paper IV-B
LENGTH_BINS = ((2, 5), (6, 10), (11, 19), (20, 20))
ENCODING_BATCH = 4096
DRAWN_WINDOWS = 5000  # more would hide each other


@dataclass(frozen=True)
class Part:
    """Accuracy on a part of the test windows; None where there are none."""

    accuracy: float | None
    windows: int


@dataclass(frozen=True)
class TraitAccuracy:
    """Accuracy of a linear support vector classifier on the latent mean, on windows of unseen episodes."""

    accuracy: float
    windows: int
    by_length: Mapping[str, Part]  # keyed "2-5", "6-10", "11-19", "20"
    by_leader: Mapping[str, Part]  # keyed "with_leader", "without_leader"


def evaluate(model: TraitModel, windows: Windows, conservative: NDArray[np.bool_], *, seed: int = 0) -> TraitAccuracy:
    """Fit a linear classifier on two thirds of the episodes and test it on the rest (paper IV-B).

    Args:
        model: a trained model; it is not changed.
        windows: N windows.
        conservative: (N,) the label of each window's driver.
        seed: of the split. Use the one of training, so that the test episodes are unseen by the model too.

    Raises:
        InputError: the training part does not hold both traits, or the test part is empty.
    """
    train, test = split_by_episode(windows, TEST_FRACTION, seed)
    if len(np.unique(conservative[train])) < 2 or len(test) == 0:
        raise InputError("both traits and several episodes are needed to evaluate; record a larger dataset")
    latents = encode_windows(model, windows)
    classifier = make_pipeline(StandardScaler(), LinearSVC()).fit(latents[train], conservative[train])
    correct = classifier.predict(latents[test]) == conservative[test]
    length, has_leader = windows.length[test], windows.has_leader[test]
    return TraitAccuracy(
        accuracy=float(correct.mean()),
        windows=len(test),
        by_length={
            str(low) if low == high else f"{low}-{high}": _part(correct[(length >= low) & (length <= high)])
            for low, high in LENGTH_BINS
        },
        by_leader={"with_leader": _part(correct[has_leader]), "without_leader": _part(correct[~has_leader])},
    )


def encode_windows(model: TraitModel, windows: Windows) -> NDArray[np.float32]:
    """Latent means (N, latent_size)."""
    states, length = torch.from_numpy(windows.states), torch.from_numpy(windows.length)
    with torch.inference_mode():
        parts = [
            model.encode(states[start : start + ENCODING_BATCH], length[start : start + ENCODING_BATCH])[0]
            for start in range(0, len(length), ENCODING_BATCH)
        ]
    return torch.cat(parts).numpy()


def plot_latents(
    model: TraitModel, windows: Windows, conservative: NDArray[np.bool_], file: Path, *, seed: int = 0
) -> None:
    """Write a PNG of the first two latent means, coloured by trait (paper Fig. 3).

    Args:
        model: a trained model with at least two latents.
        windows: N windows, best those of unseen episodes; a random part of them is drawn.
        conservative: (N,) the label of each window's driver.
        file: where the PNG goes.
        seed: of the part that is drawn.
    """
    generator = np.random.default_rng(seed)
    drawn = generator.choice(len(windows.length), min(DRAWN_WINDOWS, len(windows.length)), replace=False)
    latents, is_conservative = encode_windows(model, windows)[drawn], conservative[drawn]
    colours = np.where(is_conservative[:, None], _rgb(CONSERVATIVE), _rgb(AGGRESSIVE))

    figure = Figure(figsize=(6.0, 5.0), dpi=150, layout="constrained")
    axes = figure.subplots()
    axes.scatter(latents[:, 0], latents[:, 1], s=6, c=colours, alpha=0.4, linewidths=0)
    for profile, count in ((CONSERVATIVE, is_conservative.sum()), (AGGRESSIVE, (~is_conservative).sum())):
        axes.scatter([], [], s=30, color=_rgb(profile), label=f"{profile.name} ({count} windows)")
    axes.set(xlabel="latent 1", ylabel="latent 2", title=f"Latent space of '{model.method}' (mean of each window)")
    axes.legend(loc="upper center", bbox_to_anchor=(0.5, -0.12), ncols=2, frameon=False)
    axes.grid(alpha=0.25)
    with whole_file(file) as partial:
        figure.savefig(partial, format="png")


def _rgb(profile: DriverProfile) -> tuple[float, ...]:
    return tuple(int(part) / 255 for part in profile.colour.split(","))


def _part(correct: NDArray[np.bool_]) -> Part:
    return Part(float(correct.mean()) if len(correct) else None, len(correct))
