"""Other settings of PPO: every combination of some values is trained and tested, and one table compares them."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, fields, replace
from functools import cached_property
from itertools import product
from operator import attrgetter
from pathlib import Path
from typing import Any

import pandas as pd

from tint_sumo.config import (
    ALL_MIXES,
    P_CONSERVATIVE,
    SEEDS,
    Mix,
    PolicySettings,
    PpoSettings,
)
from tint_sumo.core.errors import InputError
from tint_sumo.core.files import claim_folder, write_text
from tint_sumo.core.percentages import percent
from tint_sumo.core.progress import Report
from tint_sumo.core.ranges import require_distinct
from tint_sumo.core.structures import overlay, plain, require_fields
from tint_sumo.core.yaml_files import read_list
from tint_sumo.envs.rows import BUILT_IN_OUTCOMES
from tint_sumo.jobs import Workers, executor_of
from tint_sumo.methods.evaluation import TUNING_SET, require_cases
from tint_sumo.methods.registry import find_learned, learned_methods, with_shared_trainings
from tint_sumo.scenes import Scene, described, paper_scene
from tint_sumo.study.budgets import Conditions, Trials
from tint_sumo.study.jobs import EvaluateJob, TrainJob
from tint_sumo.study.plan import require_scene, require_traits
from tint_sumo.study.results import Result
from tint_sumo.study.tables import Lines, Table

MAX_NAME = 150  # characters of a variant's name: it is part of the names of files
_NETWORK = "policy."
_ATTENTION = "policy.attention"
SETTINGS = (
    *(setting.name for setting in fields(PpoSettings) if setting.name != "policy"),
    *(name for setting in fields(PolicySettings) if (name := _NETWORK + setting.name) != _ATTENTION),
)


@dataclass(frozen=True)
class Sweep:
    """Settings of a sweep: some methods with each combination of values, and some seeds of each."""

    settings: PpoSettings  # what no value is given for
    varied: Mapping[str, Sequence[Any]]  # the values by the name of the setting, one of SETTINGS
    methods: tuple[str, ...] = ("oracle",)
    seeds: tuple[int, ...] = (0,)
    p_conservative: Mix = ALL_MIXES  # in training
    scene: Scene = field(default_factory=paper_scene)
    episodes: int = 500  # cases at each P(conservative)

    def __post_init__(self) -> None:
        require_distinct(self, "methods", "seeds")
        for seed in self.seeds:
            SEEDS.require("seed", seed)
        require_cases(self.episodes, TUNING_SET)
        if not self.tested:
            tested = ", ".join(f"{p:g}" for p in P_CONSERVATIVE)
            trained = self.p_conservative.text
            raise InputError(f"p_conservative must include one of {tested}, where policies are tested, not {trained}")
        self._require_values()
        others = ", ".join(name for name in learned_methods() if not find_learned(name).encoder)
        require_traits(self.methods, require_scene("a sweep", self.scene), f"choose methods without one: {others}")

    def _require_values(self) -> None:
        """Raise InputError unless every setting is known, and each value fits, is given once, and makes a name."""
        if not self.varied:
            raise InputError("a sweep needs a setting to vary, such as learning_rate=0.001,0.003")
        if _ATTENTION in self.varied:
            raise InputError(f"{_ATTENTION} is part of the method; compare with the method no_attention instead")
        for name in self.methods:
            find_learned(name).settings_of(self.settings)
        require_fields(self.varied, dict.fromkeys(SETTINGS))
        for name, values in self.varied.items():
            if not values:
                raise InputError(f"{name} needs a value; give one or more, as {name}=VALUE,VALUE")
        for name, values in self.varied.items():
            if len({attrgetter(name)(settings) for settings in self.variants.values()}) < len(values):
                raise InputError(f"{name} must have each value once, not {', '.join(map(str, values))}")
        longest = max(map(len, self.variants))
        if longest > MAX_NAME:
            raise InputError(f"the settings make names of {longest} characters, more than {MAX_NAME}; vary fewer")

    @cached_property
    def variants(self) -> dict[str, PpoSettings]:
        """All combinations of the values, by their names."""
        return dict(self._variant(values) for values in product(*self.varied.values()))

    def _variant(self, values: Sequence[Any]) -> tuple[str, PpoSettings]:
        given = dict(zip(self.varied, values, strict=True))
        network = {name.removeprefix(_NETWORK): value for name, value in given.items() if name.startswith(_NETWORK)}
        direct = {name: value for name, value in given.items() if not name.startswith(_NETWORK)}
        settings = overlay(self.settings, {**direct, "policy": network})
        return ",".join(f"{name}={_word(attrgetter(name)(settings))}" for name in given), settings

    @property
    def tested(self) -> tuple[float, ...]:
        """The conditions of the tests: each P(conservative) that policies are trained for."""
        return tuple(p for p in P_CONSERVATIVE if self.p_conservative.contains(Mix(p)))


def read_varied(words: Sequence[str]) -> dict[str, list[Any]]:
    """The values by name that words such as ``learning_rate=0.001,0.003`` say, as in a configuration file.

    Raises:
        InputError: a word says no values, or a name comes twice.
    """
    varied: dict[str, list[Any]] = {}
    for word in words:
        name, equals, values = word.partition("=")
        if not equals:
            raise InputError(f"{word!r} must be NAME=VALUE,VALUE, such as learning_rate=0.001,0.003")
        if name in varied:
            raise InputError(f"{name} is given twice; give all of its values at once, as {name}=VALUE,VALUE")
        varied[name] = read_list(values)
    return varied


def run_sweep(sweep: Sweep, out: Path, *, workers: Workers = 2, progress: bool = True) -> pd.DataFrame:
    """Run the sweep into ``out``; what an earlier, interrupted call has finished is not repeated.

    Policies are tested on cases of a set that is reported nowhere, so that settings can be chosen by the results.

    Args:
        sweep: what is trained and tested.
        out: a new folder, or the one of this very sweep.
        workers: processes at a time, or an executor.
        progress: show progress on stderr.

    Returns:
        A row for each variant, method, seed and P(conservative): columns variant, method, seed, p_conservative,
        success, timeout, collision (shares of the cases) and navigation_time_s (NaN without a success); also in
        sweep.csv. sweep.md has the table for readers.

    Raises:
        InputError: ``out`` holds another run, or a stage was refused.
        JobError: jobs were given up; all others are done.
    """
    executor = executor_of(workers)
    with claim_folder(out, {"kind": "sweep", **plain(sweep), **described([sweep.scene])}):
        executor.run(plan(sweep, out), progress)
        table = _read_table(_tests(sweep, out))
        write_text(out / "sweep.csv", table.to_csv(index=False))
        write_text(out / "sweep.md", report_markdown(table, sweep.episodes))
        return table


def plan(sweep: Sweep, out: Path) -> "list[VariantJob]":
    """All jobs, one seed after the other, and all trainings of a seed before its tests."""
    return sorted([*_trainings(sweep, out), *_tests(sweep, out)], key=lambda job: job.job.seed)


@dataclass(frozen=True)
class VariantJob:
    """A job of a study, done in a variant's folder, which is laid out as a study's."""

    variant: str
    job: TrainJob | EvaluateJob  # wherever its own folder is
    out: Path  # folder of the sweep

    @property
    def placed(self) -> TrainJob | EvaluateJob:
        """The job in the variant's folder."""
        return replace(self.job, out=self.out / self.variant)

    @property
    def name(self) -> str:
        return self._of_variant(self.job.name)

    @property
    def needs(self) -> tuple[str, ...]:
        return tuple(self._of_variant(name) for name in self.job.needs)

    def _of_variant(self, name: str) -> str:
        return f"{name} {self.variant}"

    @property
    def inputs(self) -> tuple[str, ...]:
        return tuple(f"{self.variant}/{path}" for path in self.job.inputs)

    @property
    def outputs(self) -> tuple[str, ...]:
        return tuple(f"{self.variant}/{path}" for path in self.job.outputs)

    @property
    def uses_gpu(self) -> bool:
        return self.job.uses_gpu

    def is_done(self) -> bool:
        return self.placed.is_done()

    def run(self, report: Report) -> str:
        return self.placed.run(report)


