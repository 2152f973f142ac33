"""The cases, worlds and metrics of the study for any policy, and the table of those that have been measured by them.

``evaluate(policy, "strangers")`` is all that others need. A row of ``data/results/leaderboard.csv`` holds the outcome
of each case, so that whoever adds one can be checked by repeating some of them.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from importlib import import_module
from pathlib import Path
from typing import Any, cast

import numpy as np
import pandas as pd
from numpy.typing import NDArray
from stable_baselines3.common.vec_env import VecEnv

from tint_sumo.config import ALL_MIXES, HELD_OUT_WORLDS, P_CONSERVATIVE, PPO_BUDGETS, Mix
from tint_sumo.core.determinism import single_threaded
from tint_sumo.core.errors import InputError, find_named, shown
from tint_sumo.core.files import write_frame
from tint_sumo.core.percentages import percent
from tint_sumo.core.progress import Report, silent
from tint_sumo.core.statistics import Rate
from tint_sumo.envs import TaskSettings
from tint_sumo.envs.rows import BUILT_IN_OUTCOMES
from tint_sumo.envs.worlds import find_world, task_in
from tint_sumo.methods import evaluation
from tint_sumo.methods.evaluation import REPORTED_SET, Evaluation
from tint_sumo.methods.loading import load_policy
from tint_sumo.methods.registry import Policy
from tint_sumo.policy.wrappers import policy_venv
from tint_sumo.scenes import paper_scene

STRANGERS_SET = 600  # case set of tests among strangers
LETTERS = {outcome[0]: outcome for outcome in BUILT_IN_OUTCOMES}  # of outcomes in the leaderboard
_DECISION_STEPS = PPO_BUDGETS["full"].action_repeat  # simulation steps per decision, as in the study

Function = Callable[[dict[str, NDArray[np.float32]]], Any]


@dataclass(frozen=True)
class Trial:
    """The drivers and the sensor of some cases."""

    name: str  # in tables
    world: str  # name of a world
    p_conservative: Mix = ALL_MIXES


@dataclass(frozen=True)
class Suite:
    """The trials of a benchmark, all with the cases of one set."""

    name: str
    trials: tuple[Trial, ...]
    case_set: int


def worlds_suite(name: str, worlds: Sequence[str]) -> Suite:
    """Return the suite of some worlds, with drivers of all mixes."""
    return Suite(name, tuple(Trial(world, world) for world in worlds), STRANGERS_SET)


SUITES = {
    "paper": Suite("paper", tuple(Trial(f"P {p:g}", "old", Mix(p)) for p in P_CONSERVATIVE), REPORTED_SET),
    "strangers": worlds_suite("strangers", list(HELD_OUT_WORLDS)),
}


@dataclass(frozen=True)
class Result:
    """Results of a policy in the trials of a suite."""

    suite: str
    evaluations: Mapping[str, Evaluation]  # by the trial's name

    @property
    def table(self) -> pd.DataFrame:
        """A row for each trial: name as world, number of cases, each outcome's share with its 95 % interval, time."""
        return pd.DataFrame([_row(name, found) for name, found in self.evaluations.items()])

    def to_csv(self, file: str | Path) -> None:
        """Write the table, whole or not at all."""
        write_frame(self.table, Path(file))

    def letters(self) -> dict[str, str]:
        """Return the outcome of each case by its first letter, in one word for each trial."""
        return {name: "".join(case.outcome[0] for case in found.cases) for name, found in self.evaluations.items()}


def _row(name: str, found: Evaluation) -> dict[str, Any]:
    row: dict[str, Any] = {"world": name, "cases": len(found.cases)}
    for outcome in BUILT_IN_OUTCOMES:
        rate = found.rate(outcome)
        low, high = rate.interval
        shares = {"": rate.value, "_low": low, "_high": high}
        row |= {f"{outcome}{end}_percent": round(100.0 * share, 2) for end, share in shares.items()}
    return row | {"navigation_time_s": found.navigation_time_s}


def evaluate(
    policy: str | Path | Policy | Function,
    suite: str | Suite = "strangers",
    *,
    cases: int = 200,
    report: Report = silent,
) -> Result:
    """Drive a policy through the cases of a suite, which are the same for every policy.

    Args:
        policy: anything with Stable-Baselines3's ``predict(observation, state, episode_start, deterministic)`` for a
            batch of observations; a function of one observation that returns the action; or name, folder or file of
            what ``load_policy`` reads. The first two get the observations of ``tint_sumo/TIntersection-v1`` and decide
            every 0.4 s; traits are up to them.
        suite: "strangers", the worlds that no training may meet; "paper", the old world's mixes; or another suite.
        cases: number of cases in each trial.
        report: called with the progress of each trial.

    Raises:
        InputError: there is no such suite or policy, it is none of these, or the number of cases does not fit.
    """
    chosen = find_named("suite", suite, SUITES) if isinstance(suite, str) else suite
    driver, make_venv, task = _driver(policy)
    found = {}
    with single_threaded():
        for trial in chosen.trials:
            seen = task_in(find_world(trial.world), replace(task, p_conservative=trial.p_conservative))
            make = partial(make_venv, task=seen)
            found[trial.name] = evaluation.evaluate(driver, make, cases, chosen.case_set, report=report)
    return Result(chosen.name, found)


