"""The results table, as CSV and Markdown, and the bar figure, from the results of the single jobs."""

import csv
import io
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import groupby
from pathlib import Path
from typing import Any

from matplotlib.axes import Axes
from matplotlib.figure import Figure

from tint_sumo.files import whole_file, write_text
from tint_sumo.study.evaluation import OUTCOMES, Evaluation
from tint_sumo.study.methods import METHODS
from tint_sumo.study.published import RATES_PERCENT
from tint_sumo.study.results import Result, read_results
from tint_sumo.study.tables import markdown_table

COLOURS = {"success": "#3b8a5a", "timeout": "#e8c468", "collision": "#c8503c"}
INK = {"success": "white", "timeout": "black", "collision": "white"}  # of the numbers on these colours


@dataclass(frozen=True)
class Row:
    """One line of the table: all seeds of a method at one P(conservative)."""

    method: str
    p_conservative: float
    seeds: tuple[int, ...]
    evaluation: Evaluation  # the cases of all seeds

    @property
    def title(self) -> str:
        return METHODS[self.method].title if self.method in METHODS else self.method

    @property
    def published(self) -> dict[str, float]:
        """The paper's rates in percent, empty where it has none."""
        rates = RATES_PERCENT.get((self.method, self.p_conservative), ())
        return dict(zip(OUTCOMES, rates, strict=False))

    def to_json(self) -> dict[str, Any]:
        return {
            "method": self.method,
            "p_conservative": self.p_conservative,
            "seeds": list(self.seeds),
            **self.evaluation.summary(),
            "published_percent": self.published or None,
        }


@dataclass(frozen=True)
class StudyReport:
    """What was written, and the table itself."""

    rows: tuple[Row, ...]
    markdown: str
    csv_file: Path
    markdown_file: Path
    figure_file: Path


def tabulate(results: Sequence[Result]) -> list[Row]:
    """One row per P(conservative) and method, methods in the registry's order, seeds pooled."""
    order = {name: position for position, name in enumerate(METHODS)}

    def key(result: Result) -> tuple[float, int, str]:
        return result.p_conservative, order.get(result.method, len(order)), result.method

    rows = []
    for (p_conservative, _, method), group in groupby(sorted(results, key=key), key):
        members = sorted(group, key=lambda result: result.seed)
        cases = tuple(case for member in members for case in member.evaluation.cases)
        rows.append(Row(method, p_conservative, tuple(member.seed for member in members), Evaluation(cases)))
    return rows


def write_report(out: Path) -> StudyReport:
    """Write results.csv, results.md and results.png into a study's folder.

    Raises:
        InputError: there are no results, or a file is damaged.
    """
    rows = tabulate(read_results(out))
    report = StudyReport(tuple(rows), to_markdown(rows), out / "results.csv", out / "results.md", out / "results.png")
    write_text(report.csv_file, to_csv(rows))
    write_text(report.markdown_file, report.markdown)
    plot(rows, report.figure_file)
    return report


def to_csv(rows: Sequence[Row]) -> str:
    """Rates and interval ends in percent; the paper's rates in the last three columns."""
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    measured = [f"{outcome}{part}_percent" for outcome in OUTCOMES for part in ("", "_low", "_high")]
    published = [f"paper_{outcome}_percent" for outcome in OUTCOMES]
    writer.writerow(["method", "p_conservative", *measured, "navigation_time_s", "episodes", "seeds", *published])
    for row in rows:
        rates = [row.evaluation.rate(outcome) for outcome in OUTCOMES]
        numbers = [f"{100.0 * part:.2f}" for rate in rates for part in (rate.value, *rate.interval)]
        time_s = row.evaluation.navigation_time_s
        writer.writerow(
            [
                row.method,
                f"{row.p_conservative:g}",
                *numbers,
                "" if time_s is None else f"{time_s:.2f}",
                len(row.evaluation.cases),
                " ".join(map(str, row.seeds)),
                *(row.published.get(outcome, "") for outcome in OUTCOMES),
            ]
        )
    return text.getvalue()


