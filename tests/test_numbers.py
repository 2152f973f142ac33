"""Numbers of the README, the documentation and docstrings: those of data/results, of cards, or measured once."""

import re
import shlex
from datetime import date
from pathlib import Path

import pandas
import pytest
from scipy.stats import trim_mean

from tint_sumo import traits
from tint_sumo.cli import main
from tint_sumo.config import NO_LEADER_GAP_M, PPO_BUDGETS, SENSORS, STEP_S
from tint_sumo.core.percentages import percent
from tint_sumo.drivers.check import FITTED, OTHERS, QUANTITIES
from tint_sumo.drivers.models import MODELS
from tint_sumo.drivers.prediction import ERRORS
from tint_sumo.envs.rows import BUILT_IN_OUTCOMES
from tint_sumo.methods.registry import find_learned, learned_methods
from tint_sumo.study.results_csv import read_csv
from tint_sumo.study.summary import Summary, at_mixes, by_title, in_other_conditions
from tint_sumo.traits.identification import (
    AMONG_RUN,
    CHANCE,
    ICC,
    ICC_LESS_SPEED,
    OTHER,
    PREDICTION,
    PREDICTORS,
    RANK_ONE,
    SAME,
    VECTORS,
)
from tint_sumo.traits.storage import read_card

ROOT = Path(__file__).parents[1]
README = ROOT / "README.md"
DOCS = ROOT / "docs"
RESULTS = ROOT / "data" / "results"
_TABLE = re.compile(r"(?:^\|.*\|\n)+", re.MULTILINE)
_INFERRING = [name for name in learned_methods() if find_learned(name).encoder and find_learned(name).attention]


@pytest.mark.parametrize(
    ("page", "head"),
    [
        (README, "| method | seeds | P 0.1"),
        (DOCS / "results" / "index.md", "| method | seeds | P 0.1"),
        (DOCS / "explanation" / "when-traits-help.md", "| method | as trained |"),
    ],
    ids=("README", "results", "when-traits-help"),
)
def test_tables_are_those_of_the_results(page: Path, head: str) -> None:
    measured = _tables(RESULTS / "navigation.md")
    shown = [table for table in _tables(page) if table.startswith(head)]
    assert len(shown) == 1
    assert shown[0] in measured


def test_the_tables_of_the_study_say_what_the_csv_file_says() -> None:
    rows, ceilings = read_csv(RESULTS / "navigation.csv")
    text = re.sub(r" +", " ", (RESULTS / "navigation.md").read_text(encoding="utf-8"))
    for row in at_mixes(rows):
        rates = [re.escape(percent(row.rate(outcome))) + r" \[[^]]+\]" for outcome in BUILT_IN_OUTCOMES]
        line = " \\| ".join([f"{_mix(row):g}", re.escape(row.title), *rates])
        assert re.search(rf"^\| {line} \|", text, re.MULTILINE), line
    for title, own in by_title(in_other_conditions(rows)).items():
        cells = [f"{percent(row.rate('success'))} ({percent(row.rate('collision'))})" for row in own]
        (line,) = [line for line in text.split("## ")[-1].splitlines() if line.startswith(f"| {title} |")]
        assert [cell for cell in line.strip("| ").split(" | ")[1:] if cell != "-"] == cells
    assert f"| ceiling | | {' | '.join(percent(share) for share in ceilings.values())} |" in text


def test_the_yield_rule_s_page_has_the_study_s_rates() -> None:
    rows, _ = read_csv(RESULTS / "navigation.csv")
    own = {_mix(row): row for row in at_mixes(rows) if row.method == "always_go"}
    cells = [" / ".join(percent(own[p].rate(outcome)) for outcome in BUILT_IN_OUTCOMES) for p in (0.25, 0.4, 0.6)]
    assert f"| `TIntersection-v1` | {' | '.join(cells)} |" in (DOCS / "explanation" / "yield-rule.md").read_text()


