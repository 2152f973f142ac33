"""The page's charts, as Plotly takes them; colours of paper and ink are the page's."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import pandas as pd

from tint_sumo.config import Mix
from tint_sumo.core.percentages import percent
from tint_sumo.core.sampling import evenly_spread
from tint_sumo.methods.registry import Look
from tint_sumo.study.jobs import smoothed_percent
from tint_sumo.study.summary import (
    CONDITION_TITLES,
    Summary,
    by_line,
    by_title,
    labels,
    looks,
    marker_offset,
    titles_and_looks,
    varied,
)
from tint_sumo.study.tables import Lines

# Plotly's names for Matplotlib's markers and line styles.
_SYMBOLS = {
    **{"o": "circle", "s": "square", "D": "diamond", "d": "diamond-tall", "^": "triangle-up", "v": "triangle-down"},
    **{"<": "triangle-left", ">": "triangle-right", "P": "cross", "X": "x", "*": "star", "h": "hexagon"},
    "p": "pentagon",
}
_DASHES = {"-": "solid", "--": "dash", ":": "dot", "-.": "dashdot"}
# Mixes are no methods: all have the same colour, and different markers.
_MIX_COLOUR, _MIX_MARKERS = "#70757a", "oD^sv*PXh"
_ROW_PX = 46  # height of a method's row
_MOST_OFFSET = 0.3  # of a marker from its row, in rows
_CURVE_LINES = 10  # rows of the table of learning curves


@dataclass(frozen=True)
class Chart:
    name: str
    description: str
    lines: Lines  # its numbers
    figure: dict[str, Any]  # Plotly's data and layout


def outcome_chart(rows: Sequence[Summary], outcome: str) -> Chart:
    """Return the chart of an outcome's rates with intervals: a line for each method, a marker for each mix."""
    titles = list(by_title(rows))
    mixes = sorted({row.conditions.p_conservative for row in rows})
    traces, lines = [], [["method", "P(conservative)", f"{outcome} %", "95 % interval"]]
    for position, mix in enumerate(mixes):
        shown_rows = [row for row in rows if row.conditions.p_conservative == mix]
        shift = marker_offset(position, len(mixes), _MOST_OFFSET)
        shares, limits = _rates(shown_rows, outcome)
        heights = [titles.index(row.title) + shift for row in shown_rows]
        look = Look(_MIX_COLOUR, _MIX_MARKERS[position % len(_MIX_MARKERS)])
        traces.append(
            {
                **_marks(shares, heights, f"P {mix.low:g}", look),
                "mode": "markers",
                "error_x": _errors(shares, limits),
                "text": [row.title for row in shown_rows],
                "hovertemplate": "%{text}: %{x:.1f} %<extra>%{fullData.name}</extra>",
            }
        )
    for title, shown_rows in by_title(rows).items():
        for row in shown_rows:
            share, span = percent(row.rate(outcome)), _span(row.intervals[outcome])
            lines.append([title, f"{row.conditions.p_conservative.low:g}", share, span])
    layout = {
        "height": 120 + _ROW_PX * len(titles),
        "xaxis": {"title": {"text": f"{outcome}, % of the cases"}, "range": [-1, 101]},
        "yaxis": _row_axis(titles),
    }
    description = f"{outcome} by method and mix of drivers, with 95 % intervals"
    return Chart(outcome, description.capitalize(), lines, {"data": traces, "layout": layout})


def curve_chart(curves: Mapping[tuple[str, Mix], Sequence[pd.DataFrame]]) -> Chart:
    """Return the chart of success in training against decisions: the mean over the seeds, and their range as a band."""
    traces: list[dict[str, Any]] = []
    lines = [["method", "decisions", "success %", "range of the seeds"]]
    for seeds, (title, look) in zip(curves.values(), titles_and_looks(curves), strict=True):
        success = smoothed_percent(seeds)
        at = success.index.to_numpy()
        middle, low, high = success.mean(axis=1), success.min(axis=1), success.max(axis=1)
        if len(seeds) > 1:
            traces.append(_band(at, low.to_numpy(), high.to_numpy(), look))
        line = _marks(at, _rounded(middle.to_numpy()), title, look)
        line["marker"]["maxdisplayed"] = 8
        traces.append({**line, "mode": "lines+markers", "line": _line(look)})
        for row in evenly_spread(len(at), _CURVE_LINES):
            span = _span((low.iloc[row] / 100.0, high.iloc[row] / 100.0)) if len(seeds) > 1 else "-"
            lines.append([title, f"{at[row]:,.0f}", percent(middle.iloc[row] / 100.0), span])
    layout = {
        "height": 480,
        "xaxis": {"title": {"text": "decisions of the policy"}},
        "yaxis": {"title": {"text": "success in training, %"}, "range": [0, 101]},
    }
    return Chart("curves", "Success in training by decisions", lines, {"data": traces, "layout": layout})


