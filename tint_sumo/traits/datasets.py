"""Trait models from a dataset folder: training on its training episodes, evaluation on the others."""

from dataclasses import asdict
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tint_sumo import traits
from tint_sumo.config import LATENT_SIZE, TRAIT_BUDGETS, TraitSettings
from tint_sumo.core.errors import InputError
from tint_sumo.core.progress import Report, silent
from tint_sumo.dataset.inspection import trait_colours
from tint_sumo.dataset.schema import read_manifest
from tint_sumo.dataset.windows import (
    WindowFile,
    Windows,
    load_labels,
    load_windows,
    read_training_windows,
    split_by_episode,
    window_file,
)
from tint_sumo.scenes.drivers import require_two_kinds
from tint_sumo.traits.evaluation import TEST_FRACTION, evaluate
from tint_sumo.traits.figures import plot_latents, plot_reconstructions
from tint_sumo.traits.model import find_trait_method
from tint_sumo.traits.storage import read_card, require_scene, require_scene_gaps
from tint_sumo.traits.training import train
from tint_sumo.traits.vae import Vae


def train_traits(
    data: Path,
    out: Path,
    *,
    method: str = "vae",
    settings: TraitSettings,
    seed: int = 0,
    streaming: bool = False,
    report: Report = silent,
) -> dict[str, Any]:
    """Train a trait model on two thirds of a dataset's episodes (paper IV-B) and return its card.

    Args:
        data: folder of a dataset.
        out: a new folder, or the one of this very run; model.safetensors and model.json go there.
        method: a name in ``tint_sumo.traits.TRAIT_METHODS``.
        settings: sizes, loss weights and schedule.
        seed: of weights, order and noise, and of the split into training and test episodes.
        streaming: keep the windows in a file beside the model instead of in memory; the model is the same.
        report: called with the progress.

    Raises:
        InputError: no such method, no usable dataset, a negative seed, no room for the file, or ``out`` holds another
            run.
    """
    if seed < 0:
        raise InputError(f"seed must not be negative: {seed}")
    find_trait_method(method)
    learn = partial(train_on, data=data, out=out, method=method, settings=settings, seed=seed, report=report)
    if streaming:
        with window_file(read_training_windows(data, TEST_FRACTION, seed), out) as stored:
            learn(stored)
    else:
        windows = load_windows(data)
        chosen, _ = split_by_episode(windows, TEST_FRACTION, seed)
        learn(windows[chosen])
    return read_card(out / "model.safetensors").entries


def train_on(
    windows: Windows | WindowFile,
    data: Path,
    out: Path,
    *,
    method: str,
    settings: TraitSettings,
    seed: int,
    latent_size: int = LATENT_SIZE,
    report: Report = silent,
) -> traits.TraitModel:
    """Train on all of ``windows``, which are the training windows of the dataset ``data``; return the model.

    Other arguments and errors are those of ``train_traits``.
    """
    uses_labels = find_trait_method(method).uses_labels
    return train(
        windows,
        settings,
        out,
        method=method,
        seed=seed,
        latent_size=latent_size,
        conservative=first_of_two(load_labels(data, windows), method) if uses_labels else None,
        report=report,
        card={"data": describe(data)},
    )


def evaluate_traits(
    data: Path, model: str | Path, *, noise_m: float = 0.0, other_scene: bool = False
) -> dict[str, Any]:
    """Return the accuracy of classifiers on a model's latents, in the episodes that its training left out.

    Args:
        data: folder of a dataset.
        model: name of a shipped model, folder of a training run, or path of a .safetensors file.
        noise_m: standard deviation of the noise on every position.
        other_scene: take a model of another scene than the dataset's, too.

    Returns:
        ``model``, ``noise_m`` and the fields of ``Evaluation``, its confusions by the traits' names.

    Raises:
        InputError: no usable dataset or model.
    """
    trained, windows, labels, seed = _load_for_test(data, model, noise_m, other_scene)
    found = evaluate(trained, windows, labels, noise_m=noise_m, seed=seed)
    names = read_manifest(data).traits
    confusion = {
        names[kind]: {names[answer]: count for answer, count in answers.items()}
        for kind, answers in found.confusion.items()
    }
    return {"model": str(model), "noise_m": noise_m, **asdict(found), "confusion": confusion}


def plot_traits(
    data: Path, model: str | Path, out: Path, *, noise_m: float = 0.0, other_scene: bool = False
) -> list[Path]:
    """Write pictures of a model's latents and reconstructions in unseen episodes into ``out``; return the files.

    Raises:
        InputError: no usable dataset or model.
    """
    trained, windows, labels, seed = _load_for_test(data, model, noise_m, other_scene)
    _, unseen = split_by_episode(windows, TEST_FRACTION, seed)
    files = [out / "latent.png"]
    plot_latents(
        trained, windows[unseen], labels[unseen], trait_colours(read_manifest(data)), files[0], noise_m=noise_m
    )
    if isinstance(trained, Vae):
        files.append(out / "reconstruction.png")
        plot_reconstructions(trained, windows[unseen], files[1])
    return files


def _load_for_test(
    data: Path, model: str | Path, noise_m: float, other_scene: bool
) -> tuple[traits.TraitModel, Windows, NDArray[np.int64], int]:
    """Return a model, the windows of a dataset it may be tested on, their labels, and the seed of the split."""
    require_noise(noise_m)
    trained = traits.load(model)
    require_scene_gaps(model)
    if not other_scene:
        described = describe(data)
        require_scene(model, described["scene"], described["scene_digest"], str(data))
    _require_unseen(data, model)
    windows = load_windows(data)
    return trained, windows, load_labels(data, windows), read_card(model).seed


def first_of_two(labels: NDArray[np.int64], method: str) -> NDArray[np.bool_]:
    """Return which drivers are of the first of two kinds: conservative, or of the first vType."""
    kinds = np.unique(labels)
    require_two_kinds(len(kinds), f"method {method}", "the dataset")
    return np.asarray(labels == kinds[0])


def require_noise(noise_m: float) -> None:
    """Raise InputError unless ``noise_m`` can be a standard deviation."""
    if not 0.0 <= noise_m < float("inf"):
        raise InputError(f"noise is a standard deviation in m and must be 0 or more, not {noise_m}")


def require_used(method: str, settings: TraitSettings) -> None:
    """Raise InputError if settings that a method does not use are others than in all budgets that have names."""
    for name in find_trait_method(method).unused_settings:
        if getattr(settings, name) not in {getattr(budget, name) for budget in TRAIT_BUDGETS.values()}:
            raise InputError(f"method {method} does not use {name}; leave it out of the budget")


def describe(data: Path) -> dict[str, Any]:
    """Return a model card's entries about the dataset that the model was trained on."""
    content = read_manifest(data).content()
    return {key: content[key] for key in ("scene", "scene_digest", "p_conservative", "population", "seed", "windows")}


def _require_unseen(data: Path, model: str | Path) -> None:
    """Raise InputError if the dataset shares episodes with the model's training, yet is not the same dataset.

    Episodes follow from P and seed; a dataset of another size has them in common, but splits them otherwise.
    """
    trained_on = read_card(model).data or {}
    present = describe(data)
    alike = all(trained_on.get(key) == present[key] for key in ("scene", "p_conservative", "population", "seed"))
    if alike and trained_on.get("windows") != present["windows"]:
        raise InputError(
            f"{data} has episodes that {model} was trained on; record another dataset with seed {present['seed'] + 1}"
        )
