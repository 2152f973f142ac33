import json
from dataclasses import replace

import numpy as np
import pytest
import safetensors.torch
import torch

from tests.bombs import BOMBS, bomb
from tint_sumo.core.checkpoints import CHECKPOINT_FILE, PICKLES
from tint_sumo.core.errors import DivergedError, InputError
from tint_sumo.traits import TRAIT_METHODS, load, training
from tint_sumo.traits.classifier import Classifier
from tint_sumo.traits.evaluation import evaluate
from tint_sumo.traits.training import train
from tint_sumo.traits.vae import Vae

from .interruptions import interrupt_at_step
from .scenes import two_populations


@pytest.fixture
def windows(street):
    return street[0]


def assert_same_weights(one, other):
    assert one.state_dict().keys() == other.state_dict().keys()
    for name, value in one.state_dict().items():
        assert torch.equal(value, other.state_dict()[name]), name


def test_other_labels_or_drivers_are_another_run_where_a_method_learns_from_them(street, small, tmp_path):
    windows, conservative = street
    short = replace(small, epochs=1)
    train(windows, short, tmp_path / "labels", method="classifier", conservative=conservative)
    with pytest.raises(InputError, match=r"already holds another run.*windows_sha256"):
        train(windows, short, tmp_path / "labels", method="classifier", conservative=~conservative)
    renamed = replace(windows, driver=windows.driver // 2)
    train(windows, short, tmp_path / "drivers", method="cross_window")
    with pytest.raises(InputError, match=r"already holds another run.*windows_sha256"):
        train(renamed, short, tmp_path / "drivers", method="cross_window")
    same = train(windows, short, tmp_path / "vae")
    assert_same_weights(train(renamed, short, tmp_path / "vae"), same)


def test_a_run_writes_a_model_that_loads_as_trained(windows, small, tmp_path):
    model = train(windows, small, tmp_path / "run", card={"data": {"scene": "street"}})
    assert_same_weights(load(tmp_path / "run"), model)
    assert not model.training
    card = json.loads((tmp_path / "run" / "model.json").read_text())
    assert card["method"] == "vae"
    assert card["latent_size"] == 2
    assert card["data"] == {"scene": "street"}
    assert card["windows"] == len(windows.length)
    assert {path.name for path in (tmp_path / "run").glob("[!.]*")} == {
        *("run.json", "model.json", "model.safetensors", "tensorboard"),
    }


def test_an_interrupted_run_resumes_to_the_very_same_weights(windows, small, tmp_path, monkeypatch):
    whole = train(windows, small, tmp_path / "whole")
    steps_per_epoch = -(-len(windows.length) // small.batch_size)
    monkeypatch.setattr(training, "CHECKPOINT_INTERVAL_S", 0.0)
    with monkeypatch.context() as interrupted, pytest.raises(KeyboardInterrupt):
        interrupt_at_step(interrupted, steps_per_epoch + 3)
        train(windows, small, tmp_path / "broken")
    assert {path.name for path in (tmp_path / "broken").glob("[!.]*")} == {"run.json", CHECKPOINT_FILE, "tensorboard"}

    with monkeypatch.context() as counted:
        interrupt_at_step(counted, 2 * steps_per_epoch)  # the two epochs of three that are left
        resumed = train(windows, small, tmp_path / "broken")
    assert_same_weights(resumed, whole)
    cards = [json.loads((tmp_path / run / "model.json").read_text()) for run in ("whole", "broken")]
    assert cards[0] == cards[1]
    assert not (tmp_path / "broken" / CHECKPOINT_FILE).exists()


def test_a_finished_run_is_loaded_and_not_repeated(windows, small, tmp_path, monkeypatch):
    model = train(windows, small, tmp_path)
    interrupt_at_step(monkeypatch, 0)
    assert_same_weights(train(windows, small, tmp_path), model)


def test_the_seed_decides_the_result_and_the_global_generator_is_left_alone(windows, small, tmp_path):
    torch.manual_seed(5)
    expected = torch.rand(1)
    torch.manual_seed(5)
    first = train(windows, small, tmp_path / "a", seed=7)
    assert torch.equal(torch.rand(1), expected)
    assert_same_weights(train(windows, small, tmp_path / "b", seed=7), first)
    other = train(windows, small, tmp_path / "c", seed=8)
    assert not torch.equal(other.encoder.mean_head.weight, first.encoder.mean_head.weight)


@pytest.mark.parametrize("change", ["seed", "settings", "windows"])
def test_a_folder_of_another_run_is_refused_and_kept(windows, small, tmp_path, change):
    train(windows, small, tmp_path)
    before = {path: path.read_bytes() for path in tmp_path.rglob("*") if path.is_file()}
    settings = replace(small, epochs=9) if change == "settings" else small
    shifted = replace(windows, states=windows.states + np.float32(0.5)) if change == "windows" else windows
    with pytest.raises(InputError, match=f"already holds another run.*{change}"):
        train(shifted, settings, tmp_path, seed=int(change == "seed"))
    assert {path: path.read_bytes() for path in tmp_path.rglob("*") if path.is_file()} == before


def test_a_damaged_checkpoint_is_reported(windows, small, tmp_path, monkeypatch):
    monkeypatch.setattr(training, "CHECKPOINT_INTERVAL_S", 0.0)
    with monkeypatch.context() as interrupted, pytest.raises(KeyboardInterrupt):
        interrupt_at_step(interrupted, 10)
        train(windows, small, tmp_path)
    checkpoint = tmp_path / CHECKPOINT_FILE
    checkpoint.write_bytes(checkpoint.read_bytes()[:1000])
    with pytest.raises(InputError, match=r"checkpoint\.safetensors is damaged or of another version .*; remove it"):
        train(windows, small, tmp_path)


@pytest.mark.parametrize("kind", BOMBS)
@pytest.mark.parametrize("name", [CHECKPOINT_FILE, *PICKLES])
def test_no_checkpoint_can_run_code(windows, small, tmp_path, monkeypatch, kind, name):
    with monkeypatch.context() as interrupted, pytest.raises(KeyboardInterrupt):
        interrupt_at_step(interrupted, 0)
        train(windows, small, tmp_path / "run")
    (tmp_path / "run" / name).write_bytes(bomb(kind, tmp_path / "marker"))
    with pytest.raises(InputError, match=f"{name} is .*; remove it to begin the training anew"):
        train(windows, small, tmp_path / "run")
    assert not (tmp_path / "marker").exists()


def spoilt(windows, value):
    states = windows.states.copy()
    states[3, 0, 0] = value
    return replace(windows, states=states)


@pytest.mark.parametrize("method", sorted(TRAIT_METHODS))
@pytest.mark.parametrize(
    ("change", "value", "step"),
    [
        ({"learning_rate": 1e6}, 0.0, r"[1-9]\d*"),
        ({}, np.nan, "0"),
        ({}, np.inf, "0"),
    ],
)
def test_a_training_that_diverges_says_at_which_step_and_keeps_the_last_finite_model(
    street, small, tmp_path, method, change, value, step
):
    if method == "classifier" and "learning_rate" in change:
        pytest.skip("the logistic loss of such weights is finite")
    windows, conservative = street
    labels = conservative if TRAIT_METHODS[method].uses_labels else None
    settings = replace(small, **change)
    with pytest.raises(DivergedError, match=rf"^the training diverged at step {step}: .*not finite[^\n]*$"):
        train(spoilt(windows, value), settings, tmp_path, method=method, conservative=labels)
    assert not (tmp_path / "model.json").exists()
    if step != "0":
        tensors = safetensors.torch.load_file(tmp_path / CHECKPOINT_FILE)
        assert all(tensor.isfinite().all() for tensor in tensors.values())


def test_bad_requests_leave_no_folder(windows, small, tmp_path):
    with pytest.raises(InputError, match="unknown trait method"):
        train(windows, small, tmp_path / "run", method="theirs")
    nothing = replace(windows, **{name: value[:0] for name, value in vars(windows).items()})
    with pytest.raises(InputError, match="no windows to train on"):
        train(nothing, small, tmp_path / "run")
    assert not (tmp_path / "run").exists()


def test_progress_is_reported_in_windows_with_the_loss(windows, small, tmp_path):
    reported = []
    train(windows, small, tmp_path, report=reported.append)
    count = len(windows.length)
    assert {(progress.total, progress.unit) for progress in reported} == {(small.epochs * count, "window")}
    assert [progress.done for progress in reported] == sorted({progress.done for progress in reported})
    assert (reported[0].done, reported[0].measures) == (0, {})
    assert reported[-1].done == small.epochs * count
    card = json.loads((tmp_path / "model.json").read_text())
    assert reported[-1].measures == {"loss": pytest.approx(card["loss"]["total"])}


def test_the_learning_rate_decays_linearly_to_zero(windows, small, tmp_path, monkeypatch):
    rates = []
    original = torch.optim.Adam.step

    def step(self, *args, **kwargs):
        rates.append(self.param_groups[0]["lr"])
        return original(self, *args, **kwargs)

    monkeypatch.setattr(torch.optim.Adam, "step", step)
    train(windows, replace(small, epochs=2), tmp_path)
    count = 2 * -(-len(windows.length) // small.batch_size)
    assert rates == pytest.approx([small.learning_rate * (1.0 - number / count) for number in range(count)])


def test_large_networks_train_in_bfloat16(windows, small, tmp_path):
    settings = replace(small, hidden_size=training.BFLOAT16_HIDDEN_SIZE, epochs=1)
    model = train(windows, settings, tmp_path)
    assert all(value.dtype == torch.float32 and value.isfinite().all() for value in model.state_dict().values())


@pytest.mark.parametrize("method", ["classifier", "vae", "cross_window"])  # morton learns nothing from constant speed
def test_two_populations_separate(small, tmp_path, method):
    windows, slow = two_populations(1000)
    labels = slow if TRAIT_METHODS[method].uses_labels else None
    settings = replace(small, hidden_size=16, learning_rate=1e-2, epochs=8)
    model = train(windows, settings, tmp_path, method=method, conservative=labels)
    assert evaluate(model, windows, slow).accuracy > 0.95
    if isinstance(model, Classifier):
        mean, _ = model.encode(torch.from_numpy(windows.states), torch.from_numpy(windows.length))
        predicted = model.logit(mean).numpy() > 0.0
        assert (predicted == slow).mean() > 0.95, "positive log-odds are those of the drivers with a true label"


def test_only_the_classifier_gets_labels(windows, small, tmp_path):
    assert [name for name, method in TRAIT_METHODS.items() if method.uses_labels] == ["classifier"]
    for method in TRAIT_METHODS:
        labels = None if TRAIT_METHODS[method].uses_labels else np.ones(len(windows), bool)
        with pytest.raises(ValueError, match="labels are for the methods that learn with them"):
            train(windows, small, tmp_path / method, method=method, conservative=labels)


def test_noise_is_drawn_anew_in_every_epoch_from_the_seed(windows, small, tmp_path, monkeypatch):
    seen = []
    original = Vae.loss

    def loss(self, batch, generator):
        seen.append(batch.states.sum().item())
        return original(self, batch, generator)

    monkeypatch.setattr(Vae, "loss", loss)
    one_batch = replace(small, batch_size=len(windows), epochs=2, noise_m=0.1)
    first = train(windows, one_batch, tmp_path / "first")
    assert seen[0] != pytest.approx(seen[1], abs=1e-3)
    again = train(windows, one_batch, tmp_path / "again")
    assert_same_weights(first, again)
    clean = train(windows, replace(one_batch, noise_m=0.0), tmp_path / "clean")
    assert clean.feature_scale[0] < first.feature_scale[0]
