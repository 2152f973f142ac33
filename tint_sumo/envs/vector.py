"""The vector environment: all environments are replicas of a scene in one simulation."""

from collections.abc import Sequence
from typing import Any

import numpy as np
from gymnasium import spaces
from gymnasium.vector import AutoresetMode, VectorEnv
from gymnasium.vector.utils import batch_space
from numpy.typing import NDArray

from tint_sumo.envs.batch import Batch, Ended, LocalBatch, Snapshot
from tint_sumo.envs.episodes import TaskSettings, action_space, observation_space, require_actions
from tint_sumo.envs.rendering import RENDER_FPS, require_render_mode
from tint_sumo.envs.rows import OBSERVATION_KEYS, REWARD_TERMS, Observation, copied
from tint_sumo.envs.workers import WorkerBatch
from tint_sumo.errors import InputError
from tint_sumo.scenes import T_INTERSECTION, AnyScene, OwnScene, Scene


class SceneVectorEnv(VectorEnv[Observation, NDArray[np.int64], NDArray[Any]]):
    """``num_envs`` times ``tint_sumo.envs.scene_env.SceneEnv``, whose docstring is the manual.

    Environment ``i`` seeded with ``seed + i`` lives through exactly the episodes of a single environment with that
    seed, whatever ``num_envs`` is. A finished episode is followed by the next one in the same step
    (``AutoresetMode.SAME_STEP``): its last observation and info stand in ``infos["final_obs"]`` and
    ``infos["final_info"]``. All other infos are arrays over the environments.

    ``scene`` may also be a list of scenes: the environments are shared out among them, in order and as evenly as can
    be, and each scene has a process of its own.

    With ``workers`` above 1 the environments are shared out among as many processes, with the same results; a script
    that asks for them needs the usual ``if __name__ == "__main__":``. This process is one of them, unless another
    environment of it uses libsumo already. Waiting processes are busy for a millisecond before they sleep, so more
    workers than cores are no help.
    """

    metadata = {  # noqa: RUF012 - gymnasium's way
        "render_modes": ["rgb_array"],
        "render_fps": RENDER_FPS,
        "autoreset_mode": AutoresetMode.SAME_STEP,
    }

    def __init__(
        self,
        num_envs: int = 1,
        scene: AnyScene | Sequence[AnyScene] = T_INTERSECTION,
        render_mode: str | None = None,
        workers: int | None = None,
        **task: Any,
    ) -> None:
        if num_envs < 1:
            raise InputError(f"num_envs must be at least 1, not {num_envs}")
        if isinstance(scene, str | Scene | OwnScene):
            scenes: Sequence[AnyScene] = [scene] * (1 if workers is None else workers)
        elif workers in (None, len(scene)):
            scenes = scene
        else:
            raise InputError(f"{len(scene)} scenes need as many workers, not {workers}; leave workers out")
        if not 1 <= len(scenes) <= num_envs:
            raise InputError(f"workers must be 1 to num_envs = {num_envs}, not {len(scenes)}")
        require_render_mode(render_mode, self.metadata["render_modes"])
        all_settings = [TaskSettings(one, **task) for one in scenes]
        settings = all_settings[0]
        if len({one.played.max_vehicles for one in all_settings}) > 1:
            raise InputError("scenes of one environment must observe the same number of vehicles; change max_vehicles")
        self.num_envs = num_envs
        self.slot_infos = settings.slot_infos
        self.render_mode = render_mode
        self.single_observation_space = observation_space(settings.played.max_vehicles)
        self.single_action_space: spaces.Discrete = action_space(settings.played)
        self.observation_space = batch_space(self.single_observation_space, num_envs)
        self.action_space = batch_space(self.single_action_space, num_envs)
        self.batch: Batch = LocalBatch(num_envs, settings) if len(scenes) == 1 else WorkerBatch(num_envs, all_settings)
        self._has_begun = False

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
        self.batch.reset(seeds, mask)
        self._has_begun = True
        return self._shown()

    def step(
        self, actions: NDArray[np.int64]
    ) -> tuple[Observation, NDArray[Any], NDArray[Any], NDArray[Any], dict[str, Any]]:
        actions = np.asarray(actions)
        require_actions(actions, self.num_envs, int(self.single_action_space.n))
        ended = self.batch.step(actions)
        rows = copied(self.batch.rows)
        infos = self._infos(rows)
        infos |= self._everywhere({"reward_terms": self._everywhere({term: rows[term] for term in REWARD_TERMS})})
        if ended:
            infos |= self._final(infos, ended)
        return _observation(rows), rows["reward"], rows["terminated"], rows["truncated"], infos

    def snapshot(self) -> list[Snapshot]:
        """What ``restore`` needs to come back to where the episodes are now, as in ``SceneEnv``; it can be pickled.

        Raises:
            InputError: no episodes have begun.
        """
        if not self._has_begun:
            raise InputError("there are no episodes to come back to; reset the environments first")
        return self.batch.snapshot()

    def restore(self, snapshots: Sequence[Snapshot]) -> tuple[Observation, dict[str, Any]]:
        """Go back, or to the episodes of another vector with the same arguments; the observation and infos there.

        It takes as long as the longest episode so far.

        Raises:
            InputError: there are not as many snapshots as environments.
        """
        if len(snapshots) != self.num_envs:
            raise InputError(f"{len(snapshots)} snapshots do not fit {self.num_envs} environments; give as many")
        self.batch.restore(snapshots)
        self._has_begun = True
        return self._shown()

    def _shown(self) -> tuple[Observation, dict[str, Any]]:
        """The observation and infos where the environments are."""
        rows = copied(self.batch.rows)
        return _observation(rows), self._infos(rows)

    def _infos(self, rows: dict[str, NDArray[Any]]) -> dict[str, Any]:
        outcome = np.full(self.num_envs, "")  # an episode that ended has been followed by the next
        slots = {key: rows[key] for key in self.slot_infos}
        return self._everywhere({**slots, "outcome": outcome, "time_s": rows["time_s"]})

    def _final(self, infos: dict[str, Any], ended: list[Ended]) -> dict[str, Any]:
        """The last observation and info of the episodes that ended."""
        final_obs, collision = (np.full(self.num_envs, None, dtype=object) for _ in range(2))
        done, collided = (np.zeros(self.num_envs, bool) for _ in range(2))
        told = (*self.slot_infos, "time_s")
        final = {key: infos[key].copy() for key in told} | {"outcome": infos["outcome"].astype("U9")}
        for one in ended:
            done[one.index], collided[one.index] = True, bool(one.collision)
            final_obs[one.index] = {key: one.row[key] for key in OBSERVATION_KEYS}
            collision[one.index], final["outcome"][one.index] = one.collision, one.outcome
            for key in told:
                final[key][one.index] = one.row[key]
        final_info = infos | final | _masked({"collision": collision}, collided)
        return _masked({"final_obs": final_obs, "final_info": final_info}, done)

    def _everywhere(self, values: dict[str, Any]) -> dict[str, Any]:
        return _masked(values, np.ones(self.num_envs, bool))

    def render(self) -> tuple[NDArray[np.uint8], ...] | None:
        """One (H, W, 3) image per environment."""
        return None if self.render_mode is None else tuple(self.batch.render())

    def close_extras(self, **kwargs: Any) -> None:  # noqa: ARG002 - gymnasium's signature
        self.batch.close()


def _observation(rows: dict[str, NDArray[Any]]) -> Observation:
    return {key: rows[key] for key in OBSERVATION_KEYS}


def _masked(values: dict[str, Any], mask: NDArray[np.bool_]) -> dict[str, Any]:
    """Gymnasium's vector infos: each key has a twin ``_key`` that tells where it holds."""
    return {**values, **{f"_{key}": mask for key in values}}
