"""Evaluation by an executor, which finds the same policy as this process does."""

import shutil
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import pytest

from tint_sumo.core.files import shipped
from tint_sumo.core.progress import silent
from tint_sumo.envs import TaskSettings
from tint_sumo.jobs import Executor, Job
from tint_sumo.jobs.local import Local
from tint_sumo.methods.evaluation import Evaluation, evaluate
from tint_sumo.methods.evaluation_jobs import CasesJob, evaluate_on
from tint_sumo.methods.loading import load_policy

TASK = TaskSettings(p_conservative=0.4)
CASES, SET = 3, 1000
POLICIES = shipped("models") / "policies"


@dataclass(frozen=True)
class Here(Local):
    """Does the jobs in this process, in another working folder and with nothing but the files it was given."""

    folder: Path = Path()

    def run(self, jobs: Sequence[Job], progress: bool = True) -> None:
        with pytest.MonkeyPatch.context() as moved:
            moved.chdir(self.folder)
            for job in jobs:
                assert isinstance(job, CasesJob)
                assert job.model == "ttc" or (job.out / job.model).is_file()
                job.run(silent)


@pytest.fixture
def elsewhere(tmp_path_factory: pytest.TempPathFactory) -> Executor:
    return Here(1, tmp_path_factory.mktemp("elsewhere"))


def here(model: str) -> Evaluation:
    contender = load_policy(model)
    return evaluate(contender.policy, lambda count: contender.make_venv(count, TASK), CASES, SET)


@pytest.mark.parametrize("model", ["oracle", "vae", "ttc"])
def test_a_name_stands_for_the_same_policy_whatever_lies_in_the_working_folder(
    model: str, elsewhere: Executor, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for suffix in (".safetensors", ".json"):
        (tmp_path / model).mkdir(exist_ok=True)
        shutil.copy((POLICIES / "no_labels").with_suffix(suffix), tmp_path / model / f"policy{suffix}")
    monkeypatch.chdir(tmp_path)
    assert evaluate_on(elsewhere, model, TASK, CASES, SET, progress=False) == here(model)


def test_a_path_without_suffix_is_sent_with_its_files(
    elsewhere: Executor, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for suffix in (".safetensors", ".json"):
        shutil.copy((POLICIES / "oracle").with_suffix(suffix), tmp_path / f"mine{suffix}")
    monkeypatch.chdir(tmp_path)
    assert evaluate_on(elsewhere, "mine", TASK, CASES, SET, progress=False) == here("oracle")
