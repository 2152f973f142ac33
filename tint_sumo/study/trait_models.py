"""Trait models from a dataset folder: training on its training episodes, evaluation on the others."""

from dataclasses import asdict
from pathlib import Path
from typing import Any

from tint_sumo import traits
from tint_sumo.config import VaeSettings
from tint_sumo.dataset.windows import load_labels, load_windows, read_manifest, split_by_episode
from tint_sumo.errors import InputError
from tint_sumo.traits.evaluation import TEST_FRACTION, evaluate, plot_latents
from tint_sumo.traits.storage import read_card
from tint_sumo.traits.training import train


def train_traits(
    data: Path, out: Path, *, method: str = "ours", settings: VaeSettings, seed: int = 0, progress: bool = True
) -> dict[str, Any]:
    """Train a trait model on two thirds of a dataset's episodes (paper IV-B), without labels, and return its card.

    Args:
        data: folder of a dataset.
        out: a new folder, or the one of this very run; model.safetensors and model.json go there.
        method: a name in ``tint_sumo.traits.METHODS``.
        settings: sizes, loss weights and schedule.
        seed: of weights, order and noise, and of the split into training and test episodes.
        progress: show a progress bar on stderr.

    Raises:
        InputError: no such method, no usable dataset, a negative seed, or ``out`` holds another run.
    """
    if seed < 0:
        raise InputError(f"seed must not be negative: {seed}")
    windows = load_windows(data)
    chosen, _ = split_by_episode(windows, TEST_FRACTION, seed)
    card = {"data": _described(data)}
    train(windows[chosen], settings, out, method=method, seed=seed, progress=progress, card=card)
    return read_card(out / "model.safetensors")


def evaluate_traits(data: Path, model: str | Path, figure: Path | None = None) -> dict[str, Any]:
    """Accuracy of a linear classifier on a model's latents, in the episodes that its training left out.

    Args:
        data: folder of a dataset.
        model: name of a shipped model, folder of a training run, or path of a .safetensors file.
        figure: where a picture of the latent space goes; None for no picture.

    Returns:
        ``accuracy`` and ``windows`` (those of the test episodes), ``by_length`` and ``by_leader``.

    Raises:
        InputError: no usable dataset or model.
    """
    trained = traits.load(model)
    _require_unseen(data, model)
    windows = load_windows(data)
    labels = load_labels(data, windows)
    seed = int(read_card(model).get("seed", 0))
    found = evaluate(trained, windows, labels, seed=seed)
    if figure is not None:
        _, unseen = split_by_episode(windows, TEST_FRACTION, seed)
        plot_latents(trained, windows[unseen], labels[unseen], figure)
    return {"model": str(model), **asdict(found)}


def _described(data: Path) -> dict[str, Any]:
    manifest = read_manifest(data)
    return {key: manifest[key] for key in ("p_conservative", "seed", "windows")}


def _require_unseen(data: Path, model: str | Path) -> None:
    """Raise InputError if the dataset shares episodes with the model's training, yet is not the same dataset.

    Episodes follow from P and seed; a dataset of another size has them in common, but splits them otherwise.
    """
    trained_on = read_card(model).get("data") or {}
    here = _described(data)
    alike = all(trained_on.get(key) == here[key] for key in ("p_conservative", "seed"))
    if alike and trained_on["windows"] != here["windows"]:
        raise InputError(
            f"{data} has episodes that {model} was trained on; record another dataset with --seed {here['seed'] + 1}"
        )
