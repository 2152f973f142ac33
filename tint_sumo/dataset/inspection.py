"""Contents of a recorded dataset: counts, and distributions per trait.

Shards are read one after the other and only counts of rounded values are kept, so that memory does not grow with the
dataset. Labels are joined here to describe the data; no input of a model comes from here.
"""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from matplotlib import colormaps
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Patch
from matplotlib.ticker import PercentFormatter
from numpy.typing import NDArray

from tint_sumo.core.errors import InputError
from tint_sumo.core.files import whole_file
from tint_sumo.core.progress import Progress
from tint_sumo.dataset.schema import DRIVERS, TRAJECTORIES, Manifest, read_manifest, read_shards
from tint_sumo.jobs.table import one_job

RESOLUTION = 0.01  # m, m/s or s: values are rounded to multiples of it
QUANTILES = (0.05, 0.25, 0.5, 0.75, 0.95)
_MOST_ROWS = 24  # vTypes in a figure
_COLOURS_OF_VTYPES = (0, 1, 2, 3, 4, 6, 8, 9)  # of tab10, without brown and grey, which have other meanings
Colour = tuple[float, float, float]  # red, green and blue, each in [0, 1]
_KEYS = ["episode", "vehicle"]


@dataclass(frozen=True)
class Distribution:
    """Counts of values that are rounded to 0.01."""

    value: NDArray[np.float64]  # (K,), increasing
    count: NDArray[np.int64]  # (K,)

    @classmethod
    def of(cls, values: pd.Series) -> "Distribution":
        """Return the distribution of the values that are not null."""
        level, count = np.unique(np.rint(values.dropna().to_numpy(np.float64) / RESOLUTION), return_counts=True)
        return cls(level * RESOLUTION, count)

    def __add__(self, other: "Distribution") -> "Distribution":
        value, index = np.unique(np.rint(np.r_[self.value, other.value] / RESOLUTION), return_inverse=True)
        count = np.bincount(index, np.r_[self.count, other.count], len(value)).astype(np.int64)
        return Distribution(value * RESOLUTION, count)

    def quantile(self, fraction: float) -> float:
        """Return the smallest value that at least this fraction does not exceed."""
        reached = np.cumsum(self.count) >= fraction * self.count.sum()
        return round(float(self.value[reached.argmax()]), 2)

    def summary(self) -> dict[str, Any]:
        """Return count, mean, sd, min, quantiles and max; the count alone if it is 0."""
        total = int(self.count.sum())
        if total == 0:
            return {"count": 0}
        mean = float(self.value @ self.count) / total
        variance = float((self.value - mean) ** 2 @ self.count) / total
        return {
            "count": total,
            "mean": round(mean, 4),
            "sd": round(variance**0.5, 4),
            "min": self.quantile(0.0),
            **{f"q{fraction:.0%}".rstrip("%"): self.quantile(fraction) for fraction in QUANTILES},
            "max": self.quantile(1.0),
        }


NOTHING = Distribution(np.empty(0), np.empty(0, np.int64))


@dataclass(frozen=True)
class TraitStatistics:
    """Counts and distributions of all drivers with one trait."""

    drivers: int = 0
    rows: int = 0
    speed_mps: Distribution = NOTHING
    gap_m: Distribution = NOTHING  # gaps of rows with a leader
    track_s: Distribution = NOTHING  # time on the street

    def __add__(self, other: "TraitStatistics") -> "TraitStatistics":
        return TraitStatistics(*(getattr(self, field.name) + getattr(other, field.name) for field in fields(self)))

    def summary(self) -> dict[str, Any]:
        """Return the counts, and the summaries of the distributions, by the names of the fields."""
        values = {field.name: getattr(self, field.name) for field in fields(self)}
        return {name: value.summary() if isinstance(value, Distribution) else value for name, value in values.items()}


@dataclass(frozen=True)
class Inspection:
    """Manifest of a dataset, and distributions in its tables."""

    manifest: Manifest
    traits: Mapping[str, TraitStatistics]  # by name of the trait
    episode_s: Distribution
    drivers_per_episode: Distribution

    def summary(self) -> dict[str, Any]:
        """Return manifest and summaries as JSON can hold them."""
        return {
            "manifest": self.manifest.content(),
            "traits": {trait: statistics.summary() for trait, statistics in self.traits.items()},
            "episode_s": self.episode_s.summary(),
            "drivers_per_episode": self.drivers_per_episode.summary(),
        }


