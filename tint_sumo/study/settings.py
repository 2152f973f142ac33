"""The settings in a study's folder, as its results need them."""

from pathlib import Path
from typing import Any

from tint_sumo.core.errors import InputError
from tint_sumo.core.files import RUN_FILE, damaged, read_json
from tint_sumo.scenes import Scene, paper_scene, read_described, require_built_in
from tint_sumo.study.published import RATES_PERCENT, Rates


def read_scene_of(out: Path) -> Scene:
    """Return the scene of the study in ``out``: the paper's, unless its settings name another one.

    Raises:
        InputError: the settings are damaged.
    """
    settings = _read(out)
    if "scene" not in settings:
        return paper_scene()
    try:
        return require_built_in("a study", read_described(settings)[0])
    except InputError as error:
        raise damaged(out / RUN_FILE, "run settings", error) from None


def published_for(out: Path) -> Rates:
    """Return the paper's rates if the study in ``out`` trains and tests where the paper does, else none.

    Raises:
        InputError: the settings are damaged.
    """
    is_paper_s = read_scene_of(out) == paper_scene() and _read(out).get("world") in (None, "old")
    return RATES_PERCENT if is_paper_s else {}


def _read(out: Path) -> Any:
    return read_json(out / RUN_FILE, "run settings") if (out / RUN_FILE).exists() else {}