def test_differences_between_methods_are_those_of_the_study() -> None:
    text = (RESULTS / "navigation.md").read_text(encoding="utf-8")
    shown = re.findall(
        r"\+[\d.]+ \[[^]]+\]", (DOCS / "explanation" / "when-traits-help.md").read_text(encoding="utf-8")
    )
    assert len(shown) == 2
    for method, difference in zip(("cross-window", "oracle"), shown, strict=True):
        (line,) = [line for line in text.splitlines() if re.match(rf"\| {method} +\| no labels ", line)]
        assert difference == line.split("|")[4].strip()


def test_the_table_of_trait_models_has_the_study_s_accuracies() -> None:
    table = pandas.read_csv(RESULTS / "traits.csv").set_index(["method", "noise_m"])
    head, _, *lines = next(
        one for one in _tables(DOCS / "explanation" / "trait-models.md") if "| noise |" in one
    ).split("\n")[:-1]
    methods = re.findall("`(.*?)`", head)
    assert len(methods) == 4 and len(lines) == 4
    for line in lines:
        noise, *cells = line.strip("| ").split(" | ")
        for method, cell in zip(methods, cells, strict=True):
            row = table.loc[(method, 0.0 if noise == "none" else float(noise.removesuffix(" m")))]
            digits = len(cell.split(" ")[0].split(".")[1])
            assert cell == f"{percent(row['svc_percent'] / 100, digits)} ± {row['svc_percent_sd']:.{digits}f}"


def test_when_traits_help() -> None:
    noisy, late, mixed = _summaries(position_noise_m=0.2), _summaries(tau_s=1.5), _summaries()
    losses = [mixed[name] - noisy[name] for name in ("cross_window", "streaming", "streaming_critic")]
    late_percent = [late[name] for name in _INFERRING]
    page = _prose("docs/explanation/when-traits-help.md")
    assert max(_summaries(position_noise_m=0.05)[name] for name in ("vae", "morton", "ma")) < 20.0
    assert "Ma) fall below 20 %" in page
    assert f"lose {min(losses):.0f} to {max(losses):.0f} points at 20 cm; the policy without labels loses 4." in page
    assert round(mixed["no_labels"] - noisy["no_labels"]) == 4
    low, high = min(late_percent), max(late_percent)
    assert f"falls to {low:.0f} to {high:.0f} % ({late['no_attention']:.0f} % without attention), the one" in page
    assert f"without labels to {late['no_labels']:.0f} %, and the oracle to {late['oracle']:.0f} %." in page
    without, with_it = _spread("no_attention"), _spread("vae")
    assert f"between the four seeds is {without} points, where it is {with_it} with attention" in page


def test_the_limits_of_the_study() -> None:
    rows, ceilings = read_csv(RESULTS / "navigation.csv")
    missed = {p: 100.0 * (share - _best(rows, p)) for p, share in ceilings.items()}
    page = _prose("docs/results/index.md")
    assert f"is {_spread('oracle')} points for the oracle and {_spread('cross_window')} for the cross-window" in page
    assert f"but {_spread('no_attention')} for the policy without attention" in page
    assert f"by {missed[0.1]:.0f} points at P 0.1, and by {missed[0.25]:.0f} at P 0.25" in page


def test_what_trait_models_leave_open() -> None:
    table = pandas.read_csv(RESULTS / "traits.csv").set_index(["method", "noise_m"])
    seeds = pandas.read_csv(RESULTS / "traits_seeds.csv")
    mine, bound = table.loc["cross_window"], table.loc["classifier"]
    page = _prose("docs/explanation/trait-models.md")
    assert f"in percent of {seeds['windows'].mean():,.0f}"[:-3] + "000 unseen windows" in page
    assert f"on {seeds['training_windows'].mean():,.0f}"[:-3] + "000 windows each" in page
    full, middle, short = (f"{mine.loc[0.2, f'svc_{part}_percent']:.1f}" for part in ("20", "6_to_10", "2_to_5"))
    assert f"right in {full} % of the full windows, in {middle} % of those of 6 to 10 steps, and in {short} %" in page
    parts = (f"{bound.loc[0.2, f'svc_{part}_percent']:.1f}" for part in ("20", "6_to_10", "2_to_5"))
    assert "(`classifier`: {}, {} and {})".format(*parts) in page
    assert (bound["svc_percent"] - mine["svc_percent"]).max() < 0.1
    assert "within 0.1 points of supervision" in page
    others = mine[[f"svc_P{p}_percent" for p in (0.25, 0.4, 0.6)]]
    assert others.sub(mine["svc_percent"], axis=0).abs().max(axis=None) < 0.1
    assert "stays within 0.1 points" in page
    noisy = seeds[(seeds["method"] == "cross_window") & (seeds["noise_m"] > 0.0)]["errors_in_most_uncertain_tenth"]
    assert f"holds {100 * noisy.min():.0f} to {100 * noisy.max():.0f} % of all errors" in page
    minutes = seeds["training_s"] / 60.0
    assert f"A training took {minutes.min():.0f} to {minutes.max():.0f} minutes" in page


