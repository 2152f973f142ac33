"""The vector environment: all environments are intersections of one simulation."""

from collections.abc import Sequence
from typing import Any

import numpy as np
from gymnasium import spaces
from gymnasium.utils import seeding
from gymnasium.vector import AutoresetMode, VectorEnv
from gymnasium.vector.utils import batch_space
from numpy.typing import NDArray

from tint_sumo.config import Backend
from tint_sumo.envs.episodes import Episodes, Observation, TaskSettings, Transition, observation_space
from tint_sumo.envs.rendering import RENDER_FPS, render_intersection, require_render_mode
from tint_sumo.errors import InputError


class TIntersectionVectorEnv(VectorEnv[Observation, NDArray[np.int64], NDArray[Any]]):
    """``num_envs`` times :class:`~tint_sumo.envs.t_intersection.TIntersectionEnv`, whose docstring is the manual.

    Environment ``i`` seeded with ``seed + i`` lives through exactly the episodes of a single environment with that
    seed, whatever ``num_envs`` is. A finished episode is followed by the next one in the same step
    (``AutoresetMode.SAME_STEP``): its last observation and info stand in ``infos["final_obs"]`` and
    ``infos["final_info"]``. All other infos are arrays over the environments.
    """

    metadata = {  # noqa: RUF012 - gymnasium's way
        "render_modes": ["rgb_array"],
        "render_fps": RENDER_FPS,
        "autoreset_mode": AutoresetMode.SAME_STEP,
    }

    def __init__(
        self,
        num_envs: int = 1,
        p_conservative: float = 0.4,
        reward: str = "paper",
        time_limit_s: float = 50.0,
        position_noise_m: float = 0.0,
        backend: Backend = "auto",
        render_mode: str | None = None,
    ) -> None:
        if num_envs < 1:
            raise InputError(f"num_envs must be at least 1, not {num_envs}")
        require_render_mode(render_mode)
        self.num_envs = num_envs
        self.render_mode = render_mode
        self._episodes = Episodes(
            num_envs, TaskSettings(p_conservative, reward, time_limit_s, position_noise_m, backend)
        )
        speeds_mps = self._episodes.simulation.scenario.ego.desired_speeds_mps
        self.single_observation_space = observation_space()
        self.single_action_space = spaces.Discrete(len(speeds_mps))
        self.observation_space = batch_space(self.single_observation_space, num_envs)
        self.action_space = batch_space(self.single_action_space, num_envs)
        self._rngs: list[np.random.Generator | None] = [None] * num_envs

    def reset(
        self, *, seed: int | Sequence[int | None] | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Observation, dict[str, Any]]:
        """Start a new episode in every environment, or in those of ``options["reset_mask"]``."""
        if seed is None:
            seeds: Sequence[int | None] = [None] * self.num_envs
        elif isinstance(seed, int | np.integer):
            seeds = [int(seed) + index for index in range(self.num_envs)]
        else:
            seeds = seed
        if len(seeds) != self.num_envs:
            raise InputError(f"{len(seeds)} seeds do not fit {self.num_envs} environments; give one number or as many")
        mask = (options or {}).get("reset_mask", np.ones(self.num_envs, bool))
        for index in np.flatnonzero(mask).tolist():
            self._begin(index, seeds[index])
        return self._episodes.observe(), self._infos()

    def _begin(self, index: int, seed: int | None = None) -> None:
        rng = self._rngs[index]
        if rng is None or seed is not None:
            rng, _ = seeding.np_random(seed)
            self._rngs[index] = rng
        self._episodes.begin(index, rng)

    def step(
        self, actions: NDArray[np.int64]
    ) -> tuple[Observation, NDArray[Any], NDArray[Any], NDArray[Any], dict[str, Any]]:
        transition = self._episodes.step(np.asarray(actions))
        done = transition.done
        observation, infos = self._episodes.observe(), self._infos(transition)
        if done.any():
            collisions = [self._episodes.collision_info(index) for index in range(self.num_envs)]
            final_infos = infos | _masked({"collision": np.array(collisions, dtype=object)}, transition.collision)
            final_obs = np.full(self.num_envs, None, dtype=object)
            for index in np.flatnonzero(done).tolist():
                final_obs[index] = {key: value[index] for key, value in observation.items()}
                self._begin(index)
            observation, infos = self._episodes.observe(), self._infos(transition)
            infos["outcome"] = np.where(done, "", infos["outcome"])
            infos |= _masked({"final_obs": final_obs, "final_info": final_infos}, done)
        return observation, transition.reward, transition.terminated, transition.timeout, infos

    def _infos(self, transition: Transition | None = None) -> dict[str, Any]:
        everywhere = np.ones(self.num_envs, bool)
        step_s = self._episodes.simulation.scenario.episode.step_s
        outcome = np.full(self.num_envs, "") if transition is None else transition.outcome
        values = {"traits": self._episodes.traits(), "outcome": outcome, "time_s": self._episodes.steps * step_s}
        infos = _masked(values, everywhere)
        if transition is not None:
            infos |= _masked({"reward_terms": _masked(transition.reward_terms, everywhere)}, everywhere)
        return infos

    def render(self) -> tuple[NDArray[np.uint8], ...] | None:
        """One (H, W, 3) image per environment."""
        if self.render_mode is None:
            return None
        return tuple(render_intersection(self._episodes.simulation, index) for index in range(self.num_envs))

    def close_extras(self, **kwargs: Any) -> None:  # noqa: ARG002 - gymnasium's signature
        self._episodes.simulation.close()


def _masked(values: dict[str, Any], mask: NDArray[np.bool_]) -> dict[str, Any]:
    """Gymnasium's vector infos: each key has a twin ``_key`` that tells where it holds."""
    return {**values, **{f"_{key}": mask for key in values}}