def _trainings(sweep: Sweep, out: Path) -> list[VariantJob]:
    """Those of the methods, and of others whose training they share; these come first."""
    return [
        VariantJob(variant, TrainJob(method, sweep.p_conservative, seed, settings, True, out, sweep.scene), out)
        for variant, settings in sweep.variants.items()
        for method in with_shared_trainings(sweep.methods)
        for seed in sweep.seeds
    ]


def _tests(sweep: Sweep, out: Path) -> list[VariantJob]:
    trials = (Trials(tuple(Conditions(Mix(p)) for p in sweep.tested), sweep.episodes),)
    return [
        VariantJob(variant, EvaluateJob(method, sweep.p_conservative, seed, trials, out, sweep.scene, TUNING_SET), out)
        for variant in sweep.variants
        for method in sweep.methods
        for seed in sweep.seeds
    ]


def _read_table(tests: Sequence[VariantJob]) -> pd.DataFrame:
    rows = []
    for job in tests:
        assert isinstance(job.placed, EvaluateJob)
        result = Result.read(job.placed.result_file)
        for tested in result.tested:
            rows.append(
                {
                    "variant": job.variant,
                    "method": result.method,
                    "seed": result.seed,
                    "p_conservative": tested.conditions.p_conservative.low,
                    **{outcome: tested.evaluation.rate(outcome).value for outcome in BUILT_IN_OUTCOMES},
                    "navigation_time_s": tested.evaluation.navigation_time_s,
                }
            )
    return pd.DataFrame(rows).astype({"navigation_time_s": float})


def report_markdown(table: pd.DataFrame, episodes: int) -> str:
    """Success by variant and method, means and standard deviations over the seeds; the best line comes first."""
    note = (
        f"Success in percent of {episodes} cases at each P(conservative), ± the standard deviation between training "
        f"seeds; mean: over all P. The cases are of set {TUNING_SET}, which settings are chosen on and which is "
        "reported nowhere. The best of many lines is also a lucky one, so test what you choose on other cases."
    )
    return "\n\n".join(Table("Success by settings of PPO", _lines(table), note).markdown) + "\n"


def _lines(table: pd.DataFrame) -> Lines:
    mixes = sorted(table["p_conservative"].unique())
    found = [(keys, rows) for keys, rows in table.groupby(["variant", "method"], sort=False)]
    found.sort(key=lambda item: -item[1]["success"].mean())
    lines = [["settings", "method", *(f"P {p:g}" for p in mixes), "mean"]]
    for (variant, method), rows in found:
        cells = [_with_spread(rows.loc[rows["p_conservative"] == p, "success"]) for p in mixes]
        lines.append([str(variant), str(method), *cells, percent(rows["success"].mean())])
    return lines


def _with_spread(shares: "pd.Series[float]") -> str:
    spread = f" ± {100 * shares.std(ddof=1):.1f}" if len(shares) > 1 else ""
    return f"{percent(shares.mean())}{spread}"


def _word(value: Any) -> str:
    """A value in the name of a variant, which is also that of its folder."""
    return "x".join(map(str, value)) or "none" if isinstance(value, tuple) else str(value)
