"""Predict how long studies take on clusters of 2-core machines: measure their jobs here, then lay them out in order.

python scripts/predict_cluster.py
"""

import heapq
import tempfile
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from itertools import count
from pathlib import Path

from tint_sumo.config import ALL_MIXES, Mix
from tint_sumo.jobs import Job, Local
from tint_sumo.jobs.jobs import Ended, Event, Started, run_jobs
from tint_sumo.methods.registry import METHODS, Learned
from tint_sumo.study.budgets import BUDGETS, Budget, Conditions, Trials
from tint_sumo.study.ceiling_job import CeilingJob
from tint_sumo.study.jobs import EvaluateJob, TrainJob
from tint_sumo.study.plan import plan

CORES = 2
FULL = BUDGETS["full"]
ROLLOUT = FULL.ppo.rollout
ROLLOUTS = 8
CASES = 1000
MACHINES = (1, 8, 64, 1000)
STUDIES = {
    "--budget full": FULL,
    "the same with 5 seeds": replace(FULL, seeds=tuple(range(5))),
    "policies for 5 single mixes, 5 seeds": replace(
        FULL, mixes=tuple(map(Mix, (0.1, 0.25, 0.4, 0.6, 0.9))), seeds=tuple(range(5))
    ),
}


@dataclass(frozen=True)
class Times:
    """Durations of jobs on one core while others of their kind keep the other cores busy."""

    start_s: float  # of any job
    decision_s: dict[str, float]  # of a training, by method; none for methods that share another one's training
    case_s: float
    ceilings_s: float

    def of(self, job: Job) -> float:
        match job:
            case TrainJob():
                return self.start_s + self.decision_s.get(job.method, 0.0) * job.settings.total_steps
            case EvaluateJob():
                return self.start_s + self.case_s * sum(episodes for _, episodes in job.wanted)
            case CeilingJob():
                return self.start_s + self.ceilings_s
        raise TypeError(job)


@dataclass
class Schedule:
    """A host whose jobs take the time that was measured, without doing anything."""

    room: int
    times: Times
    now_s: float = 0.0
    _running: list[tuple[float, int, Job]] = field(default_factory=list)  # by their end
    _numbers: Iterator[int] = field(default_factory=count)

    def start(self, job: Job) -> None:
        heapq.heappush(self._running, (self.now_s + self.times.of(job), next(self._numbers), job))

    def listen(self, patience_s: float) -> list[tuple[Job, Event]]:  # noqa: ARG002 - time is not spent here
        self.now_s, _, job = heapq.heappop(self._running)
        return [(job, Started()), (job, Ended("done"))]

    def interrupt(self) -> None:
        pass


def measure() -> Times:
    learned = [method.name for method in METHODS.values() if isinstance(method, Learned) and method.trained_as is None]
    decision_s = {}
    for method in learned:
        short_s, long_s = (_job_s(_training(method, rollouts)) for rollouts in (1, 1 + ROLLOUTS))
        decision_s[method] = (long_s - short_s) / (ROLLOUTS * ROLLOUT)
        print(f"training of {method}: {decision_s[method] * FULL.ppo.total_steps / 60:.1f} min", flush=True)
    few_s, many_s = (_job_s(_test(cases)) for cases in (100, 100 + CASES))
    case_s = (many_s - few_s) / CASES
    start_s = few_s - 100 * case_s
    with _folder() as out:
        ceilings_s = _seconds(lambda: Local().run([CeilingJob(FULL.trials, out)], progress=False)) - start_s
    print(f"start: {start_s:.0f} s, 1,000 cases: {1000 * case_s:.0f} s, ceilings: {ceilings_s:.0f} s", flush=True)
    return Times(start_s, decision_s, case_s, ceilings_s)


def _training(method: str, rollouts: int) -> Callable[[Path, int], Job]:
    ppo = replace(FULL.ppo, total_steps=rollouts * ROLLOUT)
    return lambda out, seed: TrainJob(method, ALL_MIXES, seed, ppo, True, out)


def _test(cases: int) -> Callable[[Path, int], Job]:
    trials = (Trials((Conditions(Mix(0.4)),), cases),)
    return lambda out, seed: EvaluateJob(("oracle", "vae")[seed], None, 0, trials, out)


def _job_s(make: Callable[[Path, int], Job]) -> float:
    """Mean time of such jobs that keep all cores busy, their start included."""
    with _folder() as out:
        return _seconds(lambda: Local(CORES).run([make(out, seed) for seed in range(CORES)], progress=False))


def _seconds(work: Callable[[], None]) -> float:
    began_s = time.perf_counter()
    work()
    return time.perf_counter() - began_s


@contextmanager
def _folder() -> Iterator[Path]:
    with tempfile.TemporaryDirectory() as folder:
        yield Path(folder)


def predict_s(budget: Budget, machines: int, times: Times) -> float:
    with _folder() as out:
        schedule = Schedule(CORES * machines, times)
        run_jobs(plan(budget, out), schedule, progress=False)
        return schedule.now_s


def main() -> None:
    times = measure()
    for name, budget in STUDIES.items():
        jobs = len(plan(budget, Path()))
        took = "  ".join(f"{machines}: {predict_s(budget, machines, times) / 60:.0f} min" for machines in MACHINES)
        print(f"{name}, {jobs} jobs on machines of {CORES} cores: {took}", flush=True)


if __name__ == "__main__":
    main()
