"""A study's results as CSV: a line for each row of its tables, for other programs and for figures."""

import csv
import io
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from tint_sumo.config import Mix
from tint_sumo.core.errors import InputError
from tint_sumo.core.reading import RESULT_BYTES, read_file
from tint_sumo.core.statistics import Interval
from tint_sumo.envs.rows import BUILT_IN_OUTCOMES
from tint_sumo.study.budgets import Conditions
from tint_sumo.study.summary import Summary, named

Ceilings = Mapping[float, float]  # share of the cases that a careful driver can finish, by P(conservative)

_PARTS = ("", "_low", "_high", "_sd")  # a rate, the ends of its interval, its spread between seeds
_CONDITIONS = ("p_conservative", "position_noise_m", "tau_s", "scene_tau_s", "training_percent", "world")
COLUMNS = (
    *("method", "origin", "trained_p_conservative", *_CONDITIONS),
    *(f"{outcome}{part}_percent" for outcome in BUILT_IN_OUTCOMES for part in _PARTS),
    *("navigation_time_s", "episodes", "seeds", "ceiling_percent"),
    *(f"paper_{outcome}_percent" for outcome in BUILT_IN_OUTCOMES),
)


@dataclass(frozen=True)
class StoredRow(Summary):
    """A line of such a table that was read back: rates and intervals, without the single cases."""

    cases: int
    rates: Mapping[str, float]  # by outcome, as are the next two
    limits: Mapping[str, Interval]
    spreads: Mapping[str, float | None]
    time_s: float | None

    @property
    def episodes(self) -> int:
        return self.cases

    def rate(self, outcome: str) -> float:
        return self.rates[outcome]

    def spread(self, outcome: str) -> float | None:
        return self.spreads[outcome]

    @property
    def intervals(self) -> Mapping[str, Interval]:
        return self.limits

    @property
    def navigation_time_s(self) -> float | None:
        return self.time_s


def to_csv(rows: Sequence[Summary], ceilings: Ceilings) -> str:
    """Return rates, ends of intervals and spread in percent; the paper's rates are in the last three columns."""
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(COLUMNS)
    for row in rows:
        conditions, time_s = row.resolved, row.navigation_time_s
        tested = (conditions.position_noise_m, conditions.tau_s, row.scene_tau_s, conditions.percent)
        p = conditions.p_conservative
        ceiling = ceilings.get(p.low) if row.conditions.is_single_mix else None  # of the scene's own traffic
        numbers: list[str] = []
        for outcome in BUILT_IN_OUTCOMES:
            numbers += (_percent(part) for part in (row.rate(outcome), *row.intervals[outcome], row.spread(outcome)))
        writer.writerow(
            [
                *(row.method, row.origin, "" if row.mix is None else row.mix.text, p.text),
                *("" if value is None else f"{value:g}" for value in tested),
                conditions.world or "",
                *numbers,
                "" if time_s is None else f"{time_s:.2f}",
                row.episodes,
                " ".join(map(str, row.seeds)),
                _percent(ceiling),
                *(f"{row.published[outcome]:g}" if row.published else "" for outcome in BUILT_IN_OUTCOMES),
            ]
        )
    return text.getvalue()


def read_csv(file: Path) -> tuple[list[StoredRow], dict[float, float]]:
    """Return the rows of a table that ``to_csv`` wrote, and the ceilings, by P(conservative).

    Raises:
        InputError: there is no such file, or it is another kind of table.
    """
    content = read_file(file, "results", RESULT_BYTES)
    try:
        table = list(csv.DictReader(io.StringIO(content.decode(), newline=""), strict=True))
        if not table:
            raise ValueError("no rows")
        named_mix = named(_mix(line) for line in table)
        rows = [_row(line, named_mix(_mix(line))) for line in table]
        stated = [line for line in table if line["ceiling_percent"]]
        ceilings = {float(line["p_conservative"]): _read_percent(line["ceiling_percent"]) for line in stated}
    except (KeyError, TypeError, AttributeError, ValueError, csv.Error) as error:
        raise InputError(f"{file} is no results.csv of a study ({error!r})") from None
    return rows, ceilings


def _mix(line: Mapping[str, str]) -> Mix | None:
    """Return P(conservative) in training."""
    text = line["trained_p_conservative"]
    return Mix.from_text(text) if text else None


def _row(line: Mapping[str, str], named_mix: Mix | None) -> StoredRow:
    rates, limits, spreads = {}, {}, {}
    for outcome in BUILT_IN_OUTCOMES:
        rate, low, high, spread = (line[f"{outcome}{part}_percent"] for part in _PARTS)
        rates[outcome], limits[outcome] = _read_percent(rate), (_read_percent(low), _read_percent(high))
        spreads[outcome] = _read_percent(spread) if spread else None
    time_s, published = line["navigation_time_s"], {outcome: line[f"paper_{outcome}_percent"] for outcome in rates}
    p, noise_m, tau_s, scene_tau_s, percent = (line[name] for name in _CONDITIONS[:-1])
    world = line.get("world") or None  # tables of earlier versions have no such column
    given_tau_s = float(tau_s) if tau_s else None
    return StoredRow(
        line["method"],
        line["origin"],
        _mix(line),
        Conditions(Mix.from_text(p), float(noise_m), given_tau_s, int(percent), world).relative_to(float(scene_tau_s)),
        tuple(map(int, line["seeds"].split())),
        float(scene_tau_s),
        int(line["episodes"]),
        rates,
        limits,
        spreads,
        float(time_s) if time_s else None,
        named_mix=named_mix,
        published={outcome: float(rate) for outcome, rate in published.items() if rate},
    )


def _percent(share: float | None) -> str:
    """Return a share with more digits than people read."""
    return "" if share is None else f"{100.0 * share:.2f}"


def _read_percent(words: str) -> float:
    return float(f"{words}e-2")  # the share that was meant, where a division by 100 gives a neighbour of it
