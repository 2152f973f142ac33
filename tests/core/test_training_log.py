"""TensorBoard logs of trainings, read back as TensorBoard reads them."""

import io
import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator
from tensorboard.plugins.hparams.metadata import PLUGIN_NAME

from tint_sumo.cli import main
from tint_sumo.config import Mix, PolicySettings, PpoSettings, TraitSettings
from tint_sumo.core.progress import Progress
from tint_sumo.core.structures import plain as plain_of
from tint_sumo.dataset.windows import Windows
from tint_sumo.methods.training import train_policy
from tint_sumo.scenes import find_scene
from tint_sumo.traits.training import train

SMALL = PolicySettings((8,), (8,), 8, (8,), 8, (8,))
TINY = PpoSettings(n_envs=4, n_steps=16, n_minibatches=2, n_epochs=1, policy=SMALL, time_limit_s=2.0)


def read(run: Path) -> EventAccumulator:
    log = EventAccumulator(str(run / "tensorboard"))
    log.Reload()
    return log


def gif_of(policy: Path) -> bytes:
    """A picture whose width tells which policy it is of."""
    data = io.BytesIO()
    Image.new("RGB", (len(policy.stem), 2)).save(data, format="GIF")
    return data.getvalue()


def test_a_policy_s_log_holds_outcomes_settings_and_a_film_of_every_kept_policy(tmp_path: Path) -> None:
    train_policy("no_labels", Mix(0.4), 256, 0, tmp_path, settings=TINY, film=gif_of)
    log = read(tmp_path)
    assert {f"rollout/{outcome}" for outcome in ("success", "timeout", "collision")} <= set(log.Tags()["scalars"])
    films = [(film.step, film.width) for film in log.Images("film")]
    assert films == [(64, len("policy-25")), (128, len("policy-50")), (256, len("policy"))]
    assert log.PluginTagToContent(PLUGIN_NAME), "TensorBoard's tab of hyperparameters has something to show"


def test_the_command_line_films_a_training_and_gives_the_policy_that_python_gives(tmp_path: Path) -> None:
    """The films of a training that holds libsumo run through TraCI. Threads are those of a usual Python."""
    torch.set_num_threads(2)
    try:
        scene = replace(find_scene("t_intersection"), time_limit_s=2.0)
        plain = train_policy("oracle", Mix(0.4), 256, 0, tmp_path / "plain", settings=TINY, scene=scene)
    finally:
        torch.set_num_threads(1)
    config = tmp_path / "train.yaml"
    settings = {"method": "oracle", "p_conservative": 0.4, "steps": 256, "scene": {"time_limit_s": 2.0}}
    config.write_text(json.dumps({**settings, "budget": plain_of(TINY)}))
    out = tmp_path / "filmed"
    assert main(["policy", "train", "--config", str(config), "--out", str(out)]) == 0
    assert (out / "policy.safetensors").read_bytes() == plain.read_bytes()
    films = read(out).Images("film")
    assert len(films) == 3
    with Image.open(io.BytesIO(films[-1].encoded_image_string)) as film:
        assert film.format == "GIF" and getattr(film, "n_frames", 1) == 21


def test_an_interrupted_training_goes_on_with_the_same_curves(tmp_path: Path) -> None:
    def interrupt(progress: Progress) -> None:
        if progress.done >= 128:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        train_policy("no_labels", Mix(0.4), 256, 0, tmp_path, settings=TINY, report=interrupt)
    train_policy("no_labels", Mix(0.4), 256, 0, tmp_path, settings=TINY)
    steps = [event.step for event in read(tmp_path).Scalars("train/loss")]
    assert steps[-1] == 256 and steps == sorted(set(steps))


def random_windows(count: int) -> Windows:
    states = np.random.default_rng(0).random((count, 20, 2)).astype(np.float32)
    number = np.arange(count)
    return Windows(states, np.full(count, 20), number, number, np.ones(count, bool))


def test_a_trait_model_s_log_holds_each_epoch_s_loss_and_the_settings(tmp_path: Path) -> None:
    settings = TraitSettings((4,), 8, 8, 8, batch_size=64, epochs=3)
    train(random_windows(128), settings, tmp_path, method="vae", seed=0)
    log = read(tmp_path)
    losses = log.Scalars("loss/total")
    assert [loss.step for loss in losses] == [1, 2, 3]
    assert np.isfinite([loss.value for loss in losses]).all()
    assert {"loss/kl", "loss/reconstruction"} <= set(log.Tags()["scalars"])
    assert log.PluginTagToContent(PLUGIN_NAME)
