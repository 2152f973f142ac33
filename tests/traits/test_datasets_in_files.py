"""Trait models from datasets larger than memory: the very models of datasets in memory, at a bounded size."""

import subprocess
import sys
from collections.abc import Iterator
from contextlib import AbstractContextManager
from dataclasses import replace
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from tests.traits.interruptions import interrupt_at_step
from tint_sumo.cli import main
from tint_sumo.config import STEP_S, TRAIT_BUDGETS, TraitSettings
from tint_sumo.core.checkpoints import CHECKPOINT_FILE
from tint_sumo.core.errors import InputError
from tint_sumo.core.files import write_json
from tint_sumo.dataset.schema import MANIFEST, SCHEMA_VERSION
from tint_sumo.dataset.shards import write_tables
from tint_sumo.dataset.windows import WindowFile, Windows, count_windows, window_file
from tint_sumo.traits import TRAIT_METHODS, datasets
from tint_sumo.traits.datasets import train_traits
from tint_sumo.traits.storage import read_card

EPISODES = 16  # of each shard
SMALL = TraitSettings(
    embedding_sizes=(8,), hidden_size=8, encoder_output_size=8, decoder_output_size=8, batch_size=1024, epochs=2
)


def write_dataset(folder: Path, shards: int, vehicles: int = 20, steps: int = 125) -> Path:
    """Slow and fast drivers, each at a speed of its own; so many in each episode, and so many steps of each."""
    generator = np.random.default_rng(0)
    keys = pd.MultiIndex.from_product([range(EPISODES), range(vehicles)], names=["episode", "vehicle"]).to_frame(False)
    slow = generator.random(len(keys)) < 0.5
    speed_mps = np.where(slow, 2.4, 3.0) + generator.normal(scale=0.05, size=len(keys))
    rows = keys.loc[keys.index.repeat(steps)].reset_index(drop=True)
    time_s = np.tile(STEP_S * np.arange(steps), len(keys))
    rows = rows.assign(
        time_s=time_s,
        route=pd.Categorical(["lower"] * len(rows)),
        position_m=speed_mps.repeat(steps) * time_s,
        speed_mps=speed_mps.repeat(steps),
        acceleration_mps2=0.0,
        leader=pd.array([pd.NA] * len(rows), "Int16"),
        gap_m=generator.uniform(3.0, 12.0, len(keys)).repeat(steps),
    )
    trait = pd.Categorical(np.where(slow, "conservative", "aggressive"))
    drivers = keys.assign(trait=trait, vtype="one", desired_speed_mps=speed_mps, min_gap_m=4.0, tau_s=1.0)
    for shard in range(shards):
        first = shard * EPISODES
        write_tables(
            folder,
            shard,
            rows.assign(episode=rows["episode"] + first),
            drivers.assign(episode=drivers["episode"] + first),
        )
    counts = {"rows": shards * len(rows), "drivers": shards * len(drivers), "windows": shards * count_windows(rows)}
    recorded = {"scene": "t_intersection", "scene_digest": "", "p_conservative": 0.5, "population": "traits", "seed": 0}
    write_json(folder / MANIFEST, {"schema_version": SCHEMA_VERSION, "shards": shards, **counts, **recorded})
    return folder