def to_markdown(rows: Sequence[Row]) -> str:
    """The table for readers: rates in percent with 95 % Wilson intervals, the paper's in the last column."""
    header = ["P(cons.)", "method", *(f"{outcome} %" for outcome in OUTCOMES), "time s", "episodes", "seeds", "paper %"]
    lines = [header]
    for row in rows:
        time_s = row.evaluation.navigation_time_s
        lines.append(
            [
                f"{row.p_conservative:g}",
                row.title,
                *(_rate_text(row.evaluation, outcome) for outcome in OUTCOMES),
                "-" if time_s is None else f"{time_s:.1f}",
                str(len(row.evaluation.cases)),
                ", ".join(map(str, row.seeds)),
                " / ".join(f"{rate:g}" for rate in row.published.values()) or "-",
            ]
        )
    note = (
        "Rates with 95 % Wilson intervals over all episodes; they leave out the spread between training seeds.\n"
        "time: mean navigation time of successful episodes. "
        "paper: published success / timeout / collision of 500 episodes."
    )
    return markdown_table(lines) + "\n\n" + note + "\n"


def _rate_text(evaluation: Evaluation, outcome: str) -> str:
    rate = evaluation.rate(outcome)
    low, high = rate.interval
    return f"{100 * rate.value:.1f} [{100 * low:.1f}, {100 * high:.1f}]"


def plot(rows: Sequence[Row], file: Path) -> None:
    """Stacked bars of success, timeout and collision as in the paper's Fig. 4, one panel per P(conservative)."""
    panels = [(p, list(group)) for p, group in groupby(rows, key=lambda row: row.p_conservative)]
    width = sum(1.0 + 0.85 * len(group) for _, group in panels)
    figure = Figure(figsize=(max(width, 4.5), 4.2), dpi=150, layout="constrained")
    all_axes = figure.subplots(
        1, len(panels), sharey=True, squeeze=False, width_ratios=[len(group) for _, group in panels]
    )[0]
    for axes, (p_conservative, group) in zip(all_axes, panels, strict=True):
        _plot_panel(axes, group)
        axes.set_title(f"P(conservative) = {p_conservative:g}", fontsize=10)
    all_axes[0].set_ylabel("share of episodes (%)")
    entries = list(zip(*all_axes[0].get_legend_handles_labels(), strict=True))
    entries.sort(key=lambda entry: entry[1] not in OUTCOMES)  # the bars first
    handles, labels = zip(*entries, strict=True)
    figure.legend(handles, labels, loc="outside lower center", ncols=3, frameon=False, fontsize=9)
    with whole_file(file) as partial:
        figure.savefig(partial, format="png")


def _plot_panel(axes: Axes, rows: Sequence[Row]) -> None:
    positions = range(len(rows))
    bottom = [0.0] * len(rows)
    for outcome in OUTCOMES:
        heights = [100.0 * row.evaluation.rate(outcome).value for row in rows]
        axes.bar(positions, heights, 0.7, bottom=bottom, color=COLOURS[outcome], label=outcome)
        for position, start, height in zip(positions, bottom, heights, strict=True):
            if height >= 5.0:  # thinner parts have no room for a number
                axes.text(
                    position,
                    start + height / 2,
                    f"{height:.0f}",
                    ha="center",
                    va="center",
                    fontsize=8,
                    color=INK[outcome],
                )
        bottom = [start + height for start, height in zip(bottom, heights, strict=True)]
    _mark_success(axes, rows)
    axes.set_xticks(list(positions), [row.title.replace(" ", "\n") for row in rows], fontsize=8)
    axes.set_ylim(0, 100)
    axes.spines[["top", "right"]].set_visible(False)


def _mark_success(axes: Axes, rows: Sequence[Row]) -> None:
    """The interval of the success rate, and the paper's rate as an arrowhead at the bar's side."""
    for position, row in enumerate(rows):
        rate = row.evaluation.rate("success")
        low, high = rate.interval
        below, above = 100 * (rate.value - low), 100 * (high - rate.value)
        label = "95 % interval" if position == 0 else None
        axes.errorbar(
            position - 0.2, 100 * rate.value, [[below], [above]], fmt="none", ecolor="black", capsize=3, label=label
        )
    published = [row.published.get("success", float("nan")) for row in rows]
    axes.plot([position + 0.43 for position in range(len(rows))], published, "k<", ms=7, label="success in the paper")
