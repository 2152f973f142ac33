"""The page: its sections, put together with its style and its scripts."""

import json
import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cache
from html import escape
from pathlib import Path
from string import Template
from typing import Any

from plotly.offline import get_plotlyjs

import tint_sumo
from tint_sumo.core.files import RUN_FILE, read_json, write_text
from tint_sumo.jobs import Workers
from tint_sumo.methods.training import POLICY
from tint_sumo.policy.storage import read_versions
from tint_sumo.study.jobs import read_curves
from tint_sumo.study.page.charts import Chart, condition_charts, curve_chart, outcome_chart, world_chart
from tint_sumo.study.page.choosing import choose
from tint_sumo.study.page.episodes import Recordings, failure_lists, player_data, player_notes, record_episodes
from tint_sumo.study.page.findings import MEANING_OF_P, what_came_out
from tint_sumo.study.page.html import chart, content_policy, folded, json_data, packed, paragraph, section, table
from tint_sumo.study.page.latents import read_latents
from tint_sumo.study.report import StudyReport
from tint_sumo.study.settings import read_scene_of
from tint_sumo.study.summary import Row, at_mixes, in_other_conditions, in_worlds
from tint_sumo.study.tables import Lines, Table

PAGE_FILE = "report.html"
_STATIC = Path(__file__).with_name("static")
_STYLE_OF_PLOTLY = ""  # it adds its rules one by one to an element without text
_STYLE_OF_MAPS = re.compile(r'getElementById\("([0-9a-f]{64})"\)')  # it is added unless there is such an element
_SCRIPTS = ("unpacking.js", "theme.js", "printing.js", "scene.js", "player.js", "latents.js", "charts.js")


@dataclass(frozen=True)
class _Study:
    """Everything that the page shows."""

    out: Path
    rows: tuple[Row, ...]
    tables: dict[str, Table]  # by their headings
    curves: Chart | None
    recordings: Recordings
    latents: dict[str, Any] | None


def write_page(report: StudyReport, out: Path, *, workers: Workers = 2, progress: bool = True) -> StudyReport:
    """Write report.html into a study's folder: one file that needs no network.

    The episodes it shows are recorded first, into ``episodes`` there; what is recorded already is not repeated.

    Args:
        report: of the study.
        out: the study's folder.
        workers: processes at a time that record, or an executor.
        progress: show the progress on stderr.

    Returns:
        The report with the page's file.

    Raises:
        InputError: a file is damaged.
    """
    curves = read_curves(out)
    study = _Study(
        out,
        report.rows,
        {found.heading: found for found in report.tables},
        curve_chart(curves) if curves else None,
        record_episodes(out, read_scene_of(out), choose(report.rows), workers=workers, progress=progress),
        read_latents(out, [row.method for row in report.rows], progress=progress),
    )
    write_text(out / PAGE_FILE, _page(study))
    return replace(report, page_file=out / PAGE_FILE)


def _page(study: _Study) -> str:
    charts: list[Chart] = []
    sections = [
        ("results", "Results", _results(study, charts)),
        ("curves", "Learning curves", _curves(study, charts)),
        ("conditions", "Other conditions and shorter trainings", _conditions(study, charts)),
        ("worlds", "Worlds", _worlds(study, charts)),
        ("player", "Episode player", _player(study)),
        ("failures", "Failures", _failures(study)),
        ("latents", "Latent space", _latents(study)),
        ("making", "How it was made", _making(study)),
    ]
    title = f"Study {study.out.resolve().name}"
    script, style = "\n".join(_static(name) for name in _SCRIPTS), _static("page.css")
    plotly = get_plotlyjs() if charts else ""
    return Template(_static("page.html")).substitute(
        policy=content_policy([script, plotly], [style, _STYLE_OF_PLOTLY]),
        title=escape(title),
        summary="".join(map(paragraph, _summary(study.rows))),
        style=style,
        contents="".join(f'<li><a href="#{name}">{escape(heading)}</a></li>' for name, heading, _ in sections),
        sections="".join(section(name, heading, content) for name, heading, content in sections),
        data=json_data("chart-data", {drawn.name: drawn.figure for drawn in charts}) + _data(study),
        script=script,
        plotly=_without_maps(plotly) + packed("plotly", plotly) if charts else "",
    )


def _without_maps(plotly: str) -> str:
    """Return elements that keep Plotly from adding the style of its maps, which the page has none of."""
    return "".join(f'<template id="{name}"></template>' for name in _STYLE_OF_MAPS.findall(plotly))


@cache
def _static(name: str) -> str:
    return (_STATIC / name).read_text(encoding="utf-8")


def _summary(rows: Sequence[Row]) -> list[str]:
    methods = len({(row.method, row.origin) for row in rows})
    seeds = max(len(row.seeds) for row in rows)
    episodes = sum(row.episodes * len(row.seeds) for row in rows)
    trained = "1 seed" if seeds == 1 else f"up to {seeds} seeds"
    sizes = f"{methods} methods, {trained} of each, {episodes:,} episodes in all."
    return [text for text in (what_came_out(rows), MEANING_OF_P, sizes) if text]