def _driver(policy: str | Path | Policy | Function) -> tuple[Policy, Callable[..., VecEnv], TaskSettings]:
    """Return a policy, what makes its environments, and their settings."""
    if isinstance(policy, str | Path):
        contender = load_policy(policy)
        return contender.policy, contender.make_venv, contender.task
    task = TaskSettings(paper_scene())
    if hasattr(policy, "predict"):
        return cast(Policy, policy), _bare_venv, task
    if callable(policy):
        return _EachAlone(policy), _bare_venv, task
    raise InputError(f"a policy is a name, a path, a function, or has a method predict, not {shown(policy)}")


def _bare_venv(num_envs: int, task: TaskSettings) -> VecEnv:
    return policy_venv(num_envs, None, [task], action_repeat=_DECISION_STEPS)


@dataclass(frozen=True)
class _EachAlone:
    """A function of one observation as a policy for batches."""

    function: Function

    def predict(
        self,
        observation: Any,
        state: Any = None,
        episode_start: NDArray[np.bool_] | None = None,  # noqa: ARG002
        deterministic: bool = False,  # noqa: ARG002
    ) -> tuple[NDArray[Any], Any]:
        count = len(observation["mask"])
        actions = [self.function({key: part[index] for key, part in observation.items()}) for index in range(count)]
        return np.array(actions, dtype=np.int64), state


# The leaderboard


@dataclass(frozen=True)
class Entry:
    """A policy in one trial of a suite, as a row of the leaderboard has it."""

    name: str
    suite: str
    world: str  # name of the trial
    outcomes: str  # first letter of each case's outcome, from the first case on
    entry: str  # name that ``load_policy`` knows, a folder, or MODULE:NAME of a policy or function
    url: str  # of its code, with the commit

    def rate(self, outcome: str) -> Rate:
        """Return how many cases ended so."""
        return Rate(self.outcomes.count(outcome[0]), len(self.outcomes))


def read_leaderboard(file: str | Path) -> list[Entry]:
    """Return the rows of a leaderboard.

    Raises:
        InputError: the file is none, or a row is in no trial of a suite or has an outcome that there is not.
    """
    try:
        rows = pd.read_csv(file, dtype=str, keep_default_na=False).to_dict("records")
        entries = [Entry(**{str(key): str(value) for key, value in row.items()}) for row in rows]
    except (OSError, ValueError, TypeError) as error:
        raise InputError(f"{file} is no leaderboard ({error}); restore it") from None
    for one in entries:
        trials = [trial.name for trial in find_named("suite", one.suite, SUITES).trials]
        if one.world not in trials or not one.outcomes or set(one.outcomes) - set(LETTERS):
            raise InputError(
                f"{file}: {one.name} in {one.world} needs a world of suite {one.suite} and outcomes of the letters "
                f"{', '.join(LETTERS)}; write the row with scripts/leaderboard.py add"
            )
    return entries


def measure(name: str, entry: str, url: str, suite: str, cases: int) -> list[Entry]:
    """Return the rows of a policy for the leaderboard."""
    found = evaluate(find_entry(entry), suite, cases=cases)
    return [Entry(name, suite, world, outcomes, entry, url) for world, outcomes in found.letters().items()]


def repeat(entries: Sequence[Entry], cases: int) -> pd.DataFrame:
    """Repeat the first cases of rows, and return for each how many of them end as the row says.

    Returns:
        name, suite, world, cases (repeated), same (of them).
    """
    rows = []
    for one in entries:
        (trial,) = (trial for trial in SUITES[one.suite].trials if trial.name == one.world)
        count = min(cases, len(one.outcomes))
        again = evaluate(find_entry(one.entry), replace(SUITES[one.suite], trials=(trial,)), cases=count)
        same = sum(a == b for a, b in zip(again.letters()[one.world], one.outcomes, strict=False))
        rows.append({"name": one.name, "suite": one.suite, "world": one.world, "cases": count, "same": same})
    return pd.DataFrame(rows)


def find_entry(entry: str) -> str | Policy | Function:
    """Return the policy of an entry: what MODULE:NAME imports, else the name itself.

    Importing runs code, so do that only with entries that you trust, or where they can do no harm.

    Raises:
        InputError: there is no such module, or nothing of that name in it.
    """
    module, colon, name = entry.partition(":")
    if not colon:
        return entry
    try:
        found: Policy | Function = getattr(import_module(module), name)
    except (ImportError, AttributeError, ValueError) as error:  # ValueError: no module's name
        raise InputError(f"{entry} cannot be imported ({error}); give MODULE:NAME") from None
    return found


def leaderboard_markdown(entries: Sequence[Entry], suite: str) -> str:
    """Return the table of a suite: means over its trials of the shares of outcomes, the best success first."""
    rows = []
    by_name: dict[str, list[Entry]] = {}
    for one in entries:
        if one.suite == suite:
            by_name.setdefault(one.name, []).append(one)
    for name, found in by_name.items():
        shares = [float(np.mean([one.rate(outcome).value for one in found])) for outcome in BUILT_IN_OUTCOMES]
        worst = min(found, key=lambda one: one.rate("success").value)
        cases = sum(len(one.outcomes) for one in found)
        label = f"[{name}]({found[0].url})" if found[0].url else name
        least = f"{percent(worst.rate('success').value, 0)} ({worst.world})"
        rows.append((shares[0], f"| {label} | {' | '.join(map(percent, shares))} | {least} | {cases} |"))
    head = f"| policy | {' | '.join(f'{outcome} %' for outcome in BUILT_IN_OUTCOMES)} | least success % | cases |"
    return "\n".join([head, "| --- | --: | --: | --: | --- | --: |", *(text for _, text in sorted(rows, reverse=True))])
