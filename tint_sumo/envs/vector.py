"""The vector environment: all environments are replicas of a scene in one simulation."""

from collections.abc import Sequence
from copy import copy
from functools import cached_property
from typing import Any

import numpy as np
from gymnasium import spaces
from gymnasium.vector import AutoresetMode, VectorEnv
from gymnasium.vector.utils import batch_space
from numpy.typing import NDArray

from tint_sumo.core.errors import InputError
from tint_sumo.envs.batch import Batch, Ended, LocalBatch, Snapshot, checked_snapshots
from tint_sumo.envs.calls import (
    Calls,
    Phase,
    checked_actions,
    checked_count,
    checked_mask,
    checked_options,
    checked_seeds,
)
from tint_sumo.envs.episodes import TaskSettings, action_space, checked_settings, fingerprints, share_simulation
from tint_sumo.envs.rendering import RENDER_FPS, require_render_mode
from tint_sumo.envs.rows import (
    GOING_ON,
    SUCCESS,
    Observation,
    copied,
    end_info,
    fields_of,
    observation_of,
    outcome_names,
    step_info,
)
from tint_sumo.envs.workers import WorkerBatch
from tint_sumo.scenes.drivers import NO_TOWN

MOST_ENVS = 100_000  # environments of one vector; memory would not do for more


