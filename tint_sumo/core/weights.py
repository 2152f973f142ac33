"""Weights of networks as safetensors files, which cannot hold code; their sizes are known before they are read."""

import hashlib
import sys
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import safetensors.torch
import torch
from safetensors import SafetensorError, safe_open
from torch import Tensor, nn

from tint_sumo.core.errors import InputError
from tint_sumo.core.files import read_json, write_bytes, write_json
from tint_sumo.core.reading import WEIGHTS_BYTES, read_file, require_file

SHA256 = "weights_sha256"  # a card's entry with the checksum of the weights beside it
_TYPES = {"F32": torch.float32, "F64": torch.float64, "I64": torch.int64, "BOOL": torch.bool}


def weights_file(stem: Path) -> Path:
    """Return the file of the weights of a model, which is given without its suffix."""
    return stem.with_name(stem.name + ".safetensors")


def card_file(stem: Path) -> Path:
    """Return the file of the card that describes a model, which is given without its suffix."""
    return stem.with_name(stem.name + ".json")


def find_weights(given: Path, in_run: str, shipped_folder: Path) -> Path | None:
    """Return the path of a model without its suffix; None if there is none.

    The files of the user come before the shipped ones, so that a folder may be called like a shipped model.

    Args:
        given: folder of a training run, file of weights, or name of a shipped model.
        in_run: name of the model in the folder of a run.
        shipped_folder: the folder of the shipped models.
    """
    weights = given.with_suffix("") if given.suffix == ".safetensors" else given
    stems = (given / in_run, weights, shipped_folder / given)
    return next((stem for stem in stems if stem.name and weights_file(stem).is_file()), None)


def write_weights(stem: Path, weights: Mapping[str, Tensor]) -> dict[str, str]:
    """Write the weights of a model; return the card's entries about the file."""
    content = safetensors.torch.save(dict(weights))
    write_bytes(weights_file(stem), content)
    return {SHA256: hashlib.sha256(content).hexdigest()}


def read_weights(stem: Path, build: Callable[[], nn.Module], card: Mapping[str, Any]) -> dict[str, Tensor]:
    """Return the weights of a model.

    The header of the file is read first, and compared with the network that the card describes, before any memory is
    taken for that network.

    Args:
        stem: path of the model without its suffix.
        build: makes the network; it is called to look at the sizes of weights alone.
        card: content of the card; weights without a checksum there are read, with a line on stderr.

    Raises:
        InputError: the file is missing, damaged, not the one that the card describes, or holds a number that is not
            finite; or ``build`` raises it.
    """
    file, described = weights_file(stem), card_file(stem)
    require_file(file, "weights", WEIGHTS_BYTES)
    with torch.device("meta"):
        wanted = {name: (tensor.dtype, tuple(tensor.shape)) for name, tensor in build().state_dict().items()}
    damaged = f"{file} is damaged; restore the file or train the model again"
    try:
        with safe_open(file, framework="pt") as header:
            slices = {name: header.get_slice(name) for name in header.keys()}  # noqa: SIM118 - no mapping
            found = {name: (_TYPES.get(part.get_dtype()), tuple(part.get_shape())) for name, part in slices.items()}
    except (OSError, SafetensorError):
        raise InputError(damaged) from None
    if any(wanted.get(name) != form for name, form in found.items()):
        raise InputError(f"{described} does not fit the weights beside it; restore both files")
    content = read_file(file, "weights", WEIGHTS_BYTES)
    if SHA256 not in card:
        print(f"{described} has no checksum of the weights, which are not verified", file=sys.stderr)
    elif card[SHA256] != hashlib.sha256(content).hexdigest():
        raise InputError(f"{file} is damaged: it has another checksum than {described.name} says; restore both files")
    try:
        weights = safetensors.torch.load(content)
    except SafetensorError:
        raise InputError(damaged) from None
    for name, tensor in weights.items():
        if not torch.isfinite(tensor).all():
            raise InputError(
                f"{file} has numbers that are not finite in {name}; restore the file or train the model again"
            )
    return weights


def add_checksum(file: Path) -> None:
    """Write the checksum of weights into the card beside them.

    Raises:
        InputError: one of the two is missing or damaged.
    """
    card = file.with_suffix(".json")
    digest = hashlib.sha256(read_file(file, "weights", WEIGHTS_BYTES)).hexdigest()
    write_json(card, {**read_json(card, "card"), SHA256: digest})
