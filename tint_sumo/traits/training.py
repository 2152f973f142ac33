"""Training of a trait model on windows; interruptible and exactly resumable."""

import hashlib
import math
import time
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import nn

from tint_sumo.config import LATENT_SIZE, NO_LEADER_GAP_M, TraitSettings
from tint_sumo.core.checkpoints import (
    damage_reported,
    pack,
    read_checkpoint,
    remove_checkpoint,
    restore_training,
    training_tensors,
    write_checkpoint,
)
from tint_sumo.core.determinism import preserved_random_state, single_threaded
from tint_sumo.core.errors import DivergedError, InputError
from tint_sumo.core.files import claim_folder
from tint_sumo.core.progress import Progress, Report, silent
from tint_sumo.core.ranges import Range
from tint_sumo.core.training_log import open_log
from tint_sumo.dataset.windows import WindowFile, Windows
from tint_sumo.traits.batches import TrainingWindows, WindowBatch
from tint_sumo.traits.input_range import InputRange
from tint_sumo.traits.model import TraitModel, find_trait_method
from tint_sumo.traits.storage import RUN_MODEL, load, save

CHECKPOINT_INTERVAL_S = 10.0
MAX_GRAD_NORM = 1.0  # a rare batch must not undo the others
BFLOAT16_HIDDEN_SIZE = 64  # bfloat16 is faster on CPUs from this size on


def train(
    windows: Windows | WindowFile,
    settings: TraitSettings,
    out: Path,
    *,
    method: str = "vae",
    seed: int = 0,
    latent_size: int = LATENT_SIZE,
    conservative: NDArray[np.bool_] | None = None,
    no_leader_gap_m: float = NO_LEADER_GAP_M,
    report: Report = silent,
    card: Mapping[str, Any] | None = None,
) -> TraitModel:
    """Train ``method`` on all of ``windows`` and write model.safetensors and model.json into ``out``.

    An interrupted run leaves a checkpoint; the same call continues it and ends with the very weights of a run without
    interruption (on the same machine). A finished run is loaded, not repeated. It computes in one thread.

    Args:
        windows: training windows only; the caller keeps the test episodes out.
        settings: sizes, loss weights and schedule.
        out: a new folder, or the one of this very run.
        method: a name in ``TRAIT_METHODS``.
        seed: of the initial weights, the order of windows and all noise.
        latent_size: numbers that represent a trait.
        conservative: (N,) the true traits, for a method that is trained with them; no other method may have them.
        no_leader_gap_m: gap that stands for none in the windows, and caps all gaps.
        report: called with the progress.
        card: further entries of the model's card, such as the dataset of the windows.

    Returns:
        The trained model in evaluation mode.

    Raises:
        InputError: unknown method, no windows, ``out`` holds another run, or its checkpoint is damaged.
        DivergedError: the windows or the loss are not finite; the checkpoint is of before that.
    """
    model_type = find_trait_method(method)
    if len(windows) == 0:
        raise InputError("there are no windows to train on; record a dataset with more of them")
    if model_type.uses_labels is not (conservative is not None):
        raise ValueError(f"labels are for the methods that learn with them: {method}.uses_labels")
    identity = {
        "task": "traits train",
        "method": method,
        "seed": seed,
        "latent_size": latent_size,
        "settings": asdict(settings),
        "windows": len(windows),
        "windows_sha256": _digest(windows, model_type, conservative),
        **({} if no_leader_gap_m == NO_LEADER_GAP_M else {"no_leader_gap_m": no_leader_gap_m}),
    }
    with claim_folder(out, identity):
        if (out / f"{RUN_MODEL}.json").exists():
            return load(out)
        with preserved_random_state():
            torch.manual_seed(_stream_seed(seed, 0))
            model = model_type(settings, latent_size)
            model.no_leader_gap_m = no_leader_gap_m
        labels = None if conservative is None else torch.from_numpy(conservative)
        data = TrainingWindows(
            windows, labels, with_other=model_type.uses_other_window, no_leader_gap_m=no_leader_gap_m
        )
        run = _Run(model, data, settings, seed)
        with single_threaded():
            loss = run.fit(out, report)

        known = {key: identity[key] for key in ("seed", "windows", "windows_sha256")}
        reach = asdict(InputRange.of(windows.parts()))
        save(model, out / RUN_MODEL, {**known, "loss": loss, "input_range": reach, **(card or {})})
        remove_checkpoint(out)
        return model.eval().requires_grad_(False)


@dataclass(frozen=True)
class _State:
    """State of a training beside its tensors, from which it is resumed."""

    epochs: Annotated[int, Range(0, 2**62)]  # that are finished
    loss: dict[str, float]  # terms of the last epoch