class SceneVectorEnv(VectorEnv[Observation, NDArray[np.int64], NDArray[Any]]):
    """``num_envs`` times ``tint_sumo.envs.scene_env.SceneEnv``, whose docstring is the manual.

    Environment ``i`` seeded with ``seed + i`` lives through exactly the episodes of a single environment with that
    seed, whatever ``num_envs`` is. The infos are arrays over the environments, each with a mask under ``"_key"`` that
    says where it holds.

    ``autoreset_mode`` says what follows an episode's end, as in gymnasium's ``SyncVectorEnv``: an ``AutoresetMode``, or
    its value. With ``"NextStep"`` (default) the environment's next step begins the next episode; that step ignores the
    action, and its reward is 0. With ``"SameStep"`` the next episode begins in the step that ends the one before, whose
    last observation and info stand in ``infos["final_obs"]`` and ``infos["final_info"]``. With ``"Disabled"`` it begins
    with ``reset(options={"reset_mask": mask})``, whose mask (N,) is true for the environments to reset.

    ``settings`` may also be several, as for several scenes: the environments are shared out among them, in order and as
    evenly as can be. Settings that differ in their sensors alone share one simulation; otherwise, each has a process
    for itself. ``gymnasium.make_vec`` takes a list of scenes instead.

    With ``workers`` above 1 the environments are shared out among as many processes, with the same results; a script
    that asks for them needs the usual ``if __name__ == "__main__":``. This process is one of them, unless another
    environment of it uses libsumo already. Waiting processes are busy for a millisecond before they sleep, so more
    workers than cores are no help.
    """

    metadata = {  # noqa: RUF012 - gymnasium's way
        "render_modes": ["rgb_array"],
        "render_fps": RENDER_FPS,
        "autoreset_mode": AutoresetMode.NEXT_STEP,
    }

    def __init__(
        self,
        num_envs: int = 1,
        settings: TaskSettings | Sequence[TaskSettings] | None = None,
        render_mode: str | None = None,
        workers: int | None = None,
        autoreset_mode: AutoresetMode | str = AutoresetMode.NEXT_STEP,
    ) -> None:
        num_envs = checked_count("num_envs", num_envs, MOST_ENVS)
        settings = _shared_out(settings, num_envs, workers)
        require_render_mode(render_mode, self.metadata["render_modes"])
        first = settings[0]
        if len({task.played.max_vehicles for task in settings}) > 1:
            raise InputError("scenes of one environment must observe the same number of vehicles; change max_vehicles")
        if len({(task.tracks, task.contents._replace(slot_infos=())) for task in settings}) > 1:
            raise InputError(
                "scenes of one environment must have the same `tracks`, `perceives` and `red_light`; change them"
            )
        self.autoreset_mode = _autoreset_mode(autoreset_mode)
        more = {"autoreset_mode": self.autoreset_mode, "render_fps": first.render_fps}
        self.metadata = {**self.metadata, **more}
        self.num_envs = num_envs
        self.contents = max((task.contents for task in settings), key=lambda contents: len(contents.slot_infos))
        self.render_mode = render_mode
        self.single_observation_space = first.observation_space
        self.single_action_space: spaces.Discrete = action_space(first.played)
        self.observation_space = batch_space(self.single_observation_space, num_envs)
        self.action_space = batch_space(self.single_action_space, num_envs)
        self._settings = list(settings)
        self._calls = Calls()
        self.batch = self._make_batch()

    def _make_batch(self) -> Batch:
        settings = self._settings
        if share_simulation(settings):
            return LocalBatch(self.num_envs, settings, self.autoreset_mode)
        return WorkerBatch(self.num_envs, settings, self.autoreset_mode)

    @cached_property
    def batch(self) -> Batch:
        """The running environments; started when they are needed in a copy, or after a call that was interrupted."""
        self._calls.require_open()
        return self._make_batch()

    def _stop(self) -> None:
        """End the simulations, if any run."""
        if "batch" in vars(self):
            self.batch.close()
            del self.batch

    def reset(
        self, *, seed: int | Sequence[int | None] | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Observation, dict[str, Any]]:
        """Start a new episode in every environment, or in those of ``options["reset_mask"]``.

        Raises:
            InputError: a seed, an option or the mask does not fit; or the mask leaves out environments that have no
                episode yet, or whose last call has failed or was interrupted.
        """
        self._calls.require_open()
        seeds = checked_seeds(seed, self.num_envs)
        mask = checked_mask(checked_options(options, ("reset_mask",)).get("reset_mask"), self.num_envs)
        if not mask.all():
            self._calls.require_episode()
        if self._calls.phase is Phase.BUSY:  # an interrupted call may have been done in part
            self._stop()
        with self._calls:
            self.batch.reset(seeds, mask)
        return self._shown(mask)

    def step(
        self, actions: NDArray[np.int64]
    ) -> tuple[Observation, NDArray[Any], NDArray[Any], NDArray[Any], dict[str, Any]]:
        self._calls.require_episode()
        begun = self.batch.rows["outcome"] != GOING_ON  # those that ended before: NEXT_STEP now begins the next ones
        if self.autoreset_mode is AutoresetMode.DISABLED and begun.any():
            raise InputError(
                f"the episodes of environments {', '.join(map(str, np.flatnonzero(begun)))} have ended; "
                'reset them with options={"reset_mask": mask} before the next step'
            )
        rows, ended = self.advance(actions)
        if self.autoreset_mode is AutoresetMode.SAME_STEP:
            begun[[end.index for end in ended]] = True
        infos = self._infos(rows)
        if not begun.all():  # an episode that begins has no rewards yet
            terms = _masked({term: rows[term] for term in self.contents.terms}, ~begun)
            more = {name: rows[name] for name in self.contents.step_infos}
            more["is_success"] = rows["outcome"] == SUCCESS
            infos |= _masked({"reward_terms": terms, **more}, ~begun)
        for end in ended:
            infos = self._add_info(infos, self._ending(end), end.index)
        return observation_of(rows, self.contents), rows["reward"], rows["terminated"], rows["truncated"], infos

    def advance(self, actions: NDArray[np.int64]) -> tuple[dict[str, NDArray[Any]], list[Ended]]:
        """Take a step; return the fields of all rows after it, and the episodes that ended in it.

        Rewards, terminations and truncations are those of the step, all else is as it is now.
        """
        self._calls.require_episode()
        taken = checked_actions(actions, (self.num_envs,), int(self.single_action_space.n))
        with self._calls:
            ended = self.batch.step(taken)
        rows = copied(self.batch.rows, self.contents.slot_infos)
        for end in ended:
            for key in ("reward", "terminated", "truncated"):
                rows[key][end.index] = end.row[key]
        return rows, ended

    @property
    def tasks(self) -> list[str]:
        """Fingerprint of each environment's settings, which its snapshots have, too."""
        return fingerprints(self.num_envs, self._settings)

    def snapshot(self) -> list[Snapshot]:
        """Return what ``restore`` needs to come back to these steps of the episodes; it can be pickled.

        Raises:
            InputError: no episodes have begun.
        """
        self._calls.require_episode()
        with self._calls:
            return self.batch.snapshot()

    def restore(self, snapshots: Sequence[Snapshot]) -> tuple[Observation, dict[str, Any]]:
        """Replay episodes of this vector, or of one with the same arguments; return observation and infos there.

        It takes as long as the longest episode so far.

        Raises:
            InputError: they are no snapshots, not as many as environments, or of other settings.
        """
        self._calls.require_open()
        checked = checked_snapshots(snapshots, self.tasks)
        if self._calls.phase is Phase.BUSY:
            self._stop()
        with self._calls:
            self.batch.restore(checked)
        return self._shown()

    def park(self, mask: NDArray[np.bool_]) -> None:
        """Empty the environments where the mask (N,) is true: they cost next to nothing until their next reset."""
        self._calls.require_episode()
        with self._calls:
            self.batch.park(mask)

    def _shown(self, mask: NDArray[np.bool_] | None = None) -> tuple[Observation, dict[str, Any]]:
        """Return the observation of the present steps, and the infos of the environments in the mask, or of all."""
        rows = copied(self.batch.rows, self.contents.slot_infos)
        return observation_of(rows, self.contents), self._infos(rows, mask)

    def _infos(self, rows: dict[str, NDArray[Any]], mask: NDArray[np.bool_] | None = None) -> dict[str, Any]:
        """Return the infos of the environments in a mask, or of all; 0 or None elsewhere, as gymnasium has it."""
        infos = {**{key: rows[key] for key in self.contents.slot_infos}, "outcome": outcome_names(rows["outcome"])}
        infos["time_s"] = rows["time_s"]
        infos |= {name: rows[name] for name in self.contents.infos}
        shown = np.ones(self.num_envs, bool) if mask is None else mask.copy()
        if not shown.all():
            for values in infos.values():
                values[~shown] = None if values.dtype == object else 0
        in_town = shown & (rows["town"] != NO_TOWN)
        towns = _masked({"town": np.where(in_town, rows["town"], 0)}, in_town) if in_town.any() else {}
        return {**_masked(infos, shown), **towns}

    def _ending(self, ended: Ended) -> dict[str, Any]:
        """Return the entries that infos get where an episode has ended."""
        if self.autoreset_mode is not AutoresetMode.SAME_STEP:
            return end_info(ended.outcome, ended.collision)
        last = fields_of(ended.row)
        final = step_info(last, self.contents, ended.collision)
        return {"final_obs": observation_of(last, self.contents), "final_info": final}

    def render(self) -> tuple[NDArray[np.uint8], ...] | None:
        """Return an (H, W, 3) image per environment."""
        self._calls.require_episode()
        if self.render_mode is None:
            return None
        with self._calls:
            return tuple(self.batch.render())

    def close_extras(self, **kwargs: Any) -> None:  # noqa: ARG002 - gymnasium's signature
        self._calls.phase = Phase.CLOSED
        self._stop()

    def __getstate__(self) -> tuple[dict[str, Any], list[Snapshot]]:
        """Return what a copy or a pickle consists of: everything but the simulations, and where the episodes are."""
        attributes = {name: value for name, value in vars(self).items() if name != "batch"}
        return attributes, self.snapshot() if self._calls.phase is Phase.READY else []

    def __setstate__(self, state: tuple[dict[str, Any], list[Snapshot]]) -> None:
        """Restore a copy from its state, as in ``SceneEnv``."""
        attributes, snapshots = state
        vars(self).update(attributes)
        self._calls = copy(self._calls)
        self._settings = [settings.of_copy for settings in self._settings]
        if snapshots:
            self.restore(snapshots)


