"""Driver traits as a part of the policy's observation (paper III-C)."""

from abc import ABC, abstractmethod
from dataclasses import dataclass
from typing import Any, Protocol, Self

import numpy as np
import torch
from gymnasium import spaces
from stable_baselines3.common.vec_env import VecEnv, VecEnvWrapper
from stable_baselines3.common.vec_env.base_vec_env import VecEnvStepReturn

from tint_sumo.config import LATENT_SIZE, MAX_VEHICLES, POSITION_SCALE_M, WINDOW_STEPS, Street, VehicleShape
from tint_sumo.dataset.schema import NO_LEADER_GAP_M
from tint_sumo.errors import InputError
from tint_sumo.scenario.geometry import lane_border_y_m

_NEEDED = frozenset({"ego", "vehicles", "mask"})

Observation = dict[str, np.ndarray]


@dataclass(frozen=True)
class Frame:
    """What N environments show at one time."""

    observation: Observation  # arrays (N, ...)
    infos: list[dict[str, Any]]  # N of them
    done: np.ndarray  # (N,) bool, whether the last step ended the episode


class TraitSource(ABC):
    """Where the traits of N environments' vehicles come from; ``traits`` is (N, 12, 2) float32."""

    traits: np.ndarray

    def attach(self, num_envs: int) -> None:
        """Get ready for ``num_envs`` environments."""
        self.traits = np.zeros((num_envs, MAX_VEHICLES, LATENT_SIZE), np.float32)

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
    """(..., 12) of +1 conservative, -1 aggressive, 0 nobody, to (..., 12, 2)."""
    return np.stack([labels > 0, labels < 0], axis=-1).astype(np.float32)


_LANE_BORDER_Y_M = lane_border_y_m(Street())


@dataclass
class Tracks:
    """Where vehicles were at the last 20 steps, oldest first; arrays are (N, 20, 12), of N environments."""

    x_m: np.ndarray  # of the vehicle's centre, float32
    y_m: np.ndarray  # the same
    present: np.ndarray  # whether the slot holds a vehicle, bool

    @classmethod
    def empty(cls, num_envs: int) -> Self:
        shape = (num_envs, WINDOW_STEPS, MAX_VEHICLES)
        return cls(np.zeros(shape, np.float32), np.zeros(shape, np.float32), np.zeros(shape, bool))

    def of(self, envs: np.ndarray) -> "Tracks":
        """The tracks of some environments."""
        return Tracks(self.x_m[envs], self.y_m[envs], self.present[envs])


def is_upper(y_m: np.ndarray) -> np.ndarray:
    """Whether positions lie in the upper lane, which runs east; the lower runs west."""
    return y_m > _LANE_BORDER_Y_M


def windows(tracks: Tracks) -> tuple[np.ndarray, np.ndarray]:
    """Trait model inputs from tracks, as in ``tint_sumo.dataset.windows``.

    Returns:
        states: (N, 12, 20, 2) float32: offset along the lane from the window's first position (m) and bumper-to-bumper
            gap to the leader (m); zero after ``length``.
        length: (N, 12) int64: for how many steps up to now the slot has held its vehicle, 0..20.
    """
    length = np.minimum.accumulate(tracks.present[:, ::-1], axis=1).sum(axis=1)
    along = np.where(is_upper(tracks.y_m), tracks.x_m, -tracks.x_m)
    features = np.stack([along, leader_gaps(tracks)], axis=-1).swapaxes(1, 2)
    steps = np.arange(WINDOW_STEPS)
    valid = steps < length[..., None]
    source = np.where(valid, steps + (WINDOW_STEPS - length)[..., None], 0)
    states = np.take_along_axis(features, source[..., None], axis=2)
    states[..., 0] -= states[:, :, :1, 0]
    return np.where(valid[..., None], states, np.float32(0.0)), length