def test_shipped_trait_models() -> None:
    page = _prose("docs/explanation/trait-models.md")
    accuracy = {name: read_card(name).entries["accuracy_by_noise"] for name in traits.TRAIT_METHODS}
    assert f"right in {percent(accuracy['cross_window']['0'], 3)} % of the exact windows" in page
    fallen = [accuracy[name]["0.05"] for name in ("vae", "morton", "classifier")]
    assert f"fall to {percent(min(fallen))} to {percent(max(fallen))} % at 0.05 m" in page


def test_drivers_without_classes() -> None:
    found = pandas.read_csv(RESULTS / "traits_continuous.csv").groupby(["method", "latent_size"])
    mean, spread = found.mean(), found.std()
    (table,) = (one for one in _tables(DOCS / "explanation" / "trait-models.md") if "desired speed, 2 latents" in one)
    for method in ("vae", "cross_window"):
        columns = [(size, name) for name in ("r2_desired_speed_mps", "r2_min_gap_m") for size in (2, 4)]
        cells = [f"{mean.loc[(method, s), name]:.3f} ± {spread.loc[(method, s), name]:.3f}" for s, name in columns]
        assert f"| `{method}` | {' | '.join(cells)} |" in table


def test_trait_models_in_other_scenes() -> None:
    table = pandas.read_csv(RESULTS / "scenes.csv").groupby(["method", "trained_on", "scene"]).mean(numeric_only=True)
    accuracy, r2 = 100.0 * table["accuracy"].unstack(), table["speed_r2"].unstack()
    one, all_six = accuracy.xs("t_intersection", level=1), accuracy.xs("all", level=1)
    page = _prose("docs/results/scenes.md")
    assert one.rsub(one["t_intersection"], axis=0).max(axis=None) < 0.3
    assert "they lose at most 0.3 points" in page
    others = one.drop(columns="t_intersection")
    for method, row in others.iterrows():
        assert re.search(f"{row.min():.2f} to {row.max():.2f} % for `{method}`", page), method
    alone = r2.xs("t_intersection", level=1)
    assert alone.rsub(alone["t_intersection"], axis=0).abs().max(axis=None) < 0.025
    assert "is the same within 0.02" in page
    spans = f"{all_six.min(axis=None):.2f} to {all_six.max(axis=None):.2f} %"
    best = r2.xs("all", level=1)
    assert f"({spans}, R² {best.min(axis=None):.2f} to {best.max(axis=None):.2f})" in page
    assert (all_six >= one - 0.005).all(axis=None)


def test_settings_of_the_training() -> None:
    full = PPO_BUDGETS["full"]
    page = _prose("docs/explanation/training.md")
    assert (
        f"{full.n_envs} environments in one simulation, rollouts of {full.n_steps} decisions of "
        f"{full.action_repeat * STEP_S:g} s, {full.n_epochs} epochs of {full.n_minibatches} minibatches, learning rate "
        f"{full.learning_rate:g} and entropy weight {full.ent_coef:g}, both falling linearly to "
        f"{full.final_ent_coef:g}, discount {full.gamma:g}, weight of the value loss {full.vf_coef:g}, and "
        f"{full.total_steps / 1e6:g} million decisions"
    ) in page
    assert f"that gap is {NO_LEADER_GAP_M:g} m" in _prose("docs/explanation/label-leak.md")


