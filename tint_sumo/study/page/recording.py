"""The study's job of recording episodes for its page: the same cases as they went for every policy."""

import hashlib
import json
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import torch
from numpy.typing import NDArray

import tint_sumo
from tint_sumo.config import Mix
from tint_sumo.core.files import damaged, read_json, write_text
from tint_sumo.core.progress import Progress, Report, part_of
from tint_sumo.core.ranges import Range
from tint_sumo.core.reading import RESULT_BYTES
from tint_sumo.core.structures import FieldError, build, plain
from tint_sumo.core.weights import weights_file
from tint_sumo.envs.rows import Outcome
from tint_sumo.films.driving import Driven, Moment, drive_case
from tint_sumo.films.trait_probe import TraitReader, fit_reader
from tint_sumo.jobs import Workers, executor_of
from tint_sumo.jobs.jobs import THREADS_PER_JOB
from tint_sumo.methods.evaluation import CASES_PER_SET, REPORTED_SET
from tint_sumo.methods.loading import Contender, find_policy, load_policy
from tint_sumo.methods.registry import METHODS, Rule
from tint_sumo.policy.storage import read_policy_card
from tint_sumo.scenes import Scene, described, paper_scene
from tint_sumo.study.budgets import Conditions
from tint_sumo.study.jobs import label, policy_folder, policy_path

EPISODES = "episodes"  # folder of the recorded episodes in a study's folder
FORMAT = 4  # number of the files' format
MISSING = -32768  # a column's number where a value is missing
# Units that the numbers of each column are multiples of. A column holds the first number, then the differences.
UNITS = {
    "x_m": 0.01,
    "y_m": 0.01,
    "heading_deg": 1.0,
    "speed_mps": 0.1,
    "brakes": 1.0,
    "held": 1.0,
    "claimed": 1.0,
    "desired_mps": 0.1,
    "value": 0.01,
    "attention": 0.01,
    "p_conservative": 0.01,
    "seen": 1.0,
    "town_rank": 0.01,
    "town_differs": 0.01,
    "trait_now": 1.0,
}

Column = list[int]
_WHAT = "recorded episodes"


@dataclass(frozen=True)
class _Identity:
    """Key of a recording; another key than the wanted one means that it is recorded anew."""

    format: int
    policy: str
    conditions: dict[str, Any]
    cases: tuple[Annotated[int, Range(0, CASES_PER_SET - 1)], ...]
    scene: dict[str, Any]


@dataclass(frozen=True)
class _StoredVehicle:
    """A vehicle's columns, from its first frame on."""

    number: int
    trait: int
    first: Annotated[int, Range(0, 1_000_000)]
    x_m: tuple[int, ...]
    y_m: tuple[int, ...]
    heading_deg: tuple[int, ...]
    brakes: tuple[int, ...]
    attention: tuple[int, ...] | None = None
    p_conservative: tuple[int, ...] | None = None
    seen: tuple[int, ...] | None = None  # whether the ego perceives it; None where it always does
    trait_now: tuple[int, ...] | None = None  # the trait where it changes; else ``trait`` is that of all frames


@dataclass(frozen=True)
class _StoredEpisode:
    """Result of ``encode``: an episode as the page stores it."""

    outcome: Outcome
    time_s: Annotated[float, Range(0.0, 1e6)]
    hit: tuple[str, str] | None  # trait and route of the driver that was hit
    frames: Annotated[int, Range(1, 1_000_000)]
    ego: dict[str, tuple[int, ...]]
    routes: dict[str, dict[str, tuple[int, ...]]]
    vehicles: tuple[_StoredVehicle, ...]


@dataclass(frozen=True)
class _Stored:
    """Content of a file of recorded episodes, by the number of the case."""

    recorded: _Identity
    episodes: dict[str, _StoredEpisode]


