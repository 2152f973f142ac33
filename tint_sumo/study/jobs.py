"""The study's jobs of training policies and of testing them."""

import re
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

import pandas as pd
import torch

from tint_sumo.config import PERFECT, Mix, PpoSettings, Sensor
from tint_sumo.core.files import damaged, write_json
from tint_sumo.core.percentages import percent
from tint_sumo.core.progress import Report, part_of
from tint_sumo.core.reading import RESULT_BYTES, require_file
from tint_sumo.envs.rows import BUILT_IN_OUTCOMES
from tint_sumo.jobs.jobs import THREADS_PER_JOB
from tint_sumo.methods.evaluation import REPORTED_SET, Evaluation, evaluate
from tint_sumo.methods.loading import load_policy, shipped_policy
from tint_sumo.methods.registry import METHODS, Rule, find_learned, find_method
from tint_sumo.methods.training import CURVE_FILE, POLICY, share_training, snapshot_stem, train_policy
from tint_sumo.scenes import Scene, paper_scene
from tint_sumo.study.budgets import Conditions, Trials
from tint_sumo.study.folders import RESULTS, trait_folder
from tint_sumo.study.results import GIVEN, TRAINED, Measured, Result

_SMOOTHED = 5  # points of a learning curve


@dataclass(frozen=True)
class TrainJob:
    """Train a policy."""

    method: str
    mix: Mix
    seed: int
    settings: PpoSettings
    shipped_traits: bool  # rather than a trait model of the study
    out: Path  # folder of the study
    scene: Scene = field(default_factory=paper_scene)
    sensors: tuple[Sensor, ...] = (PERFECT,)  # of several, each has an equal share of the environments

    uses_gpu = True

    @property
    def name(self) -> str:
        return f"train {label(self.method, self.mix, self.seed)}"

    @property
    def needs(self) -> tuple[str, ...]:
        method = find_learned(self.method)
        traits = (f"traits {method.encoder}",) if method.encoder and not self.shipped_traits else ()
        shared = (f"train {label(method.trained_as, self.mix, self.seed)}",) if method.trained_as else ()
        return traits + shared

    @property
    def inputs(self) -> tuple[str, ...]:
        method = find_learned(self.method)
        traits = (trait_folder(method.encoder),) if method.encoder and not self.shipped_traits else ()
        return traits + ((self._folder(method.trained_as),) if method.trained_as else ())

    @property
    def outputs(self) -> tuple[str, ...]:
        return (self._folder(self.method),)

    @property
    def folder(self) -> Path:
        return self.out / self._folder(self.method)

    def _folder(self, method: str) -> str:
        return policy_folder(method, self.mix, self.seed)

    def is_done(self) -> bool:
        return (self.folder / f"{POLICY}.json").exists()

    def run(self, report: Report) -> str:
        torch.set_num_threads(THREADS_PER_JOB)
        method = find_learned(self.method)
        uses_own = method.encoder is not None and not self.shipped_traits
        traits = self.out / trait_folder(str(method.encoder)) / "model.safetensors" if uses_own else None
        if method.trained_as is not None:
            share_training(self.out / self._folder(method.trained_as), self.method, self.folder, traits)
            return f"shares the training of {method.trained_as}"
        train_policy(
            self.method,
            self.mix,
            self.settings.total_steps,
            self.seed,
            self.folder,
            settings=self.settings,
            scene=self.scene,
            sensors=self.sensors,
            traits=traits,
            report=report,
        )
        return ""


