"""Test trait models in scenes in which they were not trained."""

from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import torch

from tint_sumo import traits
from tint_sumo.config import TRAIT_BUDGETS, Fraction, NoiseM, Seed, TrafficSeed, TraitSettings, WindowCount
from tint_sumo.core.errors import InputError
from tint_sumo.core.files import claim_folder, read_record, write_json, write_text
from tint_sumo.core.percentages import percent
from tint_sumo.core.progress import Report
from tint_sumo.core.ranges import require_distinct, require_ranges
from tint_sumo.core.reading import RESULT_BYTES
from tint_sumo.core.structures import Many
from tint_sumo.dataset.recorder import record
from tint_sumo.dataset.windows import Windows, joined, load_drivers, load_labels, load_windows, split_by_episode
from tint_sumo.jobs import Job, Workers, executor_of
from tint_sumo.jobs.jobs import THREADS_PER_JOB
from tint_sumo.scenes import ALL_SCENES, T_INTERSECTION, find_scene, find_scenes
from tint_sumo.scenes.geometry import Floats
from tint_sumo.study.folders import RESULTS
from tint_sumo.study.tables import markdown_table
from tint_sumo.traits.datasets import first_of_two
from tint_sumo.traits.evaluation import TEST_FRACTION, Probe, fit_line
from tint_sumo.traits.model import find_trait_method
from tint_sumo.traits.training import train

SPEED = "desired_speed_mps"
_POPULATIONS = ("traits", "continuous")


@dataclass(frozen=True)
class SceneStudy:
    """Settings of the comparison: recordings, and the trait models that are trained and tested on them."""

    windows: WindowCount = 60_000  # windows of each scene and population
    methods: Many[str] = ("vae", "cross_window", "morton", "classifier")
    settings: TraitSettings = field(default_factory=lambda: replace(TRAIT_BUDGETS["full"], epochs=10))
    seeds: Many[Seed] = (0, 1, 2)
    noise_m: NoiseM = 0.0
    scenes: Many[str] = tuple(scene.name for scene in find_scenes(ALL_SCENES))
    recording_seed: TrafficSeed = 77  # seed of the first scene; no dataset of a shipped model has it

    def __post_init__(self) -> None:
        require_ranges(self)
        require_distinct(self, "methods", "seeds", "scenes")
        for method in self.methods:
            find_trait_method(method)
        for scene in self.scenes:
            find_scene(scene)
        if T_INTERSECTION not in self.scenes or len(self.scenes) < 2:
            raise InputError(
                f"scenes must be {T_INTERSECTION}, which models are trained in alone, and at least one other"
            )


SCENE_STUDIES = {"full": SceneStudy()}


def run_scene_study(study: SceneStudy, out: Path, *, workers: Workers = 2, progress: bool = True) -> pd.DataFrame:
    """Run the comparison into ``out``; what an earlier, interrupted call has finished is not repeated.

    Each model is trained on one scene, the T-intersection, or on all. A linear classifier, and a line for the desired
    speed, are fitted to its latents on the training episodes of the same scenes, and tested in every scene.

    Returns:
        Columns method, trained_on, seed, scene, accuracy (of the linear classifier), speed_r2 (of the drivers' desired
        speeds where they have no classes); also in scenes.csv and scenes.md.

    Raises:
        InputError: ``out`` holds another run, or a stage was refused.
        JobError: jobs were given up; all others are done.
    """
    executor = executor_of(workers)
    with claim_folder(out, {"kind": "scene study", **asdict(study)}):
        for number, scene in enumerate(study.scenes):
            for population in _POPULATIONS:
                record(
                    out / _data(scene, population),
                    study.windows,
                    population=population,
                    seed=study.recording_seed + number,
                    scene=scene,
                    workers=executor,
                    progress=progress,
                )
        executor.run(plan(study, out), progress)
        return _report(out)


def plan(study: SceneStudy, out: Path) -> list[Job]:
    """A job for each method, seed, and choice of scenes to train on."""
    choices = ((T_INTERSECTION,), study.scenes)
    return [
        TransferJob(study, method, trained_on, seed, out)
        for seed in study.seeds
        for method in study.methods
        for trained_on in choices
    ]


def _data(scene: str, population: str) -> str:
    return f"{population}-{scene}"


