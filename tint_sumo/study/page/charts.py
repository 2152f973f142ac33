"""The page's charts, as Plotly takes them; colours of paper and ink are the page's."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import pandas as pd

from tint_sumo.config import ends
from tint_sumo.study.methods import METHODS
from tint_sumo.study.policy_jobs import smoothed_percent
from tint_sumo.study.rows import WORLDS, Row, by_title, varied
from tint_sumo.study.tables import Lines

# Of middling lightness, to be seen on white and on black; lines differ in marker and dash, too.
_COLOURS = (
    *("#2f7fc1", "#c2571a", "#2a8f5b", "#b0468f", "#8a6fd1", "#8c7324"),
    *("#c8475a", "#4a8c99", "#7a7f87", "#5f8f1f", "#4f6fe0"),
)
_MARKERS = ("circle", "square", "diamond", "triangle-up", "x", "star", "triangle-down", "cross", "hexagon", "pentagon")
_DASHES = ("solid", "dash", "dot", "dashdot", "longdash")
_ROW_PX = 46  # height of a method's row
_CURVE_LINES = 10  # rows of the table of learning curves


@dataclass(frozen=True)
class Chart:
    name: str
    description: str
    lines: Lines  # its numbers
    figure: dict[str, Any]  # Plotly's data and layout


def outcome_chart(rows: Sequence[Row], outcome: str) -> Chart:
    """Rates of an outcome with intervals: a line of the chart for each method, a marker for each mix."""
    titles = list(by_title(rows))
    mixes = sorted({ends(row.conditions.p_conservative) for row in rows})
    traces, lines = [], [["method", "P(conservative)", f"{outcome} %", "95 % interval"]]
    for position, mix in enumerate(mixes):
        own = [row for row in rows if ends(row.conditions.p_conservative) == mix]
        shift = 0.0 if len(mixes) == 1 else 0.3 * (2 * position / (len(mixes) - 1) - 1)
        percent, limits = _rates(own, outcome)
        traces.append(
            {
                **_marks(percent, [titles.index(row.title) + shift for row in own], position, f"P {mix[0]:g}"),
                "mode": "markers",
                "error_x": _errors(percent, limits),
                "text": [row.title for row in own],
                "hovertemplate": "%{text}: %{x:.1f} %<extra>%{fullData.name}</extra>",
            }
        )
    for title, own in by_title(rows).items():
        for row in own:
            (share,), (limit,) = _rates([row], outcome)
            span = f"{limit[0]:.1f} to {limit[1]:.1f}"
            lines.append([title, f"{ends(row.conditions.p_conservative)[0]:g}", f"{share:.1f}", span])
    layout = {
        "height": 120 + _ROW_PX * len(titles),
        "xaxis": {"title": {"text": f"{outcome}, % of the cases"}, "range": [-1, 101]},
        "yaxis": {
            "tickvals": list(range(len(titles))),
            "ticktext": titles,
            "range": [len(titles) - 0.5, -0.5],
            "zeroline": False,
        },
    }
    description = f"{outcome} by method and mix of drivers, with 95 % intervals"
    return Chart(outcome, description.capitalize(), lines, {"data": traces, "layout": layout})


def curve_chart(curves: Mapping[str, Sequence[pd.DataFrame]]) -> Chart:
    """Success in training against decisions: the mean over the seeds, and the range between them as a band."""
    traces: list[dict[str, Any]] = []
    lines = [["method", "decisions", "success %", "range of the seeds"]]
    for method, seeds in curves.items():
        position = _position(method)
        percent = smoothed_percent(seeds)
        at, title = percent.index.to_numpy(), METHODS[method].title
        middle, low, high = percent.mean(axis=1), percent.min(axis=1), percent.max(axis=1)
        if len(seeds) > 1:
            traces.append(_band(at, low.to_numpy(), high.to_numpy(), position))
        line = _marks(at, _rounded(middle.to_numpy()), position, title)
        line["marker"]["maxdisplayed"] = 8
        traces.append({**line, "mode": "lines+markers", "line": _line(position)})
        for row in np.unique(np.linspace(0, len(at) - 1, _CURVE_LINES).round().astype(int)):
            span = f"{low.iloc[row]:.1f} to {high.iloc[row]:.1f}" if len(seeds) > 1 else "-"
            lines.append([title, f"{at[row]:,.0f}", f"{middle.iloc[row]:.1f}", span])
    layout = {
        "height": 480,
        "xaxis": {"title": {"text": "decisions of the policy"}},
        "yaxis": {"title": {"text": "success in training, %"}, "range": [0, 101]},
    }
    return Chart("curves", "Success in training by decisions", lines, {"data": traces, "layout": layout})


def world_charts(rows: Sequence[Row]) -> list[Chart]:
    """Success against each condition in which the rows differ from the training's world."""
    charts = []
    for name, title in WORLDS.items():
        traces, lines = [], [["method", title, "success %", "95 % interval"]]
        for method, own in by_title(rows).items():
            position = _position(own[0].method)
            points = varied(own, name)
            percent, limits = _rates(list(points.values()), "success")
            for value, share, (low, high) in zip(points, percent, limits, strict=True):
                lines.append([method, f"{value:g}", f"{share:.1f}", f"{low:.1f} to {high:.1f}"])
            line = _marks(list(points), percent, position, method, is_open=own[0].is_shipped)
            traces.append(
                {**line, "mode": "lines+markers", "line": _line(position), "error_y": _errors(percent, limits)}
            )
        if any(len(trace["x"]) > 1 for trace in traces):
            layout = {
                "height": 480,
                "xaxis": {"title": {"text": title}},
                "yaxis": {"title": {"text": "success, % of the cases"}, "range": [0, 101]},
            }
            charts.append(Chart(name, f"Success by {title}", lines, {"data": traces, "layout": layout}))
    return charts