def test_the_tables_of_sensors_are_those_of_the_results() -> None:
    policies, rules = _tables(DOCS / "how-to" / "sensors.md")[1:]
    found = pandas.read_csv(RESULTS / "sensors.csv").set_index(["sensor", "policy"])
    lines = policies.strip().split("\n")[2:]
    assert len(lines) == len(SENSORS)
    for line, sensor in zip(lines, SENSORS, strict=True):
        cells = [_outcomes(found.loc[(sensor, policy)]) for policy in ("no_labels", "cross_window", "oracle")]
        assert line == f"| `{sensor}` | {' | '.join(cells)} |"
    found = pandas.read_csv(RESULTS / "creeping.csv")
    lines = rules.strip().split("\n")[2:]
    for line, (_, row) in zip(lines, found.groupby("sensor", sort=False), strict=True):
        start, lane = (row.iloc[number] for number in range(2))
        gained = f"{lane['success_percent'] - start['success_percent']:.1f}"
        assert line.split(" | ", 1)[1] == f"{_outcomes(start)} | {_outcomes(lane)} | {gained} |"


def test_the_page_on_calibration_has_the_measured_numbers() -> None:
    measured = pandas.read_csv(RESULTS / "calibration.csv").set_index(["group", "name"])

    def shown(group: str, name: str, decimals: int = 2) -> str:
        if (group, name) not in measured.index:
            return "-"
        value, low, high = measured.loc[(group, name), ["value", "low", "high"]]
        return f"{value:.{decimals}f} [{low:.{decimals}f}, {high:.{decimals}f}]"

    page = DOCS / "explanation" / "calibration.md"
    fits, predictions, distances, of_eidm = (table.strip().split("\n")[2:] for table in _tables(page))
    for line, model in zip(fits, MODELS, strict=True):
        own, default = (shown(f"gap error {model}", name) for name in ("fitted to the pair itself", "SUMO's defaults"))
        assert line == f"| {model} | {own} m | {default} m |"
    for line, name in zip(predictions, ERRORS, strict=True):
        cells = f"{shown('prediction', name, 1)} | {shown('posterior less', name, 1)}"
        assert line.split(" | ", 1)[1] == f"{cells} |"
    for line, (quantity, unit) in zip(distances, QUANTITIES.items(), strict=True):
        cells = [shown("distance IDM", f"{quantity}, {drivers}") for drivers in (*FITTED, *OTHERS)]
        assert line == f"| {quantity}, {unit} | {' | '.join(cells)} |"
    for line, (quantity, unit) in zip(of_eidm, QUANTITIES.items(), strict=True):
        cells = [
            shown(f"distance {model}", f"{quantity}, {drivers}")
            for model in ("EIDM", "EIDM with errors")
            for drivers in FITTED
        ]
        assert line == f"| {quantity}, {unit} | {' | '.join(cells)} |"
    prose = _prose(str(page))
    assert f"takes {measured.loc[('time IDM', 'fit of all pairs'), 'value']:.0f} s on one core" in prose
    sigma, fading_s = (measured.loc[("errors EIDM", name), "value"] for name in ("sigmaerror", "tPersDrive"))
    assert f"({sigma:.2f} and {fading_s:.2f} s;" in prose


def test_the_page_on_real_traits_has_the_measured_numbers() -> None:
    measured = pandas.read_csv(RESULTS / "real_traits.csv").set_index(["group", "situation", "name"])

    def shown(group: str, situation: str, name: str, decimals: int = 2, scale: float = 1.0) -> str:
        if (group, situation, name) not in measured.index:
            return "-"
        value, low, high = scale * measured.loc[(group, situation, name), ["value", "low", "high"]]
        return f"{value:.{decimals}f} [{low:.{decimals}f}, {high:.{decimals}f}]"

    found = _tables(DOCS / "explanation" / "real-traits.md")
    predictions, identified, correlations = (table.strip().split("\n")[2:] for table in found)
    for line, name in zip(predictions, PREDICTORS, strict=True):
        cells = [
            shown(group, situation, name)
            for situation in (SAME, OTHER)
            for group in (PREDICTION, f"{PREDICTION} gained")
        ]
        assert line == f"| {name} | {' | '.join(cells)} |"
    for line, name in zip(identified, (*VECTORS, CHANCE), strict=True):
        groups = ((RANK_ONE, SAME), (RANK_ONE, OTHER), (AMONG_RUN, OTHER))
        cells = [shown(*group, name, 0, 100.0) for group in groups]
        assert line == f"| {name} | {' | '.join(cells)} |"
    for line, name in zip(correlations, VECTORS, strict=True):
        assert line == f"| {name} | {shown(ICC, OTHER, name)} | {shown(ICC_LESS_SPEED, OTHER, name)} |"


