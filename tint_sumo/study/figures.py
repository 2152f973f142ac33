"""Figures of a study's results."""

from collections.abc import Collection, Mapping, Sequence
from itertools import groupby
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from tint_sumo.config import ALL_MIXES, Mix
from tint_sumo.core.files import whole_file
from tint_sumo.core.percentages import percent
from tint_sumo.core.statistics import Scores
from tint_sumo.envs.rows import BUILT_IN_OUTCOMES
from tint_sumo.methods.registry import Look, look_of
from tint_sumo.study.jobs import smoothed_percent
from tint_sumo.study.summary import (
    CONDITION_TITLES,
    Summary,
    by_line,
    by_title,
    labels,
    looks,
    marker_offset,
    title_of,
    titles_and_looks,
    varied,
)

COLOURS = {"success": "#3b8a5a", "timeout": "#e8c468", "collision": "#c8503c"}
INK = {"success": "white", "timeout": "black", "collision": "white"}  # colours of the numbers on these colours
_PANELS = 3  # panels in a row


def plot_bars(rows: Sequence[Summary], file: Path) -> Path:
    """Draw stacked bars of success, timeout and collision as in the paper's Fig. 4, one panel per P(conservative)."""
    panels = [(p, list(group)) for p, group in groupby(rows, key=lambda row: row.conditions.p_conservative.low)]
    columns = min(len(panels), _PANELS)
    lines = -(-len(panels) // columns)
    height = max(len(group) for _, group in panels)
    size = (1.6 + 3.4 * columns, lines * (1.1 + 0.34 * height))
    figure = Figure(figsize=size, dpi=150, layout="constrained")
    all_axes = figure.subplots(lines, columns, sharex=True, squeeze=False)
    for axes in all_axes.flat[len(panels) :]:
        axes.set_visible(False)
    for position, (axes, (p_conservative, group)) in enumerate(zip(all_axes.flat, panels, strict=False)):
        _plot_panel(axes, group)
        axes.set_title(f"P(conservative) = {p_conservative:g}", fontsize=10)
        axes.set_xlabel("% of the cases", fontsize=8)
        axes.tick_params(labelbottom=True)
        if position % columns and _titles(group) == _titles(panels[position - 1][1]):
            axes.tick_params(labelleft=False)
    legends = [axes.get_legend_handles_labels() for axes in all_axes.flat]
    entries = {label: handle for legend in legends for handle, label in zip(*legend, strict=True)}
    figure.legend(entries.values(), entries.keys(), loc="outside lower center", ncols=5, frameon=False, fontsize=9)
    return _write(figure, file)


def _titles(rows: Sequence[Summary]) -> list[str]:
    return [row.title for row in rows]


def _plot_panel(axes: Axes, rows: Sequence[Summary]) -> None:
    positions = range(len(rows))
    left = [0.0] * len(rows)
    for outcome in BUILT_IN_OUTCOMES:
        widths = [100.0 * row.rate(outcome) for row in rows]
        axes.barh(positions, widths, 0.72, left=left, color=COLOURS[outcome], label=outcome)
        for row, position, start, width in zip(rows, positions, left, widths, strict=True):
            if width >= 8.0:  # thinner parts have no room for a number
                text: dict[str, Any] = {"ha": "center", "va": "center", "fontsize": 8, "color": INK[outcome]}
                axes.text(start + width / 2, position - 0.1, percent(row.rate(outcome)), **text)
        left = [start + width for start, width in zip(left, widths, strict=True)]
    ends_percent = 100.0 * np.array([row.intervals["success"] for row in rows]).T
    middle = np.array([100.0 * row.rate("success") for row in rows])
    errors = np.abs(ends_percent - middle)
    below = [position + 0.24 for position in positions]  # so that the numbers stay readable
    interval: dict[str, Any] = {"fmt": "none", "ecolor": "black", "capsize": 2, "lw": 1}
    axes.errorbar(middle, below, xerr=errors, label="95 % interval of success", **interval)
    published = [row.published.get("success", float("nan")) for row in rows]
    if not np.isnan(published).all():
        axes.plot(published, [position - 0.44 for position in positions], "kv", ms=4, label="success in the paper")
    axes.set_yticks(list(positions), _titles(rows), fontsize=8)
    axes.tick_params(axis="x", labelsize=8)
    axes.set_xlim(0, 100)
    axes.invert_yaxis()
    axes.spines[["top", "right"]].set_visible(False)


def plot_curves(curves: Mapping[tuple[str, Mix], Sequence[pd.DataFrame]], file: Path) -> Path:
    """Draw success in training against decisions: the mean over seeds, and the range between them as a band.

    Args:
        curves: of each method and mix in training, a frame per seed with columns decisions and success.
        file: of the PNG.
    """
    figure = Figure(figsize=(7.5, 4.6), dpi=150, layout="constrained")
    axes = figure.subplots()
    for seeds, (title, look) in zip(curves.values(), titles_and_looks(curves), strict=True):
        success = smoothed_percent(seeds)
        at, style = success.index.to_numpy(), _line_style(look) | {"markevery": 0.12}
        axes.plot(at, success.mean(axis=1), label=title, **style)
        axes.fill_between(at, success.min(axis=1), success.max(axis=1), color=style["color"], alpha=0.12, lw=0)
    axes.set(
        xlabel="decisions", ylabel=f"success in training{_cases_at({mix for _, mix in curves})} (%)", ylim=(0, 100)
    )
    axes.grid(alpha=0.25)
    axes.legend(frameon=False, fontsize=8, ncols=2)
    return _write(figure, file)


def plot_conditions(rows: Sequence[Summary], file: Path) -> Path:
    """Draw success in other conditions than the training's, and after parts of the training; a line per method."""
    figure = Figure(figsize=(11.0, 4.2), dpi=150, layout="constrained")
    all_axes = figure.subplots(1, 3, sharey=True)
    lines = by_line(rows)
    for axes, (name, title) in zip(all_axes, CONDITION_TITLES.items(), strict=True):
        for (label, found), look in zip(lines.items(), looks(lines), strict=True):
            _plot_line(axes, found, name, label, look)
        axes.set_xlabel(title)
        axes.grid(alpha=0.25)
    all_axes[0].set_ylabel(f"success{_cases_of(rows)} (%)")
    entries = all_axes[0].get_legend_handles_labels()
    figure.legend(*entries, loc="outside lower center", ncols=6, frameon=False, fontsize=8)
    return _write(figure, file)


def plot_profiles(found: Mapping[str, Scores], file: Path) -> Path:
    """Draw performance profiles: the share of trainings and conditions in which a method succeeds more often than this.

    A line that falls early shows trainings that fail (Agarwal et al. 2021). ``found`` has success (S, T) by method.
    """
    figure = Figure(figsize=(7.5, 4.6), dpi=150, layout="constrained")
    axes = figure.subplots()
    thresholds = np.linspace(0.0, 1.0, 201)
    for method, scores in found.items():
        shares = (scores.flatten()[:, None] > thresholds).mean(axis=0)
        style = _line_style(look_of(method)) | {"markevery": 0.12}
        axes.plot(100.0 * thresholds, 100.0 * shares, label=title_of(method), **style)
    axes.set(xlabel="success (%)", ylabel="trainings and conditions with more than that (%)")
    axes.grid(alpha=0.25)
    axes.legend(frameon=False, fontsize=8, ncols=2)
    return _write(figure, file)


def plot_worlds(rows: Sequence[Summary], file: Path) -> Path:
    """Draw success and collisions with 95 % intervals: a line for each world, a marker for each method."""
    worlds, methods = labels(rows), by_title(rows)
    figure = Figure(figsize=(11.0, 1.6 + 0.42 * len(worlds)), dpi=150, layout="constrained")
    all_axes = figure.subplots(1, 2, sharey=True)
    for axes, outcome in zip(all_axes, ("success", "collision"), strict=True):
        for position, (found, look) in enumerate(zip(methods.values(), looks(methods), strict=True)):
            shift = marker_offset(position, len(methods), 0.32)
            heights = [list(worlds).index(row.conditions) + shift for row in found]
            rates = np.array([100.0 * row.rate(outcome) for row in found])
            limits = 100.0 * np.array([row.intervals[outcome] for row in found]).T
            style = _line_style(look, is_open=found[0].is_shipped) | {"linestyle": "none", "elinewidth": 0.8}
            axes.errorbar(rates, heights, xerr=np.abs(limits - rates), label=found[0].title, **style)
        axes.set_xlabel(f"{outcome}{_cases_of(rows)} (%)")
        axes.set_xlim(left=-1.0, right=101.0 if outcome == "success" else None)
        axes.grid(alpha=0.25)
    all_axes[0].set_yticks(range(len(worlds)), list(worlds.values()), fontsize=8)
    all_axes[0].invert_yaxis()
    entries = all_axes[0].get_legend_handles_labels()
    figure.legend(*entries, loc="outside lower center", ncols=6, frameon=False, fontsize=8)
    return _write(figure, file)


def _cases_of(rows: Sequence[Summary]) -> str:
    return _cases_at({row.conditions.p_conservative for row in rows})


def _cases_at(mixes: Collection[Mix]) -> str:
    """Return words about P(conservative) of the cases for the name of an axis; none where lines are named by it."""
    first, *others = mixes
    if others:
        return ""
    return ", all mixes" if first == ALL_MIXES else f", P {first.text}"


def _plot_line(axes: Axes, rows: Sequence[Summary], name: str, label: str, look: Look) -> None:
    if points := varied(rows, name):
        values = list(points)
        success = np.array([100.0 * points[value].rate("success") for value in values])
        limits = np.array([[100.0 * end for end in points[value].intervals["success"]] for value in values]).T
        style = _line_style(look, is_open=rows[0].is_shipped) | {"capsize": 2, "elinewidth": 0.8}
        axes.errorbar(values, success, yerr=np.abs(limits - success), label=label, **style)


def _line_style(look: Look, *, is_open: bool = False) -> dict[str, Any]:
    """Return Matplotlib's arguments for a method's line; a shipped policy has open markers."""
    style = {"color": look.colour, "marker": look.marker, "linestyle": look.dash, "ms": 4.5, "lw": 1.3}
    return style | ({"markerfacecolor": "white"} if is_open else {})


def _write(figure: Figure, file: Path) -> Path:
    with whole_file(file) as partial:
        figure.savefig(partial, format="png")
    return file
