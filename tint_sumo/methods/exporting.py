"""Folders with all that belongs to one policy or trait model, for others to use and to share."""

import shutil
from pathlib import Path

from tint_sumo import traits
from tint_sumo.core.errors import InputError
from tint_sumo.core.files import whole_folder, write_json, write_text
from tint_sumo.core.weights import card_file, weights_file
from tint_sumo.methods.loading import Contender, find_policy, trait_model_of
from tint_sumo.methods.model_cards import policy_page, traits_page
from tint_sumo.methods.training import POLICY, TRAITS
from tint_sumo.policy.storage import read_policy_card
from tint_sumo.traits.cross_window import CrossWindow
from tint_sumo.traits.storage import RUN_MODEL, find, read_card

PAGE = "README.md"  # the card as Hugging Face shows it


def export_policy(contender: Contender, out: Path, *, with_onnx: bool = False) -> list[Path]:
    """Write the folder of a learned policy, which ``load_policy`` reads; return its files.

    Args:
        contender: policy by its name, folder or .safetensors file, as ``load_policy`` has returned it.
        out: the folder, which has no files yet.
        with_onnx: write ONNX files of policy and trait model, too; needs ``tint_sumo[onnx]``.

    Raises:
        InputError: the policy is a rule, or the folder cannot be written or has files.
        ModuleNotFoundError: a package for ONNX is not installed.
    """
    if contender.source is None:
        raise InputError(f"{contender.name} is a rule and has no network; give a learned policy")
    stem = find_policy(contender.name)
    card = read_policy_card(stem)
    with whole_folder(out) as folder:
        shutil.copyfile(weights_file(stem), weights_file(folder / POLICY))
        if card["traits"] is not None:
            _copy(find(trait_model_of(stem, card)), folder / TRAITS)
            card["traits"] = TRAITS
        write_json(card_file(folder / POLICY), card)
        write_text(folder / PAGE, policy_page(Path(contender.name).name, card))
        if with_onnx:
            from tint_sumo.methods import onnx_files  # noqa: PLC0415 - an extra

            onnx_files.write_policy(contender, folder / f"{POLICY}.onnx")
            if (steps := onnx_files.steps_of(contender)) is not None:
                onnx_files.write_traits(steps, contender.name, folder / f"{TRAITS}.onnx")
    return sorted(out.iterdir())


def export_traits(name_or_path: str | Path, out: Path, *, with_onnx: bool = False) -> list[Path]:
    """Write the folder of a trait model, which ``tint_sumo.traits.load`` reads; return its files.

    The ONNX file of a cross-window model takes whole tracks; those of others take windows.

    Args:
        name_or_path: as in ``tint_sumo.traits.load``.
        out: as in ``export_policy``.
        with_onnx: as there.

    Raises:
        InputError: there is no such model, it is damaged, or the folder cannot be written or has files.
        ModuleNotFoundError: a package for ONNX is not installed.
    """
    model = traits.load(name_or_path)
    with whole_folder(out) as folder:
        _copy(find(name_or_path), folder / RUN_MODEL)
        write_text(folder / PAGE, traits_page(Path(name_or_path).name, read_card(name_or_path).entries))
        if with_onnx:
            from tint_sumo.methods import onnx_files  # noqa: PLC0415 - an extra

            steps = onnx_files.trait_steps(model, streaming=isinstance(model, CrossWindow))
            onnx_files.write_traits(steps, str(name_or_path), folder / f"{TRAITS}.onnx")
    return sorted(out.iterdir())


def _copy(source: Path, target: Path) -> None:
    """Copy weights and card, given without their suffixes."""
    for file in (weights_file, card_file):
        shutil.copyfile(file(source), file(target))
