"""Sources of the driver traits in the policy's observation (paper III-C)."""

from abc import ABC, abstractmethod
from dataclasses import dataclass
from typing import Any, ClassVar, Protocol

import numpy as np
import torch

from tint_sumo.config import (
    KINDS,
    LATENT_SIZE,
    NO_LEADER_GAP_M,
    SPEED_SCALE_MPS,
    STEP_S,
    WINDOW_STEPS,
    RelativeSettings,
)
from tint_sumo.core.errors import InputError
from tint_sumo.dataset.windows import cut_windows
from tint_sumo.traits.classifier import Classifier
from tint_sumo.traits.cross_window import CrossWindow
from tint_sumo.traits.model import TraitModel
from tint_sumo.traits.relative import LATENTS, RelativeStream, TownEstimate
from tint_sumo.traits.stepping import AGE_SCALE_S
from tint_sumo.traits.streaming import TrackStream

Observation = dict[str, np.ndarray]
_MOTION = 3  # numbers
_SPEED_STEPS, _MEAN_STEPS = 3, 12  # of moving averages
_GAP_SCALE_M = 10.0


@dataclass(frozen=True)
class Frame:
    """Observations of N environments with V vehicle slots each, at one time."""

    observation: Observation  # arrays (N, ...)
    slots: dict[str, np.ndarray]  # arrays (N, V), see ``tint_sumo.envs.sb3.SceneVecEnv``
    done: np.ndarray  # (N,) bool, whether the last step ended the episode

    @property
    def present(self) -> np.ndarray:
        """(N, V) bool, which slots hold a vehicle."""
        present: np.ndarray = self.observation["mask"] > 0.5
        return present


class TraitSource(ABC):
    """Source of the traits of N environments' vehicles; ``traits`` is (N, V, size) float32."""

    size: int = LATENT_SIZE  # numbers per vehicle
    meaning: ClassVar[str]  # of the numbers, for the users of an exported policy; of a trait model: TraitSteps.meaning
    needs_tracks: ClassVar[bool] = False  # whether it takes the positions of vehicles on their routes
    traits: np.ndarray

    def attach(self, num_envs: int, max_vehicles: int) -> None:
        """Get ready for ``num_envs`` environments of so many slots."""
        self.traits = np.zeros((num_envs, max_vehicles, self.size), np.float32)

    def memory(self) -> dict[str, Any]:
        """Return the arrays and tensors with all that is known of the present episodes, by name."""
        return {"traits": self.traits}

    @abstractmethod
    def begin(self, frame: Frame) -> None:
        """Take the first observation of a new episode in the environments that are done; ignore the others."""

    @abstractmethod
    def advance(self, frame: Frame) -> None:
        """Take the next observation of every running episode, the terminal one in environments that are done."""


class NoTraits(TraitSource):
    """Traits are always zero."""

    meaning = "0, always"

    def begin(self, frame: Frame) -> None: ...

    def advance(self, frame: Frame) -> None: ...


class OracleTraits(TraitSource):
    """The true traits, known at once: 1 at the number of the driver's profile, conservative first; else 0.

    Args:
        profiles: their number in the scene's population.
    """

    meaning = "1 at the number of the driver's profile, conservative first, else 0; all 0 where it is not known"

    def __init__(self, profiles: int = KINDS) -> None:
        self.size = profiles

    def begin(self, frame: Frame) -> None:
        self.traits[frame.done] = one_hot(frame.slots["traits"][frame.done], self.size)

    def advance(self, frame: Frame) -> None:
        self.traits[:] = one_hot(frame.slots["traits"], self.size)


def one_hot(labels: np.ndarray, size: int) -> np.ndarray:
    """Return (..., size) with 1 at the number (...) of the profile, else 0; -1, an empty slot, gives zeros."""
    hot: np.ndarray = (labels[..., None] == np.arange(size)).astype(np.float32)
    return hot