@dataclass(frozen=True)
class Recording:
    """A policy and the cases in which it is recorded, into a file."""

    method: str
    mix: Mix | None  # mix of its training; None: a rule or a shipped policy
    seed: int
    conditions: Conditions
    cases: tuple[int, ...]
    out: Path  # folder of the study
    scene: Scene = field(default_factory=paper_scene)  # scene of the study

    @property
    def label(self) -> str:
        return label(self.method, self.mix, self.seed)

    @property
    def inputs(self) -> tuple[str, ...]:
        """The policy's folder, relative to the study's, if the study has trained it."""
        return () if self.mix is None else (policy_folder(self.method, self.mix, self.seed),)

    @property
    def path(self) -> str:
        """The file, relative to the study's folder."""
        return f"{EPISODES}/{self.label}.json"

    @property
    def file(self) -> Path:
        return self.out / self.path

    def require_policy(self) -> None:
        """Raise InputError unless there is a policy that can be loaded."""
        self._contender()

    def _contender(self) -> Contender:
        return load_policy(self._policy, scene=self.scene if self.mix is None else None)

    @property
    def _policy(self) -> str | Path:
        return policy_path(self.out, self.method, self.mix, self.seed, self.conditions.percent)

    @property
    def _identity(self) -> dict[str, Any]:
        identity = {
            "format": FORMAT,
            "policy": _digest(self._policy),
            "conditions": plain(self.conditions),
            "cases": self.cases,
            "scene": described([self.scene]),
        }
        read: dict[str, Any] = json.loads(json.dumps(identity))
        return read

    def is_done(self) -> bool:
        """Whether the file there is of this very policy and these very cases.

        Raises:
            InputError: there is no such policy, or the file is damaged.
        """
        return self.file.exists() and read_json(self.file, _WHAT, RESULT_BYTES).get("recorded") == self._identity

    def make(self, report: Report) -> None:
        contender = self._contender()
        reader, routes = fit_reader(contender), [route.name for route in self.scene.routes]
        episodes = {}
        for done, case in enumerate(self.cases):
            report(Progress(done, len(self.cases), "case"))
            driven = drive_case(contender, case, REPORTED_SET, self.conditions.task(contender.scene))
            episodes[str(case)] = encode(driven, reader, routes)
        content = {"recorded": self._identity, "episodes": episodes}
        write_text(self.file, json.dumps(content, separators=(",", ":")))


@dataclass(frozen=True)
class RecordJob:
    """Make several recordings in one process: each alone would cost more time to start than to record."""

    number: int
    recordings: tuple[Recording, ...]  # they are made in this job's folder, whatever their own
    out: Path  # folder of the study

    needs = ()
    uses_gpu = False

    @property
    def name(self) -> str:
        return f"episodes {self.number}"

    @property
    def inputs(self) -> tuple[str, ...]:
        return tuple(path for recording in self.recordings for path in recording.inputs)

    @property
    def outputs(self) -> tuple[str, ...]:
        return tuple(recording.path for recording in self.recordings)

    def is_done(self) -> bool:
        return not self._missing()

    def _missing(self) -> list[Recording]:
        placed = [replace(recording, out=self.out) for recording in self.recordings]
        return [recording for recording in placed if not recording.is_done()]

    def run(self, report: Report) -> str:
        torch.set_num_threads(THREADS_PER_JOB)
        missing = self._missing()
        total, done = sum(len(recording.cases) for recording in missing), 0
        for recording in missing:
            recording.make(part_of(report, done, total))
            done += len(recording.cases)
        return f"policies: {len(missing)}"


def record_all(recordings: Sequence[Recording], out: Path, workers: Workers, progress: bool) -> None:
    """Make the recordings of the study in ``out`` that are not there yet."""
    executor = executor_of(workers)
    missing = tuple(recording for recording in recordings if not recording.is_done())
    count = min(executor.slots, len(missing))
    executor.run([RecordJob(number, missing[number::count], out) for number in range(count)], progress)


def read_episodes(file: Path) -> dict[int, dict[str, Any]]:
    """Return the episode of each case.

    Raises:
        InputError: the file is missing or damaged.
    """
    content = read_json(file, _WHAT, RESULT_BYTES)
    try:
        found: _Stored = build(_Stored, content)
    except FieldError as error:
        raise damaged(file, _WHAT, error) from None
    if list(found.episodes) != [str(case) for case in found.recorded.cases]:
        raise damaged(file, _WHAT, "it has other episodes than it says")
    return {int(case): episode for case, episode in content["episodes"].items()}