def condition_charts(rows: Sequence[Summary]) -> list[Chart]:
    """Return charts of success against each condition in which the rows differ from the conditions of the training."""
    charts, drawn = [], by_line(rows)
    for name, title in CONDITION_TITLES.items():
        traces, lines = [], [["method", title, "success %", "95 % interval"]]
        for (method, shown_rows), look in zip(drawn.items(), looks(drawn), strict=True):
            points = varied(shown_rows, name)
            shares, limits = _rates(list(points.values()), "success")
            for value, row in points.items():
                lines.append([method, f"{value:g}", percent(row.rate("success")), _span(row.intervals["success"])])
            line = _marks(list(points), shares, method, look, is_open=shown_rows[0].is_shipped)
            traces.append({**line, "mode": "lines+markers", "line": _line(look), "error_y": _errors(shares, limits)})
        if any(len(trace["x"]) > 1 for trace in traces):
            layout = {
                "height": 480,
                "xaxis": {"title": {"text": title}},
                "yaxis": {"title": {"text": "success, % of the cases"}, "range": [0, 101]},
            }
            charts.append(Chart(name, f"Success by {title}", lines, {"data": traces, "layout": layout}))
    return charts


def world_chart(rows: Sequence[Summary], outcome: str) -> Chart:
    """Return the chart of an outcome's rates in each world: a line for each world, a marker for each method."""
    worlds, methods = labels(rows), by_title(rows)
    names = list(worlds.values())
    traces, lines = [], [["world", "method", f"{outcome} %", "95 % interval"]]
    for position, ((title, shown_rows), look) in enumerate(zip(methods.items(), looks(methods), strict=True)):
        shift = marker_offset(position, len(methods), _MOST_OFFSET)
        shares, limits = _rates(shown_rows, outcome)
        heights = [list(worlds).index(row.conditions) + shift for row in shown_rows]
        line = _marks(shares, heights, title, look, is_open=shown_rows[0].is_shipped)
        traces.append({**line, "mode": "markers", "error_x": _errors(shares, limits)})
    for conditions, name in worlds.items():
        for row in (row for row in rows if row.conditions == conditions):
            lines.append([name, row.title, percent(row.rate(outcome)), _span(row.intervals[outcome])])
    layout = {
        "height": 120 + _ROW_PX * len(names),
        "xaxis": {"title": {"text": f"{outcome}, % of the cases"}, "range": [-1, 101]},
        "yaxis": _row_axis(names),
    }
    description = f"{outcome} by world and method, with 95 % intervals"
    return Chart(f"worlds-{outcome}", description.capitalize(), lines, {"data": traces, "layout": layout})


def _row_axis(titles: Sequence[str]) -> dict[str, Any]:
    """Return a vertical axis with a row for each title, the first on top."""
    return {
        "tickvals": list(range(len(titles))),
        "ticktext": list(titles),
        "range": [len(titles) - 0.5, -0.5],
        "zeroline": False,
    }


def _rates(rows: Sequence[Summary], outcome: str) -> tuple[list[float], list[tuple[float, float]]]:
    """Return the rate of each row and the ends of its interval, in percent."""
    limits = [row.intervals[outcome] for row in rows]
    return (
        [round(100 * row.rate(outcome), 2) for row in rows],
        [(round(100 * low, 2), round(100 * high, 2)) for low, high in limits],
    )


def _span(interval: tuple[float, float]) -> str:
    low, high = interval
    return f"{percent(low)} to {percent(high)}"


def _errors(shares: Sequence[float], limits: Sequence[tuple[float, float]]) -> dict[str, Any]:
    above = [round(high - share, 2) for share, (_, high) in zip(shares, limits, strict=True)]
    below = [round(share - low, 2) for share, (low, _) in zip(shares, limits, strict=True)]
    return {"type": "data", "symmetric": False, "array": above, "arrayminus": below, "thickness": 1.2, "width": 3}


def _marks(x: Any, y: Any, name: str, look: Look, *, is_open: bool = False) -> dict[str, Any]:
    symbol = _SYMBOLS[look.marker] + ("-open" if is_open else "")
    marker = {"symbol": symbol, "size": 8, "color": look.colour}
    return {"type": "scatter", "x": list(map(float, x)), "y": list(map(float, y)), "name": name, "marker": marker}


def _line(look: Look) -> dict[str, Any]:
    return {"color": look.colour, "dash": _DASHES[look.dash], "width": 1.8}


def _band(at: Any, low: Any, high: Any, look: Look) -> dict[str, Any]:
    return {
        "type": "scatter",
        "x": [*map(float, at), *map(float, at[::-1])],
        "y": [*_rounded(low), *_rounded(high[::-1])],
        "fill": "toself",
        "fillcolor": look.colour,
        "opacity": 0.15,
        "line": {"width": 0},
        "mode": "lines",
        "hoverinfo": "skip",
        "showlegend": False,
    }


def _rounded(values: Any) -> list[float]:
    return [round(float(value), 2) for value in values]