def test_the_table_of_own_networks_is_that_of_the_results() -> None:
    (table,) = (one for one in _tables(DOCS / "how-to" / "own-network.md") if "`no_labels`" in one)
    head, _, *lines = table.strip().split("\n")
    measured = pandas.read_csv(RESULTS / "own_networks.csv").set_index(["network", "method"])
    names = ["success", "timeout", "collision", "red_light"]
    assert {line.split(" | ")[0].strip("| ") for line in lines} == set(measured.index.get_level_values(0))
    for line in lines:
        network, *cells = line.strip("| ").split(" | ")
        for method, cell in zip(re.findall("`(.*?)`", head), cells, strict=True):
            if (network, method) not in measured.index:
                assert cell == "-"
                continue
            row = measured.loc[(network, method)]
            assert row["lost_percent"] == 0.0
            time = "-" if pandas.isna(row["time_s"]) else f"{row['time_s']:.1f} s"
            assert cell == f"{' / '.join(str(row[f'{name}_percent']) for name in names)}, {time}"


def test_the_numbers_of_recordings_are_those_of_the_results() -> None:
    measured = pandas.read_csv(RESULTS / "replay.csv").set_index(["recording", "others", "ego"])
    street = "street, recorded here"
    page = DOCS / "how-to" / "replay.md"
    (table,) = (one for one in _tables(page) if "always go" in one)
    head, _, *lines = table.strip().split("\n")
    egos = head.strip("| ").split(" | ")[1:]
    truth = measured.loc[street].iloc[:3]
    assert lines[0] == "| the truth | " + " | ".join(_outcomes(row, "true_") for _, row in truth.iterrows()) + " |"
    assert [line.strip("| ").split(" | ")[0] for line in lines[1:]] == list(dict.fromkeys(_kinds(measured, street)))
    for line in lines[1:]:
        kind, *cells = line.strip("| ").split(" | ")
        rows = [measured.loc[(street, kind, ego)] for ego in egos]
        assert cells == [
            f"{_outcomes(row)}; {row['same_outcome_percent']:.0f} %; {row['position_error_m']:.2f} m" for row in rows
        ]
    off_m = measured.xs("as recorded", level="ego")["released_error_m"]
    for scene, title in (("USA_Lanker-1_1_T-1", "Lankershim Boulevard"), ("USA_Peach-4_8_T-1", "Peachtree Street")):
        kinds = ("fitted", "one IDM for all", "SUMO's default")
        shown = ", ".join(f"{off_m[(scene, kind)]:.2f} m" for kind in kinds)
        assert f"{title}: {shown}" in _prose(str(page))


def _kinds(measured: pandas.DataFrame, recording: str) -> list[str]:
    return [str(kind) for kind in measured.loc[recording].index.get_level_values("others")]


def _outcomes(row: pandas.Series, prefix: str = "") -> str:
    return " / ".join(str(row[f"{prefix}{outcome}_percent"]) for outcome in BUILT_IN_OUTCOMES)


_ONCE = pandas.read_csv(RESULTS / "once.csv")


def test_what_was_measured_once_stands_where_the_list_of_it_says() -> None:
    assert not _ONCE.isna().any(axis=None)
    for one in _ONCE.itertuples():
        assert str(one.shown) in _prose(str(one.page)), one
        date.fromisoformat(str(one.published))


@pytest.mark.parametrize(
    "command", sorted({one for how in _ONCE["how_to_repeat"] for one in re.findall("`(.*?)`", how)})
)
def test_how_it_is_repeated_can_be_typed(command: str, capsys: pytest.CaptureFixture[str]) -> None:
    program, *words = shlex.split(command)
    if program == "python":
        assert (ROOT / words[0]).exists()
    else:
        assert program == "tint-sumo"
        assert main([*words, "--print-config"]) == 0, capsys.readouterr().err