def _rates(rows: Sequence[Row], outcome: str) -> tuple[list[float], list[tuple[float, float]]]:
    """Of each row, in percent: the rate, and the ends of its interval."""
    limits = [row.intervals[outcome] for row in rows]
    return (
        [round(100 * row.rate(outcome), 2) for row in rows],
        [(round(100 * low, 2), round(100 * high, 2)) for low, high in limits],
    )


def _errors(percent: Sequence[float], limits: Sequence[tuple[float, float]]) -> dict[str, Any]:
    above = [round(high - share, 2) for share, (_, high) in zip(percent, limits, strict=True)]
    below = [round(share - low, 2) for share, (low, _) in zip(percent, limits, strict=True)]
    return {"type": "data", "symmetric": False, "array": above, "arrayminus": below, "thickness": 1.2, "width": 3}


def _position(method: str) -> int:
    """A method looks the same in every chart."""
    return list(METHODS).index(method) if method in METHODS else len(METHODS)


def _marks(x: Any, y: Any, position: int, name: str, *, is_open: bool = False) -> dict[str, Any]:
    symbol = _MARKERS[position % len(_MARKERS)] + ("-open" if is_open else "")
    marker = {"symbol": symbol, "size": 8, "color": _colour(position)}
    return {"type": "scatter", "x": list(map(float, x)), "y": list(map(float, y)), "name": name, "marker": marker}


def _line(position: int) -> dict[str, Any]:
    return {"color": _colour(position), "dash": _DASHES[position % len(_DASHES)], "width": 1.8}


def _colour(position: int) -> str:
    return _COLOURS[position % len(_COLOURS)]


def _band(at: Any, low: Any, high: Any, position: int) -> dict[str, Any]:
    return {
        "type": "scatter",
        "x": [*map(float, at), *map(float, at[::-1])],
        "y": [*_rounded(low), *_rounded(high[::-1])],
        "fill": "toself",
        "fillcolor": _colour(position),
        "opacity": 0.15,
        "line": {"width": 0},
        "mode": "lines",
        "hoverinfo": "skip",
        "showlegend": False,
    }


def _rounded(values: Any) -> list[float]:
    return [round(float(value), 2) for value in values]
