"""Episodes of the navigation task in a batch of intersections: what all environment classes share."""

import math
from collections.abc import Iterable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray

from tint_sumo.config import (
    MAX_VEHICLES,
    POSITION_SCALE_M,
    REWARD_PRESETS,
    SPEED_SCALE_MPS,
    Backend,
    EgoController,
    EpisodeRules,
    RewardPreset,
    Scenario,
    Traffic,
)
from tint_sumo.errors import InputError
from tint_sumo.scenario.geometry import Bools, Floats, Pose
from tint_sumo.simulation.intersections import Intersections

Observation = dict[str, NDArray[np.float32]]
REWARD_TERMS = ("goal", "collision", "speed", "step")

_BOUND = 2.0  # of normalised observations: 40 m, 6 m/s
_SEED_LIMIT = 2**63
_ACTIONS_MPS = EgoController().desired_speeds_mps


@dataclass(frozen=True)
class TaskSettings:
    """The arguments of the environments' constructors."""

    p_conservative: float = 0.4
    reward: str = "paper"
    time_limit_s: float = 50.0
    position_noise_m: float = 0.0
    backend: Backend = "auto"

    def __post_init__(self) -> None:
        if self.reward not in REWARD_PRESETS:
            raise InputError(f"unknown reward preset {self.reward!r}; choose one of {', '.join(REWARD_PRESETS)}")
        if not EpisodeRules().step_s <= self.time_limit_s < math.inf:
            raise InputError(f"time_limit_s must be at least a step of 0.1 s, and finite, not {self.time_limit_s}")
        if not 0.0 <= self.position_noise_m < math.inf:
            raise InputError(f"position_noise_m must be finite and not negative, not {self.position_noise_m}")

    @property
    def scenario(self) -> Scenario:
        rules = replace(EpisodeRules(), time_limit_s=self.time_limit_s)
        return Scenario(traffic=Traffic(p_conservative=self.p_conservative), episode=rules)


def action_space() -> spaces.Discrete:
    return spaces.Discrete(len(_ACTIONS_MPS))


def observation_space() -> spaces.Dict:
    return spaces.Dict(
        {
            "ego": spaces.Box(-_BOUND, _BOUND, (4,), np.float32),
            "vehicles": spaces.Box(-_BOUND, _BOUND, (MAX_VEHICLES, 2), np.float32),
            "mask": spaces.Box(0.0, 1.0, (MAX_VEHICLES,), np.float32),
        }
    )


def require_actions(actions: NDArray[np.integer], num_envs: int) -> None:
    if actions.shape != (num_envs,) or not ((actions >= 0) & (actions < len(_ACTIONS_MPS))).all():
        raise InputError(f"actions must be {num_envs} of 0, 1, 2, not {actions.tolist()}")


@dataclass(frozen=True)
class Transition:
    """What one step brought each environment; arrays (N,)."""

    reward: Floats
    reward_terms: dict[str, Floats]
    success: Bools
    collision: Bools
    timeout: Bools

    @property
    def terminated(self) -> Bools:
        return self.success | self.collision

    @property
    def done(self) -> Bools:
        return self.terminated | self.timeout

    @property
    def outcome(self) -> NDArray[np.str_]:
        """``success``, ``collision``, ``timeout`` or the empty string."""
        if not self.done.any():
            return np.full(self.done.shape, "")
        ends = [self.success, self.collision, self.timeout]
        return np.select(ends, ["success", "collision", "timeout"], "")


def reward_terms(speed_mps: Floats, success: Bools, collision: Bools, preset: RewardPreset) -> dict[str, Floats]:
    """The named terms whose sum is the reward (paper IV-A); (N,) each."""
    driving = ~(success | collision)
    return {
        "goal": np.multiply(preset.goal, success),
        "collision": np.multiply(preset.collision, collision),
        "speed": preset.speed_weight_per_mps * speed_mps * driving,
        "step": np.multiply(preset.step, driving),
    }


def has_reached_goal(pose: Pose, scenario: Scenario) -> Bools:
    """Whether the ego's centre is past the goal and within a metre of the upper lane's middle."""
    off_centre_m = np.abs(pose.y_m - scenario.street.upper_y_m)
    return np.asarray((pose.x_m > scenario.episode.goal_x_m) & (off_centre_m < scenario.street.lane_width_m / 4))


