"""The comparison of trait methods: every method at every position noise, several training seeds, one table."""

import time
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Annotated

import numpy as np
import torch

from tint_sumo.comparisons.traits_report import TraitReport, write_trait_report
from tint_sumo.config import TRAIT_BUDGETS, Fraction, LatentCount, NoiseM, Seed, TraitSettings, WindowCount
from tint_sumo.core.errors import InputError
from tint_sumo.core.files import claim_folder, write_json
from tint_sumo.core.progress import Report, part_of
from tint_sumo.core.ranges import Range, require_distinct, require_ranges
from tint_sumo.core.structures import Many
from tint_sumo.dataset.recorder import record
from tint_sumo.dataset.windows import Windows, load_drivers, load_labels, load_windows, split_by_episode
from tint_sumo.jobs import Job, Workers, executor_of
from tint_sumo.jobs.jobs import THREADS_PER_JOB
from tint_sumo.study.folders import RESULTS
from tint_sumo.traits.datasets import train_on
from tint_sumo.traits.evaluation import TEST_FRACTION, Probe, linear_r2
from tint_sumo.traits.model import find_trait_method
from tint_sumo.traits.storage import RUN_MODEL, add_to_card

DATASET_SEED = 2022
PROPERTIES = ("desired_speed_mps", "min_gap_m")
_DATA, _CONTINUOUS_DATA = "dataset", "continuous"  # folders in a comparison's folder


@dataclass(frozen=True)
class TraitStudy:
    """Settings of the comparison."""

    windows: WindowCount = 696_000  # paper IV-B
    settings: TraitSettings = TRAIT_BUDGETS["full"]
    methods: Many[str] = ("vae", "cross_window", "morton", "classifier")
    noises_m: Many[NoiseM] = (0.0, 0.05, 0.1, 0.2)
    seeds: Many[Seed] = (0, 1, 2)
    p_conservative: Fraction = 0.5  # mix of the training data
    other_p: Many[Fraction] = (0.25, 0.4, 0.6)  # mixes of further test data
    other_windows: WindowCount = 30_000
    continuous_windows: WindowCount = 240_000
    continuous_methods: Many[str] = ("vae", "cross_window")
    continuous_latents: Many[LatentCount] = (2, 4)
    continuous_seeds: Many[Seed] = (0, 1)
    continuous_epochs: Annotated[int, Range(1, 1_000_000)] = 10  # properties without classes take longer to show

    def __post_init__(self) -> None:
        require_ranges(self)
        require_distinct(self, "methods", "noises_m", "seeds")
        if self.continuous_methods:
            require_distinct(self, "continuous_methods", "continuous_latents", "continuous_seeds")
        if self.other_p:
            require_distinct(self, "other_p")
        for method in (*self.methods, *self.continuous_methods):
            find_trait_method(method)
        if self.p_conservative in self.other_p:
            raise InputError(
                f"other_p has the mix of the training data, {self.p_conservative:g}, tested anyway; leave it out"
            )
        if self.settings.noise_m != 0.0:
            raise InputError("settings.noise_m has no use, since every noise of noises_m is trained with; leave it out")


TRAIT_STUDIES = {"full": TraitStudy()}


def run_trait_study(study: TraitStudy, out: Path, *, workers: Workers = 2, progress: bool = True) -> TraitReport:
    """Run the comparison into ``out``; what an earlier, interrupted call has finished is not repeated.

    Args:
        study: sizes of all stages.
        out: a new folder, or the one of this very study.
        workers: processes at a time, or an executor.
        progress: show the progress on stderr.

    Raises:
        InputError: ``out`` holds another run, or a stage was refused.
        JobError: jobs were given up; all others are done.
    """
    executor = executor_of(workers)
    with claim_folder(out, {"kind": "trait study", **asdict(study)}):
        for folder, windows, p_conservative in _recordings(study, out):
            record(
                folder, windows, p_conservative=p_conservative, seed=DATASET_SEED, workers=executor, progress=progress
            )
        if study.continuous_methods:
            record(
                out / _CONTINUOUS_DATA,
                study.continuous_windows,
                population="continuous",
                seed=DATASET_SEED,
                workers=executor,
                progress=progress,
            )
        executor.run(plan(study, out), progress)
        return write_trait_report(out)


def plan(study: TraitStudy, out: Path) -> list[Job]:
    """All jobs after the recordings."""
    comparisons = [CompareJob(study, method, seed, out) for seed in study.seeds for method in study.methods]
    continuous = [
        ContinuousJob(study, method, latent_size, seed, out)
        for seed in study.continuous_seeds
        for method in study.continuous_methods
        for latent_size in study.continuous_latents
    ]
    return [*comparisons, *continuous]


def _recordings(study: TraitStudy, out: Path) -> list[tuple[Path, int, float]]:
    """Folder, windows and P(conservative) of each recording."""
    others = [(out / _other_data(p), study.other_windows, p) for p in study.other_p]
    return [(out / _DATA, study.windows, study.p_conservative), *others]


def _other_data(p_conservative: float) -> str:
    return f"{_DATA}-P{p_conservative:g}"


