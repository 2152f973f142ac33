"""Episodes of the navigation task in a batch of intersections: what all environment classes share."""

import math
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
    Idm,
    Population,
    Scenario,
    Share,
    Traffic,
)
from tint_sumo.envs.rows import BOUND, ROW, Rows, Scales, TaskRules, judge, observe
from tint_sumo.errors import InputError
from tint_sumo.scenario.geometry import Floats
from tint_sumo.simulation.intersections import Intersections

_SEED_LIMIT = 2**63
_ACTIONS_MPS = EgoController().desired_speeds_mps


@dataclass(frozen=True)
class TaskSettings:
    """The arguments of the environments' constructors."""

    p_conservative: Share = 0.4
    reward: str = "paper"
    time_limit_s: float = 50.0
    position_noise_m: float = 0.0
    tau_s: float = Idm.tau_s
    backend: Backend = "auto"

    def __post_init__(self) -> None:
        if self.reward not in REWARD_PRESETS:
            raise InputError(f"unknown reward preset {self.reward!r}; choose one of {', '.join(REWARD_PRESETS)}")
        if not EpisodeRules().step_s <= self.time_limit_s < math.inf:
            raise InputError(f"time_limit_s must be at least a step of 0.1 s, and finite, not {self.time_limit_s}")
        if not 0.0 <= self.position_noise_m < math.inf:
            raise InputError(f"position_noise_m must be finite and not negative, not {self.position_noise_m}")

        if not EpisodeRules().step_s <= self.tau_s < math.inf:
            raise InputError(f"tau_s must be at least a step of 0.1 s, and finite, not {self.tau_s}")

    @property
    def scenario(self) -> Scenario:
        rules = replace(EpisodeRules(), time_limit_s=self.time_limit_s)
        population = replace(Population(), idm=replace(Idm(), tau_s=self.tau_s))
        return Scenario(Traffic(p_conservative=self.p_conservative), population, episode=rules)


def action_space() -> spaces.Discrete:
    return spaces.Discrete(len(_ACTIONS_MPS))


def observation_space() -> spaces.Dict:
    return spaces.Dict(
        {
            "ego": spaces.Box(-BOUND, BOUND, (4,), np.float32),
            "vehicles": spaces.Box(-BOUND, BOUND, (MAX_VEHICLES, 2), np.float32),
            "mask": spaces.Box(0.0, 1.0, (MAX_VEHICLES,), np.float32),
        }
    )


def require_actions(actions: NDArray[np.integer], num_envs: int) -> None:
    if actions.shape != (num_envs,) or not ((actions >= 0) & (actions < len(_ACTIONS_MPS))).all():
        raise InputError(f"actions must be {num_envs} of 0, 1, 2, not {actions.tolist()}")


def episode_seed(rng: np.random.Generator) -> int:
    """Seed of the next episode of an environment with this generator."""
    return int(rng.integers(_SEED_LIMIT))


class Episodes:
    """``num_envs`` episodes at a time, each in its own replica with its own random stream.

    Args:
        rows: (N,) what the environments tell is written there; new if none is given.
    """

    def __init__(self, num_envs: int, settings: TaskSettings, rows: Rows | None = None) -> None:
        self.settings = settings
        self.simulation = Intersections(num_envs, settings.scenario, backend=settings.backend)
        self.rows = np.zeros(num_envs, ROW) if rows is None else rows
        traits = [1 if member.profile.yields else -1 for member in self.simulation.population]
        self._trait_of_member = np.array([*traits, 0], np.int8)  # the last: empty slots
        self._rules = TaskRules.of(settings.scenario, REWARD_PRESETS[settings.reward])
        self._scales = Scales(POSITION_SCALE_M, SPEED_SCALE_MPS, settings.scenario.episode.step_s)
        self._speeds_mps = np.array(_ACTIONS_MPS)
        self.steps = np.zeros(num_envs, np.int64)
        self._noise: dict[int, np.random.Generator] = {}  # of each environment, where there is noise
        self._noise_m: Floats = np.zeros((num_envs, MAX_VEHICLES, 2))

    def begin(self, index: int, rng: np.random.Generator) -> None:
        """Start a new episode drawn from an environment's generator."""
        seed = episode_seed(rng)
        self.simulation.reset(index, seed)
        self.steps[index] = 0
        if self.settings.position_noise_m > 0.0:
            self._noise[index] = np.random.default_rng([seed, 1])
        self._observe(slice(index, index + 1))

    def step(self, actions: NDArray[np.integer]) -> bool:
        """Take an action, 0, 1 or 2, in each environment; (N,). Tells whether any episode has ended."""
        simulation = self.simulation
        simulation.step(self._speeds_mps[actions])
        self.steps += 1
        self._observe(slice(0, len(self.steps)))
        return judge(
            simulation.ego_pose, simulation.ego_speed_mps, simulation.collided, self.steps, self._rules, self.rows
        )

    def _observe(self, envs: slice) -> None:
        """Write the observations of some environments, each with noise from its own generator."""
        simulation = self.simulation
        for index in self._noise.keys() & range(envs.start, envs.stop):
            rng = self._noise[index]
            self._noise_m[index] = rng.normal(0.0, self.settings.position_noise_m, (MAX_VEHICLES, 2))
        observe(
            simulation.ego_pose[envs],
            simulation.ego_speed_mps[envs],
            simulation.present[envs],
            simulation.x_m[envs],
            simulation.y_m[envs],
            self._trait_of_member[simulation.member[envs]],
            self._noise_m[envs],
            self.steps[envs],
            self._scales,
            self.rows[envs],
        )

    def collision_info(self, index: int) -> dict[str, Any]:
        """Who was hit where; empty without a collision."""
        event = self.simulation.collision[index]
        if event is None:
            return {}
        return {"trait": event.profile, "lane": event.lane, "slot": event.slot, "ego_m": (event.ego_x_m, event.ego_y_m)}
