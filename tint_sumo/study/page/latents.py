"""The latent space of each trait model as a part of the page."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from tint_sumo import traits
from tint_sumo.config import LATENT_SIZE, NO_LEADER_GAP_M, POPULATIONS, STEP_S
from tint_sumo.dataset.recorder import record
from tint_sumo.dataset.windows import Windows, load_drivers, load_labels, load_windows
from tint_sumo.methods.registry import METHODS, Learned
from tint_sumo.study.page.recording import EPISODES
from tint_sumo.traits.evaluation import encode_windows
from tint_sumo.traits.storage import shipped_model

DRAWN = 400  # windows; more would hide each other
_RECORDED, _SEED = 3000, 404  # unlike that of any dataset a model was trained on
_P_CONSERVATIVE = 0.5
_STEP_M = 0.01  # what offsets and gaps are multiples of


def read_latents(out: Path, methods: Sequence[str], *, progress: bool) -> dict[str, Any] | None:
    """Return windows of drivers that no model was trained on, with their latents by each of the methods' trait models.

    None if no method infers traits with a model. The windows are recorded once.

    Raises:
        InputError: a model is damaged.
    """
    known = [METHODS[name] for name in methods if name in METHODS]
    encoders = dict.fromkeys(method.encoder for method in known if isinstance(method, Learned) and method.encoder)
    if not encoders:
        return None
    data = out / EPISODES / "windows"
    record(data, _RECORDED, p_conservative=_P_CONSERVATIVE, seed=_SEED, progress=progress)
    windows = load_windows(data)
    chosen = np.sort(np.random.default_rng(0).permutation(len(windows))[:DRAWN])
    drawn, labels = windows[chosen], load_labels(data, windows)[chosen]
    drivers = load_drivers(data, windows, ["desired_speed_mps", "min_gap_m"]).iloc[chosen].round(2)
    names = [profile.name for profile in POPULATIONS["traits"].profiles]
    return {
        "traits": names,
        "step_m": _STEP_M,
        "step_s": STEP_S,
        "windows": [
            {
                "driver": int(drawn.driver[number]),
                "trait": int(labels[number]),
                **{name: float(value) for name, value in drivers.iloc[number].items()},
                **_states(drawn, number),
            }
            for number in range(len(drawn))
        ],
        "models": [{"name": name, **_model(out, name, drawn)} for name in encoders],
    }


def _states(windows: Windows, number: int) -> dict[str, list[int | None]]:
    """Return the window's valid steps; no gap where there is no leader."""
    steps = windows.states[number, : windows.length[number]]
    offsets, gaps = np.rint(steps / _STEP_M).astype(int).T.tolist()
    led = steps[:, 1] < NO_LEADER_GAP_M
    return {"offsets": offsets, "gaps": [gap if there else None for gap, there in zip(gaps, led, strict=True)]}


def _model(out: Path, name: str, windows: Windows) -> dict[str, Any]:
    trained = out / "traits" / name / "model.safetensors"
    model = traits.load(trained if trained.exists() else shipped_model(name), latent_size=LATENT_SIZE)
    latents = encode_windows(model, windows).mean
    return {"is_trained": trained.exists(), "latents": np.round(latents.astype(float), 3).tolist()}