def inspect(folder: Path, progress: bool = True) -> Inspection:
    """Read all of a dataset, labels included, and count.

    Raises:
        InputError: no dataset there, an unfinished or damaged one, or one of another schema version.
    """
    manifest = read_manifest(folder)
    traits = {trait: TraitStatistics() for trait in trait_colours(manifest)}
    episode_s = drivers_per_episode = NOTHING
    for rows in _shards(folder, manifest, progress):
        for trait in traits:
            traits[trait] += _statistics(rows[rows["trait"] == trait])
        episodes = rows.groupby("episode")
        episode_s += Distribution.of(episodes["time_s"].max())
        drivers_per_episode += Distribution.of(episodes["vehicle"].nunique())
    found = sum(statistics.rows for statistics in traits.values())
    if found != manifest.rows:
        raise InputError(
            f"{folder} has {found} of {manifest.rows} rows with their drivers; "
            "repeat the command that recorded the dataset"
        )
    return Inspection(manifest, traits, episode_s, drivers_per_episode)


def trait_colours(manifest: Manifest) -> dict[str, Colour]:
    """Return each trait's colour, by the traits' numbers; those of vTypes begin again after some."""
    if manifest.profiles is not None:
        return {profile.name: profile.rgb for profile in manifest.profiles}
    palette = [colormaps["tab10"](number)[:3] for number in _COLOURS_OF_VTYPES]
    return {vtype: palette[number % len(palette)] for number, vtype in enumerate(manifest.traits)}


def _shards(folder: Path, manifest: Manifest, progress: bool) -> Iterator[pd.DataFrame]:
    """Yield the rows of each shard with their drivers' traits."""
    tables = (
        read_shards(folder, TRAJECTORIES, manifest, [*_KEYS, "time_s", "speed_mps", "gap_m"]),
        read_shards(folder, DRIVERS, manifest, [*_KEYS, "trait"]),
    )
    with one_job("inspect", progress=progress) as report:
        for shard, (rows, drivers) in enumerate(zip(*tables, strict=True)):
            report(Progress(shard, manifest.shards, "shard"))
            yield rows.merge(drivers, on=_KEYS)


def _statistics(rows: pd.DataFrame) -> TraitStatistics:
    tracks = rows.groupby(_KEYS)["time_s"]
    track_s = tracks.max() - tracks.min()
    return TraitStatistics(
        len(track_s),
        len(rows),
        Distribution.of(rows["speed_mps"]),
        Distribution.of(rows["gap_m"]),
        Distribution.of(track_s),
    )


def report(inspection: Inspection) -> str:
    """Return the manifest and a table of the distributions, for people."""
    content = inspection.manifest.content()
    width = max(map(len, content))
    lines = [f"{key:{width}}  {_printed(value)}" for key, value in content.items()]
    table = {
        "drivers per episode": inspection.drivers_per_episode,
        "episode (s)": inspection.episode_s,
        **{
            f"{trait}, {name}": distribution
            for trait, statistics in inspection.traits.items()
            if statistics.drivers
            for name, distribution in (
                ("speed (m/s)", statistics.speed_mps),
                ("gap to the leader (m)", statistics.gap_m),
                ("time on the street (s)", statistics.track_s),
            )
        },
    }
    summaries = pd.DataFrame.from_dict(
        {name: distribution.summary() for name, distribution in table.items()}, orient="index"
    )
    without = [trait for trait, statistics in inspection.traits.items() if not statistics.drivers]
    note = [f"no drivers: {', '.join(without)}"] if without else []
    return "\n".join([*lines, "", summaries.to_string(na_rep=""), *note])


def _printed(value: object) -> str:
    return ", ".join(f"{key} {part}" for key, part in value.items()) if isinstance(value, Mapping) else str(value)


def plot(inspection: Inspection, file: Path) -> None:
    """Write a picture of the distributions of speed, gap and time on the street, per trait.

    The few profiles of a built-in scene are histograms; the vTypes of a SUMO configuration, which can be many, are rows
    of boxes.
    """
    figure = _histograms(inspection) if inspection.manifest.profiles else _boxes(inspection)
    with whole_file(file) as partial:
        figure.savefig(partial, format=file.suffix.lower().removeprefix("."))