def _bounded(values: Floats) -> NDArray[np.float32]:
    return np.minimum(np.maximum(values, -_BOUND), _BOUND).astype(np.float32, order="C")


class Episodes:
    """``num_envs`` episodes at a time, each in its own replica with its own random stream."""

    def __init__(self, num_envs: int, settings: TaskSettings) -> None:
        self.settings = settings
        self.simulation = Intersections(num_envs, settings.scenario, backend=settings.backend)
        traits = [1 if member.profile.yields else -1 for member in self.simulation.population]
        self._trait_of_member = np.array([*traits, 0], np.int8)  # the last: empty slots
        self._preset = REWARD_PRESETS[settings.reward]
        self._speeds_mps = np.array(_ACTIONS_MPS)
        self._step_limit = round(settings.time_limit_s / self.simulation.scenario.episode.step_s)
        self.steps = np.zeros(num_envs, np.int64)
        self._noise = [np.random.default_rng(0) for _ in range(num_envs)]
        self._measured_noise_m: Floats = np.zeros((num_envs, MAX_VEHICLES, 2))

    def begin(self, index: int, rng: np.random.Generator) -> None:
        """Start a new episode drawn from an environment's generator."""
        seed = int(rng.integers(_SEED_LIMIT))
        self.simulation.reset(index, seed)
        self.steps[index] = 0
        self._noise[index] = np.random.default_rng([seed, 1])
        self._measure([index])

    def step(self, actions: NDArray[np.integer]) -> Transition:
        """Take an action, 0, 1 or 2, in each environment; (N,)."""
        simulation = self.simulation
        simulation.step(self._speeds_mps[actions])
        self.steps += 1
        self._measure(range(len(self.steps)))
        collision = simulation.collided.copy()
        success = has_reached_goal(simulation.ego_pose(), simulation.scenario) & ~collision
        timeout = (self.steps >= self._step_limit) & ~(success | collision)
        terms = reward_terms(simulation.ego_speed_mps, success, collision, self._preset)
        return Transition(sum(terms.values(), np.zeros(len(self.steps))), terms, success, collision, timeout)

    def _measure(self, indices: Iterable[int]) -> None:
        """Draw the noise of this step's position measurements, from each environment's own generator."""
        sigma_m = self.settings.position_noise_m
        if sigma_m > 0.0:
            for index in indices:
                self._measured_noise_m[index] = self._noise[index].normal(0.0, sigma_m, (MAX_VEHICLES, 2))

    def observe(self) -> Observation:
        """Observations of all environments, batched along the first axis."""
        simulation = self.simulation
        pose = simulation.ego_pose()
        speed = simulation.ego_speed_mps / SPEED_SCALE_MPS
        x, y = pose.x_m / POSITION_SCALE_M, pose.y_m / POSITION_SCALE_M
        ego = np.array([x, y, speed * pose.heading_x, speed * pose.heading_y]).T
        relative_m = self._measured_noise_m.copy()
        relative_m[:, :, 0] += simulation.x_m - pose.x_m[:, None]
        relative_m[:, :, 1] += simulation.y_m - pose.y_m[:, None]
        vehicles = relative_m * (simulation.present[:, :, None] / POSITION_SCALE_M)
        return {"ego": _bounded(ego), "vehicles": _bounded(vehicles), "mask": simulation.present.astype(np.float32)}

    def time_s(self) -> Floats:
        """Time since the episodes' start; (N,)."""
        return np.asarray(self.steps * self.simulation.scenario.episode.step_s)

    def traits(self) -> NDArray[np.int8]:
        """True traits, (N, 12): 1 conservative, -1 aggressive, 0 in empty slots."""
        return np.asarray(self._trait_of_member[self.simulation.member])

    def collision_info(self, index: int) -> dict[str, Any]:
        """Who was hit where; empty without a collision."""
        event = self.simulation.collision[index]
        if event is None:
            return {}
        return {"trait": event.profile, "lane": event.lane, "slot": event.slot, "ego_m": (event.ego_x_m, event.ego_y_m)}
