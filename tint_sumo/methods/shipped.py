"""The models that the package ships, with their cards."""

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from tint_sumo.config import WORLDS, Mix
from tint_sumo.core.errors import find_named
from tint_sumo.core.files import read_json, shipped
from tint_sumo.core.percentages import percent
from tint_sumo.methods.model_cards import policy_page, traits_page

_FOLDERS = {"trait model": ".", "policy": "policies"}  # by kind, in the folder of the models
_SHOWN_MIXES = ("P 0.25", "P 0.4", "P 0.6")  # of the results in a policy's card
_SHOWN_WORLDS = ("old", "held_out_towns")  # of one that drives among strangers


@dataclass(frozen=True)
class ShippedModel:
    """A model, and in a few words how it was trained and how good it is."""

    name: str
    kind: str  # "trait model" or "policy"
    method: str
    scene: str
    training: str
    result: str
    card: Mapping[str, Any]

    def summary(self) -> dict[str, str]:
        """Return all but the card."""
        return {key: value for key, value in vars(self).items() if key != "card"}

    def page(self) -> str:
        """Return the model's card in the form of Hugging Face."""
        return (policy_page if self.kind == "policy" else traits_page)(self.name, self.card)

    @property
    def page_file(self) -> Path:
        """File of that card, beside the weights."""
        return shipped("models") / _FOLDERS[self.kind] / f"{self.name}.md"


def shipped_models() -> list[ShippedModel]:
    """Return all models that are shipped, trait models first, by name.

    Raises:
        InputError: a card is damaged.
    """
    return [
        _described(kind, weights, weights.relative_to(shipped("models") / folder).with_suffix("").as_posix())
        for kind, folder in _FOLDERS.items()
        for weights in _weights(shipped("models") / folder, kind)
    ]


def _weights(folder: Path, kind: str) -> list[Path]:
    """Return the files of a kind of models; policies of other worlds than the old one are in folders of these."""
    found = folder.rglob("*.safetensors") if kind == "policy" else folder.glob("*.safetensors")
    return sorted(found, key=lambda file: (len(file.parts), file.name))


def models_named(name: str) -> list[ShippedModel]:
    """Return the models of a name: a trait model, a policy, or one of each.

    Raises:
        InputError: none has it.
    """
    by_name: dict[str, list[ShippedModel]] = {}
    for model in shipped_models():
        by_name.setdefault(model.name, []).append(model)
    return find_named("shipped model", name, by_name)


def models_table(models: Sequence[ShippedModel]) -> str:
    """Return a line for each model, below a line of headings."""
    rows = [list(models[0].summary()), *(list(model.summary().values()) for model in models)]
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    return "\n".join("  ".join(map(str.ljust, row, widths)).rstrip() for row in rows)


def card_text(model: ShippedModel) -> str:
    """Return a model's card as JSON, below what it is."""
    return f"{model.kind} {model.name}\n{json.dumps(model.card, indent=2)}"


def _described(kind: str, weights: Path, name: str) -> ShippedModel:
    card = read_json(weights.with_suffix(".json"), f"card of the {kind}")
    if kind == "policy":
        scene, training, result = card["scene"], _policy_training(card), _policy_result(card["results"])
    else:
        data, settings = card["data"], card["settings"]
        scene = data["scene"]
        mix = Mix.parse(data["p_conservative"]).text
        training = f"{card['windows']:,} windows, P {mix}, {settings['epochs']} epochs"
        result = f"{percent(card['accuracy'])}% of windows (linear SVC, noise {settings['noise_m']:g} m)"
    return ShippedModel(name, kind, card["method"], scene, training, result, card)


def _policy_training(card: Mapping[str, Any]) -> str:
    traits = f", traits of {card['traits']}" if card["traits"] else ""
    sensors = f", {len(card['sensors'])} sensors" if "sensors" in card else ""
    mix = Mix.parse(card["p_conservative"]).text
    return f"{card['steps']:,} decisions, P {mix}, seed {card['seed']}{traits}{sensors}"


def _policy_result(results: Mapping[str, Any]) -> str:
    mixes = [(mix, f"at {mix}") for mix in _SHOWN_MIXES if mix in results]
    worlds = [(world, f"in {WORLDS[world].title}") for world in _SHOWN_WORLDS if world in results]
    shown = [f"{percent(results[key]['success'])}% {where}" for key, where in mixes or worlds]
    seeds = len(next(iter(results.values()))["seeds"])
    return f"success {', '.join(shown)} ({f'mean of {seeds} seeds' if seeds > 1 else '1 seed'})"
