"""Accuracy of traits that are read from a model's latents, with labels, which label-free methods meet nowhere else."""

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from typing import Annotated

import numpy as np
import torch
from numpy.typing import NDArray
from sklearn.linear_model import LinearRegression
from sklearn.neighbors import KNeighborsClassifier
from sklearn.pipeline import Pipeline, make_pipeline
from sklearn.preprocessing import StandardScaler
from sklearn.svm import LinearSVC

from tint_sumo.config import Fraction, WindowCount
from tint_sumo.core.errors import InputError
from tint_sumo.core.ranges import Range
from tint_sumo.dataset.windows import Windows, split_by_episode
from tint_sumo.traits.batches import TrainingWindows
from tint_sumo.traits.model import TraitModel

TEST_FRACTION = 1 / 3  # paper IV-B
LENGTH_BINS = ((2, 5), (6, 10), (11, 19), (20, 20))
NEIGHBOURS = 15
KNN_REFERENCES = 50_000  # windows; more cost time and change nothing
ENCODING_BATCH = 1024  # keeps a step of the network in the processor's cache


@dataclass(frozen=True)
class Part:
    """Accuracy on a part of the test windows; None where there are none."""

    accuracy: Fraction | None
    windows: Annotated[int, Range(0, 100_000_000)]


@dataclass(frozen=True)
class TraitAccuracy:
    """Accuracy of classifiers on the latent mean, on windows of unseen episodes."""

    accuracy: Fraction  # share of windows that a linear support vector classifier gets right
    knn_accuracy: Fraction  # the same of the nearest neighbours in the latent space
    majority_share: Fraction  # accuracy of always taking the most frequent trait
    windows: WindowCount
    error_m: float | None  # root mean square of reconstructed or predicted positions; None if the method has none
    # Share of the linear classifier's errors; None without errors or with point estimates.
    errors_in_most_uncertain_tenth: float | None
    by_length: Mapping[str, Part]  # keyed "2-5", "6-10", "11-19", "20"
    by_leader: Mapping[str, Part]  # keyed "with_leader", "without_leader"


@dataclass(frozen=True)
class Evaluation(TraitAccuracy):
    """Accuracy, and which traits the linear classifier takes for which."""

    balanced_accuracy: Fraction  # mean over the traits of the share of their windows that it gets right
    confusion: Mapping[int, Mapping[int, int]]  # windows by label, and by the classifier's answer


@dataclass(frozen=True)
class Latents:
    """Gaussians over the latents of N windows."""

    mean: NDArray[np.float32]  # (N, latent_size)
    std: NDArray[np.float32]  # (N, latent_size)


class Probe:
    """Classifiers on the latents of one model, fitted once and applied to any windows.

    Args:
        model: a trained model; it is not changed.
        windows: N windows to fit on.
        labels: (N,) the kind of each window's driver.
        noise_m: standard deviation of the noise on every position, here and in ``score``.
        seed: of the noise and of the neighbours' choice.

    Raises:
        InputError: the windows do not hold two traits.
    """

    def __init__(
        self,
        model: TraitModel,
        windows: Windows,
        labels: NDArray[np.integer],
        *,
        noise_m: float = 0.0,
        seed: int = 0,
    ) -> None:
        if len(np.unique(labels)) < 2:
            raise InputError(
                "drivers of two traits and several episodes are needed to evaluate; record a larger dataset, of "
                "population traits or several vTypes"
            )
        self._model, self._noise_m, self._seed = model, noise_m, seed
        mean = encode_windows(model, windows, noise_m=noise_m, seed=seed).mean
        reference = np.random.default_rng(seed).permutation(len(mean))[:KNN_REFERENCES]
        self._linear: Pipeline = make_pipeline(StandardScaler(), LinearSVC(random_state=0)).fit(mean, labels)
        neighbours = KNeighborsClassifier(min(NEIGHBOURS, len(reference)))
        self._nearest: Pipeline = make_pipeline(StandardScaler(), neighbours)
        self._nearest.fit(mean[reference], labels[reference])

    def score(self, windows: Windows, labels: NDArray[np.integer]) -> TraitAccuracy:
        """Return the accuracy on N windows, which the probe should not have been fitted on.

        Raises:
            InputError: there are no windows.
        """
        return self._score(windows, labels)[0]

    def evaluate(self, windows: Windows, labels: NDArray[np.integer]) -> Evaluation:
        """Return the accuracy on N windows with all confusions; errors are those of ``score``."""
        accuracy, answers = self._score(windows, labels)
        kinds = sorted({*labels.tolist(), *answers.tolist()})
        confusion = {
            kind: {answer: int(((labels == kind) & (answers == answer)).sum()) for answer in kinds} for kind in kinds
        }
        recalls = [float((answers == kind)[labels == kind].mean()) for kind in np.unique(labels)]
        return Evaluation(**vars(accuracy), balanced_accuracy=float(np.mean(recalls)), confusion=confusion)

    def _score(self, windows: Windows, labels: NDArray[np.integer]) -> tuple[TraitAccuracy, NDArray[np.integer]]:
        """Return the accuracy, and the linear classifier's answers, (N,)."""
        if len(windows) == 0:
            raise InputError("there are no windows to evaluate on; record a larger dataset")
        latents = encode_windows(self._model, windows, noise_m=self._noise_m, seed=self._seed + 1)
        answers = self._linear.predict(latents.mean)
        correct = answers == labels
        nearest = self._nearest.predict(latents.mean) == labels
        length, has_leader = windows.length, windows.has_leader
        accuracy = TraitAccuracy(
            accuracy=float(correct.mean()),
            knn_accuracy=float(nearest.mean()),
            majority_share=float(np.unique(labels, return_counts=True)[1].max() / len(labels)),
            windows=len(windows),
            error_m=position_error_m(self._model, windows, noise_m=self._noise_m, seed=self._seed + 1),
            errors_in_most_uncertain_tenth=_share_of_errors(correct, latents.std),
            by_length={
                str(low) if low == high else f"{low}-{high}": _part(correct[(length >= low) & (length <= high)])
                for low, high in LENGTH_BINS
            },
            by_leader={"with_leader": _part(correct[has_leader]), "without_leader": _part(correct[~has_leader])},
        )
        return accuracy, answers


