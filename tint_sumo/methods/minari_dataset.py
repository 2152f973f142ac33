"""Episodes of policies as datasets in the format of Minari (https://minari.farama.org), for offline learning."""

import shutil
from collections import Counter
from collections.abc import Iterator, Sequence
from contextlib import closing, contextmanager
from dataclasses import dataclass, fields, replace
from functools import cached_property
from pathlib import Path
from typing import Annotated, Any

import h5py  # noqa: F401 - Minari asks for it only when it writes
import numpy as np
from minari import EpisodeData, MinariDataset, __version__
from minari.data_collector.episode_buffer import EpisodeBuffer
from minari.dataset.minari_dataset import DATASET_ID_RE
from minari.dataset.minari_storage import MinariStorage
from minari.namespace import NAMESPACE_METADATA_FILENAME
from minari.storage import get_dataset_path

from tint_sumo import __version__ as own_version
from tint_sumo.config import EpisodesSeed, Fraction
from tint_sumo.core.errors import InputError, shown
from tint_sumo.core.files import locked, require_output_folder, write_json
from tint_sumo.core.percentages import percent
from tint_sumo.core.progress import Progress, Report, silent
from tint_sumo.core.provenance import PACKAGES, commit, versions
from tint_sumo.core.ranges import Range, require_ranges
from tint_sumo.envs import SceneEnv, TaskSettings
from tint_sumo.envs.entry_points import env_spec
from tint_sumo.envs.episodes import action_space
from tint_sumo.envs.rows import Contents, full_info
from tint_sumo.jobs import Workers, executor_of
from tint_sumo.methods.driving import drive
from tint_sumo.methods.loading import Contender, load_policy
from tint_sumo.methods.registry import METHODS

EPISODES_PER_SEED = 1_000_000  # all below the seeds of test cases, ``tint_sumo.methods.evaluation.CASE_SEED``
_BATCH = 50  # episodes at a time: what a process does, whatever the number of processes
_DATA = "data"  # folder in that of a dataset
_CHECKED_EPISODES = 3  # of those that were written, which are driven once more in the recovered environment


@dataclass(frozen=True)
class Credits:
    """The people and the code behind a dataset, as Minari keeps them; None: not noted."""

    author: str | None = None
    author_email: str | None = None
    code_permalink: str | None = None
    description: str | None = None  # None: the number of episodes, the policy, the scene and the outcomes


@dataclass(frozen=True)
class Recorded:
    """A dataset that was written."""

    folder: Path
    steps: int
    outcomes: dict[str, int]  # number of episodes by outcome