@pytest.fixture(scope="module")
def data(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_dataset(tmp_path_factory.mktemp("data"), shards=3)


def files(folder: Path) -> dict[str, bytes]:
    """Return the files of a folder, apart from the log, which contains the time."""
    return {file.name: file.read_bytes() for file in folder.glob("[!.]*") if file.is_file()}


@pytest.mark.parametrize("method", sorted(TRAIT_METHODS))
def test_the_model_is_the_very_one_of_training_in_memory(data: Path, tmp_path: Path, method: str) -> None:
    settings = replace(SMALL, noise_m=0.05)
    for out, streaming in ((tmp_path / "memory", False), (tmp_path / "file", True)):
        train_traits(data, out, method=method, settings=settings, seed=1, streaming=streaming)
    assert files(tmp_path / "file") == files(tmp_path / "memory")
    card = read_card(tmp_path / "file" / "model.safetensors").entries
    assert card["windows"] == card["data"]["windows"] * 2 / 3


@pytest.mark.parametrize("resumed_streaming", [True, False])
def test_an_interrupted_training_ends_with_the_very_same_model_wherever_its_windows_are(
    data: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, resumed_streaming: bool
) -> None:
    def run(out: str, streaming: bool) -> None:
        train_traits(data, tmp_path / out, settings=SMALL, streaming=streaming)

    run("whole", streaming=True)
    with monkeypatch.context() as interrupted, pytest.raises(KeyboardInterrupt):
        interrupt_at_step(interrupted, 7)  # an epoch has five
        run("broken", streaming=True)
    assert files(tmp_path / "broken").keys() == {"run.json", CHECKPOINT_FILE}
    with monkeypatch.context() as counted:
        interrupt_at_step(counted, 5)
        run("broken", streaming=resumed_streaming)
    assert files(tmp_path / "broken") == files(tmp_path / "whole")


def test_the_command_keeps_windows_in_a_file_with_its_flag(
    data: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    opened: list[Path] = []

    def opening(parts: Iterator[Windows], folder: Path) -> AbstractContextManager[WindowFile]:
        opened.append(folder)
        return window_file(parts, folder)

    monkeypatch.setattr(datasets, "window_file", opening)
    monkeypatch.setitem(TRAIT_BUDGETS, "quick", SMALL)
    command = ["traits", "train", "--data", str(data), "--out", str(tmp_path / "run")]
    assert main([*command, "--streaming"]) == 0
    made = files(tmp_path / "run")
    assert "model.safetensors" in made
    assert main(command) == 0  # it is the same run
    assert files(tmp_path / "run") == made
    assert opened == [tmp_path / "run"]


def test_bad_requests_are_refused_before_the_dataset_is_read(tmp_path: Path) -> None:
    for wrong in ({"method": "theirs"}, {"seed": -1}):
        with pytest.raises(InputError, match=r"unknown trait method|seed must not be negative"):
            train_traits(tmp_path / "nowhere", tmp_path / "run", settings=SMALL, streaming=True, **wrong)


def peak_mib(code: str, *arguments: object) -> float:
    """The most memory that a process took which ran some code."""
    peak = "print(next(line for line in open('/proc/self/status') if line.startswith('VmHWM')).split()[1])"
    command = [sys.executable, "-c", f"{code}\n{peak}", *map(str, arguments)]
    ran = subprocess.run(command, capture_output=True, text=True, check=True)
    return float(ran.stdout.split()[-1]) / 1024


BEGIN_TRAINING = f"""
import sys
from pathlib import Path
import torch
from tint_sumo.config import TraitSettings
from tint_sumo.traits.datasets import train_traits
from tint_sumo.traits.cross_window import CrossWindow
torch.set_num_threads(1)
original, steps = CrossWindow.loss, iter(range(40))
def loss(self, *args):
    if next(steps, None) is None:
        raise KeyboardInterrupt
    return original(self, *args)
CrossWindow.loss = loss
data, out = map(Path, sys.argv[1:])
settings = {replace(SMALL, batch_size=64)}
try:
    train_traits(data, out, method="cross_window", settings=settings, streaming=True)
except KeyboardInterrupt:
    pass
"""
INSPECT = """
import sys
from pathlib import Path
from tint_sumo.dataset.inspection import inspect
inspect(Path(sys.argv[1]), progress=False)
"""


@pytest.fixture(scope="module")
def few_and_many(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path]:
    """Datasets of 3 and of 33 shards, each with 10,240 windows of three steps, which take the room of whole ones."""
    folder = tmp_path_factory.mktemp("sizes")
    few, many = (write_dataset(folder / str(shards), shards, vehicles=640, steps=3) for shards in (3, 33))
    return few, many


@pytest.mark.parametrize("code", [BEGIN_TRAINING, INSPECT], ids=["train", "inspect"])
def test_memory_does_not_grow_with_the_dataset(few_and_many: tuple[Path, Path], tmp_path: Path, code: str) -> None:
    few_mib, many_mib = (peak_mib(code, data, tmp_path / data.name) for data in few_and_many)
    more_mib = 30 * 10_240 * 2 / 3 * 160 / 2**20  # of states to train on
    assert many_mib < few_mib + more_mib * 2 / 3  # the same run twice differs by up to 15 MiB on a busy machine
