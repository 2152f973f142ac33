"""Films of a training's policies for its TensorBoard log."""

import tempfile
from pathlib import Path

from tint_sumo.core.errors import InputError
from tint_sumo.films.film import render_case, require_film_scene
from tint_sumo.methods.loading import load_policy
from tint_sumo.policy.storage import read_policy_card
from tint_sumo.scenes import ALL_SCENES, T_INTERSECTION

CASE = 1  # always the same one, which no policy is trained on


def film_policy(policy: Path) -> bytes | None:
    """Return a GIF of the policy in this file in one case; None in scenes that films cannot show.

    It draws no random numbers of the training's. Where the training holds libsumo, the case runs through TraCI.
    """
    trained_in = read_policy_card(policy.with_suffix("")).get("scene")
    contender = load_policy(policy, scene=T_INTERSECTION if trained_in == ALL_SCENES else None)
    try:
        require_film_scene(contender.scene)
    except InputError:
        return None
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / "film.gif"
        render_case(contender, CASE, file)
        return file.read_bytes()