def _digest(policy: str | Path) -> str:
    """Return a checksum of a policy's weights and its card; for a rule the package's version."""
    if isinstance(METHODS.get(str(policy)), Rule):
        return tint_sumo.__version__
    stem = find_policy(policy)
    card = json.dumps(read_policy_card(stem), sort_keys=True)
    return hashlib.sha256(weights_file(stem).read_bytes() + card.encode()).hexdigest()


def encode(driven: Driven, reader: TraitReader | None, routes: Sequence[str]) -> dict[str, Any]:
    """Return an episode as small whole numbers.

    Its entries are ``outcome``, ``time_s``, ``hit``, ``frames``, columns of the ``ego`` and of each vehicle from its
    ``first`` frame on, and the column ``claimed`` of each route.
    """
    case, moments = driven.case, driven.moments
    numbers = np.array([moment.vehicles for moment in moments])
    return {
        "outcome": case.outcome,
        "time_s": case.time_s,
        "hit": None if case.trait is None else [case.trait, case.route],
        "frames": len(moments),
        "ego": _ego(moments),
        "routes": {
            name: {"claimed": _column("claimed", [moment.claimed[route] for moment in moments])}
            for route, name in enumerate(routes)
        },
        "vehicles": [_vehicle(moments, reader, numbers, number) for number in np.unique(numbers[numbers >= 0])],
    }


def _ego(moments: Sequence[Moment]) -> dict[str, Column]:
    columns = {
        **_positions(np.array([moment.ego for moment in moments])),
        "speed_mps": [moment.ego_mps for moment in moments],
        "brakes": [moment.ego_brakes for moment in moments],
        "held": [moment.is_held for moment in moments],
        "desired_mps": [np.nan if moment.desired_mps is None else moment.desired_mps for moment in moments],
        "value": [np.nan if moment.value is None else moment.value for moment in moments],
        "town_rank": [np.nan if moment.town is None else moment.town.rank for moment in moments],
        "town_differs": [np.nan if moment.town is None else moment.town.differs for moment in moments],
    }
    return {name: _column(name, values) for name, values in columns.items() if not np.isnan(values).all()}


def _vehicle(
    moments: Sequence[Moment], reader: TraitReader | None, numbers: NDArray[np.int64], number: int
) -> dict[str, Any]:
    """The vehicle keeps its slot while it is there."""
    frames, slots = np.nonzero(numbers == number)
    slot, present = int(slots[0]), [moments[frame] for frame in frames.tolist()]
    columns: dict[str, Any] = {
        **_positions(np.array([moment.boxes[slot] for moment in present])),
        "brakes": [moment.brakes[slot] for moment in present],
    }
    if present[0].attention is not None:
        columns["attention"] = [moment.attention[slot] for moment in present if moment.attention is not None]
    seen = [bool(moment.seen[slot]) for moment in present]
    if not all(seen):
        columns["seen"] = seen
    traits = [int(moment.traits[slot]) for moment in present]
    if len(set(traits)) > 1:
        columns["trait_now"] = traits
    if reader is not None:
        columns["p_conservative"] = reader.p_conservative(
            np.array([moment.observed_traits[slot] for moment in present if moment.observed_traits is not None])
        )
    return {
        "number": int(number),
        "trait": traits[0],
        "first": int(frames[0]),
        **{name: _column(name, values) for name, values in columns.items()},
    }


def _positions(boxes: NDArray[np.void]) -> dict[str, Any]:
    heading = np.unwrap(np.arctan2(boxes["heading_y"], boxes["heading_x"]))
    return {"x_m": boxes["x_m"], "y_m": boxes["y_m"], "heading_deg": np.degrees(heading)}


def _column(name: str, values: Any) -> Column:
    multiples = np.rint(np.asarray(values, np.float64) / UNITS[name])
    whole = np.where(np.isnan(multiples), MISSING, multiples).astype(np.int64)
    return [int(step) for step in np.diff(whole, prepend=0)]
