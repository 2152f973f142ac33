"""The whole study: record, learn traits, train and evaluate every policy, report."""

from dataclasses import asdict
from pathlib import Path

from tint_sumo.dataset.recorder import record
from tint_sumo.errors import InputError
from tint_sumo.files import claim_folder
from tint_sumo.study.budgets import Budget
from tint_sumo.study.methods import Learned, Rule, find_method
from tint_sumo.study.policy_job import PolicyJob
from tint_sumo.study.pool import Job, run_jobs
from tint_sumo.study.report import StudyReport, write_report
from tint_sumo.study.trait_job import DATASET, SEED, TraitJob


def plan(budget: Budget, out: Path) -> list[Job]:
    """All jobs after the recording, those that take or hold up others longest first."""
    grid = [
        PolicyJob(method, p, seed, budget.episodes, budget.ppo, out)
        for seed in budget.seeds
        for p in budget.p_conservative
        for method in budget.methods
    ]
    found = {name: find_method(name) for name in budget.methods}
    encoders = {method.encoder: None for method in found.values() if isinstance(method, Learned) and method.encoder}
    learned = sorted((job for job in grid if isinstance(found[job.method], Learned)), key=lambda job: len(job.needs))
    rules = [job for job in grid if isinstance(found[job.method], Rule)]
    return [*(TraitJob(encoder, budget.traits, out) for encoder in encoders), *learned, *rules]


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
        record(
            out / DATASET,
            budget.windows,
            p_conservative=budget.record_p_conservative,
            seed=SEED,
            workers=workers,
            progress=progress,
        )
        run_jobs(jobs, workers, progress)
        return write_report(out)