def _shown(drawn: Chart, charts: list[Chart]) -> str:
    charts.append(drawn)
    return chart(drawn.name, drawn.description, drawn.lines)


def _results(study: _Study, charts: list[Chart]) -> str:
    main = at_mixes(study.rows)
    if not main:
        return _left_out("no policy was tested at a single mix of drivers")
    parts = [_shown(outcome_chart(main, outcome), charts) for outcome in ("success", "collision")]
    for heading in (
        "Success by mix of drivers",
        "All outcomes",
        "Collisions by trait and route",
        "Differences in success",
        "Over seeds and conditions",
    ):
        if heading in study.tables:
            parts.append(_table(study.tables[heading]))
    return "".join(parts)


def _table(found: Table) -> str:
    return f"<h3>{escape(found.heading)}</h3>" + table(found.lines, found.heading) + paragraph(found.note)


def _curves(study: _Study, charts: list[Chart]) -> str:
    if study.curves is None:
        return _left_out("the study's folder has no learning curves")
    note = "Means of the seeds, smoothed over five points; bands lead from the worst seed to the best."
    return _shown(study.curves, charts) + paragraph(note)


def _conditions(study: _Study, charts: list[Chart]) -> str:
    varied = in_other_conditions(study.rows)
    if not varied:
        return _left_out("the study tested its policies in the conditions of their training alone")
    shown = [_shown(drawn, charts) for drawn in condition_charts(varied)]
    return "".join(
        [*shown, *(_table(found) for found in study.tables.values() if found.heading.startswith("Other conditions"))]
    )


def _worlds(study: _Study, charts: list[Chart]) -> str:
    found = in_worlds(study.rows)
    if not found:
        return _left_out("the study tested its policies among the drivers of their training alone")
    shown = [_shown(world_chart(found, outcome), charts) for outcome in ("success", "collision")]
    return "".join([*shown, _table(study.tables["Worlds"])])


def _player(study: _Study) -> str:
    if not study.recordings.policies:
        return _left_out("none of the study's policies can be loaded") + player_notes(study.recordings)
    return _static("player.html") + player_notes(study.recordings)


def _failures(study: _Study) -> str:
    if not study.recordings.policies:
        return _left_out("no episodes were recorded")
    lists = failure_lists(study.recordings)
    if not lists:
        return paragraph("There are none: all tested policies succeeded in all cases.")
    return (
        paragraph(
            "A failure opens in the episode player. Of a collision it says which driver was hit: trait and route."
        )
        + lists
    )


def _latents(study: _Study) -> str:
    if study.latents is None:
        return _left_out("no method of the study infers traits with a model")
    return _static("latents.html")


def _making(study: _Study) -> str:
    parts = [paragraph(f"Written by tint_sumo {tint_sumo.__version__}.")]
    if (study.out / RUN_FILE).exists():
        settings = read_json(study.out / RUN_FILE, "run settings")
        lines = [["setting", "value"], *([name, value] for name, value in _flat(settings, ""))]
        parts.append(folded("Settings of the study", table(lines, "Settings of the study")))
    else:
        parts.append(_left_out("the study's folder has no settings"))
    seeds = [["method", "seeds"]]
    seeds += [[title, ", ".join(map(str, numbers))] for title, numbers in _seeds(study.rows).items()]
    parts.append(folded("Seeds of the trainings", table(seeds, "Seeds of the trainings")))
    versions = _versions(study.out)
    if versions:
        parts.append(folded("Versions at the training", table(versions, "Versions at the training")))
    return "".join(parts)


def _flat(value: Any, name: str) -> Iterator[tuple[str, str]]:
    """Return names and values of nested settings."""
    if isinstance(value, Mapping):
        for key, part in value.items():
            yield from _flat(part, f"{name}.{key}" if name else str(key))
    else:
        yield name, json.dumps(value)


def _seeds(rows: Sequence[Row]) -> dict[str, tuple[int, ...]]:
    return {row.title: row.seeds for row in rows}


def _versions(out: Path) -> Lines:
    """Return the versions of the packages at the training; all of them where policies differ."""
    found: dict[str, dict[str, None]] = {}
    for file in sorted(out.glob(f"policies/*/{POLICY}.json")):
        for package, version in read_versions(file.with_suffix("")).items():
            found.setdefault(package, {})[version] = None
    return [["package", "version"], *([name, ", ".join(all_)] for name, all_ in found.items())] if found else []


def _left_out(reason: str) -> str:
    return paragraph(f"This section is left out: {reason}.")


def _data(study: _Study) -> str:
    parts = [player_data(study.recordings)] if study.recordings.policies else []
    if study.latents is not None:
        parts.append(packed("latent-data", json.dumps(study.latents, separators=(",", ":"))))
    return "".join(parts)
