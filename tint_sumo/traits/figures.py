"""Pictures of what trait models have learnt (paper Fig. 3)."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from numpy.typing import NDArray

from tint_sumo.config import NO_LEADER_GAP_M, STEP_S, WINDOW_STEPS, VehicleShape
from tint_sumo.core.files import whole_file
from tint_sumo.core.sampling import evenly_spread
from tint_sumo.dataset.inspection import Colour
from tint_sumo.dataset.windows import Windows
from tint_sumo.traits.evaluation import encode_windows
from tint_sumo.traits.model import TraitModel
from tint_sumo.traits.vae import Vae

DRAWN_WINDOWS = 5000  # more windows would hide each other
NUMBERED = 10  # windows whose trajectories are shown
LEADER_COLOUR = (0.55, 0.35, 0.17)
_RECONSTRUCTED = 6
_MOST_COLOURS = 8  # as many as vTypes have
_OTHERS = (0.6, 0.6, 0.6)


def plot_latents(
    model: TraitModel,
    windows: Windows,
    labels: NDArray[np.integer],
    colours: Mapping[str, Colour],
    file: Path,
    *,
    noise_m: float = 0.0,
    seed: int = 0,
) -> None:
    """Write a PNG of the first two latent means, coloured by trait, and of the trajectories behind some of them.

    Args:
        model: a trained model with at least two latents.
        windows: N windows, best those of unseen episodes; a random part of them is drawn.
        labels: (N,) the number of each window's trait.
        colours: of the traits by their names, in the order of their numbers. If too many traits have windows, the rarer
            ones are grey.
        file: where the PNG goes.
        noise_m: standard deviation of the noise on every position.
        seed: of the part that is drawn, and of the noise.
    """
    chosen = np.random.default_rng(seed).permutation(len(windows))[:DRAWN_WINDOWS]
    drawn, kind = windows[chosen], labels[chosen]
    latents = encode_windows(model, drawn, noise_m=noise_m, seed=seed).mean
    by_count = sorted(np.unique(kind).tolist(), key=lambda number: -int((kind == number).sum()))
    shown = sorted(by_count if len(by_count) <= _MOST_COLOURS else by_count[: _MOST_COLOURS - 1])
    colour = np.array([rgb if number in shown else _OTHERS for number, rgb in enumerate(colours.values())])[kind]
    numbered = _numbered(latents, drawn, kind, sorted(by_count[:NUMBERED]))

    figure = Figure(figsize=(11.0, 5.0), dpi=150, layout="constrained")
    space, street = figure.subplots(1, 2)
    space.scatter(latents[:, 0], latents[:, 1], s=6, c=colour, alpha=0.35, linewidths=0)
    names = list(colours)
    for number in shown:
        count = int((kind == number).sum())
        space.scatter([], [], s=30, color=colours[names[number]], label=f"{names[number]} ({count} windows)")
    if others := len(by_count) - len(shown):
        count = int((~np.isin(kind, shown)).sum())
        space.scatter([], [], s=30, color=_OTHERS, label=f"{others} others ({count} windows)")
    noise = f", {noise_m:g} m noise" if noise_m else ""
    space.set(xlabel="latent 1", ylabel="latent 2", title=f"Latent space of '{model.method}'{noise}")
    space.legend(loc="upper center", bbox_to_anchor=(0.5, -0.12), ncols=2, frameon=False)
    space.grid(alpha=0.25)
    for number, window in enumerate(numbered, start=1):
        box = {"boxstyle": "circle,pad=0.15", "facecolor": "white", "alpha": 0.8, "linewidth": 0.6}
        space.annotate(str(number), latents[window, :2], ha="center", va="center", fontsize=7, bbox=box)
    _draw_street(street, drawn[numbered], colour[numbered])
    _save(figure, file)


def plot_reconstructions(model: Vae, windows: Windows, file: Path, *, seed: int = 0) -> None:
    """Write a PNG of some full windows beside what the model makes of them.

    Args:
        model: a trained model of method ``vae``.
        windows: N windows, some of them of full length.
        file: where the PNG goes.
        seed: of the choice.
    """
    full = np.flatnonzero(windows.length == WINDOW_STEPS)
    chosen = windows[np.random.default_rng(seed).permutation(full)[:_RECONSTRUCTED]]
    states, length = torch.from_numpy(chosen.states), torch.from_numpy(chosen.length)
    with torch.no_grad():
        decoded = model.reconstruct(states, length).numpy()
    time_s = STEP_S * np.arange(WINDOW_STEPS)

    figure = Figure(figsize=(11.0, 4.2), dpi=150, layout="constrained")
    grid = figure.subplots(2, len(chosen), sharex=True, sharey="row", squeeze=False)
    for window in range(len(chosen)):
        for row, quantity in enumerate(("offset (m)", "gap to the leader (m)")):
            axes = grid[row, window]
            axes.plot(time_s, chosen.states[window, :, row], color="0.6", linewidth=4, label="recorded")
            axes.plot(time_s, decoded[window, :, row], color="black", linewidth=1.2, label="reconstructed")
            axes.grid(alpha=0.25)
            if window == 0:
                axes.set_ylabel(quantity)
        grid[1, window].set_xlabel("time (s)")
    grid[0, 0].legend(frameon=False, fontsize=8)
    figure.suptitle("Windows of unseen drivers and their reconstruction from two numbers")
    _save(figure, file)


def _numbered(
    latents: NDArray[np.float32], windows: Windows, kind: NDArray[np.integer], kinds: Sequence[int]
) -> NDArray[np.int64]:
    """Return full windows spread evenly over the order of each trait in ``kinds`` along its widest latent direction."""
    chosen: list[int] = []
    for trait in kinds:
        mine = np.flatnonzero((kind == trait) & (windows.length == WINDOW_STEPS))
        widest = latents[mine].var(axis=0).argmax() if len(mine) else 0
        ordered = mine[np.argsort(latents[mine, widest], kind="stable")]
        chosen.extend(ordered[evenly_spread(len(ordered), NUMBERED // len(kinds))])
    return np.array(chosen, np.int64)


def _draw_street(axes: Axes, windows: Windows, colours: NDArray[np.float64]) -> None:
    """Draw a row per window: positions of the driver and of its leader, darker as time goes on."""
    opacity: Any = np.linspace(0.15, 1.0, WINDOW_STEPS)  # matplotlib's type hints know only one for all markers
    for row in range(len(windows)):
        offset, gap = windows.states[row].T
        led = gap < NO_LEADER_GAP_M
        height = np.full(WINDOW_STEPS, row + 1)
        axes.scatter(offset, height, marker=">", s=22, color=colours[row], alpha=opacity, linewidths=0)
        if led.any():
            ahead = (offset + gap + VehicleShape.length_m)[led]
            axes.scatter(ahead, height[led], marker=">", s=22, color=LEADER_COLOUR, alpha=opacity[led], linewidths=0)
    axes.invert_yaxis()
    axes.set(
        xlabel="front bumper from the window's first position (m)",
        ylabel="window",
        yticks=np.arange(1, len(windows) + 1),
        title="Their drivers and leaders (brown), 2 s each, darker later",
    )
    axes.grid(alpha=0.25)


def _save(figure: Figure, file: Path) -> None:
    with whole_file(file) as partial:
        figure.savefig(partial, format="png")