def _summaries(**conditions: float) -> dict[str, float]:
    """Success of each method's trained policies over all mixes, %, in conditions that differ as given."""
    rows, _ = read_csv(RESULTS / "navigation.csv")
    wanted = {"position_noise_m": 0.0, "tau_s": 1.0, "percent": 100, **conditions}
    return {
        row.method: 100.0 * row.rate("success")
        for row in in_other_conditions(rows)
        if all(getattr(row.resolved, name) == value for name, value in wanted.items())
    }


def _spread(method: str) -> str:
    """Standard deviation of a method's success between seeds at P 0.4, percentage points."""
    rows, _ = read_csv(RESULTS / "navigation.csv")
    (spread,) = (row.spread("success") for row in at_mixes(rows) if row.method == method and _mix(row) == 0.4)
    assert spread is not None
    return f"{100.0 * spread:.1f}"


def _best(rows: list[Summary], p_conservative: float) -> float:
    return max(row.rate("success") for row in at_mixes(rows) if _mix(row) == p_conservative)


def _mix(row: Summary) -> float:
    assert row.conditions.p_conservative.is_single
    return row.conditions.p_conservative.low


def _prose(page: str) -> str:
    """Return a page's text in one line."""
    return " ".join((ROOT / page).read_text(encoding="utf-8").split())


def _tables(page: Path) -> list[str]:
    """The tables of a page, with single spaces."""
    text = re.sub(r" +", " ", page.read_text(encoding="utf-8"))
    return [re.sub(r"-{3,}", "---", table) for table in _TABLE.findall(text)]


def test_the_table_of_relative_traits_is_that_of_the_results() -> None:
    (table,) = (one for one in _tables(DOCS / "explanation" / "strangers.md") if "supervised" in one)
    head, _, *lines = table.strip().split("\n")
    measured = pandas.read_csv(RESULTS / "relative_traits.csv").set_index(["world", "method"])
    methods = head.strip("| ").split(" | ")[1:]
    assert [line.split("`")[1] for line in lines] == list(dict.fromkeys(measured.index.get_level_values(0)))
    for line in lines:
        world, *cells = line.strip("| ").split(" | ")
        for method, cell in zip(methods, cells, strict=True):
            row = measured.loc[(world.strip("`"), method)]
            assert cell == f"{100 * row['accuracy']:.1f} ({100 * row['calibration_error']:.1f})"


@pytest.mark.parametrize("p_conservative", [0.1, 0.25])
def test_the_numbers_of_the_planner_are_those_of_its_cases(p_conservative: float) -> None:
    cases = pandas.read_csv(RESULTS / "planner.csv")
    cases = cases[cases["p_conservative"] == p_conservative]
    in_ceiling, finished = cases["ceiling"] == "yes", cases["oracle"] == "success"
    searched, found = cases["planner"] != "not searched", cases["planner"] == "success"
    between = in_ceiling & ~finished
    assert searched[between].all()
    numbers = [len(cases), finished.sum(), in_ceiling.sum(), found[between].sum(), between.sum()]
    assert [searched[finished].sum(), searched[~in_ceiling].sum()] == [8, 8]
    assert found[finished & searched].all() and not found[~in_ceiling].any()
    sentence = (
        rf"(\d+) cases at P {p_conservative:g} the oracle finishes (\d+) and the ceiling has (\d+), and "
        r"in (\d+) of the (\d+) cases between"
    )
    match = re.search(sentence, _prose("docs/results/index.md"))
    assert match is not None and [int(number) for number in match.groups()] == numbers


def test_the_numbers_of_adaptation_are_those_of_the_results() -> None:
    page = (DOCS / "explanation" / "strangers.md").read_text()
    (words,) = re.findall(r"### Getting to know a town\n(.*?)\n## ", page, re.DOTALL)
    stated = [float(number) for number in re.findall(r"\d\d\.\d", words)]
    measured = pandas.read_csv(RESULTS / "adaptation.csv").groupby("kind", sort=False)["accuracy"].apply(list)
    first, _, last = measured["long"]
    expected = [first, last, *measured["remembers"], *measured["forgets"]]
    assert stated == [round(100 * accuracy, 1) for accuracy in expected]


