"""Trait models as files: NAME.safetensors with the weights and NAME.json, the card that describes them."""

from collections.abc import Mapping
from dataclasses import asdict, dataclass, field, fields, replace
from pathlib import Path
from typing import Annotated, Any

from tint_sumo.config import NO_LEADER_GAP_M, LatentCount, NoLeaderGapM, TraitSettings
from tint_sumo.core.determinism import preserved_random_state
from tint_sumo.core.errors import InputError
from tint_sumo.core.files import read_json, shipped, write_json
from tint_sumo.core.ranges import Range
from tint_sumo.core.structures import FieldError, build
from tint_sumo.core.weights import card_file, find_weights, read_weights, write_weights
from tint_sumo.traits.input_range import InputRange
from tint_sumo.traits.model import TRAIT_METHODS, TraitModel

RUN_MODEL = "model"  # name of the model in the folder of a training run


@dataclass(frozen=True)
class ModelCard:
    """Contents of a card: fields that the code uses, and all entries as they are."""

    method: str
    latent_size: LatentCount
    settings: TraitSettings
    data: dict[str, Any] | None = None  # the training dataset: scene, scene_digest, p_conservative, ...
    seed: Annotated[int, Range(0, 2**64 - 1)] = 0
    input_range: InputRange | None = None
    no_leader_gap_m: NoLeaderGapM = NO_LEADER_GAP_M
    entries: dict[str, Any] = field(default_factory=dict)


_FIELDS = [known.name for known in fields(ModelCard) if known.name != "entries"]


def save(model: TraitModel, stem: Path, card: Mapping[str, Any]) -> None:
    """Write ``stem``.safetensors and ``stem``.json.

    The card holds method, settings and latent size of the model, the checksum of its weights, and whatever else
    ``card`` says about it (data, seed, accuracy). It is written last, so that where there is a card there are weights.
    """
    checksum = write_weights(stem, model.state_dict())
    described = {
        "method": model.method,
        "latent_size": model.latent_size,
        "settings": asdict(model.settings),
        "no_leader_gap_m": model.no_leader_gap_m,
    }
    write_json(card_file(stem), {**card, **described, **checksum})


def load(name_or_path: str | Path, latent_size: int | None = None) -> TraitModel:
    """Return a trained model in evaluation mode, its weights frozen.

    Args:
        name_or_path: folder of a training run, path of a .safetensors file, or name of a shipped model; files that are
            there come before a shipped model of the same name.
        latent_size: the number of latents the caller needs; None accepts any.

    Raises:
        InputError: there is no such model, its files are missing or damaged, the card does not fit the weights, or
            the latent size is another.
    """
    stem = find(name_or_path)
    card = _read_card(stem)
    if latent_size is not None and card.latent_size != latent_size:
        raise InputError(
            f"trait model {name_or_path} has {card.latent_size} latents where {latent_size} are needed; "
            "use a model trained with that latent size"
        )
    weights = read_weights(stem, lambda: _build(card, stem), card.entries)
    model = _build(card, stem)
    try:
        model.load_state_dict(weights)
    except RuntimeError:
        raise InputError(
            f"{card_file(stem)} does not fit the weights beside it; restore both files of the model"
        ) from None
    return model.eval().requires_grad_(False)


def read_card(name_or_path: str | Path) -> ModelCard:
    """Return the card of a model.

    Args:
        name_or_path: as in ``load``.

    Raises:
        InputError: there is no such model, or its card is damaged.
    """
    return _read_card(find(name_or_path))


def require_scene(name_or_path: str | Path, scene: str, digest: str, user: str) -> None:
    """Raise InputError if a model was trained in another scene than its user's, or in another version of it."""
    require_scene_gaps(name_or_path)
    data = read_card(name_or_path).data or {}
    if data.get("scene_digest", digest) != digest:
        raise InputError(
            f"trait model {name_or_path} was trained in scene {data.get('scene')}, {user} is of scene {scene}; "
            "give `other_scene` to use it all the same"
        )


def require_scene_gaps(name_or_path: str | Path) -> None:
    """Raise InputError if a model knows other gaps than scenes have, as it was trained on recorded tracks."""
    limit_m = read_card(name_or_path).no_leader_gap_m
    if limit_m != NO_LEADER_GAP_M:
        raise InputError(
            f"trait model {name_or_path} knows gaps up to {limit_m:g} m, and scenes have gaps up to "
            f"{NO_LEADER_GAP_M:g} m; train one on a dataset"
        )


def add_to_card(name_or_path: str | Path, entries: Mapping[str, Any]) -> None:
    """Add entries, such as an accuracy, to the card of a saved model."""
    stem = find(name_or_path)
    write_json(card_file(stem), {**_read_card(stem).entries, **entries})


def shipped_model(name: str) -> Path:
    """Return the path of a shipped model without its suffixes: that model, whatever the present folder holds."""
    return shipped("models") / name


def find(name_or_path: str | Path) -> Path:
    """Return the path of a model without its suffixes.

    Raises:
        InputError: there is no such model.
    """
    if (stem := find_weights(Path(name_or_path), RUN_MODEL, shipped("models"))) is not None:
        return stem
    known = sorted(file.stem for file in shipped("models").glob("*.safetensors") if _is_trait_model(file))
    raise InputError(
        f"no trait model {name_or_path}; give the folder of a training run, a .safetensors file, "
        f"or a shipped model ({', '.join(known) or 'none is shipped'})"
    )


def _is_trait_model(weights: Path) -> bool:
    try:
        _read_card(weights.with_suffix(""))
    except InputError:
        return False
    return True


def _read_card(stem: Path) -> ModelCard:
    file = card_file(stem)
    entries = read_json(file, "card of the trait model")
    mend = "restore the file or train the model again"
    if str(entries.get("method")) not in TRAIT_METHODS:
        raise InputError(
            f"{file} is not the card of a trait model (methods: {', '.join(sorted(TRAIT_METHODS))}); {mend}"
        )
    try:
        card: ModelCard = build(ModelCard, {name: entries[name] for name in _FIELDS if name in entries})
    except FieldError as error:
        raise InputError(f"{file} is not the card of a trait model ({error}); {mend}") from None
    return replace(card, entries=entries)


def _build(card: ModelCard, stem: Path) -> TraitModel:
    try:
        with preserved_random_state():
            model = TRAIT_METHODS[card.method](card.settings, card.latent_size)
    except (TypeError, ValueError, RuntimeError, IndexError) as error:
        raise InputError(
            f"{card_file(stem)}: unusable settings ({error}); restore the file or train the model again"
        ) from None
    model.no_leader_gap_m = card.no_leader_gap_m
    return model