def _shared_out(settings: Any, num_envs: int, workers: int | None) -> list[TaskSettings]:
    """Return the settings among which the environments are shared out: those given, or the same for each worker.

    Raises:
        InputError: they are no settings, more than environments, or do not fit the workers.
    """
    is_several = isinstance(settings, Sequence) and not isinstance(settings, str)
    several = [checked_settings(task) for task in (settings if is_several else [settings])]
    if not several:
        raise InputError("there are no settings; give those of at least one scene")
    if len(several) > num_envs:
        raise InputError(f"num_envs must be at least {len(several)}, one for each scene or sensor, not {num_envs}")
    if len(several) == 1:
        return several * (1 if workers is None else checked_count("workers", workers, num_envs))
    if workers not in (None, len(several)):
        raise InputError(
            f"workers are for environments of the same settings, and these are of {len(several)} (scenes or sensors); "
            "leave workers out"
        )
    return several


def _autoreset_mode(mode: AutoresetMode | str) -> AutoresetMode:
    try:
        return AutoresetMode(mode)
    except ValueError:
        choices = ", ".join(repr(choice.value) for choice in AutoresetMode)
        raise InputError(f"unknown autoreset_mode {mode!r}; choose one of {choices}") from None


def _masked(values: dict[str, Any], mask: NDArray[np.bool_]) -> dict[str, Any]:
    """Return infos as gymnasium's vectors have them: each key has a twin ``_key``, true where it holds."""
    return {**values, **{f"_{key}": mask for key in values}}
