"""Executors of work: processes of this machine, or a Ray cluster.

An executor runs jobs, which leave files in a folder, and does numbered pieces of work in order. Ray is imported by
``tint_sumo.jobs.cluster`` alone.
"""

from tint_sumo.jobs.jobs import Executor, Job, Work
from tint_sumo.jobs.local import Local

Workers = int | Executor  # so many processes of this machine, or an executor


def executor_of(workers: Workers) -> Executor:
    """Return the executor that ``workers`` stands for.

    Raises:
        InputError: fewer workers than one.
    """
    return Local(workers) if isinstance(workers, int) else workers


__all__ = ["Executor", "Job", "Local", "Work", "Workers", "executor_of"]