def test_the_table_of_the_papers_recipe_is_that_of_its_cases() -> None:
    (table,) = (one for one in _tables(DOCS / "explanation" / "paper.md") if "whole training" in one)
    measured = pandas.read_csv(RESULTS / "paper_recipe.csv")
    assert set(measured["cases"]) == {500}
    recipes = {"paper": "the paper's", "full": "ours, `--budget full`"}

    def rates(row: pandas.Series, head: str = "") -> str:
        return "/".join(f"{row[f'{head}{outcome}_percent']:.0f}" for outcome in BUILT_IN_OUTCOMES)

    trainings = {}
    for (method, p_conservative, budget), rows in measured.groupby(["method", "p_conservative", "budget"]):
        parts = [row for _, row in rows.sort_values("percent").iterrows()]
        is_published = parts[-1].notna()["published_success_percent"]  # in numbers, for our recipe never
        published = rates(parts[-1], "published_") if is_published else "-"
        trainings[f"`{method}`", f"{p_conservative:g}", recipes[budget]] = [*map(rates, parts), published]
    lines = [line.strip("| ").split(" | ") for line in table.strip().split("\n")[2:]]
    assert {tuple(line[:3]): line[3:] for line in lines} == trainings
    assert len(lines) == len(trainings)


def test_the_learning_rates_are_those_of_the_results() -> None:
    (table,) = (one for one in _tables(DOCS / "explanation" / "training.md") if "| 0.001 |" in one)
    _, _, *lines = table.strip().split("\n")
    measured = pandas.read_csv(RESULTS / "learning_rates.csv")
    short = measured[measured["variant"].str.contains("total_steps=400000")]
    success = 100.0 * short.groupby(["method", "variant"], sort=False)["success"].mean().unstack()
    assert len(lines) == len(success) == 8
    for line, (method, rates) in zip(lines, success.iterrows(), strict=True):
        name, *cells = line.strip("| ").split(" | ")
        assert name == f"`{method}`"
        assert cells == [f"**{rate:.1f}**" if rate == rates.max() else f"{rate:.1f}" for rate in rates]
    assert (success.idxmax(axis=1) == "learning_rate=0.003,total_steps=400000").sum() == 6
    page = _prose("docs/explanation/training.md")
    assert "Six of the eight do best with 0.003" in page
    whole = 100.0 * measured[measured["variant"] == "learning_rate=0.006"].groupby("method")["success"].mean()
    assert f"the oracle has {whole['oracle']:.1f} % then and `streaming` {whole['streaming']:.1f} %" in page


def _strangers() -> pandas.DataFrame:
    return pandas.read_csv(RESULTS / "strangers.csv", keep_default_na=False, dtype={"seed": str})


def test_the_tables_of_policies_among_strangers_are_those_of_the_results() -> None:
    worlds, scores = _tables(RESULTS / "strangers.md")
    measured = _strangers()
    assert set(measured["cases"]) == {200}
    head, _, *lines = worlds.strip().split("\n")
    columns = []
    for title in head.strip("| ").split(" | ")[1:]:
        method, _, old = title.partition(", ")
        columns.append((method, "old" if old else "" if method == "ttc" else "strangers"))
    assert set(columns) == set(zip(measured["method"], measured["trained_in"], strict=True))
    for line in lines:
        world, *cells = line.strip("| ").split(" | ")
        for (method, trained_in), cell in zip(columns, cells, strict=True):
            chosen = (measured["method"] == method) & (measured["trained_in"] == trained_in)
            found = measured[chosen & (measured["world"] == world.strip("`"))]
            means = (found[f"{outcome}_percent"].mean() / 100.0 for outcome in BUILT_IN_OUTCOMES)
            assert cell == "/".join(percent(mean, 0) for mean in means)
    trained = measured[measured["trained_in"] == "strangers"]
    for line in scores.strip().split("\n")[2:]:
        method, middle, success, collisions, careful, _ = line.strip("| ").split(" | ")
        found = trained[trained["method"] == method.strip("`")]
        assert float(middle.split()[0]) == pytest.approx(trim_mean(found["success_percent"], 0.25), abs=0.51)
        seeds = [rows for _, rows in found.groupby("seed")]
        assert success == ", ".join(percent(rows["success_percent"].mean() / 100, 0) for rows in seeds)
        assert collisions == ", ".join(percent(rows["collision_percent"].mean() / 100) for rows in seeds)
        assert careful == ", ".join(str((rows["collision_percent"] <= 1.0).sum()) for rows in seeds)