def _boxes(inspection: Inspection) -> Figure:
    """Return a figure with a row per vType that has drivers: median, middle half, and where 90 % of the values lie."""
    by_drivers = sorted(inspection.traits.items(), key=lambda pair: -pair[1].drivers)
    shown = [(vtype, statistics) for vtype, statistics in by_drivers if statistics.drivers][:_MOST_ROWS]
    figure = Figure(figsize=(12.0, 1.8 + 0.42 * max(len(shown), 1)), dpi=150, layout="constrained")
    speed, gap, track = figure.subplots(1, 3, sharey=True)
    for row, (_, statistics) in enumerate(shown):
        for axes, distribution in ((speed, statistics.speed_mps), (gap, statistics.gap_m), (track, statistics.track_s)):
            _draw_box(axes, distribution, row)
    speed.set(xlabel="speed (m/s)", ylim=(len(shown) - 0.5, -0.5))
    speed.set_yticks(range(len(shown)), [f"{vtype} ({statistics.drivers:,} drivers)" for vtype, statistics in shown])
    gap.set(xlabel="gap to the leader, if there is one (m)")
    track.set(xlabel="time on the street (s)")
    for axes in (speed, gap, track):
        axes.set_xlim(0, None)
        axes.grid(alpha=0.25, axis="x")
    left_out = len(by_drivers) - len(shown)
    note = f"; {left_out} vTypes with fewer drivers or none are left out" if left_out else ""
    figure.suptitle(_title(inspection) + note, fontsize=11)
    figure.supxlabel("boxes: the middle half and the median; lines: from 5 to 95 %", fontsize=8)
    return figure


def _draw_box(axes: Axes, distribution: Distribution, row: int) -> None:
    """Draw a box in a row; nothing where there are no values."""
    if len(distribution.value) == 0:
        return
    names = ("whislo", "q1", "med", "q3", "whishi")
    box = {name: distribution.quantile(fraction) for name, fraction in zip(names, QUANTILES, strict=True)}
    style: dict[str, Any] = {
        **{"orientation": "horizontal", "showfliers": False, "patch_artist": True, "manage_ticks": False},
        **{"boxprops": {"facecolor": "#c3d9ee"}, "medianprops": {"color": "black"}},
    }
    axes.bxp([box], positions=[row], widths=0.6, **style)


def _title(inspection: Inspection) -> str:
    return f"{inspection.manifest.windows:,} windows, {inspection.episode_s.count.sum():,} episodes of traffic"


def _histograms(inspection: Inspection) -> Figure:
    """Return a figure with the distributions of each profile upon each other."""
    figure = Figure(figsize=(12.0, 4.2), dpi=150, layout="constrained")
    speed, gap, track = figure.subplots(1, 3)
    colours = trait_colours(inspection.manifest)
    for trait, colour in colours.items():
        statistics = inspection.traits[trait]
        _draw(speed, statistics.speed_mps, colour, width=0.02)
        _draw(gap, statistics.gap_m, colour, width=0.1)
        _draw(track, statistics.track_s, colour, width=0.5)
    speed.set(xlabel="speed (m/s)", ylabel="steps")
    gap.set(xlabel="gap to the leader, if there is one (m)", xlim=(0, None))
    track.set(xlabel="time on the street (s)", ylabel="drivers", xlim=(0, None))
    for axes in (speed, gap, track):
        axes.set_ylim(0, None)
        axes.yaxis.set_major_formatter(PercentFormatter(1.0, decimals=0))
        axes.grid(alpha=0.25)
    figure.suptitle(_title(inspection))
    known = [
        Patch(color=colour, alpha=0.5, label=f"{trait} ({inspection.traits[trait].drivers:,} drivers)")
        for trait, colour in colours.items()
    ]
    figure.legend(handles=known, loc="outside lower center", ncols=len(known), frameon=False)
    return figure


def _draw(axes: Axes, distribution: Distribution, colour: Colour, width: float) -> None:
    """Draw a histogram whose edges lie between the rounded values; nothing where there are no values."""
    if len(distribution.value) == 0:
        return
    first, last = (np.floor(end / width) for end in distribution.value[[0, -1]])
    edges = np.arange(first, last + 2) * width - RESOLUTION / 2
    share, _ = np.histogram(distribution.value, edges, weights=distribution.count / distribution.count.sum())
    axes.stairs(share, edges, color=colour, alpha=0.35, fill=True)
    axes.stairs(share, edges, color=colour)
