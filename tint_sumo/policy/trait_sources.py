"""Where the driver traits in the policy's observation come from (paper III-C)."""

from abc import ABC, abstractmethod
from dataclasses import dataclass
from typing import Any, ClassVar, Protocol

import numpy as np
import torch

from tint_sumo.config import LATENT_SIZE, MAX_VEHICLES, POSITION_SCALE_M, WINDOW_STEPS, EpisodeRules
from tint_sumo.errors import InputError
from tint_sumo.policy.tracks import (
    LANE_BORDER_Y_M,
    Observation,
    Tracks,
    along_m,
    centres_m,
    is_upper,
    leader_gaps,
    windows,
)
from tint_sumo.traits.classifier import Classifier
from tint_sumo.traits.cross_window import CrossWindow
from tint_sumo.traits.model import TraitModel
from tint_sumo.traits.streaming import TrackStream


@dataclass(frozen=True)
class Frame:
    """What N environments show at one time."""

    observation: Observation  # arrays (N, ...)
    infos: list[dict[str, Any]]  # N of them
    done: np.ndarray  # (N,) bool, whether the last step ended the episode


class TraitSource(ABC):
    """Where the traits of N environments' vehicles come from; ``traits`` is (N, 12, size) float32."""

    size: ClassVar[int] = LATENT_SIZE  # numbers per vehicle
    traits: np.ndarray

    def attach(self, num_envs: int) -> None:
        """Get ready for ``num_envs`` environments."""
        self.traits = np.zeros((num_envs, MAX_VEHICLES, self.size), np.float32)

    @abstractmethod
    def begin(self, frame: Frame) -> None:
        """Take the first observation of a new episode in the environments that are done; ignore the others."""

    @abstractmethod
    def advance(self, frame: Frame) -> None:
        """Take the next observation of every running episode, the terminal one in environments that are done."""


class NoTraits(TraitSource):
    """Traits are always zero."""

    def begin(self, frame: Frame) -> None: ...

    def advance(self, frame: Frame) -> None: ...


class OracleTraits(TraitSource):
    """The true traits, known at once: conservative (1, 0), aggressive (0, 1), no vehicle (0, 0)."""

    def begin(self, frame: Frame) -> None:
        for env in np.flatnonzero(frame.done):
            self.traits[env] = _one_hot(frame.infos[env]["traits"])

    def advance(self, frame: Frame) -> None:
        keys = np.where(frame.done, "terminal_traits", "traits")
        labels = [info[key] for info, key in zip(frame.infos, keys, strict=True)]
        self.traits[:] = _one_hot(np.stack(labels))


def _one_hot(labels: np.ndarray) -> np.ndarray:
    """(...) of +1 conservative, -1 aggressive, 0 nobody, to (..., 2)."""
    return np.stack([labels > 0, labels < 0], axis=-1).astype(np.float32)