def test_what_traits_gain_among_strangers_is_that_of_the_results() -> None:
    measured = _strangers()
    trained = measured[measured["trained_in"] == "strangers"]
    success = trained.groupby(["method", "world"])["success_percent"].mean()
    gain = (success["relative"] - success["no_labels"]).sort_values()
    mean = success.groupby("method").mean()
    page = _prose("docs/explanation/strangers.md")
    worlds = f"in 16 of 18 worlds, by {gain.iloc[2]:.0f} to {gain.iloc[-1]:.0f} points"
    for text in (_prose("README.md"), _prose("docs/results/index.md"), page):
        assert worlds in text
    assert f"(69 against {mean['no_labels']:.0f} %)" in page and round(mean["relative"]) == 69
    assert set(gain.index[:2]) == {"headway_1.5", "same_speed"}  # where the two are alike
    for method, shown in {"streaming": "`streaming` succeeds in", "vae": "the paper's method (`vae`) in"}.items():
        assert f"{shown} {mean[method]:.0f}" in page
    by_seed = trained.groupby(["method", "seed"])["success_percent"].mean()
    oracle, without = by_seed["oracle"], by_seed["no_labels"]
    assert f"those of the oracle {oracle.min():.0f} to {oracle.max():.0f}" in page
    assert f"The five seeds of no labels have {without.min():.0f} to {without.max():.0f}" in page
    assert "(five seeds each)" in _prose("README.md") and len(without) == len(by_seed["relative"]) == 5


def test_the_old_policy_without_traits_is_compared_with_the_new_ones_as_in_the_results() -> None:
    measured = _strangers()
    rates = [f"{outcome}_percent" for outcome in ("success", "collision")]
    by_world = measured.groupby(["trained_in", "method", "world"])[rates].mean()
    old, new = by_world.loc["old", "no_labels"], by_world.loc["strangers", "relative"]
    ahead = int((old["success_percent"] > new["success_percent"]).sum())
    (success, collision), (new_success, new_collision) = old.mean().round().astype(int), new.mean().round().astype(int)
    readme, results, page = map(_prose, ("README.md", "docs/results/index.md", "docs/explanation/strangers.md"))
    assert f"({success} against {new_success} %), but collides twice as often ({collision} against" in readme
    assert f"{new_collision} %)" in readme and 1.5 < old["collision_percent"].mean() / new_collision < 2.5
    assert f"in {ahead} of the 18 worlds and in {success} % in the mean of all" in results
    assert f"in {collision} % of the cases against {new_collision}." in results
    assert f"has {success} % in the mean of all worlds and is ahead in {ahead} of the 18" in page
    assert f"`relative` has {new_success} %" in page and f"{collision} % collisions against {new_collision} %" in page
    lead = (old["success_percent"] - new["success_percent"]).sort_values()
    assert set(lead.index[-3:]) == {"same_speed", "acc", "krauss"}


def test_the_profile_of_trainings_is_that_of_the_results() -> None:
    (table,) = (one for one in _tables(DOCS / "explanation" / "training.md") if "SUMO's step" in one)
    _, _, *lines = table.strip().split("\n")
    measured = pandas.read_csv(RESULTS / "training_profile.csv").groupby("part", sort=False)
    stated = [line.strip("| ").split(" | ") for line in lines]
    assert stated == [
        [part, *(f"{row.cpu_us_per_decision:.0f} µs ({row.share_percent:.0f} %)" for row in rows.itertuples())]
        for part, rows in measured
    ]
    share = measured.get_group("update")["share_percent"].iloc[0] / 100
    page = _prose("docs/explanation/training.md")
    assert f"learning is {100 * share:.0f} % of a training" in page
    assert f"by a factor of {1 / (1 - share):.2f} only" in page
