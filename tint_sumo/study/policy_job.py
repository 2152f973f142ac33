"""The study's job of training and evaluating one policy."""

import time
from dataclasses import dataclass
from pathlib import Path

import torch

from tint_sumo.config import PpoSettings
from tint_sumo.files import write_json
from tint_sumo.study.evaluation import evaluate
from tint_sumo.study.loading import load_policy
from tint_sumo.study.methods import Learned, Rule, find_method
from tint_sumo.study.pool import THREADS_PER_JOB
from tint_sumo.study.progress import Report
from tint_sumo.study.results import RESULTS, Result
from tint_sumo.study.training import train_policy


@dataclass(frozen=True)
class PolicyJob:
    """Train a policy, unless it is a rule, and evaluate it."""

    method: str
    p_conservative: float
    seed: int  # of training and of the cases
    episodes: int
    settings: PpoSettings
    out: Path  # of the study

    @property
    def name(self) -> str:
        return f"{self.method} P{self.p_conservative:g} seed{self.seed}"

    @property
    def needs(self) -> tuple[str, ...]:
        method = find_method(self.method)
        return (f"traits {method.encoder}",) if isinstance(method, Learned) and method.encoder else ()

    @property
    def result_file(self) -> Path:
        return self.out / RESULTS / f"{self.name.replace(' ', '-')}.json"

    def is_done(self) -> bool:
        return self.result_file.exists()

    def run(self, report: Report) -> str:
        torch.set_num_threads(THREADS_PER_JOB)
        began = time.monotonic()
        model = self.method if isinstance(find_method(self.method), Rule) else str(self._train(report))
        contender = load_policy(model)
        evaluation = evaluate(
            contender.policy,
            lambda num_envs: contender.make_venv(num_envs, self.p_conservative),
            self.episodes,
            self.seed,
            report=report,
        )
        result = Result(self.method, self.p_conservative, self.seed, evaluation)
        write_json(self.result_file, result.to_json())
        rates = ", ".join(f"{outcome} {evaluation.rate(outcome).value:.1%}" for outcome in ("success", "collision"))
        return f"{rates} ({time.monotonic() - began:.0f} s)"

    def _train(self, report: Report) -> Path:
        method = find_method(self.method)
        assert isinstance(method, Learned)
        return train_policy(
            self.method,
            self.p_conservative,
            self.settings.total_steps,
            self.seed,
            self.out / "policies" / self.name.replace(" ", "-"),
            settings=self.settings,
            traits=self.out / "traits" / str(method.encoder) / "model.safetensors",
            report=report,
        )