class Encoder(Protocol):
    """A trait model as far as windows need it."""

    latent_size: int

    def encode(self, states: torch.Tensor, length: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """Mean and log-variance (M, 2) of windows (M, 20, 2) of some lengths (M,)."""


class EncoderTraits(TraitSource):
    """Traits inferred from what the ego has observed of the vehicles.

    Traits are zero for an episode's first 20 steps; then, every 20 steps, they are the encoder's mean for the last 20
    steps, or as many (at least 2) as a vehicle has been seen. Drivers in a lane the ego has passed keep their trait
    (paper III-C): the lower lane counts as passed once the ego's centre is beyond its upper border, y > 4 m; the upper
    lane, in which the ego ends, never is. (The authors' code has y > 2.23 m and y > 6 m in this frame.) A slot is zero
    as soon as its vehicle has left.

    Args:
        model: trait model.
        scale: traits are divided by this (8 in the authors' code).

    Raises:
        InputError: the model's traits do not have 2 numbers.
    """

    def __init__(self, model: Encoder, scale: float = 1.0) -> None:
        _require_latent_size(model)
        self.model = model
        self.scale = scale

    def attach(self, num_envs: int) -> None:
        super().attach(num_envs)
        self._steps = np.zeros(num_envs, np.int64)
        self._history = Tracks.empty(num_envs)

    def begin(self, frame: Frame) -> None:
        self._steps[frame.done] = 0
        self.traits[frame.done] = 0.0
        self._history.present[frame.done] = False
        self._record(frame.observation, np.flatnonzero(frame.done))

    def advance(self, frame: Frame) -> None:
        self._steps += 1
        self._record(frame.observation, np.arange(len(self._steps)))
        self.traits[frame.observation["mask"] <= 0.5] = 0.0
        due = np.flatnonzero(self._steps % WINDOW_STEPS == 0)
        if len(due):
            self._infer(due, frame.observation["ego"][due, 1] * POSITION_SCALE_M)

    def _record(self, observation: Observation, envs: np.ndarray) -> None:
        """Overwrite the oldest step; a window that is due thus lies in the order of time."""
        at = (self._steps[envs] - 1) % WINDOW_STEPS
        self._history.x_m[envs, at], self._history.y_m[envs, at] = centres_m(observation, envs)
        self._history.present[envs, at] = observation["mask"][envs] > 0.5

    def _infer(self, envs: np.ndarray, ego_y_m: np.ndarray) -> None:
        tracks = self._history.of(envs)
        states, length = windows(tracks)
        ahead = is_upper(tracks.y_m[:, -1]) | (ego_y_m <= LANE_BORDER_Y_M)[:, None]
        rows, slots = np.nonzero((length >= 2) & ahead)
        if len(rows):
            with torch.no_grad():
                mean, _ = self.model.encode(
                    torch.from_numpy(states[rows, slots]), torch.from_numpy(length[rows, slots])
                )
            self.traits[envs[rows], slots] = self._told(mean) / self.scale

    def _told(self, latents: torch.Tensor) -> np.ndarray:
        """The numbers that stand for latents (M, 2)."""
        told: np.ndarray = latents.cpu().numpy()
        return told


class ClassifierTraits(EncoderTraits):
    """The classes that a supervised classifier predicts, in the form of :class:`OracleTraits`, at the same times.

    With a policy trained on true traits this is the pipeline of Ma et al. (2020) as the paper has it (IV-C).
    """

    model: Classifier

    def _told(self, latents: torch.Tensor) -> np.ndarray:
        is_conservative = self.model.logit(latents).cpu().numpy() > 0.0
        return _one_hot(np.where(is_conservative, 1, -1))


class StreamingTraits(TraitSource):
    """Traits inferred at every step from all that has been seen of a vehicle so far, and how sure they are.

    Each vehicle has five numbers: mean (2) and standard deviation (2) of the cross-window model's posterior, which are
    those of the prior, 0 and 1, until a vehicle has been seen twice, and for how long it has been seen, in units of
    10 s. All are zero in empty slots.

    Raises:
        InputError: the model is not a cross-window model with 2 latents.
    """

    size = 2 * LATENT_SIZE + 1

    def __init__(self, model: TraitModel) -> None:
        _require_latent_size(model)
        if not isinstance(model, CrossWindow):
            raise InputError(
                f"streaming needs the posteriors of a cross_window model, not of {model.method}; "
                "give a model trained with --method cross_window"
            )
        self.model = model

    def attach(self, num_envs: int) -> None:
        super().attach(num_envs)
        self._stream = TrackStream(self.model, num_envs * MAX_VEHICLES)

    def begin(self, frame: Frame) -> None:
        envs = np.flatnonzero(frame.done)
        self._stream.forget((envs[:, None] * MAX_VEHICLES + np.arange(MAX_VEHICLES)).flatten())
        self._follow(frame.observation, envs)

    def advance(self, frame: Frame) -> None:
        self._follow(frame.observation, np.arange(len(frame.done)))

    def _follow(self, observation: Observation, envs: np.ndarray) -> None:
        """Take one more step of the tracks in some environments."""
        present = observation["mask"][envs] > 0.5
        x_m, y_m = centres_m(observation, envs)
        gap_m = leader_gaps(x_m, y_m, present)
        tracks = envs[:, None] * MAX_VEHICLES + np.arange(MAX_VEHICLES)
        self._stream.forget(tracks[~present])
        mean, std = self._stream.advance(tracks[present], along_m(x_m, y_m)[present], gap_m[present])
        age = self._stream.steps[tracks[present]] * np.float32(EpisodeRules.step_s / _AGE_SCALE_S)
        self.traits[envs] = 0.0
        rows, slots = np.nonzero(present)
        self.traits[envs[rows], slots] = np.concatenate([mean, std, age[:, None]], axis=-1)


_AGE_SCALE_S = 10.0  # a vehicle crosses the street in 15 to 20 s


def _require_latent_size(model: Encoder) -> None:
    if model.latent_size != LATENT_SIZE:
        raise InputError(
            f"the policy takes traits of {LATENT_SIZE} numbers, this trait model's have {model.latent_size}; "
            f"train one with latent_size={LATENT_SIZE}"
        )
