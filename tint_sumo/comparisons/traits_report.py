"""Table and figure of the comparison of trait methods, from the results of its jobs."""

import math
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pandas as pd
from matplotlib.figure import Figure

from tint_sumo.config import Fraction, LatentCount, NoiseM, Seed, WindowCount
from tint_sumo.core.errors import InputError
from tint_sumo.core.files import damaged, read_json, whole_file, write_text
from tint_sumo.core.percentages import percent
from tint_sumo.core.reading import RESULT_BYTES
from tint_sumo.core.structures import FieldError, build, require_known
from tint_sumo.methods.registry import look_of_encoder
from tint_sumo.study.folders import RESULTS
from tint_sumo.study.tables import markdown_table
from tint_sumo.traits.evaluation import TraitAccuracy

_WHAT = "result of a trait study"


@dataclass(frozen=True)
class _Comparison(TraitAccuracy):
    """Accuracy of one training of a method."""

    method: str
    noise_m: NoiseM
    seed: Seed
    training_windows: WindowCount
    training_s: float | None
    by_p: Mapping[str, Fraction]


@dataclass(frozen=True)
class _Continuous:
    """R2 of one training of a method for the properties of drivers without classes."""

    method: str
    latent_size: LatentCount
    seed: Seed
    r2: Mapping[str, float]


_KINDS = {"comparison": _Comparison, "continuous": _Continuous}


@dataclass(frozen=True)
class TraitReport:
    """The tables, and the files that were written."""

    table: pd.DataFrame  # a row per method and noise; every measure's mean and standard deviation over the seeds
    markdown: str
    csv_file: Path
    markdown_file: Path
    figure_file: Path


def write_trait_report(out: Path) -> TraitReport:
    """Write traits.csv, traits_seeds.csv, traits.md and traits.png into a trait study's folder.

    Raises:
        InputError: there are no results, or a file is damaged.
    """
    contents = _read_results(out)
    seeds = pd.DataFrame([_flat(content) for content in contents if content["kind"] == "comparison"])
    continuous = pd.DataFrame([_flat(content) for content in contents if content["kind"] == "continuous"])
    table = aggregate(seeds)
    markdown = to_markdown(table, continuous)
    report = TraitReport(table, markdown, out / "traits.csv", out / "traits.md", out / "traits.png")
    write_text(out / "traits_seeds.csv", seeds.to_csv(index=False))
    if len(continuous):
        write_text(out / "traits_continuous.csv", continuous.to_csv(index=False))
    write_text(report.csv_file, table.to_csv(index=False))
    write_text(report.markdown_file, markdown)
    plot_noise(table, report.figure_file)
    return report


def _read_results(out: Path) -> list[dict[str, Any]]:
    files = sorted((out / RESULTS).glob("*.json"))
    contents = [_read_result(file) for file in files]
    if not any(content["kind"] == "comparison" for content in contents):
        raise InputError(f"no results in {out}; run the comparison first")
    return contents


def _read_result(file: Path) -> dict[str, Any]:
    content = read_json(file, _WHAT, RESULT_BYTES)
    try:
        kind = require_known(content.get("kind"), _KINDS, ("kind",))
        build(_KINDS[kind], {key: value for key, value in content.items() if key != "kind"})
    except FieldError as error:
        raise damaged(file, _WHAT, error) from None
    return content


def _flat(content: dict[str, Any]) -> dict[str, Any]:
    """A result as one row: fractions as percentages, parts as columns of their own."""
    row = {key: value for key, value in content.items() if not isinstance(value, dict) and key != "kind"}
    for key, name in (("accuracy", "svc_percent"), ("knn_accuracy", "knn_percent")):
        if key in row:
            row[name] = 100.0 * row.pop(key)
    for group in ("by_length", "by_leader"):
        for part, found in content.get(group, {}).items():
            value = found["accuracy"]
            row[f"svc_{part.replace('-', '_to_')}_percent"] = math.nan if value is None else 100.0 * value
    row |= {f"svc_P{p}_percent": 100.0 * value for p, value in content.get("by_p", {}).items()}
    return row | {f"r2_{name}": value for name, value in content.get("r2", {}).items()}


def aggregate(seeds: pd.DataFrame) -> pd.DataFrame:
    """A row per method and noise: mean of every measure over the seeds, and its sample standard deviation ("_sd")."""
    keys = ["method", "noise_m"]
    groups = seeds.astype({"error_m": float, "training_s": float}).groupby(keys, sort=True)
    mean = groups.mean(numeric_only=True).drop(columns="seed")
    spread = groups.std(numeric_only=True).drop(columns=["seed", "windows", "training_windows", "training_s"])
    joined = mean.join(spread.add_suffix("_sd"))
    joined.insert(0, "seeds", groups["seed"].count())
    columns = ["seeds", *(name for column in mean.columns for name in (column, f"{column}_sd") if name in joined)]
    return joined[columns].reset_index()


