"""Jobs that evaluate a policy on some of the cases each, so that many machines can share them."""

import math
import shutil
import tempfile
from dataclasses import dataclass
from pathlib import Path

import torch

from tint_sumo.core.errors import InputError
from tint_sumo.core.files import read_record, write_json
from tint_sumo.core.progress import Report
from tint_sumo.core.reading import RESULT_BYTES
from tint_sumo.envs import TaskSettings
from tint_sumo.jobs import Executor
from tint_sumo.jobs.jobs import THREADS_PER_JOB
from tint_sumo.methods.evaluation import BATCH, Case, Evaluation, StoredCase, evaluate, require_cases
from tint_sumo.methods.loading import find_policy, load_policy
from tint_sumo.methods.registry import METHODS, Rule
from tint_sumo.methods.training import TRAITS

MAX_CASES = 1000  # cases of a job: some 20 seconds' work is lost with a machine
_MODEL = "model"  # folder of the policy's files
_SUFFIXES = (".safetensors", ".json", ".zip")


@dataclass(frozen=True)
class _Cases:
    """Content of the file that such a job writes."""

    cases: tuple[StoredCase, ...]


@dataclass(frozen=True)
class CasesJob:
    """Evaluate a policy on the cases ``first``, ``first + 1``, ... of a case set."""

    model: str  # name of a rule, or path in ``out`` of a policy's file
    allow_pickle: bool
    task: TaskSettings
    case_set: int
    first: int
    episodes: int
    out: Path

    needs = ()
    inputs = (_MODEL,)
    uses_gpu = False

    @property
    def name(self) -> str:
        return f"cases {self.first}"

    @property
    def outputs(self) -> tuple[str, ...]:
        return (f"cases-{self.first}.json",)

    @property
    def file(self) -> Path:
        return self.out / self.outputs[0]

    def is_done(self) -> bool:
        return self.file.exists()

    def run(self, report: Report) -> str:
        torch.set_num_threads(THREADS_PER_JOB)
        copied = self.out / self.model
        model = copied if copied.exists() else self.model
        contender = load_policy(model, scene=self.task.scene, allow_pickle=self.allow_pickle)
        evaluation = evaluate(
            contender.policy,
            lambda num_envs: contender.make_venv(num_envs, self.task),
            self.episodes,
            self.case_set,
            first=self.first,
            report=report,
        )
        write_json(self.file, {"cases": [case.stored() for case in evaluation.cases]})
        return ""

    def cases(self) -> tuple[Case, ...]:
        """Return the cases that the job has written."""
        return tuple(Case(*values) for values in read_record(self.file, "cases", _Cases, RESULT_BYTES).cases)


def evaluate_on(
    executor: Executor,
    model: str,
    task: TaskSettings,
    episodes: int,
    case_set: int,
    *,
    allow_pickle: bool = False,
    progress: bool = True,
) -> Evaluation:
    """Evaluate a policy with an executor; each case has the same outcome as with ``evaluate``.

    Args:
        executor: where it is done.
        model, allow_pickle: as in ``load_policy``.
        task: settings of the environments.
        episodes, case_set: number of cases, and of their case set.
        progress: show a table on stderr.

    Raises:
        InputError: bad values, or a scene that other machines do not have.
        JobError: cases were given up.
    """
    require_cases(episodes, case_set)
    if task.scene.sumocfg:
        raise InputError("the .sumocfg of a scene is on this machine alone; evaluate here, not on a cluster")
    with tempfile.TemporaryDirectory(prefix="tint_sumo-") as folder:
        out = Path(folder)
        named = _copy_model(model, out)
        rounds = math.ceil(episodes / (MAX_CASES * executor.slots))  # each gives every slot a job of the same size
        count = BATCH * math.ceil(episodes / (rounds * executor.slots * BATCH))
        jobs = [
            CasesJob(named, allow_pickle, task, case_set, first, min(count, episodes - first), out)
            for first in range(0, episodes, count)
        ]
        executor.run(jobs, progress)
        return Evaluation(tuple(case for job in jobs for case in job.cases()))


def _copy_model(model: str, out: Path) -> str:
    """Copy the files of the policy that ``load_policy`` finds, and its trait model; return its path, a rule's name."""
    if isinstance(METHODS.get(model), Rule):
        return model
    zipped = Path(model).suffix == ".zip"
    stem = Path(model).with_suffix("") if zipped else find_policy(model)
    (out / _MODEL).mkdir()
    for file in stem.parent.iterdir():
        if file.stem in (stem.name, TRAITS) and file.suffix in _SUFFIXES and file.is_file():
            shutil.copy(file, out / _MODEL)
    return f"{_MODEL}/{stem.name}{'.zip' if zipped else '.safetensors'}"