def leader_gaps(tracks: Tracks) -> np.ndarray:
    """Bumper-to-bumper gaps to the leaders in the same lane, (N, 20, 12) m, at most ``NO_LEADER_GAP_M``."""
    upper = is_upper(tracks.y_m)
    along = np.where(upper, tracks.x_m, -tracks.x_m)
    gap = along[..., None, :] - along[..., :, None]
    leads = (gap > 0.0) & (upper[..., None, :] == upper[..., :, None]) & tracks.present[..., None, :]
    nearest = np.where(leads, gap - VehicleShape.length_m, NO_LEADER_GAP_M).min(axis=-1)
    capped: np.ndarray = np.minimum(nearest, NO_LEADER_GAP_M).astype(np.float32)
    return capped


class Encoder(Protocol):
    """A trait model as this module needs it."""

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
        if model.latent_size != LATENT_SIZE:
            raise InputError(
                f"the policy takes traits of {LATENT_SIZE} numbers, this trait model's have {model.latent_size}; "
                f"train one with latent_size={LATENT_SIZE}"
            )
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
        centre = (observation["vehicles"][envs] + observation["ego"][envs, None, :2]) * POSITION_SCALE_M
        self._history.x_m[envs, at], self._history.y_m[envs, at] = centre[..., 0], centre[..., 1]
        self._history.present[envs, at] = observation["mask"][envs] > 0.5

    def _infer(self, envs: np.ndarray, ego_y_m: np.ndarray) -> None:
        tracks = self._history.of(envs)
        states, length = windows(tracks)
        ahead = is_upper(tracks.y_m[:, -1]) | (ego_y_m <= _LANE_BORDER_Y_M)[:, None]
        rows, slots = np.nonzero((length >= 2) & ahead)
        if len(rows):
            with torch.no_grad():
                mean, _ = self.model.encode(
                    torch.from_numpy(states[rows, slots]), torch.from_numpy(length[rows, slots])
                )
            self.traits[envs[rows], slots] = mean.cpu().numpy() / self.scale


class TraitObservation(VecEnvWrapper):
    """Adds "traits" (12, 2) to the observations of a T-intersection, terminal ones included.

    Args:
        venv: Stable-Baselines3 vector environment of T-intersections.
        source: where the traits come from; for one environment only.

    Raises:
        InputError: the environment does not observe ego, vehicles and mask.
    """

    def __init__(self, venv: VecEnv, source: TraitSource) -> None:
        if not isinstance(venv.observation_space, spaces.Dict) or not set(venv.observation_space.spaces) >= _NEEDED:
            raise InputError(
                f"traits belong to observations with {', '.join(sorted(_NEEDED))}, as a T-intersection's; "
                f"this environment's space is {venv.observation_space}"
            )
        traits = spaces.Box(-np.inf, np.inf, (MAX_VEHICLES, LATENT_SIZE), np.float32)
        super().__init__(venv, spaces.Dict({**venv.observation_space.spaces, "traits": traits}))
        self.source = source
        source.attach(venv.num_envs)

    def reset(self) -> Observation:
        observation = _dictionary(self.venv.reset())
        self.source.begin(Frame(observation, self.venv.reset_infos, np.ones(self.num_envs, bool)))
        return self._with_traits(observation)

    def step_wait(self) -> VecEnvStepReturn:
        fresh, rewards, done, infos = self.venv.step_wait()
        observation = _dictionary(fresh)
        ended = np.flatnonzero(done)
        self.source.advance(Frame(_continued(observation, infos, ended), infos, done))
        for env in ended:
            infos[env]["terminal_observation"]["traits"] = self.source.traits[env].copy()
        if len(ended):
            self.source.begin(Frame(observation, infos, done))
        return self._with_traits(observation), rewards, done, infos

    def _with_traits(self, observation: Observation) -> Observation:
        return {**observation, "traits": self.source.traits.copy()}


def _dictionary(observation: Any) -> Observation:
    assert isinstance(observation, dict)
    return observation


def _continued(observation: Observation, infos: list[dict[str, Any]], ended: np.ndarray) -> Observation:
    """The observations that continue the last ones' episodes: the terminal ones in the ``ended`` environments."""
    if not len(ended):
        return observation
    continued = {key: values.copy() for key, values in observation.items()}
    for env in ended:
        for key, value in infos[env]["terminal_observation"].items():
            continued[key][env] = value
    return continued