@dataclass(frozen=True)
class EvaluateJob:
    """Evaluate a trained policy, a shipped one, or a rule."""

    method: str
    mix: Mix | None  # mix of its training; None: a rule or a shipped policy
    seed: int
    trials: tuple[Trials, ...]
    out: Path  # folder of the study
    scene: Scene = field(default_factory=paper_scene)
    case_set: int = REPORTED_SET

    uses_gpu = False

    @property
    def name(self) -> str:
        return f"evaluate {self._label}"

    @property
    def _label(self) -> str:
        return label(self.method, self.mix, self.seed)

    @property
    def needs(self) -> tuple[str, ...]:
        return () if self.mix is None else (f"train {self._label}",)

    @property
    def inputs(self) -> tuple[str, ...]:
        return () if self.mix is None else (policy_folder(self.method, self.mix, self.seed),)

    @property
    def outputs(self) -> tuple[str, ...]:
        return (f"{RESULTS}/{self._label}.json",)

    @property
    def result_file(self) -> Path:
        return self.out / self.outputs[0]

    @property
    def wanted(self) -> list[tuple[Conditions, int]]:
        """The conditions in which it is tested, and the number of cases in each."""
        pairs = [(conditions, trials.episodes) for trials in self.trials for conditions in trials.conditions]
        return [(conditions, episodes) for conditions, episodes in pairs if self._meets(conditions)]

    def is_done(self) -> bool:
        return self.result_file.exists()

    def run(self, report: Report) -> str:
        torch.set_num_threads(THREADS_PER_JOB)
        total, done = sum(episodes for _, episodes in self.wanted), 0
        tested: list[Measured] = []
        for conditions, episodes in self.wanted:
            evaluation = self._test(conditions, episodes, part_of(report, done, total))
            tested.append(Measured(conditions, evaluation))
            done += episodes
        origin = GIVEN if self.mix is None else TRAINED
        scene_tau_s = self.scene.tau_s
        result = Result(self.method, origin, self.mix, self.seed, tuple(tested), self.case_set, scene_tau_s)
        write_json(self.result_file, result.to_json())
        successes = ", ".join(f"{percent(test.evaluation.rate('success').value)}%" for test in tested)
        return f"success {successes}"

    def _meets(self, conditions: Conditions) -> bool:
        """Whether the policy is tested there: among drivers it was trained for, and if it was trained at all."""
        if self.mix is None:
            return conditions.percent == 100
        return self.mix.contains(conditions.p_conservative)

    def _test(self, conditions: Conditions, episodes: int, report: Report) -> Evaluation:
        path = policy_path(self.out, self.method, self.mix, self.seed, conditions.percent)
        contender = load_policy(path, scene=self.scene if self.mix is None else None)
        return evaluate(
            contender.policy,
            lambda num_envs: contender.make_venv(num_envs, conditions.task(contender.scene)),
            episodes,
            self.case_set,
            report=report,
        )


def label(method: str, mix: Mix | None, seed: int) -> str:
    """Return the name of a policy in the files of a study."""
    if mix is None:
        return method if isinstance(find_method(method), Rule) else f"{method}-shipped"
    return f"{method}-P{mix.text.replace(' ', '')}-seed{seed}"


def policy_folder(method: str, mix: Mix, seed: int) -> str:
    """Return the folder of a policy that a study trains, relative to the study's."""
    return f"policies/{label(method, mix, seed)}"


def policy_path(out: Path, method: str, mix: Mix | None, seed: int, percent: int = 100) -> str | Path:
    """Return where a study's policy after part of its training is, or a shipped one; of a rule its name."""
    if mix is None:
        return method if isinstance(find_method(method), Rule) else shipped_policy(method)
    return snapshot_stem(out / policy_folder(method, mix, seed), percent).with_suffix(".safetensors")


def read_curves(out: Path) -> dict[tuple[str, Mix], list[pd.DataFrame]]:
    """Return the curves of the trainings of the study in ``out``, one per seed, by method and mix in training.

    Methods have the registry's order. A training in which no episode has ended yet has no curve.

    Raises:
        InputError: a file is damaged.
    """
    found: dict[tuple[str, Mix], list[pd.DataFrame]] = {}
    for name in METHODS:
        folders = [(_mix_in(folder.name, name), folder) for folder in (out / "policies").glob(f"{name}-P*")]
        for mix, folder in sorted((mix, folder) for mix, folder in folders if mix is not None):
            if (folder / CURVE_FILE).exists() and len(curve := _read_curve(folder / CURVE_FILE)):
                found.setdefault((name, mix), []).append(curve)
    return found


def _mix_in(folder: str, method: str) -> Mix | None:
    """Return the mix of a training in the name of its folder, which is the policy's ``label``; None in other names."""
    text = re.fullmatch(rf"{re.escape(method)}-P([\d.e-]+)(?:to([\d.e-]+))?-seed\d+", folder)
    return Mix(*(float(number) for number in text.groups() if number)) if text else None


def smoothed_percent(seeds: Sequence[pd.DataFrame]) -> pd.DataFrame:
    """Return success in training, %: a row for each number of decisions, a column for each seed."""
    shares = [curve.set_index("decisions")["success"].rolling(_SMOOTHED, min_periods=1).mean() for curve in seeds]
    return 100.0 * pd.concat(shares, axis=1).dropna()


def _read_curve(file: Path) -> pd.DataFrame:
    require_file(file, "training curve", RESULT_BYTES)
    try:
        curve = pd.read_csv(file, dtype=float, compression=None)[["decisions", *BUILT_IN_OUTCOMES]]
    except (KeyError, ValueError, OverflowError) as error:
        raise damaged(file, "training curve", " ".join(str(error).split())) from None
    decisions, shares = curve["decisions"], curve[list(BUILT_IN_OUTCOMES)]
    if not (decisions.between(0, 1e12).all() and decisions.is_monotonic_increasing and decisions.is_unique):
        raise damaged(file, "training curve", "decisions must grow from 0 on")
    if not ((shares >= 0.0) & (shares <= 1.0)).all(axis=None):
        raise damaged(file, "training curve", "shares of outcomes must lie in 0 to 1")
    return curve
