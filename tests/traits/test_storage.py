import json
from dataclasses import asdict, replace
from pathlib import Path

import pytest
import torch

from tint_sumo.core.errors import InputError
from tint_sumo.traits import load, storage
from tint_sumo.traits.input_range import InputRange
from tint_sumo.traits.storage import add_to_card, find, read_card, save, shipped_model
from tint_sumo.traits.vae import Vae


@pytest.fixture
def model(small) -> Vae:
    model = Vae(small)
    model.feature_mean.copy_(torch.tensor([0.25, 9.0]))
    return model


@pytest.fixture
def saved(model, tmp_path):
    """Folder of a saved run."""
    save(model, tmp_path / "run" / "model", {"seed": 4})
    return tmp_path / "run"


@pytest.fixture
def shelf(model, tmp_path, monkeypatch):
    """A folder of shipped models: ``vae`` and ``older``, and a file that is none."""
    folder = tmp_path / "models"
    for name in ("vae", "older"):
        save(model, folder / name, {})
    (folder / "policy.safetensors").write_bytes(b"")
    (folder / "policy.json").write_text('{"method": "ppo"}')
    monkeypatch.setattr(storage, "shipped", lambda name: folder)
    return folder


def assert_same_encoding(one, other, street):
    states, length = (torch.from_numpy(part[:50]) for part in (street[0].states, street[0].length))
    for left, right in zip(one.encode(states, length), other.encode(states, length), strict=True):
        assert torch.equal(left, right)


@pytest.mark.parametrize("path", [".", "model.safetensors", "model"])
def test_a_saved_model_encodes_as_before(saved, model, street, path):
    loaded = load(saved / path)
    assert_same_encoding(loaded, model, street)
    assert loaded.settings == model.settings
    assert not loaded.training
    assert not any(parameter.requires_grad for parameter in loaded.parameters())


def test_shipped_models_are_found_by_name(shelf, model, street):
    assert_same_encoding(load("vae"), model, street)


def test_files_of_the_user_come_before_shipped_models_of_their_name(shelf, small, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "older").mkdir()
    save(Vae(small), tmp_path / "vae" / "model", {"seed": 5})
    assert find("older") == shelf / "older", "a folder without a model"
    assert find("vae") == find("./vae") == Path("vae/model")
    assert read_card("vae").seed == 5
    assert find(shipped_model("vae")) == shelf / "vae"


def test_an_unknown_name_is_answered_with_the_shipped_trait_models(shelf):
    with pytest.raises(InputError, match=r"no trait model theirs; .* shipped model \(older, vae\)"):
        load("theirs")


@pytest.mark.parametrize("name", ["", ".", "/"])
def test_a_path_that_names_no_model_is_refused(shelf, name):
    with pytest.raises(InputError, match="no trait model"):
        load(name)


def test_another_latent_size_than_needed_is_refused(small, tmp_path):
    save(Vae(small, latent_size=3), tmp_path / "model", {})
    assert load(tmp_path).latent_size == 3
    with pytest.raises(InputError, match="has 3 latents where 2 are needed"):
        load(tmp_path, latent_size=2)


@pytest.mark.parametrize("kept", [0, 4, 200, -50])
def test_damaged_weights_are_reported(saved, kept):
    weights = saved / "model.safetensors"
    weights.write_bytes(weights.read_bytes()[:kept])
    with pytest.raises(InputError, match=r"model\.safetensors is damaged"):
        load(saved)


def test_a_missing_or_unreadable_card_is_reported(saved):
    (saved / "model.json").write_text('{"method": ')
    with pytest.raises(InputError, match=r"model\.json is damaged"):
        load(saved)
    (saved / "model.json").unlink()
    with pytest.raises(InputError, match=r"no file .*model\.json"):
        load(saved)


@pytest.mark.parametrize("entry", [{"method": "theirs"}, {"latent_size": "two"}, {"settings": [1]}, {"method": None}])
def test_a_card_of_something_else_is_reported(saved, entry):
    add_directly(saved, entry)
    with pytest.raises(InputError, match="is not the card of a trait model"):
        load(saved)


def add_directly(saved, entry):
    card = json.loads((saved / "model.json").read_text())
    (saved / "model.json").write_text(json.dumps({**card, **entry}))


def test_a_card_that_does_not_fit_the_weights_is_reported(saved, small):
    add_directly(saved, {"settings": vars(replace(small, hidden_size=9))})
    with pytest.raises(InputError, match="does not fit the weights"):
        load(saved)


@pytest.mark.parametrize("settings", [{"depth": 3}, {"embedding_sizes": [-1]}, {"hidden_size": "many"}])
def test_unusable_settings_are_reported(saved, settings):
    add_directly(saved, {"settings": settings})
    with pytest.raises(InputError, match="settings"):
        load(saved)


def test_the_card_keeps_its_entries_and_takes_additions(saved):
    add_to_card(saved, {"accuracy": 0.99})
    card = read_card(saved)
    assert (card.method, card.latent_size, card.seed, card.entries["accuracy"]) == ("vae", 2, 4, 0.99)
    assert load(saved).latent_size == 2


def test_a_card_keeps_the_range_of_the_training_windows(saved, street):
    windows, _ = street
    reach = InputRange.of(windows.parts())
    assert read_card(saved).input_range is None
    add_to_card(saved, {"input_range": asdict(reach)})
    assert read_card(saved).input_range == reach


@pytest.mark.parametrize("broken", [1, {}, {"low_gap_m": [0.0] * 20}, "short", "text"])
def test_a_damaged_range_is_refused(saved, broken):
    steps = {"short": [0.0] * 19, "text": ["far"] * 20}.get(str(broken))
    names = ("low_offset_m", "high_offset_m", "low_gap_m", "high_gap_m")
    add_directly(saved, {"input_range": dict.fromkeys(names, steps) if steps else broken})
    with pytest.raises(InputError, match=r"is not the card of a trait model \(input_range.*restore the file"):
        load(saved)