class _Run:
    """One training run: a model, its windows as tensors, and the optimiser."""

    def __init__(self, model: TraitModel, data: TrainingWindows, settings: TraitSettings, seed: int) -> None:
        self.model = model
        self.data = data
        self.settings = settings
        self.seed = seed
        self.optimiser = torch.optim.Adam(
            model.parameters(), settings.learning_rate, weight_decay=settings.weight_decay
        )

    def fit(self, out: Path, report: Report) -> dict[str, float]:
        """Run all epochs, beginning after those in the checkpoint in ``out``; return the mean loss terms of the last.

        Each epoch draws from another generator, so a checkpoint needs no generator states.
        """
        generator = self._generator(0)
        self.model.fit_features(part.with_noise(self.settings.noise_m, generator) for part in self.data.parts())
        if not (self.model.feature_mean.isfinite().all() and self.model.feature_scale.isfinite().all()):
            raise DivergedError("the training diverged at step 0: the windows are not finite; check data and noise")
        done, loss = self._resume(out)
        settings = {"method": self.model.method, "seed": self.seed, **asdict(self.settings)}
        log = open_log(out, settings, ["loss/total"], done)
        saved_at = time.monotonic()
        state = self._checkpoint(done, loss)
        report(self._progress(done, 0, loss))
        for epoch in range(done, self.settings.epochs):
            try:
                loss = self._run_epoch(epoch, report)
            except KeyboardInterrupt:
                write_checkpoint(out, state)
                raise
            except DivergedError as error:
                write_checkpoint(out, state)
                raise DivergedError(f"{error}; the checkpoint in {out} holds the model of {epoch} epochs") from None
            for name, value in loss.items():
                log.record(f"loss/{name}", value)
            log.dump(epoch + 1)
            state = self._checkpoint(epoch + 1, loss)
            if time.monotonic() - saved_at >= CHECKPOINT_INTERVAL_S:
                write_checkpoint(out, state)
                saved_at = time.monotonic()
        log.close()
        return loss

    def _progress(self, epoch: int, windows: int, loss: Mapping[str, float]) -> Progress:
        """Return the progress after some windows of an epoch, which had this loss."""
        every = len(self.data)
        measures = {"loss": loss["total"]} if loss else {}
        return Progress(epoch * every + windows, self.settings.epochs * every, "window", measures)

    def _run_epoch(self, epoch: int, report: Report) -> dict[str, float]:
        """Run once over the shuffled windows; return the mean of each loss term over the batches."""
        generator = self._generator(1 + epoch)
        order = torch.randperm(len(self.data), generator=generator)
        starts = range(0, len(order), self.settings.batch_size)
        sums: dict[str, float] = {}
        for number, start in enumerate(starts):
            index = order[start : start + self.settings.batch_size]
            batch = self.data.batch(index, generator).with_noise(self.settings.noise_m, generator)
            try:
                terms = self._step(batch, 1.0 - (epoch + number / len(starts)) / self.settings.epochs, generator)
            except FloatingPointError as error:
                raise DivergedError(
                    f"the training diverged at step {epoch * len(starts) + number + 1}: {error}; choose a lower "
                    f"learning_rate than {self.settings.learning_rate:g}, and check data and noise"
                ) from None
            for name, value in terms.items():
                sums[name] = sums.get(name, 0.0) + value
            means = {name: value / (number + 1) for name, value in sums.items()}
            report(self._progress(epoch, start + len(index), means))
        return means

    def _step(self, batch: WindowBatch, remaining: float, generator: torch.Generator) -> dict[str, float]:
        """Take one gradient step at the fraction ``remaining`` of the learning rate; return the loss terms.

        Raises:
            FloatingPointError: the loss or its gradient is not finite; the weights are as before.
        """
        for group in self.optimiser.param_groups:
            group["lr"] = self.settings.learning_rate * remaining
        with torch.autocast("cpu", torch.bfloat16, enabled=self.settings.hidden_size >= BFLOAT16_HIDDEN_SIZE):
            terms = self.model.loss(batch, generator)
        self.optimiser.zero_grad()
        torch.autograd.backward(terms["total"])
        norm = nn.utils.clip_grad_norm_(self.model.parameters(), MAX_GRAD_NORM)
        if not (math.isfinite(terms["total"].item()) and math.isfinite(norm.item())):
            raise FloatingPointError("the loss or its gradient is not finite")
        self.optimiser.step()
        return {name: value.item() for name, value in terms.items()}

    def _generator(self, stream: int) -> torch.Generator:
        return torch.Generator().manual_seed(_stream_seed(self.seed, stream))

    def _resume(self, out: Path) -> tuple[int, dict[str, float]]:
        """Go on from the checkpoint, if any; return the number of finished epochs and the last epoch's loss terms."""
        found = read_checkpoint(out, _State)
        if found is None:
            return 0, {}
        tensors, state = found
        with damage_reported(out):
            restore_training(self.model, self.optimiser, tensors)
        return state.epochs, state.loss

    def _checkpoint(self, epochs: int, loss: dict[str, float]) -> bytes:
        return pack(training_tensors(self.model, self.optimiser), _State(epochs, loss))


def _stream_seed(seed: int, stream: int) -> int:
    return int(np.random.SeedSequence((seed, stream)).generate_state(1)[0])


def _digest(
    windows: Windows | WindowFile, method: type[TraitModel], conservative: NDArray[np.bool_] | None = None
) -> str:
    """Return a checksum of all that a method learns from; drivers choose the other window, where it takes one."""
    digest = hashlib.sha256()
    for column in ("states", "length", *(("driver",) if method.uses_other_window else ())):
        for part in windows.parts():
            digest.update(np.ascontiguousarray(getattr(part, column)).data)
    if conservative is not None:
        digest.update(np.ascontiguousarray(conservative).data)
    return digest.hexdigest()
