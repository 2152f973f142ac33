"""Checkpoints of trainings: tensors and JSON in one safetensors file, which cannot hold code."""

import json
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any, TypeVar

import safetensors.torch
import torch
from safetensors import SafetensorError
from torch import Tensor, nn

from tint_sumo.core.errors import InputError
from tint_sumo.core.files import write_bytes
from tint_sumo.core.reading import WEIGHTS_BYTES, read_file
from tint_sumo.core.structures import build_json, plain

CHECKPOINT_FILE = "checkpoint.safetensors"
PICKLES = ("checkpoint.zip", "checkpoint.pt")  # checkpoints of earlier versions
_STATE = "state"  # the entry of the file's metadata that holds the JSON
_MODEL, _OPTIMIZER = "model.", "optimizer."

T = TypeVar("T")
Tensors = dict[str, Tensor]


def pack(tensors: Mapping[str, Tensor], state: Any) -> bytes:
    """Return the content of a checkpoint.

    Args:
        tensors: by name; they are copied.
        state: a dataclass with all else that a resumed training needs.
    """
    whole = {name: tensor.detach().clone().contiguous() for name, tensor in tensors.items()}  # one may hold another
    return safetensors.torch.save(whole, {_STATE: json.dumps(plain(state))})


def write_checkpoint(out: Path, content: bytes) -> None:
    """Write what ``pack`` has returned into the folder of a training."""
    write_bytes(out / CHECKPOINT_FILE, content)


def remove_checkpoint(out: Path) -> None:
    (out / CHECKPOINT_FILE).unlink(missing_ok=True)


def read_checkpoint(out: Path, state: type[T]) -> tuple[Tensors, T] | None:
    """Return the tensors and the state of the checkpoint in a folder; None if there is no checkpoint.

    Raises:
        InputError: the file is damaged, its state is another, or it is a pickle of an earlier version.
    """
    for pickle in (out / name for name in PICKLES):
        if pickle.exists():
            raise InputError(
                f"{pickle} is a checkpoint of an earlier version, a pickle, which can run any code and is not read; "
                "remove it to begin the training anew"
            )
    file = out / CHECKPOINT_FILE
    if not file.exists():
        return None
    content = read_file(file, "checkpoint", WEIGHTS_BYTES)
    with damage_reported(out):
        tensors = safetensors.torch.load(content)
        # The header is JSON behind its length; safetensors has checked it, but gives the metadata of files alone.
        header = json.loads(content[8 : 8 + int.from_bytes(content[:8], "little")])
        return tensors, build_json(state, header["__metadata__"][_STATE].encode())


@contextmanager
def damage_reported(out: Path) -> Iterator[None]:
    """Raise InputError for the exceptions of a checkpoint that does not fit."""
    try:
        yield
    except (SafetensorError, ValueError, LookupError, TypeError, RuntimeError) as error:
        reason = " ".join(str(error).split())
        raise InputError(
            f"{out / CHECKPOINT_FILE} is damaged or of another version ({reason}); remove it to begin the training anew"
        ) from None


def training_tensors(model: nn.Module, optimizer: torch.optim.Optimizer) -> Tensors:
    """Return the weights and buffers of a model, and the state of its optimizer for each weight."""
    remembered = {
        f"{_OPTIMIZER}{name}.{key}": value
        for name, parameter in model.named_parameters()
        for key, value in optimizer.state.get(parameter, {}).items()
    }
    return {**_weights(model), **remembered}


def _weights(model: nn.Module) -> Tensors:
    return {f"{_MODEL}{name}": tensor for name, tensor in (*model.named_parameters(), *model.named_buffers())}


def restore_training(model: nn.Module, optimizer: torch.optim.Optimizer, tensors: Mapping[str, Tensor]) -> None:
    """Give a model and its new optimizer the state of those whose ``training_tensors`` are among these.

    Raises:
        ValueError: a tensor is missing, has another shape or type, or a number that is not finite.
    """
    copy_into(_weights(model), tensors)
    require_finite_tensors(_weights(model))
    state: dict[int, Tensors] = {}
    for number, (name, parameter) in enumerate(model.named_parameters()):
        like = {"step": torch.zeros(()), "exp_avg": parameter, "exp_avg_sq": parameter}  # of Adam
        named = {key: f"{_OPTIMIZER}{name}.{key}" for key in like}
        if any(full_name in tensors for full_name in named.values()):  # else no step has changed it
            state[number] = {key: torch.empty_like(tensor, requires_grad=False) for key, tensor in like.items()}
            copy_into({named[key]: tensor for key, tensor in state[number].items()}, tensors)
            require_finite_tensors(state[number])
    optimizer.load_state_dict({"state": state, "param_groups": optimizer.state_dict()["param_groups"]})


def copy_into(targets: Mapping[str, Tensor], tensors: Mapping[str, Tensor]) -> None:
    """Copy tensors into those of the same names.

    Raises:
        ValueError: one is missing, or has another shape or type.
    """
    for name, target in targets.items():
        if name not in tensors:
            raise ValueError(f"it has no {name}")
        given = tensors[name]
        if (given.shape, given.dtype) != (target.shape, target.dtype):
            raise ValueError(f"{name} is {_words(given)}, not {_words(target)}")
    with torch.no_grad():
        for name, target in targets.items():
            target.copy_(tensors[name])


def require_finite_tensors(tensors: Mapping[str, Tensor]) -> None:
    """Raise ValueError unless all numbers are finite."""
    for name, tensor in tensors.items():
        if not tensor.isfinite().all():
            raise ValueError(f"{name} has numbers that are not finite")


def _words(tensor: Tensor) -> str:
    return f"{tensor.dtype} of {tuple(tensor.shape)}"