class Encoder(Protocol):
    """The part of a trait model that reads windows."""

    latent_size: int

    def encode(self, states: torch.Tensor, length: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """Return mean and log-variance (M, 2) of windows (M, 20, 2) of some lengths (M,)."""


class EncoderTraits(TraitSource):
    """Traits inferred from what the ego has observed of the vehicles.

    Traits are zero for an episode's first 20 steps; then, every 20 steps, they are the encoder's mean for the last 20
    steps, or as many (at least 2) as a vehicle has been seen. Drivers in a lane the ego has passed keep their trait
    (paper III-C): a lane counts as passed once the ego's centre is beyond its far border, and one that the ego merges
    into never. In the T-intersection that is y > 4 m for the lower lane (the authors' code has y > 2.23 m and y > 6 m
    in this frame). A slot is zero as soon as its vehicle has left.

    Args:
        model: trait model.
        scale: traits are divided by this (8 in the authors' code).

    Raises:
        InputError: the model's traits do not have 2 numbers.
    """

    needs_tracks = True

    def __init__(self, model: Encoder, scale: float = 1.0) -> None:
        _require_latent_size(model)
        self.model = model
        self.scale = scale

    def attach(self, num_envs: int, max_vehicles: int) -> None:
        super().attach(num_envs, max_vehicles)
        shape = (num_envs, WINDOW_STEPS, max_vehicles)  # a ring buffer holds the last steps of each environment
        self._steps = np.zeros(num_envs, np.int64)
        self._present = np.zeros(shape, bool)
        self._position_m, self._gap_m = np.zeros(shape), np.zeros(shape)

    def memory(self) -> dict[str, Any]:
        seen = {"present": self._present, "position_m": self._position_m, "gap_m": self._gap_m}
        return {**super().memory(), "steps": self._steps, **seen}

    def begin(self, frame: Frame) -> None:
        self._steps[frame.done] = 0
        self.traits[frame.done] = 0.0
        self._present[frame.done] = False
        self._record(frame, np.flatnonzero(frame.done))

    def advance(self, frame: Frame) -> None:
        self._steps += 1
        self._record(frame, np.arange(len(self._steps)))
        self.traits[~frame.present] = 0.0
        due = np.flatnonzero(self._steps % WINDOW_STEPS == 0)
        if len(due):
            self._infer(due, frame.slots["passed"][due] == 0)

    def _record(self, frame: Frame, envs: np.ndarray) -> None:
        """Overwrite the oldest step; a window that is due thus lies in the order of time."""
        at = (self._steps[envs] - 1) % WINDOW_STEPS
        self._present[envs, at] = frame.present[envs]
        self._position_m[envs, at] = frame.slots["position_m"][envs]
        self._gap_m[envs, at] = frame.slots["gap_m"][envs]

    def _infer(self, envs: np.ndarray, ahead: np.ndarray) -> None:
        """Infer anew the traits of the drivers (K, V) that are still ahead, in some environments (K,)."""
        seen = np.logical_and.accumulate(self._present[envs, ::-1], axis=1)[:, ::-1]  # without a break up to now
        env, slot, step = np.nonzero((seen & ahead[:, None]).swapaxes(1, 2))
        if not len(env):
            return
        at = (envs[env], step, slot)
        windows = cut_windows(env * ahead.shape[1] + slot, env, self._position_m[at], self._gap_m[at])
        if len(windows):
            row, column = np.divmod(windows.driver, ahead.shape[1])
            with torch.no_grad():
                mean, _ = self.model.encode(torch.from_numpy(windows.states), torch.from_numpy(windows.length))
            self.traits[envs[row], column] = self._policy_input(mean) / self.scale

    def _policy_input(self, latents: torch.Tensor) -> np.ndarray:
        """Return the policy's input (M, size) for latents (M, 2)."""
        means: np.ndarray = latents.cpu().numpy()
        return means


class ClassifierTraits(EncoderTraits):
    """The classes that a supervised classifier predicts, in the form of ``OracleTraits``, at the same times.

    With a policy trained on true traits this is the pipeline of Ma et al. (2020) as the paper has it (IV-C).

    Raises:
        InputError: the model is not a classifier with 2 latents.
    """

    size = KINDS
    model: Classifier

    def __init__(self, model: TraitModel) -> None:
        if not isinstance(model, Classifier):
            raise InputError(
                f"the classes of drivers are those of a classifier, not of {model.method}; "
                "give a trait model of the method classifier"
            )
        super().__init__(model)

    def _policy_input(self, latents: torch.Tensor) -> np.ndarray:
        is_conservative = self.model.logit(latents).cpu().numpy() > 0.0
        return one_hot(np.where(is_conservative, 0, 1), self.size)


class StreamingTraits(TraitSource):
    """Traits inferred at every step from all that has been seen of a vehicle so far, and how sure they are.

    Each vehicle has five numbers: mean (2) and standard deviation (2) of the cross-window model's posterior, which are
    those of the prior, 0 and 1, until a vehicle has been seen twice, and for how long it has been seen, in units of
    10 s. All are zero in empty slots.

    Raises:
        InputError: the model is not a cross-window model with 2 latents.
    """

    size = 2 * LATENT_SIZE + 1
    needs_tracks = True

    def __init__(self, model: TraitModel) -> None:
        _require_latent_size(model)
        if not isinstance(model, CrossWindow):
            raise InputError(
                f"streaming needs the posteriors of a cross_window model, not of {model.method}; "
                "give a trait model of the method cross_window"
            )
        self.model = model

    def attach(self, num_envs: int, max_vehicles: int) -> None:
        super().attach(num_envs, max_vehicles)
        self._tracks = np.arange(num_envs * max_vehicles).reshape(num_envs, max_vehicles)
        self._stream = TrackStream(self.model, self._tracks.size)

    def memory(self) -> dict[str, Any]:
        return {**super().memory(), **self._stream.memory()}

    def begin(self, frame: Frame) -> None:
        envs = np.flatnonzero(frame.done)
        self._stream.forget(self._tracks[envs].flatten())
        self._follow(frame, envs)

    def advance(self, frame: Frame) -> None:
        self._follow(frame, np.arange(len(frame.done)))

    def _follow(self, frame: Frame, envs: np.ndarray) -> None:
        """Take one more step of the tracks in some environments."""
        present, tracks = frame.present[envs], self._tracks[envs]
        position_m = frame.slots["position_m"][envs].astype(np.float32)
        gap_m = frame.slots["gap_m"][envs]
        self._stream.forget(tracks[~present])
        mean, std = self._stream.advance(tracks[present], position_m[present], gap_m[present])
        age = self._stream.steps[tracks[present]] * np.float32(STEP_S / AGE_SCALE_S)
        self.traits[envs] = 0.0
        rows, slots = np.nonzero(present)
        self.traits[envs[rows], slots] = np.concatenate([mean, std, age[:, None]], axis=-1)


class NeighbourTraits(TraitSource):
    """Traits inferred from how a vehicle and all others in the episode follow their leaders.

    A vehicle's two numbers are those of ``tint_sumo.traits.relative.RelativeStream``.
    """

    size = LATENTS
    meaning = "belief that the driver yields, from -1 to 1, and how much of what can be known of it is known, 0 to 1"
    needs_tracks = True

    def __init__(self, settings: RelativeSettings) -> None:
        self.settings = settings

    def attach(self, num_envs: int, max_vehicles: int) -> None:
        super().attach(num_envs, max_vehicles)
        self._stream = self.make_stream(num_envs, max_vehicles)

    def make_stream(self, num_envs: int, max_vehicles: int) -> RelativeStream:
        """Return a new stream for ``num_envs`` environments of so many slots; a subclass may have another one."""
        return RelativeStream(self.settings, num_envs, max_vehicles)

    def memory(self) -> dict[str, Any]:
        return {**super().memory(), **{f"stream_{name}": part for name, part in self._stream.memory().items()}}

    def begin(self, frame: Frame) -> None:
        envs = np.flatnonzero(frame.done)
        self._stream.begin(envs)
        self._follow(frame, envs)

    def advance(self, frame: Frame) -> None:
        self._follow(frame, np.arange(len(frame.done)))

    def town(self, env: int) -> TownEstimate:
        """Return what is known of the town of an environment's episode."""
        return self._stream.town(env)

    def _follow(self, frame: Frame, envs: np.ndarray) -> None:
        """Take one more step of the tracks in some environments."""
        position_m, gap_m = (frame.slots[key][envs].astype(np.float64) for key in ("position_m", "gap_m"))
        self.traits[envs] = self._stream.advance(envs, frame.present[envs], position_m, gap_m)


class WithMotion(TraitSource):
    """The traits of another source, behind the motion of each vehicle as its track shows it.

    Three numbers stand for the motion, all zero in empty slots: its speed, in units of 3 m/s, as a moving average over
    about 0.3 s; how much that exceeds the average over about 1.2 s, in m/s; and the gap to its leader, in units of 10 m
    and 20 m at most. Without them, the policy's network would have to find the speeds of up to 12 vehicles in the
    differences of their positions from decision to decision.
    """

    needs_tracks = True
    before = _MOTION  # numbers before the traits

    def __init__(self, inner: TraitSource) -> None:
        self.inner = inner
        self.size = _MOTION + inner.size

    def attach(self, num_envs: int, max_vehicles: int) -> None:
        super().attach(num_envs, max_vehicles)
        self.inner.attach(num_envs, max_vehicles)
        shape = (num_envs, max_vehicles)
        self._steps = np.zeros(shape, np.int64)  # for which the present vehicle has been seen
        self._position_m, self._speed_mps, self._mean_mps = np.zeros(shape), np.zeros(shape), np.zeros(shape)

    def memory(self) -> dict[str, Any]:
        own = {"steps": self._steps, "position_m": self._position_m}
        own |= {"speed_mps": self._speed_mps, "mean_mps": self._mean_mps, "traits": self.traits}
        return {**{f"inner_{name}": part for name, part in self.inner.memory().items()}, **own}

    def begin(self, frame: Frame) -> None:
        self.inner.begin(frame)
        self._steps[frame.done] = 0
        self._follow(frame, np.flatnonzero(frame.done))

    def advance(self, frame: Frame) -> None:
        self.inner.advance(frame)
        self._follow(frame, np.arange(len(frame.done)))

    def _follow(self, frame: Frame, envs: np.ndarray) -> None:
        present, position_m = frame.present[envs], frame.slots["position_m"][envs]
        steps = np.where(present, self._steps[envs] + 1, 0)
        speed_mps = (position_m - self._position_m[envs]) / STEP_S
        self._speed_mps[envs] = _moving_average(self._speed_mps[envs], speed_mps, steps, _SPEED_STEPS)
        self._mean_mps[envs] = _moving_average(self._mean_mps[envs], speed_mps, steps, _MEAN_STEPS)
        self._steps[envs], self._position_m[envs] = steps, position_m
        gap_m = np.minimum(frame.slots["gap_m"][envs], NO_LEADER_GAP_M)
        more_mps = self._speed_mps[envs] - self._mean_mps[envs]
        motion = np.stack([self._speed_mps[envs] / SPEED_SCALE_MPS, more_mps, gap_m / _GAP_SCALE_M], axis=-1)
        self.traits[envs, :, :_MOTION] = np.where(present[..., None], motion, 0.0)
        self.traits[envs, :, _MOTION:] = self.inner.traits[envs]


def _moving_average(before: np.ndarray, value: np.ndarray, steps: np.ndarray, length: int) -> np.ndarray:
    """Return the mean over the first steps, then an exponential moving average; 0 until the second step of a track."""
    weight = 1.0 / np.clip(steps - 1, 1, length)
    return np.where(steps > 1, before + weight * (value - before), 0.0)


def _require_latent_size(model: Encoder) -> None:
    if model.latent_size != LATENT_SIZE:
        raise InputError(
            f"the policy takes traits of {LATENT_SIZE} numbers, this trait model's have {model.latent_size}; "
            f"train one with latent_size={LATENT_SIZE}"
        )
