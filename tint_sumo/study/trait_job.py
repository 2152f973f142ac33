"""The study's job of learning one trait representation."""

from dataclasses import dataclass
from pathlib import Path

import torch

from tint_sumo.config import TraitSettings
from tint_sumo.core.files import write_json
from tint_sumo.core.percentages import percent
from tint_sumo.core.progress import Report
from tint_sumo.jobs.jobs import THREADS_PER_JOB
from tint_sumo.study.folders import DATASET, trait_folder
from tint_sumo.traits.datasets import evaluate_traits, plot_traits, train_traits
from tint_sumo.traits.storage import add_to_card

SEED = 0  # seed of the dataset and of the trait models


@dataclass(frozen=True)
class TraitJob:
    """Train a trait model on the study's dataset and measure how well its latents separate the traits."""

    method: str
    settings: TraitSettings
    out: Path  # folder of the study

    needs = ()
    inputs = (DATASET,)
    uses_gpu = False

    @property
    def name(self) -> str:
        return f"traits {self.method}"

    @property
    def outputs(self) -> tuple[str, ...]:
        return (trait_folder(self.method),)

    @property
    def folder(self) -> Path:
        return self.out / trait_folder(self.method)

    def is_done(self) -> bool:
        return (self.folder / "evaluation.json").exists()

    def run(self, report: Report) -> str:
        torch.set_num_threads(THREADS_PER_JOB)
        data = self.out / DATASET
        train_traits(data, self.folder, method=self.method, settings=self.settings, seed=SEED, report=report)
        found = evaluate_traits(data, self.folder)
        plot_traits(data, self.folder, self.folder)
        add_to_card(self.folder / "model.safetensors", {"accuracy": found["accuracy"]})
        write_json(self.folder / "evaluation.json", found)
        return f"{percent(found['accuracy'])}% of {found['windows']} unseen windows put into the right class"
