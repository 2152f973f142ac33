"""Model cards in the form of Hugging Face, checked by its own library without a network."""

import json
from pathlib import Path

import pandas
import pytest

from tint_sumo import traits
from tint_sumo.config import ALL_MIXES, PpoSettings, TraitSettings
from tint_sumo.envs.rows import BUILT_IN_OUTCOMES
from tint_sumo.methods.exporting import export_policy, export_traits
from tint_sumo.methods.loading import load_policy
from tint_sumo.methods.shipped import ShippedModel, models_named, shipped_models
from tint_sumo.methods.training import train_policy
from tint_sumo.traits.storage import save

huggingface_hub = pytest.importorskip("huggingface_hub", reason='needs: pip install "tint_sumo[dev]"')
NAVIGATION = Path(__file__).parents[2] / "data" / "results" / "navigation.csv"


def read(file: Path) -> "huggingface_hub.ModelCard":
    """The card, whose results must be in the form that the hub shows."""
    card = huggingface_hub.ModelCard.load(file, ignore_metadata_errors=False)
    for one in card.data.eval_results or []:
        one.__post_init__()
        assert 0.0 <= one.metric_value <= 1.0
    assert (card.data.license, card.data.library_name) == ("mit", "tint_sumo")
    assert all(f"## {title}" in card.text for title in ("Training", "Measured", "Limits", "How to use it", "Licence"))
    return card


@pytest.mark.parametrize("model", shipped_models(), ids=lambda one: f"{one.kind}-{one.name}")
def test_shipped_cards_are_those_that_the_code_makes_and_hugging_face_reads(model: ShippedModel) -> None:
    assert model.page_file.read_text() == model.page(), "run scripts/make_cards.py"
    card = read(model.page_file)
    assert card.data.model_name == model.name
    assert card.data.pipeline_tag in ("reinforcement-learning", "feature-extraction")
    assert card.data.eval_results


def test_results_in_cards_are_those_of_the_study() -> None:
    measured = pandas.read_csv(NAVIGATION)
    (model,) = (one for one in models_named("streaming") if one.kind == "policy")
    found = {(one.dataset_name, one.metric_type): one.metric_value for one in read(model.page_file).data.eval_results}
    plain = measured[(measured.method == "streaming") & (measured.training_percent == 100) & (measured.tau_s == 1)]
    plain = plain[(plain.position_noise_m == 0) & ~plain.p_conservative.astype(str).str.contains("to")]
    assert len(found) == len(BUILT_IN_OUTCOMES) * len(plain) == 15
    for row in plain.to_dict("records"):
        dataset = f"tint_sumo/TIntersection-v1, P {float(row['p_conservative']):g} (share of conservative drivers)"
        for outcome in BUILT_IN_OUTCOMES:
            share = found[dataset, f"{outcome}_rate"]
            assert 100.0 * share == pytest.approx(row[f"{outcome}_percent"], abs=0.006)


def test_folders_of_own_models_have_cards_too_and_can_be_pushed(tmp_path: Path, tiny: PpoSettings) -> None:
    train_policy("no_labels", ALL_MIXES, 64, 0, tmp_path / "run", settings=tiny)
    model = traits.TRAIT_METHODS["vae"](TraitSettings(), 2)
    save(model, tmp_path / "mine", {"seed": 1})
    files = export_policy(load_policy(tmp_path / "run"), tmp_path / "policy")
    files += export_traits(tmp_path / "mine.safetensors", tmp_path / "traits")
    for folder in ("policy", "traits"):
        card = read(tmp_path / folder / "README.md")
        assert card.data.eval_results is None
        assert "has not been measured yet" in card.text
    assert "Windows of the scene (not noted)" in card.text
    for file in files:
        added = huggingface_hub.CommitOperationAdd(path_in_repo=file.name, path_or_fileobj=file)
        assert added.upload_info.size == file.stat().st_size > 0


def test_the_page_of_a_model_of_recorded_drivers_says_so(tmp_path: Path) -> None:
    model = traits.TRAIT_METHODS["vae"](TraitSettings(), 2)
    recorded = {"tracks": "motorway.csv", "pairs": 9, "drivers": 5}
    save(model, tmp_path / "recorded", {"recorded": recorded, "windows": 1200})
    save(model, tmp_path / "drawn", {"recorded": {**recorded, "drawn": 400, "model": "IDM"}, "windows": 1200})
    pages = {
        name: " ".join(export_traits(tmp_path / f"{name}.safetensors", tmp_path / f"{name}_out")[0].read_text().split())
        for name in ("recorded", "drawn")
    }
    assert "1,200 windows of recorded traffic, motorway.csv; 1000 epochs" in pages["recorded"]
    assert "1,200 windows of 400 drivers drawn from the IDM fit of recorded traffic, motorway.csv;" in pages["drawn"]


def test_a_card_without_the_defaults_of_its_settings_has_a_page(tmp_path: Path) -> None:
    save(traits.TRAIT_METHODS["vae"](TraitSettings(), 2), tmp_path / "mine", {})
    card = json.loads((tmp_path / "mine.json").read_text())
    del card["settings"]["epochs"]
    (tmp_path / "mine.json").write_text(json.dumps(card))
    assert "1000 epochs" in export_traits(tmp_path / "mine.safetensors", tmp_path / "out")[0].read_text()