def evaluate(
    model: TraitModel, windows: Windows, labels: NDArray[np.integer], *, noise_m: float = 0.0, seed: int = 0
) -> Evaluation:
    """Fit classifiers on two thirds of the episodes and test them on the rest (paper IV-B).

    Args:
        model: a trained model; it is not changed.
        windows: N windows.
        labels: (N,) the kind of each window's driver.
        noise_m: standard deviation of the noise on every position.
        seed: of the split. Use that of the training, so that the test episodes are unseen by the model too.

    Raises:
        InputError: the training part does not hold two traits, or the test part is empty.
    """
    train, test = split_by_episode(windows, TEST_FRACTION, seed)
    probe = Probe(model, windows[train], labels[train], noise_m=noise_m, seed=seed)
    return probe.evaluate(windows[test], labels[test])


def linear_r2(
    model: TraitModel, windows: Windows, properties: NDArray[np.floating], *, noise_m: float = 0.0, seed: int = 0
) -> NDArray[np.float64]:
    """Return how well a linear map from the latent mean gives properties of drivers, in unseen episodes.

    Args:
        model: a trained model; it is not changed.
        windows: N windows.
        properties: (N, P), such as desired speed and minimum gap.
        noise_m: standard deviation of the noise on every position.
        seed: of the split, as in ``evaluate``.

    Returns:
        (P,) coefficients of determination R2; 1 is perfect, 0 no better than the mean.
    """
    train, test = split_by_episode(windows, TEST_FRACTION, seed)
    return fit_line(model, windows[train], properties[train], noise_m=noise_m, seed=seed)(
        windows[test], properties[test]
    )


def fit_line(
    model: TraitModel, windows: Windows, properties: NDArray[np.floating], *, noise_m: float = 0.0, seed: int = 0
) -> Callable[[Windows, NDArray[np.floating]], NDArray[np.float64]]:
    """Fit a linear map from the latent mean to properties of drivers; return a function of other windows for its R2."""
    fitted = LinearRegression().fit(encode_windows(model, windows, noise_m=noise_m, seed=seed).mean, properties)

    def r2(windows: Windows, properties: NDArray[np.floating]) -> NDArray[np.float64]:
        means = encode_windows(model, windows, noise_m=noise_m, seed=seed + 1).mean
        residual = properties - fitted.predict(means)
        return np.asarray(1.0 - np.square(residual).mean(axis=0) / properties.var(axis=0))

    return r2


def encode_windows(model: TraitModel, windows: Windows, *, noise_m: float = 0.0, seed: int = 0) -> Latents:
    """Return latents of N windows, measured with noise drawn from ``seed``.

    Raises:
        InputError: they are not finite.
    """
    parts = []
    with torch.inference_mode():
        for states, length in _measured(windows, noise_m, seed, model.no_leader_gap_m):
            mean, log_var = model.encode(states, length)
            parts.append(torch.stack((mean, torch.exp(0.5 * log_var))))
    mean, std = torch.cat(parts, dim=1).numpy()
    if not np.isfinite(mean).all():
        raise InputError("the latents of some windows are not finite; check the data, the noise and the model")
    return Latents(mean, std)


def _measured(
    windows: Windows, noise_m: float, seed: int, no_leader_gap_m: float
) -> Iterator[tuple[torch.Tensor, torch.Tensor]]:
    """Yield states and lengths, a batch at a time; the noise does not depend on the size of the batches."""
    data = TrainingWindows(windows, no_leader_gap_m=no_leader_gap_m)
    everything = data.batch(torch.arange(len(windows)), torch.Generator())
    everything = everything.with_noise(noise_m, torch.Generator().manual_seed(seed))
    for index in _batches(len(windows)):
        yield everything.states[index], everything.length[index]


def _batches(windows: int) -> Iterator[slice]:
    for start in range(0, windows, ENCODING_BATCH):
        yield slice(start, start + ENCODING_BATCH)


def position_error_m(model: TraitModel, windows: Windows, *, noise_m: float = 0.0, seed: int = 0) -> float | None:
    """Return the root mean square error of positions that the model reconstructs or predicts."""
    generator = torch.Generator().manual_seed(seed)
    data = TrainingWindows(windows, with_other=model.uses_other_window, no_leader_gap_m=model.no_leader_gap_m)
    total, count = 0.0, 0
    with torch.inference_mode():
        for part in _batches(len(windows)):
            index = torch.arange(len(windows))[part]
            errors = model.squared_errors_m2(data.batch(index, generator).with_noise(noise_m, generator))
            total, count = total + float(errors.sum()), count + len(errors)
    return (total / count) ** 0.5 if count else None


def _share_of_errors(correct: NDArray[np.bool_], std: NDArray[np.float32]) -> float | None:
    """Return the share of the errors in the tenth of the windows with the widest posteriors; chance is 0.1."""
    if correct.all() or not std.any():
        return None
    widest = np.argsort(-std.prod(axis=1), kind="stable")[: -(-len(correct) // 10)]
    return float((~correct[widest]).sum() / (~correct).sum())


def _part(correct: NDArray[np.bool_]) -> Part:
    return Part(float(correct.mean()) if len(correct) else None, len(correct))