@dataclass(frozen=True)
class TransferJob:
    """Train one method on some scenes, and test it in all."""

    study: SceneStudy
    method: str
    trained_on: tuple[str, ...]
    seed: int
    out: Path

    needs = ()
    uses_gpu = False

    @property
    def name(self) -> str:
        return f"{self.method}-{self._choice}-seed{self.seed}"

    @property
    def _choice(self) -> str:
        return self.trained_on[0] if len(self.trained_on) == 1 else "all"

    @property
    def inputs(self) -> tuple[str, ...]:
        return tuple(_data(scene, population) for scene in self.study.scenes for population in _POPULATIONS)

    @property
    def outputs(self) -> tuple[str, ...]:
        return f"models/{self.name}", f"{RESULTS}/{self.name}.json"

    @property
    def _result_file(self) -> Path:
        return self.out / self.outputs[1]

    def is_done(self) -> bool:
        return self._result_file.exists()

    def run(self, report: Report) -> str:
        torch.set_num_threads(THREADS_PER_JOB)
        scenes = self.study.scenes
        model, probe = self._train(report)
        line = fit_line(model, *self._properties(self.trained_on, test=False), noise_m=self.study.noise_m)
        rows, words = [], []
        for scene in scenes:
            accuracy = probe.score(*self._labelled((scene,), test=True)).accuracy
            speed_r2 = float(line(*self._properties((scene,), test=True)))
            rows.append({"scene": scene, "accuracy": accuracy, "speed_r2": speed_r2})
            words.append(f"{scene} {percent(accuracy, 2)}%")
        write_json(
            self._result_file,
            {"method": self.method, "trained_on": self._choice, "seed": self.seed, "scenes": rows},
        )
        return ", ".join(words)

    def _train(self, report: Report) -> tuple[traits.TraitModel, Probe]:
        windows, labels = self._labelled(self.trained_on, test=False)
        model = train(
            windows,
            self.study.settings,
            self.out / self.outputs[0],
            method=self.method,
            seed=self.seed,
            conservative=first_of_two(labels, self.method) if find_trait_method(self.method).uses_labels else None,
            report=report,
            card={"data": {"scenes": list(self.trained_on), "windows": len(windows)}},
        )
        return model, Probe(model, windows, labels, noise_m=self.study.noise_m, seed=self.seed)

    def _labelled(self, scenes: Sequence[str], *, test: bool) -> tuple[Windows, Any]:
        """Training or test windows of some scenes, and the labels of their drivers."""
        parts, labels = [], []
        for scene in scenes:
            data = self.out / _data(scene, "traits")
            windows, chosen = self._chosen(data, test)
            parts.append(windows[chosen])
            labels.append(load_labels(data, windows)[chosen])
        return joined(parts), np.concatenate(labels)

    def _properties(self, scenes: Sequence[str], *, test: bool) -> tuple[Windows, Any]:
        """Return windows of drivers without classes, and their desired speeds, m/s."""
        parts, speeds_mps = [], []
        for scene in scenes:
            data = self.out / _data(scene, "continuous")
            windows, chosen = self._chosen(data, test)
            parts.append(windows[chosen])
            speeds_mps.append(load_drivers(data, windows, [SPEED])[SPEED].to_numpy(np.float64)[chosen])
        return joined(parts), np.concatenate(speeds_mps)

    def _chosen(self, data: Path, test: bool) -> tuple[Windows, Any]:
        windows = load_windows(data)
        return windows, split_by_episode(windows, TEST_FRACTION, self.seed)[int(test)]


@dataclass(frozen=True)
class _SceneScore:
    """Result of a model in a scene."""

    scene: str
    accuracy: Fraction
    speed_r2: float


@dataclass(frozen=True)
class _Transfer:
    """Result file of a job: its model in each scene."""

    method: str
    trained_on: str
    seed: Seed
    scenes: tuple[_SceneScore, ...]


def _report(out: Path) -> pd.DataFrame:
    files = sorted((out / RESULTS).glob("*.json"))
    found = [read_record(file, "result of the study", _Transfer, RESULT_BYTES) for file in files]
    rows = [(result, asdict(row)) for result in found for row in result.scenes]
    table = pd.DataFrame(
        [{"method": result.method, "trained_on": result.trained_on, "seed": result.seed, **row} for result, row in rows]
    )
    write_text(out / "scenes.csv", table.to_csv(index=False))
    write_text(out / "scenes.md", report_markdown(table))
    return table


def report_markdown(table: pd.DataFrame) -> str:
    """Accuracy and R2 by scene, means and standard deviations over the seeds."""
    return "\n".join(
        f"## {title}\n\n{markdown_table(_lines(table, column, words))}\n"
        for column, title, words in (
            ("accuracy", "Accuracy of a linear classifier, %", _accuracy),
            ("speed_r2", "R2 of the desired speed, drivers without classes", _r2),
        )
    )


def _lines(table: pd.DataFrame, column: str, words: Callable[[Floats], str]) -> list[list[str]]:
    """A header, and a line for each model."""
    scenes = list(dict.fromkeys(table["scene"]))
    lines = [["method", "trained on", *scenes]]
    for (method, trained_on), rows in table.groupby(["method", "trained_on"], sort=False):
        values = [rows.loc[rows["scene"] == scene, column].to_numpy() for scene in scenes]
        lines.append([str(method), str(trained_on), *map(words, values)])
    return lines


def _accuracy(seeds: Floats) -> str:
    return percent(seeds.mean(), 2) + _spread(100.0 * seeds)


def _r2(seeds: Floats) -> str:
    return f"{seeds.mean():.2f}{_spread(seeds)}"


def _spread(seeds: Floats) -> str:
    """Return the standard deviation between seeds, and nothing where there is one."""
    return f" ± {seeds.std(ddof=1):.2f}" if len(seeds) > 1 else ""