@dataclass(frozen=True)
class PolicyEpisodes:
    """Numbered episodes of a policy, none of which is a test case; a work for an executor, ``_BATCH`` at a time."""

    model: str  # as for ``load_policy``
    task: TaskSettings
    episodes: Annotated[int, Range(1, EPISODES_PER_SEED)]
    seed: EpisodesSeed = 0
    random_actions: Fraction = 0.0  # share of the decisions whose action is drawn at random
    allow_pickle: bool = False
    out: Path = Path()

    def __post_init__(self) -> None:
        require_ranges(self)

    def __getstate__(self) -> dict[str, Any]:
        """Return what a process is handed, which loads the policy itself."""
        return {field.name: getattr(self, field.name) for field in fields(self)}

    @cached_property
    def contender(self) -> Contender:
        return load_policy(self.model, scene=self.task.scene, allow_pickle=self.allow_pickle)

    @cached_property
    def decided(self) -> TaskSettings:
        """Settings of the environment whose step is a decision of the policy."""
        repeat = self.contender.action_repeat
        return self.task if repeat == 1 else replace(self.task, decision_s=round(repeat * self.task.scene.step_s, 9))

    @property
    def batches(self) -> range:
        return range(-(-self.episodes // _BATCH))

    def paths(self, number: int) -> tuple[str, ...]:  # noqa: ARG002 - a work's files; this one has none
        return ()

    def __call__(self, number: int) -> list[EpisodeBuffer]:
        """Return the episodes of a batch, in order."""
        first = number * _BATCH
        count = min(_BATCH, self.episodes - first)
        seed = self.seed * EPISODES_PER_SEED + first
        contender = self.contender
        with closing(
            drive(
                contender.policy,
                lambda num_envs: contender.make_venv(num_envs, self.task),
                seed,
                count,
                _BATCH,
                self.random_actions,
            )
        ) as driven:
            episodes = sorted(driven, key=lambda one: one.number)
        with closing(SceneEnv(self.decided)) as env:
            again = [_episode(env, one.seed, one.actions, self.decided.contents) for one in episodes]
        if [one.infos["outcome"][-1] for one in again] != [one.info["outcome"] for one in episodes]:
            raise RuntimeError(f"episodes from seed {seed} on ended otherwise when they were driven again")
        return again


def _episode(env: SceneEnv, seed: int, actions: Sequence[int], contents: Contents) -> EpisodeBuffer:
    """Return the episode of a seed and of these actions as its environment shows it.

    A policy may see more than that, as inferred traits, and more often than once per decision.
    """
    observation, info = env.reset(seed=seed)
    observations, infos = [observation], [full_info(info, contents)]
    steps = []
    for action in actions:
        observation, *step, info = env.step(np.int64(action))
        observations.append(observation)
        infos.append(full_info(info, contents))
        steps.append(step)
    rewards, terminations, truncations = zip(*steps, strict=True)
    return EpisodeBuffer(
        seed=seed,
        observations=_stacked(observations),
        actions=np.array(actions, np.int64),
        rewards=np.array(rewards),
        terminations=np.array(terminations),
        truncations=np.array(truncations),
        infos=_stacked(infos),
    )


def _stacked(items: Sequence[Any]) -> Any:
    """Return the values of all steps: arrays (T, ...) in dictionaries as those of a step; texts as a list."""
    first = items[0]
    if isinstance(first, dict):
        return {key: _stacked([item[key] for item in items]) for key in first}
    return list(items) if isinstance(first, str) else np.array(items)


def record_minari(
    name: str,
    episodes: PolicyEpisodes,
    *,
    root: Path | None = None,
    credits: Credits | None = None,
    workers: Workers = 1,
    report: Report = silent,
) -> Recorded:
    """Write episodes of a policy as a dataset, let Minari read it, and return what was written.

    The folder of the dataset appears when it is complete and checked: its first episodes, driven once more in the
    environment that Minari recovers, are the same to the last bit.

    Args:
        name: Minari's name of the dataset, such as ``tint_sumo/streaming-v0``.
        episodes: the episodes.
        root: folder of all datasets; by default Minari's own, ``MINARI_DATASETS_PATH`` or ``~/.minari/datasets``.
        credits: the people and the code behind it.
        workers: number of processes, or an executor; the dataset does not depend on it.
        report: called with the progress.

    Raises:
        InputError: the name is none, there is such a dataset already or one in the making, or the folder is no home for
            it.
    """
    root = (get_dataset_path() if root is None else root).absolute()  # relative ones confuse Minari
    require_new_dataset(name, root)
    spec = env_spec(episodes.decided)
    outcomes: Counter[str] = Counter()
    with _whole_dataset(name, root) as data:
        storage = MinariStorage.new(
            data,
            observation_space=episodes.decided.observation_space,
            action_space=action_space(episodes.decided.played),
            env_spec=spec,
        )
        storage.update_metadata({"dataset_id": name, "minari_version": __version__})
        with executor_of(workers).map(episodes, episodes.batches) as batches:
            for batch in batches:
                first = outcomes.total()
                storage.update_episodes(batch)
                ends = [episode.infos["outcome"][-1] for episode in batch]
                totals = [{"outcome": end, "return": one.rewards.sum()} for end, one in zip(ends, batch, strict=True)]
                storage.update_episode_metadata(totals, range(first, first + len(batch)))
                outcomes.update(ends)
                report(Progress(outcomes.total(), episodes.episodes, "episode"))
        storage.update_metadata(_metadata(episodes, credits or Credits(), outcomes))
        _check(data, episodes)
        steps = storage.total_steps
    return Recorded(root / name, steps, dict(outcomes))


def require_new_dataset(name: str, root: Path) -> None:
    """Check, before the work begins, that a dataset of this name can be written.

    Raises:
        InputError: Minari has no such names, there is such a dataset already, or the folder belongs to a run.
        OSError: the folder cannot be written to, or has no room.
    """
    match = DATASET_ID_RE.fullmatch(name)
    if match is None or match["version"] is None or "//" in name or not name.isprintable():
        raise InputError(f"{shown(name)} is no name of a Minari dataset; give `minari` one as tint_sumo/streaming-v0")
    require_output_folder(root)
    for folder in (root / name, *(root / name).parents[: name.count("/")]):
        if folder.exists() and (folder == root / name or not folder.is_dir() or (folder / _DATA).exists()):
            raise InputError(f"{folder} is there already; give another name or version as `minari`")


@contextmanager
def _whole_dataset(name: str, root: Path) -> Iterator[Path]:
    """Yield a folder for the data of a dataset, and give it its name if the block succeeds.

    It is a hidden one beside the datasets, which Minari does not see. What a killed process has left there is removed.

    Raises:
        InputError: another process records a dataset of this name.
    """
    partial, target = root / f".{name.replace('/', '.')}.partial", root / name
    partial.mkdir(parents=True, exist_ok=True)
    with locked(partial, f"another process records {target}; wait for it, or give another name as `minari`"):
        try:
            data = partial / _DATA
            shutil.rmtree(data, ignore_errors=True)
            data.mkdir()
            yield data
            for namespace in reversed(target.parents[: name.count("/")]):
                namespace.mkdir(exist_ok=True)
                if not (namespace / NAMESPACE_METADATA_FILENAME).exists():
                    write_json(namespace / NAMESPACE_METADATA_FILENAME, {})
            target.mkdir()
            data.rename(target / _DATA)
        finally:
            shutil.rmtree(partial, ignore_errors=True)


def _metadata(episodes: PolicyEpisodes, given: Credits, outcomes: Counter[str]) -> dict[str, Any]:
    """Return what Minari keeps of a dataset beside its environment, and how it was made."""
    contender = episodes.contender
    total = outcomes.total()
    shares = ", ".join(f"{name} {percent(count / total)}%" for name, count in sorted(outcomes.items()))
    title = METHODS[contender.method].title
    mixed = f", {percent(episodes.random_actions)}% random actions" if episodes.random_actions else ""
    described = f"{total} episodes of the policy {title}{mixed} in the scene {episodes.task.scene.name}: {shares}."
    people = {"author": given.author, "author_email": given.author_email}
    return {
        "algorithm_name": title + mixed,
        "description": given.description or described,
        **{name: {value} for name, value in people.items() if value is not None},
        **({} if given.code_permalink is None else {"code_permalink": given.code_permalink}),
        "requirements": [f"tint_sumo=={own_version}"],
        "tint_sumo": {
            "method": contender.method,
            "seed": episodes.seed,
            "random_actions": episodes.random_actions,
            "outcomes": dict(sorted(outcomes.items())),
            "commit": commit(),
            "versions": versions(PACKAGES),
        },
    }


def _check(folder: Path, episodes: PolicyEpisodes) -> None:
    """Let Minari read a dataset, recover its environment, and compare the first episodes with those there.

    Raises:
        RuntimeError: something is missing, or not the same to the last bit.
    """
    dataset = MinariDataset(folder)
    lengths = [len(episode) for episode in dataset]
    if (len(lengths), sum(lengths)) != (episodes.episodes, dataset.total_steps):
        raise RuntimeError(f"Minari reads {len(lengths)} episodes of {episodes.episodes}")
    first = range(min(len(lengths), _CHECKED_EPISODES))
    with closing(dataset.recover_environment().unwrapped) as env:
        for number, facts in zip(first, dataset.storage.get_episode_metadata(first), strict=True):
            read = dataset[number]
            again = _episode(env, facts["seed"], read.actions.tolist(), episodes.decided.contents)
            if not _are_equal(again, read):
                raise RuntimeError(f"episode {number} is another one in the environment that Minari recovers")


def _are_equal(written: EpisodeBuffer, read: EpisodeData) -> bool:
    """Return whether observations, rewards and ends are the same to the last bit."""
    same = all(np.array_equal(written.observations[key], values) for key, values in read.observations.items())
    ends = ("rewards", "terminations", "truncations")
    return same and all(np.array_equal(getattr(written, name), getattr(read, name)) for name in ends)
