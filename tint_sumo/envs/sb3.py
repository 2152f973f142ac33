"""The vector environment as Stable-Baselines3 wants it."""

from collections.abc import Sequence
from typing import Any

import numpy as np
from gymnasium.vector import AutoresetMode
from numpy.typing import NDArray
from stable_baselines3.common.vec_env import VecEnv
from stable_baselines3.common.vec_env.base_vec_env import VecEnvIndices, VecEnvObs, VecEnvStepReturn

from tint_sumo.envs.batch import Snapshot
from tint_sumo.envs.calls import checked_options, checked_seed
from tint_sumo.envs.episodes import TaskSettings
from tint_sumo.envs.rows import end_info, fields_of, observation_of, town_info
from tint_sumo.envs.vector import SceneVectorEnv
from tint_sumo.simulation.timing import StepPart, does


class SceneVecEnv(VecEnv):
    """Stable-Baselines3 ``VecEnv`` of ``num_envs`` replicas of a scene in one simulation.

    ``settings`` and ``workers`` are as in ``SceneVectorEnv``.
    ``infos[i]`` holds ``traits``, the true traits that go with the returned observation, and with towns ``town``, the
    number of the town of the episode that made the step; after a step ``reward_terms``, ``is_success``, and ``cost``
    where red lights cost; when an episode ends also ``terminal_observation``, ``TimeLimit.truncated``,
    ``terminal_slots``, ``outcome``, ``time_s`` and, after a collision, ``collision``. As Stable-Baselines3 wants it,
    the next episode has begun by then; without ``autoreset`` it has not, and the environment shows the end of its
    episode until it is parked or all are reset.
    ``slots`` holds arrays (N, V) of what else is known of the vehicles in the returned observations, and
    ``terminal_slots`` the same of the terminal one: ``traits``, with ``tracks`` also ``position_m``, ``gap_m`` and
    ``passed``, and with a sensor that is not perfect what ``SceneEnv`` lists.
    """

    slots: dict[str, NDArray[Any]]

    def __init__(
        self,
        num_envs: int,
        settings: TaskSettings | Sequence[TaskSettings] | None = None,
        seed: int | None = None,
        render_mode: str | None = None,
        workers: int | None = None,
        autoreset: bool = True,
    ) -> None:
        mode = AutoresetMode.SAME_STEP if autoreset else AutoresetMode.DISABLED
        self.env = SceneVectorEnv(num_envs, settings, render_mode, workers, mode)
        super().__init__(num_envs, self.env.single_observation_space, self.env.single_action_space)
        self._actions: NDArray[np.int64] = np.zeros(num_envs, np.int64)
        if seed is not None:
            self.seed(seed)

    def seed(self, seed: int | None = None) -> Sequence[int | None]:
        return super().seed(checked_seed(seed))

    def set_options(self, options: list[dict[str, Any]] | dict[str, Any] | None = None) -> None:
        """Refuse options of the next reset, since there are none.

        Raises:
            InputError: one is given.
        """
        for of_one in options if isinstance(options, list) else [options]:
            checked_options(of_one)
        super().set_options(options)

    def reset(self) -> VecEnvObs:
        seeds = None if all(seed is None for seed in self._seeds) else self._seeds
        observation, infos = self.env.reset(seed=seeds)
        self._reset_seeds()
        self._reset_options()
        self._keep_slots(infos)
        self.reset_infos = _listed(infos["traits"], self.env.batch.rows["town"])
        return observation

    def step_async(self, actions: NDArray[np.int64]) -> None:
        self._actions = actions

    @does(StepPart.ADAPTER)
    def step_wait(self) -> VecEnvStepReturn:
        rows, ended = self.env.advance(self._actions)
        self._keep_slots(rows)
        listed = _listed(rows["traits"], rows["town"])
        contents = self.env.contents
        for info, terms in zip(listed, _each(rows, contents.terms), strict=True):
            info["is_success"], info["reward_terms"] = False, terms
        for name in contents.step_infos:
            for info, value in zip(listed, rows[name].tolist(), strict=True):
                info[name] = value
        for end in ended:
            last = fields_of(end.row)
            listed[end.index] |= {
                "terminal_observation": observation_of(last, contents),
                "TimeLimit.truncated": last["truncated"],
                "terminal_slots": {key: last[key] for key in contents.slot_infos},
                "outcome": end.outcome,
                "time_s": last["time_s"],
                **town_info(last["town"]),
                "reward_terms": {term: last[term] for term in contents.terms},
                **{name: last[name] for name in contents.step_infos},
                **end_info(end.outcome, end.collision),
            }
        done = rows["terminated"] | rows["truncated"]
        return observation_of(rows, contents), rows["reward"].astype(np.float32), done, listed

    def snapshot(self) -> list[Snapshot]:
        """Return snapshots, as ``SceneVectorEnv`` does."""
        return self.env.snapshot()

    def restore(self, snapshots: Sequence[Snapshot]) -> VecEnvObs:
        """Go back, as ``SceneVectorEnv`` does; return the observation there."""
        observation, infos = self.env.restore(snapshots)
        self._keep_slots(infos)
        return observation

    def _keep_slots(self, infos: dict[str, Any]) -> None:
        self.slots = {key: infos[key] for key in self.env.contents.slot_infos}

    def close(self) -> None:
        self.env.close()

    def get_attr(self, attr_name: str, indices: VecEnvIndices = None) -> list[Any]:
        return [getattr(self.env, attr_name) for _ in self._get_indices(indices)]

    def set_attr(self, attr_name: str, value: Any, indices: VecEnvIndices = None) -> None:
        raise NotImplementedError("the environments share one simulation; give settings to the constructor")

    def env_method(
        self,
        method_name: str,
        *args: Any,  # noqa: ARG002 - park takes none
        indices: VecEnvIndices = None,
        **kwargs: Any,  # noqa: ARG002
    ) -> list[Any]:
        """Call ``"park"``, the only method: empty environments, which cost next to nothing until the next reset."""
        if method_name != "park":
            raise NotImplementedError("the environments share one simulation and have no methods of their own but park")
        parked = list(self._get_indices(indices))
        self.env.park(np.isin(np.arange(self.num_envs), parked))
        return [None for _ in parked]

    def env_is_wrapped(
        self,
        wrapper_class: type[Any],  # noqa: ARG002 - the environments are never wrapped one by one
        indices: VecEnvIndices = None,
    ) -> list[bool]:
        return [False for _ in self._get_indices(indices)]

    def get_images(self) -> Sequence[NDArray[np.uint8] | None]:
        return self.env.render() or [None] * self.num_envs


def _listed(traits: NDArray[np.int16], towns: NDArray[np.int64]) -> list[dict[str, Any]]:
    """Return an info for each environment: the true traits (N, V), and the town (N,) of those that have one."""
    return [{"traits": one, "outcome": "", **town_info(town)} for one, town in zip(traits, towns.tolist(), strict=True)]


def _each(rows: dict[str, NDArray[Any]], fields: Sequence[str]) -> list[dict[str, Any]]:
    """Return some fields (N,) of rows for each of them."""
    values = zip(*(rows[field].tolist() for field in fields), strict=True)
    return [dict(zip(fields, of_one, strict=True)) for of_one in values]