def to_markdown(table: pd.DataFrame, continuous: pd.DataFrame) -> str:
    """The tables for readers."""
    parts = [_accuracy_table(table), _parts_table(table)]
    if len(continuous):
        parts.append(_continuous_table(continuous))
    return "\n\n".join(parts) + "\n"


def _accuracy_table(table: pd.DataFrame) -> str:
    lines = [["method", "noise (m)", "linear SVC %", "nearest neighbours %", "position error (m)", "training (s)"]]
    for row in table.to_dict("records"):
        lines.append(
            [
                str(row["method"]),
                f"{row['noise_m']:g}",
                _accuracy(row, "svc_percent"),
                _accuracy(row, "knn_percent"),
                _mean_sd(row, "error_m", ".4f"),
                "-" if pd.isna(row["training_s"]) else f"{row['training_s']:.0f}",
            ]
        )
    return markdown_table(lines) + (
        f"\n\nMean ± standard deviation over {int(table['seeds'].max())} training seeds; "
        f"{int(table['training_windows'].mean()):,} training and {int(table['windows'].mean()):,} test windows of "
        "other episodes. Every model is trained and tested with the noise of its row. Position error: root mean square "
        "of reconstructed (vae) or next (cross_window, morton) positions, against the measured ones."
    )


def _parts_table(table: pd.DataFrame) -> str:
    measures = {
        "2-5 steps": "svc_2_to_5_percent",
        "6-10": "svc_6_to_10_percent",
        "11-19": "svc_11_to_19_percent",
        "20": "svc_20_percent",
        "leader": "svc_with_leader_percent",
        "no leader": "svc_without_leader_percent",
    }
    others = [name for name in table.columns if name.startswith("svc_P") and name.endswith("_percent")]
    measures |= {name.removeprefix("svc_").removesuffix("_percent"): name for name in others}
    lines = [["method", "noise (m)", *measures]]
    for row in table.to_dict("records"):
        cells = ["-" if pd.isna(row.get(name)) else percent(row[name] / 100.0, 2) for name in measures.values()]
        lines.append([str(row["method"]), f"{row['noise_m']:g}", *cells])
    return (
        markdown_table(lines)
        + "\n\nLinear SVC, percent: by the window's length, with and without a leader, and at another "
        "P(conservative) with neither model nor classifier trained anew. Means over the seeds."
    )


def _continuous_table(continuous: pd.DataFrame) -> str:
    measures = [name for name in continuous.columns if name.startswith("r2_")]
    groups = continuous.groupby(["method", "latent_size"])[measures]
    mean, spread = groups.mean(), groups.std()
    lines = [["method", "latents", *(f"R2 of {name.removeprefix('r2_')}" for name in measures)]]
    for (case, means), (_, spreads) in zip(mean.iterrows(), spread.iterrows(), strict=True):
        assert isinstance(case, tuple)
        cells = [_with_spread(means[name], spreads[name], ".3f") for name in measures]
        lines.append([*map(str, case), *cells])
    return (
        markdown_table(lines)
        + "\n\nDrivers without classes: how well a linear map from the latents gives what each driver "
        "was drawn with, windows of unseen episodes, no noise."
    )


def _accuracy(row: dict[Any, Any], name: str) -> str:
    if pd.isna(row[name]):
        return "-"
    spread = row[f"{name}_sd"]
    return percent(row[name] / 100.0, 3) + ("" if pd.isna(spread) else f" ± {spread:.3f}")


def _mean_sd(row: dict[Any, Any], name: str, form: str) -> str:
    return "-" if pd.isna(row[name]) else _with_spread(row[name], row[f"{name}_sd"], form)


def _with_spread(mean: Any, spread: Any, form: str) -> str:
    return f"{mean:{form}}" if pd.isna(spread) else f"{mean:{form}} ± {spread:{form}}"


def plot_noise(table: pd.DataFrame, file: Path) -> None:
    """Write a PNG of the error of the linear classifier against the noise on positions, a line per method."""
    figure = Figure(figsize=(6.0, 4.2), dpi=150, layout="constrained")
    axes = figure.subplots()
    for key, rows in table.groupby("method", sort=False):
        method, look = str(key), look_of_encoder(str(key))
        error = 100.0 - rows["svc_percent"]
        axes.errorbar(
            rows["noise_m"],
            error.clip(lower=0.001),
            yerr=rows["svc_percent_sd"].fillna(0.0),
            marker=look.marker,
            capsize=3,
            color=look.colour,
            linestyle=look.dash,
            label=f"{method} (trained with labels)" if method == "classifier" else method,
        )
    axes.set(
        xlabel="noise on every position (m, standard deviation)",
        ylabel="windows put into the wrong class (%)",
        yscale="log",
        xticks=sorted(table["noise_m"].unique()),
        title="Traits read from two latent numbers",
    )
    axes.grid(alpha=0.25, which="both")
    axes.legend(frameon=False)
    with whole_file(file) as partial:
        figure.savefig(partial, format="png")
