"""A study's results as CSV, Markdown and figures, from the results of the single jobs."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from tint_sumo.core.files import write_text
from tint_sumo.core.percentages import percent, percent_and_ends
from tint_sumo.core.statistics import (
    Scores,
    difference_interval,
    improvement,
    improvement_interval,
    interquartile_interval,
    interquartile_mean,
)
from tint_sumo.envs.rows import BUILT_IN_OUTCOMES
from tint_sumo.study.ceiling_job import read_ceilings
from tint_sumo.study.figures import plot_bars, plot_conditions, plot_curves, plot_profiles, plot_worlds
from tint_sumo.study.jobs import read_curves
from tint_sumo.study.results import read_results
from tint_sumo.study.results_csv import Ceilings, to_csv
from tint_sumo.study.settings import published_for
from tint_sumo.study.summary import (
    Row,
    Summary,
    at_mixes,
    by_method,
    by_title,
    in_other_conditions,
    in_worlds,
    labels,
    scores,
    tabulate,
    title_of,
)
from tint_sumo.study.tables import Lines, Table


@dataclass(frozen=True)
class StudyReport:
    """The tables, and the files that were written."""

    rows: tuple[Row, ...]
    tables: tuple[Table, ...]
    markdown: str
    csv_file: Path
    markdown_file: Path
    figure_files: tuple[Path, ...]
    page_file: Path | None = None  # until the page is written


def write_report(out: Path) -> StudyReport:
    """Write results.csv, results.md and figures into a study's folder.

    Raises:
        InputError: there are no results, or a file is damaged.
    """
    rows, ceilings = tabulate(read_results(out), published_for(out)), read_ceilings(out)
    figures = []
    if at_mixes(rows):
        figures.append(plot_bars(at_mixes(rows), out / "results.png"))
    if in_other_conditions(rows):
        figures.append(plot_conditions(in_other_conditions(rows), out / "conditions.png"))
    if in_worlds(rows):
        figures.append(plot_worlds(in_worlds(rows), out / "worlds.png"))
    if len(found := scores(rows)) > 1:
        figures.append(plot_profiles(found, out / "profiles.png"))
    if curves := read_curves(out):
        figures.append(plot_curves(curves, out / "curves.png"))
    tables = result_tables(rows, ceilings)
    markdown = to_markdown(tables)
    report = StudyReport(tuple(rows), tuple(tables), markdown, out / "results.csv", out / "results.md", tuple(figures))
    write_text(report.csv_file, to_csv(rows, ceilings))
    write_text(report.markdown_file, markdown)
    return report


def to_markdown(tables: Sequence[Table]) -> str:
    return "\n\n".join(part for table in tables for part in table.markdown) + "\n"


def result_tables(rows: Sequence[Row], ceilings: Ceilings) -> list[Table]:
    """Return all tables for readers."""
    main, varied, worlds = at_mixes(rows), in_other_conditions(rows), in_worlds(rows)
    tables = []
    if main:
        tables.append(Table("Success by mix of drivers", _success_lines(main, ceilings), _SUCCESS_NOTE))
        tables.append(Table("All outcomes", _outcome_lines(main), _OUTCOME_NOTE))
        tables.append(Table("Collisions by trait and route", _collision_lines(main), _COLLISION_NOTE))
    if _compared(main):
        tables.append(Table("Differences in success", _difference_lines(main), _DIFFERENCE_NOTE))
    if len(found := scores(rows)) > 1:
        tables.append(Table("Over seeds and conditions", _robust_lines(found), _ROBUST_NOTE))
    if varied:
        note = f"Success (collision) in percent; {_cases_of(varied)}. As trained: the conditions of the training."
        tables.append(Table("Other conditions and shorter trainings", _condition_lines(varied), note))
    if worlds:
        note = f"Success / timeout / collision in percent; {_cases_of(worlds)}. {_WORLD_NOTE}"
        tables.append(Table("Worlds", _world_lines(worlds), note))
    return tables


_SUCCESS_NOTE = (
    "Success in percent of the cases, ± the standard deviation between training seeds. Ceiling: the share of the cases "
    "in which enough yielding drivers come in time for a driver that enters a lane only before one of them. "
    "Paper: the published rates of its method, of policies trained for each mix in the authors' simulator."
)
_OUTCOME_NOTE = (
    "Percent of the cases with 95 % intervals: over seeds and cases where there are several seeds (bootstrap), over "
    "cases alone (Wilson) where there is one. Time: mean of the successful cases. Paper: published success / timeout / "
    "collision of 500 episodes."
)
_COLLISION_NOTE = "Collisions in 1,000 cases by trait and route of the driver that was hit, over all seeds and mixes."
_DIFFERENCE_NOTE = (
    "Difference to another method's success on the same cases, of trainings at the same mix, in percentage points with "
    "95 % intervals over seeds and cases (bootstrap)."
)
_ROBUST_NOTE = (
    "Success in percent over all fully trained policies and all conditions that every method was tested in: the "
    "interquartile mean, which is the mean of the middle half, with its 95 % interval; means of the worst and of the "
    "best seed; and the probability that a training beats one of the method without labels (Agarwal et al. 2021)."
)
_WORLD_NOTE = "A world is a population of drivers and a sensor."


def _success_lines(rows: Sequence[Summary], ceilings: Ceilings) -> Lines:
    mixes = sorted({_number(row) for row in rows})
    lines = [["method", "seeds", *(f"P {p:g}" for p in mixes)]]
    kinds = dict.fromkeys((row.method, row.origin, row.title, row.mix) for row in by_method(rows))
    for method, origin, title, mix in kinds:
        at = {_number(row): row for row in rows if (row.method, row.origin, row.mix) == (method, origin, mix)}
        cells = [_with_spread(at[p]) if p in at else "-" for p in mixes]
        lines.append([title, str(len(next(iter(at.values())).seeds)), *cells])
    if ceilings:
        lines.append(["ceiling", "", *(percent(ceilings[p]) if p in ceilings else "-" for p in mixes)])
    paper = {_number(row): row.published["success"] for row in rows if row.method == "vae" and row.published}
    if paper:
        lines.append(["paper", "", *(f"{paper[p]:g}" if p in paper else "-" for p in mixes)])
    return lines


def _outcome_lines(rows: Sequence[Summary]) -> Lines:
    lines = [["P", "method", *(f"{outcome} %" for outcome in BUILT_IN_OUTCOMES), "time s", "cases", "seeds", "paper %"]]
    for row in rows:
        time_s = row.navigation_time_s
        lines.append(
            [
                _mix(row),
                row.title,
                *(_with_interval(row, outcome) for outcome in BUILT_IN_OUTCOMES),
                "-" if time_s is None else f"{time_s:.1f}",
                str(row.episodes),
                ", ".join(map(str, row.seeds)),
                " / ".join(f"{rate:g}" for rate in row.published.values()) or "-",
            ]
        )
    return lines


def _collision_lines(rows: Sequence[Row]) -> Lines:
    kinds = sorted({kind for row in rows for kind in row.collisions})
    lines = [["method", *kinds]]
    for title, found in by_title(rows).items():
        cases = sum(row.episodes * len(row.seeds) for row in found)
        counts = [sum(row.collisions.get(kind, 0) for row in found) for kind in kinds]
        lines.append([title, *(f"{1000 * count / cases:.1f}" for count in counts)])
    return lines


def _compared(rows: Sequence[Row]) -> list[Row]:
    """Return the rows of methods with several trainings."""
    return [row for row in rows if len(row.seeds) > 1]


def _difference_lines(rows: Sequence[Row]) -> Lines:
    trained = _compared(rows)
    mixes = sorted({_number(row) for row in trained})
    lines = [["method", "less", *(f"P {p:g}" for p in mixes)]]
    for other in ("oracle", "no_labels"):
        for title, found in by_title([row for row in trained if row.method != other]).items():
            same = [row for row in trained if (row.method, row.mix) == (other, found[0].mix)]
            if same:
                at, references = ({_number(row): row for row in rows} for rows in (found, same))
                lines.append([title, same[0].title, *(_difference(at.get(p), references.get(p)) for p in mixes)])
    return lines


def _difference(row: Row | None, other: Row | None) -> str:
    if row is None or other is None or row.episodes != other.episodes:
        return "-"
    low, high = difference_interval(row.hits("success"), other.hits("success"))
    return f"{100 * (row.rate('success') - other.rate('success')):+.1f} [{100 * low:+.1f}, {100 * high:+.1f}]"


def _robust_lines(found: Mapping[str, Scores]) -> Lines:
    reference = found.get("no_labels")
    lines = [["method", "seeds", "interquartile mean", "worst seed", "best seed", "beats no labels %"]]
    for method, method_scores in found.items():
        means = method_scores.mean(axis=1)
        chance = "-"
        if reference is not None and reference is not method_scores:
            chance = percent_and_ends(
                improvement(method_scores, reference), improvement_interval(method_scores, reference)
            )
        middle = percent_and_ends(interquartile_mean(method_scores), interquartile_interval(method_scores))
        worst, best = percent(float(means.min())), percent(float(means.max()))
        lines.append([title_of(method), str(len(means)), middle, worst, best, chance])
    return lines


def _condition_lines(rows: Sequence[Summary]) -> Lines:
    names = labels(rows)
    lines = [["method", *names.values()]]
    for title, found in by_title(rows).items():
        rates = {row.conditions: [percent(row.rate(outcome)) for outcome in ("success", "collision")] for row in found}
        cells = ["{} ({})".format(*rates[conditions]) if conditions in rates else "-" for conditions in names]
        lines.append([title, *cells])
    return lines


def _world_lines(rows: Sequence[Summary]) -> Lines:
    titles = list(by_title(rows))
    lines = [["world", *titles]]
    for conditions, name in labels(rows).items():
        found = [row for row in rows if row.conditions == conditions]
        at = {row.title: "/".join(percent(row.rate(outcome), 0) for outcome in BUILT_IN_OUTCOMES) for row in found}
        lines.append([name, *(at.get(title, "-") for title in titles)])
    return lines


def _cases_of(rows: Sequence[Summary]) -> str:
    """Return a clause about P(conservative) of the cases."""
    first, *others = {row.conditions.p_conservative for row in rows}
    if others:
        return "P is P(conservative) of the cases"
    if first.is_single:
        return f"P(conservative) is {first.text}"
    return f"every case has its own P(conservative) between {first.low:g} and {first.high:g}"


def _number(row: Summary) -> float:
    """Return P(conservative) of a row's cases; NaN where each case has its own."""
    p = row.conditions.p_conservative
    return p.low if p.is_single else math.nan


def _mix(row: Summary) -> str:
    return row.conditions.p_conservative.text


def _with_spread(row: Summary) -> str:
    spread, rate = row.spread("success"), row.rate("success")
    return percent(rate) + ("" if spread is None else f" ± {100 * spread:.1f}")


def _with_interval(row: Summary, outcome: str) -> str:
    return percent_and_ends(row.rate(outcome), row.intervals[outcome])