@dataclass(frozen=True)
class CompareJob:
    """Train one method with one seed at every noise, and measure how well each model separates the traits."""

    study: TraitStudy
    method: str
    seed: int
    out: Path

    needs = ()
    uses_gpu = False

    @property
    def name(self) -> str:
        return f"{self.method} seed{self.seed}"

    @property
    def inputs(self) -> tuple[str, ...]:
        return (_DATA, *map(_other_data, self.study.other_p))

    @property
    def outputs(self) -> tuple[str, ...]:
        return tuple(path for noise_m in self.study.noises_m for path in (self._model(noise_m), self._result(noise_m)))

    def is_done(self) -> bool:
        return all((self.out / self._result(noise_m)).exists() for noise_m in self.study.noises_m)

    def run(self, report: Report) -> str:
        torch.set_num_threads(THREADS_PER_JOB)
        windows, conservative = _load(self.out / _DATA)
        others = {p: _load(self.out / _other_data(p)) for p in self.study.other_p}
        noises_m = self.study.noises_m
        train, _ = split_by_episode(windows, TEST_FRACTION, self.seed)
        seen = self.study.settings.epochs * len(train)  # windows of a training
        for done, noise_m in enumerate(noises_m):
            if not (self.out / self._result(noise_m)).exists():
                part = part_of(report, done * seen, len(noises_m) * seen)
                self._compare(noise_m, windows, conservative, others, part)
        return f"{len(noises_m)} noise levels"

    def _compare(
        self,
        noise_m: float,
        windows: Windows,
        conservative: np.ndarray,
        others: dict[float, tuple[Windows, np.ndarray]],
        report: Report,
    ) -> None:
        folder = self.out / self._model(noise_m)
        train, test = split_by_episode(windows, TEST_FRACTION, self.seed)
        resumes = folder.exists()
        began = time.perf_counter()
        settings = replace(self.study.settings, noise_m=noise_m)
        data = self.out / _DATA
        model = train_on(
            windows[train], data, folder, method=self.method, settings=settings, seed=self.seed, report=report
        )
        training_s = None if resumes else round(time.perf_counter() - began, 1)
        probe = Probe(model, windows[train], conservative[train], noise_m=noise_m, seed=self.seed)
        found = probe.score(windows[test], conservative[test])
        by_p = {f"{p:g}": probe.score(*data).accuracy for p, data in others.items()}
        content = {
            "kind": "comparison",
            "method": self.method,
            "noise_m": noise_m,
            "seed": self.seed,
            "training_windows": len(train),
            "training_s": training_s,
            **asdict(found),
            "by_p": by_p,
        }
        add_to_card(folder / f"{RUN_MODEL}.safetensors", {"accuracy": found.accuracy})
        write_json(self.out / self._result(noise_m), content)

    def _model(self, noise_m: float) -> str:
        return f"models/{_slug(self.method, noise_m, self.seed)}"

    def _result(self, noise_m: float) -> str:
        return f"{RESULTS}/{_slug(self.method, noise_m, self.seed)}.json"


@dataclass(frozen=True)
class ContinuousJob:
    """Train a method on drivers without classes, and see how well a line through its latents finds their properties."""

    study: TraitStudy
    method: str
    latent_size: int
    seed: int
    out: Path

    needs = ()
    inputs = (_CONTINUOUS_DATA,)
    uses_gpu = False

    @property
    def name(self) -> str:
        return f"{self.method} continuous {self.latent_size} latents seed{self.seed}"

    @property
    def outputs(self) -> tuple[str, ...]:
        slug = self.name.replace(" ", "-")
        return f"models/{slug}", f"{RESULTS}/{slug}.json"

    @property
    def result_file(self) -> Path:
        return self.out / self.outputs[1]

    def is_done(self) -> bool:
        return self.result_file.exists()

    def run(self, report: Report) -> str:
        torch.set_num_threads(THREADS_PER_JOB)
        data = self.out / _CONTINUOUS_DATA
        folder = self.out / self.outputs[0]
        windows = load_windows(data)
        train, _ = split_by_episode(windows, TEST_FRACTION, self.seed)
        model = train_on(
            windows[train],
            data,
            folder,
            method=self.method,
            settings=replace(self.study.settings, epochs=self.study.continuous_epochs),
            seed=self.seed,
            latent_size=self.latent_size,
            report=report,
        )
        properties = load_drivers(data, windows, PROPERTIES).to_numpy(np.float64)
        r2 = dict(zip(PROPERTIES, linear_r2(model, windows, properties, seed=self.seed).tolist(), strict=True))
        case = {"kind": "continuous", "method": self.method, "latent_size": self.latent_size, "seed": self.seed}
        write_json(self.result_file, {**case, "r2": r2})
        return ", ".join(f"R2 of {name} {value:.3f}" for name, value in r2.items())


def _load(data: Path) -> tuple[Windows, np.ndarray]:
    windows = load_windows(data)
    return windows, load_labels(data, windows)


def _slug(method: str, noise_m: float, seed: int) -> str:
    return f"{method}-noise{noise_m:g}-seed{seed}"
