"""Trait models as files: NAME.safetensors with the weights and NAME.json, the card that says what they are."""

from collections.abc import Mapping
from dataclasses import asdict, dataclass, fields
from pathlib import Path
from typing import Annotated, Any

from tint_sumo.config import LatentCount, TraitSettings
from tint_sumo.core.determinism import preserved_random_state
from tint_sumo.core.errors import InputError, refuse_old_name
from tint_sumo.core.files import read_json, shipped, write_json
from tint_sumo.core.ranges import Range
from tint_sumo.core.structures import FieldError, build
from tint_sumo.core.weights import read_weights, write_weights
from tint_sumo.traits.model import TRAIT_METHODS, TraitModel

RUN_MODEL = "model"  # name of the model in the folder of a training run


def save(model: TraitModel, stem: Path, card: Mapping[str, Any]) -> None:
    """Write ``stem``.safetensors and ``stem``.json.

    The card holds method, settings and latent size of the model, the checksum of its weights, and whatever else
    ``card`` says about it (data, seed, accuracy). It is written last, so that where there is a card there are weights.
    """
    checksum = write_weights(_weights_file(stem), model.state_dict())
    described = {"method": model.method, "latent_size": model.latent_size, "settings": asdict(model.settings)}
    write_json(_card_file(stem), {**card, **described, **checksum})


def load(name_or_path: str | Path, latent_size: int | None = None) -> TraitModel:
    """A trained model in evaluation mode, its weights frozen.

    Args:
        name_or_path: name of a shipped model, folder of a training run, or path of a .safetensors file.
        latent_size: the number of latents the caller needs; None accepts any.

    Raises:
        InputError: there is no such model, its files are missing or damaged, the card does not fit the weights, or
            the latent size is another.
    """
    stem = find(name_or_path)
    card = _checked_card(stem)
    if latent_size is not None and card["latent_size"] != latent_size:
        raise InputError(
            f"trait model {name_or_path} has {card['latent_size']} latents where {latent_size} are needed; "
            "use a model trained with that latent size"
        )
    weights = read_weights(_weights_file(stem), _card_file(stem), lambda: _build(card, stem), card)
    model = _build(card, stem)
    try:
        model.load_state_dict(weights)
    except RuntimeError:
        raise InputError(
            f"{_card_file(stem)} does not fit the weights beside it; restore both files of the model"
        ) from None
    return model.eval().requires_grad_(False)


def read_card(name_or_path: str | Path) -> dict[str, Any]:
    """The card of a model, found as in ``load``."""
    return _checked_card(find(name_or_path))


def require_scene(name_or_path: str | Path, scene: str, digest: str, user: str) -> None:
    """Raise InputError if a model was trained in another scene than its user is of, or in another version of it."""
    data = read_card(name_or_path).get("data") or {}
    if data.get("scene_digest", digest) != digest:
        raise InputError(
            f"trait model {name_or_path} was trained in scene {data.get('scene')}, {user} is of scene {scene}; "
            "give `other_scene` to use it all the same"
        )


def add_to_card(name_or_path: str | Path, entries: Mapping[str, Any]) -> None:
    """Add what was found out about a saved model, such as its accuracy, to its card."""
    stem = find(name_or_path)
    write_json(_card_file(stem), {**_checked_card(stem), **entries})


def find(name_or_path: str | Path) -> Path:
    """The path of a model without its suffixes.

    Raises:
        InputError: there is no such model.
    """
    given = Path(name_or_path)
    weights = given.with_suffix("") if given.suffix == ".safetensors" else given
    for stem in (shipped("models") / given, given / RUN_MODEL, weights):
        if stem.name and _weights_file(stem).is_file():
            return stem
    refuse_old_name(name_or_path)
    known = sorted(file.stem for file in shipped("models").glob("*.safetensors") if _is_trait_model(file))
    raise InputError(
        f"no trait model {name_or_path}; give the folder of a training run, a .safetensors file, "
        f"or a shipped model ({', '.join(known) or 'none is shipped'})"
    )


def _is_trait_model(weights: Path) -> bool:
    try:
        _checked_card(weights.with_suffix(""))
    except InputError:
        return False
    return True


@dataclass(frozen=True)
class _Described:
    """What a card must say of its model; it may say more."""

    method: str
    latent_size: LatentCount
    settings: TraitSettings
    data: dict[str, Any] | None = None
    seed: Annotated[int, Range(0, 2**64 - 1)] = 0


def _checked_card(stem: Path) -> dict[str, Any]:
    card = read_json(_card_file(stem), "card of the trait model")
    if str(card.get("method")) not in TRAIT_METHODS:
        raise InputError(
            f"{_card_file(stem)} is not the card of a trait model (methods: {', '.join(sorted(TRAIT_METHODS))}); "
            "restore the file or train the model again"
        )
    _described(card, stem)
    return card


def _described(card: Mapping[str, Any], stem: Path) -> _Described:
    try:
        known = {field.name: card[field.name] for field in fields(_Described) if field.name in card}
        found: _Described = build(_Described, known)
    except FieldError as error:
        raise InputError(
            f"{_card_file(stem)} is not the card of a trait model: unusable settings ({error}); "
            "restore the file or train the model again"
        ) from None
    return found


def _build(card: Mapping[str, Any], stem: Path) -> TraitModel:
    found = _described(card, stem)
    try:
        with preserved_random_state():
            return TRAIT_METHODS[found.method](found.settings, found.latent_size)
    except (TypeError, ValueError, RuntimeError, IndexError) as error:
        raise InputError(
            f"{_card_file(stem)}: unusable settings ({error}); restore the file or train the model again"
        ) from None


def _weights_file(stem: Path) -> Path:
    return stem.with_name(stem.name + ".safetensors")


def _card_file(stem: Path) -> Path:
    return stem.with_name(stem.name + ".json")
