"""The whole study: record, learn traits, train and test every policy, report."""

from dataclasses import asdict
from pathlib import Path

from tint_sumo.dataset.recorder import record
from tint_sumo.errors import InputError
from tint_sumo.files import claim_folder
from tint_sumo.study.budgets import Budget
from tint_sumo.study.ceiling_job import CeilingJob
from tint_sumo.study.loading import shipped_policies
from tint_sumo.study.methods import Learned, find_method
from tint_sumo.study.page import write_page
from tint_sumo.study.policy_jobs import EvaluateJob, TrainJob
from tint_sumo.study.pool import Job, run_jobs
from tint_sumo.study.report import StudyReport, write_report
from tint_sumo.study.trait_job import DATASET, SEED, TraitJob


def plan(budget: Budget, out: Path) -> list[Job]:
    """All jobs after the recording, those that hold up others or take longest first, one seed after the other."""
    found = [find_method(name) for name in budget.methods]
    learned = [method for method in found if isinstance(method, Learned)]
    rules = [method.name for method in found if not isinstance(method, Learned)]
    encoders = dict.fromkeys(method.encoder for method in learned if method.encoder)
    traits = [] if budget.traits is None else [TraitJob(name, budget.traits, out) for name in encoders]
    given = rules + (shipped_policies() if budget.with_shipped else [])
    jobs: list[Job] = [*traits]
    for seed in budget.seeds:
        grid = [(method.name, mix, seed) for mix in budget.mixes for method in learned]
        trainings = [TrainJob(*policy, budget.ppo, budget.traits is None, out) for policy in grid]
        jobs += sorted(trainings, key=lambda job: len(job.needs))
        jobs += [EvaluateJob(*policy, budget.trials, out) for policy in grid]
    return [*jobs, CeilingJob(budget.trials, out), *(EvaluateJob(name, None, 0, budget.trials, out) for name in given)]


def run_study(budget: Budget, out: Path, *, workers: int = 2, progress: bool = True) -> StudyReport:
    """Run the study into ``out``; what an earlier, interrupted call has finished is not repeated.

    Args:
        budget: sizes of all stages.
        out: a new folder, or the one of this very study.
        workers: processes at a time.
        progress: show progress bars on stderr.

    Raises:
        InputError: ``out`` holds another run, or a stage was refused.
    """
    if workers < 1:
        raise InputError(f"workers must be at least 1, not {workers}")
    jobs = plan(budget, out)
    with claim_folder(out, {"kind": "study", **asdict(budget)}):
        if budget.traits is not None:
            record(
                out / DATASET,
                budget.windows,
                p_conservative=budget.record_p_conservative,
                seed=SEED,
                workers=workers,
                progress=progress,
            )
        run_jobs(jobs, workers, progress)
        return write_page(write_report(out), out, workers=workers, progress=progress)
