"""Batches of environments, whose episodes follow one another."""

from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np
from gymnasium.utils import seeding
from gymnasium.vector import AutoresetMode
from numpy.typing import NDArray

from tint_sumo.core.errors import InputError, shown
from tint_sumo.envs.episodes import Episodes, EpisodeStart, TaskSettings, fingerprints
from tint_sumo.envs.rows import Rows, outcome_name
from tint_sumo.simulation.timing import StepPart, does

_ACTION = np.int8  # has room for MOST_ACTIONS


@dataclass(frozen=True)
class Ended:
    """The end of an environment's episode."""

    index: int
    row: np.void  # its last row
    collision: dict[str, Any]  # empty without one

    @property
    def outcome(self) -> str:
        return outcome_name(self.row["outcome"])


@dataclass(frozen=True)
class Snapshot:
    """Generator state and actions that replay an episode to this step."""

    began: dict[str, Any]  # see ``tint_sumo.envs.episodes.EpisodeStart``
    actions: tuple[int, ...]
    task: str  # fingerprint of the environment's settings
    number: int = 0  # of the episode in its row


def checked_snapshots(snapshots: Any, tasks: Sequence[str]) -> list[Snapshot]:
    """Return the snapshots, for environments of these fingerprints.

    Raises:
        InputError: they are no sequence of snapshots, one for each environment, or of other settings.
    """
    if not isinstance(snapshots, Sequence) or not all(isinstance(snapshot, Snapshot) for snapshot in snapshots):
        raise InputError(f"what snapshot() has returned can be restored, not {shown(snapshots)}")
    if len(snapshots) != len(tasks):
        raise InputError(f"{len(snapshots)} snapshots do not fit {len(tasks)} environments; give as many")
    if [snapshot.task for snapshot in snapshots] != list(tasks):
        raise InputError("the snapshot is of another scene or other settings; make this environment as that one")
    return list(snapshots)


class Batch(Protocol):
    """Environments that step together.

    The mode, one of gymnasium's vector environments, says when the next episode begins after an episode's end: in the
    same step (``SAME_STEP``), in the next one instead of the action (``NEXT_STEP``), or with the next reset
    (``DISABLED``); until then the environment's row is that of the end.
    """

    rows: Rows  # (N,) of the environments; written by each call

    def reset(self, seeds: Sequence[int | None], mask: NDArray[np.bool_]) -> None:
        """Start a new episode where the mask (N,) is true; without a seed, from the environment's own generator."""

    def step(self, actions: NDArray[np.integer]) -> list[Ended]:
        """Take valid actions (N,); return the episodes that ended. With ``DISABLED`` none may have ended before."""

    def park(self, mask: NDArray[np.bool_]) -> None:
        """Empty the environments where the mask (N,) is true: they cost next to nothing until their next reset."""

    def snapshot(self) -> list[Snapshot]:
        """Return a snapshot of each environment; all have been reset, and none is parked."""

    def restore(self, snapshots: Sequence[Snapshot]) -> None:
        """Replay the episodes of snapshots, one in each environment."""

    def render(self) -> list[NDArray[np.uint8]]: ...

    def close(self) -> None: ...


class LocalBatch:
    """A batch in this process: replicas of one simulation.

    Environments are shared out among the settings, which differ in their sensors alone.
    """

    def __init__(
        self, num_envs: int, settings: Sequence[TaskSettings], autoreset_mode: AutoresetMode, rows: Rows | None = None
    ) -> None:
        self._autoreset_mode = autoreset_mode
        self.episodes = Episodes(num_envs, settings, rows)
        self.rows = self.episodes.rows
        self._rngs: list[np.random.Generator | None] = [None] * num_envs
        self._starts: list[EpisodeStart | None] = [None] * num_envs  # of the present episodes
        self._settings = settings[0]
        self._tasks = fingerprints(num_envs, settings)
        # The actions of the last decisions, (N,) each.
        self._actions: deque[NDArray[np.integer]] = deque(maxlen=settings[0].decisions_per_episode + 1)

    def reset(self, seeds: Sequence[int | None], mask: NDArray[np.bool_]) -> None:
        for index in np.flatnonzero(mask).tolist():
            self._begin(index, seeds[index])

    def _begin(self, index: int, seed: int | None = None) -> None:
        rng, before = self._rngs[index], self._starts[index]
        if rng is None or seed is not None:
            rng, _ = seeding.np_random(seed)
            self._rngs[index], before = rng, None
        self._start(index, self._settings.next_start(before, rng))

    def _start(self, index: int, start: EpisodeStart) -> None:
        self._starts[index] = start
        self.episodes.begin(index, start.seed)

    @does(StepPart.OTHER)
    def step(self, actions: NDArray[np.integer]) -> list[Ended]:
        self._actions.append(actions.astype(_ACTION))
        due = self._over() if self._autoreset_mode is AutoresetMode.NEXT_STEP else []
        any_ended = len(due) < len(self.rows) and self.episodes.step(actions)
        for index in due:
            self._begin(index)
        if not any_ended:
            return []
        ended = [self._ended(index) for index in self._over()]
        if self._autoreset_mode is AutoresetMode.SAME_STEP:
            for end in ended:
                self._begin(end.index)
        return ended

    def _over(self) -> list[int]:
        """Return the environments whose episode has ended and whose next one has not begun."""
        over: list[int] = np.flatnonzero(self.rows["outcome"]).tolist()
        return over

    def park(self, mask: NDArray[np.bool_]) -> None:
        for index in np.flatnonzero(mask).tolist():
            self.episodes.park(index)

    def snapshot(self) -> list[Snapshot]:
        taken = np.array(self._actions, _ACTION).reshape(-1, len(self._starts))
        # The last decision may have been cut short.
        decisions = -(-self.episodes.steps // self._settings.steps_per_decision)
        first = len(taken) - decisions  # of the present episodes
        return [
            Snapshot(start.began, tuple(actions[begin:].tolist()), task, start.number)
            for start, actions, begin, task in zip(self._starts, taken.T, first.tolist(), self._tasks, strict=True)
            if start is not None  # as none is: all have been reset
        ]

    def restore(self, snapshots: Sequence[Snapshot]) -> None:
        """Simulate all episodes once more; they begin such that they end together."""
        self.park(np.ones(len(snapshots), bool))
        for left in range(max(len(snapshot.actions) for snapshot in snapshots), -1, -1):
            for index, snapshot in enumerate(snapshots):
                if len(snapshot.actions) == left:
                    rng, _ = seeding.np_random(0)
                    rng.bit_generator.state = snapshot.began
                    self._rngs[index] = rng
                    self._start(index, EpisodeStart.drawn(rng, self._settings.row, snapshot.number))
            if left:
                actions = [snapshot.actions[-left] if left <= len(snapshot.actions) else 0 for snapshot in snapshots]
                self._actions.append(np.array(actions, _ACTION))
                self.episodes.step(self._actions[-1])

    def _ended(self, index: int) -> Ended:
        return Ended(index, self.rows[index].copy(), self.episodes.collision_info(index))

    def render(self) -> list[NDArray[np.uint8]]:
        return [self.episodes.render(index) for index in range(len(self.rows))]

    def close(self) -> None:
        self.episodes.simulation.close()
