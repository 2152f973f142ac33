"""The page without a browser: what it shows, what it leaves out, and that nothing in it leads elsewhere."""

import base64
import gzip
import json
import re
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from tests.study.scenes import given, trained, write_results
from tint_sumo.config import ALL_MIXES, Mix
from tint_sumo.core.errors import InputError
from tint_sumo.core.files import write_text
from tint_sumo.core.progress import silent
from tint_sumo.envs import TaskSettings
from tint_sumo.films.driving import Driven, Moment, drive_case
from tint_sumo.films.trait_probe import TraitReader
from tint_sumo.methods.evaluation import Case, Evaluation
from tint_sumo.methods.loading import load_policy
from tint_sumo.methods.registry import METHODS
from tint_sumo.scenes import SCENES, find_scene
from tint_sumo.scenes.geometry import new_boxes
from tint_sumo.scenes.layout import layout
from tint_sumo.study.budgets import Conditions
from tint_sumo.study.jobs import read_curves
from tint_sumo.study.page import write_page
from tint_sumo.study.page.charts import condition_charts, curve_chart, outcome_chart, world_chart
from tint_sumo.study.page.choosing import MOST_CASES, Choice, Shown, choose, choose_cases
from tint_sumo.study.page.episodes import Recorded, Recordings, failure_lists
from tint_sumo.study.page.findings import what_came_out
from tint_sumo.study.page.html import json_data, packed, table
from tint_sumo.study.page.recording import MISSING, UNITS, Recording, RecordJob, encode, read_episodes
from tint_sumo.study.page.roads import scene_shapes
from tint_sumo.study.report import write_report
from tint_sumo.study.summary import tabulate
from tint_sumo.traits.relative import TownEstimate


def outcomes(*shorts: str) -> Evaluation:
    names = {"s": "success", "t": "timeout", "c": "collision"}
    return Evaluation(tuple(Case(names[short], 10.0) for short in "".join(shorts)))


def decoded(name: str, column: list[int]) -> list[float]:
    return [np.nan if number == MISSING else number * UNITS[name] for number in np.cumsum(column).tolist()]


# Choice of policies and cases


def test_every_policy_has_failures_of_both_kinds_and_some_successes_among_the_cases() -> None:
    good, bad = outcomes("sssscssssst", "s" * 20), outcomes("cccctcccccc", "s" * 20)
    chosen = choose_cases([bad, good])
    assert chosen == tuple(sorted(chosen))
    assert {4, 10} <= set(chosen)  # the good one's only failures
    assert {bad.cases[number].outcome for number in chosen} == {"success", "timeout", "collision"}
    assert sum(good.cases[n].outcome == bad.cases[n].outcome == "success" for n in chosen) == 2
    assert len(chosen) == 2 + 1 + 2  # case 10 is a collision of the bad one, and one more joins it


def test_however_often_policies_fail_the_number_of_cases_is_bounded() -> None:
    failing = [outcomes("s" * 4 * one, "cctt", "s" * (100 - 4 * one)) for one in range(20)]  # each its own cases
    assert len(choose_cases(failing)) == MOST_CASES
    assert choose_cases([outcomes("cc")]) == (0, 1)


def test_the_middle_mix_that_most_policies_met_is_shown_with_first_seeds() -> None:
    counts = (3, 1, 1)
    mixes = {Conditions(Mix(p)): counts for p in (0.1, 0.25, 0.4, 0.6, 0.9)}
    rows = tabulate(
        [
            given("ttc", {**mixes, Conditions(Mix(0.5)): counts, Conditions(ALL_MIXES): counts}),
            *(trained("oracle", seed, mixes) for seed in (3, 4)),
            given("oracle", mixes),
        ]
    )
    choice = choose(rows)
    assert choice.conditions == Conditions(Mix(0.4))
    assert [one.label for one in choice.policies] == ["ttc", "oracle-shipped", "oracle-P0.1to0.9-seed3"]
    for other in (Conditions(ALL_MIXES, 0.1), Conditions(Mix(0.4), 0.1), Conditions(Mix(0.4), world="towns")):
        assert choose(tabulate([given("ttc", {other: counts})])).conditions == other


# Recordings


def moment(vehicles: list[int], x_m: float, outcome: str = "", **changes: Any) -> Moment:
    """One with two slots and two routes; the first slot's vehicle stands at ``x_m``."""
    boxes = new_boxes(2, 5.0, 2.0)
    boxes[0] = (x_m, -2.5, 0.0, 1.0, 5.0, 2.0)
    boxes[1] = (8.0, 1.25, -1.0, 0.0, 5.0, 2.0)
    inferred = np.array([[2.0], [0.0]])
    common = Moment(
        time_s=0.1,
        ego=boxes[1],
        ego_mps=1.5,
        ego_brakes=True,
        is_held=False,
        present=np.array([number >= 0 for number in vehicles]),
        seen=np.array([number >= 0 for number in vehicles]),
        vehicles=np.array(vehicles),
        boxes=boxes,
        brakes=np.array([False, True]),
        traits=np.array([0, 1]),
        observed_traits=inferred,
        attention=np.array([0.75, 0.25]),
        town=TownEstimate(0.25, 0.9),
        claimed=np.array([False, True]),
        desired_mps=3.0,
        value=-1.25,
        outcome=outcome,
        bodies={},
        pedestrians=new_boxes(0, 0.0, 0.0),
    )
    return replace(common, **changes)


def test_a_trait_that_changes_is_shown_as_it_is_at_each_moment() -> None:
    moments = tuple(moment([7, 2], x_m, traits=np.array([trait, 1])) for x_m, trait in ((0.0, 0), (1.0, 1), (2.0, 0)))
    episode = encode(Driven(Case("timeout", 0.2), moments), None, ["lower", "upper"])
    constant, changing = episode["vehicles"]
    assert (changing["number"], changing["trait"]) == (7, 0)
    assert decoded("trait_now", changing["trait_now"]) == [0.0, 1.0, 0.0]
    assert (constant["trait"], "trait_now" in constant) == (1, False)


def test_an_episode_survives_its_small_numbers() -> None:
    moments = (
        moment([7, -1], -3.14, desired_mps=None, value=None),
        moment([7, 2], 1.5, seen=np.array([True, False])),
        moment([9, 2], 40.0, "collision", claimed=np.array([True, True]), time_s=0.2),
    )
    driven = Driven(Case("collision", 0.2, "aggressive", "upper"), moments)
    reader = TraitReader(np.array([1.0]), 0.0, has_spread=False)
    episode = json.loads(json.dumps(encode(driven, reader, ["lower", "upper"])))
    assert (episode["outcome"], episode["time_s"], episode["frames"]) == ("collision", 0.2, 3)
    assert episode["hit"] == ["aggressive", "upper"]
    assert [(one["number"], one["trait"], one["first"]) for one in episode["vehicles"]] == [
        (2, 1, 1),
        (7, 0, 0),
        (9, 0, 2),
    ]
    second, seventh, _ = episode["vehicles"]
    assert decoded("x_m", seventh["x_m"]) == pytest.approx([-3.14, 1.5], abs=0.005)
    assert decoded("y_m", seventh["y_m"]) == pytest.approx([-2.5, -2.5], abs=0.005)
    assert decoded("heading_deg", seventh["heading_deg"]) == [90.0, 90.0]
    assert decoded("attention", seventh["attention"]) == pytest.approx([0.75, 0.75])
    assert decoded("p_conservative", seventh["p_conservative"]) == pytest.approx([0.88, 0.88])
    assert np.isnan(decoded("p_conservative", second["p_conservative"])).all()  # nothing was inferred
    assert decoded("brakes", second["brakes"]) == [1.0, 1.0]
    assert decoded("seen", second["seen"]) == [0.0, 1.0]
    assert "seen" not in seventh, "the ego sees it at all times"
    assert decoded("town_rank", episode["ego"]["town_rank"]) == pytest.approx([0.25] * 3)
    assert decoded("town_differs", episode["ego"]["town_differs"]) == pytest.approx([0.9] * 3)
    ego = episode["ego"]
    np.testing.assert_allclose(decoded("value", ego["value"]), [np.nan, -1.25, -1.25])
    np.testing.assert_allclose(decoded("desired_mps", ego["desired_mps"]), [np.nan, 3.0, 3.0])
    assert decoded("claimed", episode["routes"]["lower"]["claimed"]) == [0.0, 0.0, 1.0]


def test_rules_have_no_value_no_attention_and_nothing_inferred() -> None:
    nothing = {"value": None, "attention": None, "observed_traits": None, "town": None}
    bare = moment([1, 2], 0.0, "timeout", **nothing)
    episode = encode(Driven(Case("timeout", 50.0), (bare,)), None, ["lower", "upper"])
    assert episode["hit"] is None
    assert not {"value", "town_rank", "town_differs"} & set(episode["ego"])
    assert not {"attention", "p_conservative"} & set(episode["vehicles"][0])


def test_recordings_tell_the_case_and_are_made_once_for_a_policy_and_its_cases(tmp_path: Path) -> None:
    recording = Recording("always_go", None, 0, Conditions(Mix(0.4)), (2, 0), tmp_path)
    job = RecordJob(0, (recording,), tmp_path)
    assert not job.is_done()
    assert job.run(silent) == "policies: 1"
    episodes = read_episodes(recording.file)
    assert list(episodes) == [2, 0]
    driven = drive_case(load_policy("always_go"), 2, 0, TaskSettings(p_conservative=0.4))
    assert (episodes[2]["outcome"], episodes[2]["time_s"]) == (driven.case.outcome, driven.case.time_s)
    x_m = [moment.ego["x_m"] for moment in driven.moments]
    assert decoded("x_m", episodes[2]["ego"]["x_m"]) == pytest.approx(x_m, abs=0.006)
    written = recording.file.read_bytes()
    assert job.is_done() and job.run(silent) == "policies: 0"
    other = replace(recording, cases=(0,))
    assert not other.is_done() and not replace(recording, conditions=Conditions(Mix(0.6))).is_done()
    recording.file.unlink()
    recording.make(silent)
    assert recording.file.read_bytes() == written


def test_a_part_of_a_training_is_recorded_with_the_policy_of_that_time(tmp_path: Path) -> None:
    half = Conditions(Mix(0.4), percent=50)
    with pytest.raises(InputError, match=r"policy-50"):
        Recording("oracle", Mix(0.4), 0, half, (0,), tmp_path).require_policy()


def test_damaged_recordings_are_named_in_one_line(tmp_path: Path) -> None:
    write_text(tmp_path / "one.json", '{"episodes": [1]}')
    with pytest.raises(InputError, match=r"one\.json is damaged .* remove it"):
        read_episodes(tmp_path / "one.json")


# Drawings


@pytest.mark.parametrize("name", sorted(SCENES))
def test_the_roads_of_every_scene_lie_in_its_picture(name: str) -> None:
    shapes, roads = scene_shapes(find_scene(name)), layout(find_scene(name))
    left, top, width, height = shapes["view"]
    points = np.array(
        [[float(part) for part in pair.split()] for pair in re.findall(r"-?[\d.]+ -?[\d.]+", shapes["way"])]
    )
    assert (points >= [left, top]).all() and (points <= [left + width, top + height]).all()
    start_m, goal_m = (roads.ego.way[round(at_m / 0.02)] for at_m in (roads.scene.ego.start_m, roads.scene.ego.goal_m))
    np.testing.assert_allclose(points[[0, -1]] * [1, -1], [start_m, goal_m], atol=0.05)
    assert set(shapes["routes"]) == {route.name for route in roads.scene.routes}
    assert shapes["roads"].count("M") == shapes["roads"].count("Z") >= 1
    json.dumps(shapes, allow_nan=False)


def test_charts_and_their_tables_tell_the_rates_and_intervals() -> None:
    rows = tabulate([trained("oracle", seed, {Conditions(Mix(0.4)): (8 + seed, 2 - seed, 0)}) for seed in (0, 1)])
    chart = outcome_chart(rows, "success")
    (trace,) = chart.figure["data"]
    low, high = rows[0].intervals["success"]
    assert trace["x"] == [85.0]
    assert trace["x"][0] + trace["error_x"]["array"][0] == pytest.approx(100 * high, abs=0.01)
    assert trace["x"][0] - trace["error_x"]["arrayminus"][0] == pytest.approx(100 * low, abs=0.01)
    assert chart.lines[1:] == [["oracle", "0.4", "85.0", f"{100 * low:.1f} to {100 * high:.1f}"]]


def test_worlds_have_a_line_each() -> None:
    worlds = {Conditions(ALL_MIXES, world="range_15"): (8, 2, 0), Conditions(ALL_MIXES, world="old"): (9, 1, 0)}
    chart = world_chart(tabulate([trained("oracle", 0, worlds)]), "success")
    assert chart.figure["layout"]["yaxis"]["ticktext"] == ["the old world", "range 15 m"]
    (trace,) = chart.figure["data"]
    assert (trace["x"], trace["y"]) == ([90.0, 80.0], [0.0, 1.0])
    assert [line[:3] for line in chart.lines[1:]] == [
        ["the old world", "oracle", "90.0"],
        ["range 15 m", "oracle", "80.0"],
    ]


def test_a_method_has_one_colour_in_figures_and_on_the_page() -> None:
    rows = tabulate([given(name, {Conditions(ALL_MIXES): (4, 0, 1)}) for name in METHODS])
    rows += tabulate([given(name, {Conditions(ALL_MIXES, 0.1): (3, 0, 2)}) for name in METHODS])
    (chart,) = condition_charts(rows)
    shown = [(trace["marker"]["color"], trace["line"]["color"]) for trace in chart.figure["data"]]
    assert shown == [(method.look.colour, method.look.colour) for method in METHODS.values()]


def test_conditions_have_a_chart_for_every_condition_that_varies() -> None:
    noisy, later = Conditions(ALL_MIXES, 0.1), Conditions(ALL_MIXES, tau_s=1.5)
    rows = tabulate([given("ttc", {Conditions(ALL_MIXES): (4, 0, 1), noisy: (3, 0, 2), later: (2, 0, 3)})])
    noise, headway = condition_charts(rows)
    assert (noise.figure["data"][0]["x"], noise.figure["data"][0]["y"]) == ([0.0, 0.1], [80.0, 60.0])
    assert (headway.figure["data"][0]["x"], headway.figure["data"][0]["y"]) == ([1.0, 1.5], [80.0, 40.0])


def test_curves_are_means_with_a_band_where_there_are_seeds(tmp_path: Path) -> None:
    for seed, last in enumerate((0.6, 0.8)):
        text = f"decisions,success,timeout,collision\n64,0.2,0.4,0.4\n128,{last},0.1,0.1\n"
        write_text(tmp_path / "policies" / f"oracle-P0.4-seed{seed}" / "curve.csv", text)
    chart = curve_chart(read_curves(tmp_path))
    band, line = chart.figure["data"]
    assert line["y"] == [20.0, 45.0] and line["x"] == [64.0, 128.0]
    assert band["y"] == [20.0, 40.0, 50.0, 20.0] and not band["showlegend"]
    assert chart.lines[-1] == ["oracle", "128", "45.0", "40.0 to 50.0"]


# Pieces of HTML


def test_text_is_never_markup() -> None:
    cells = table([["<b>", "&"], ["</table>", '"x"']], 'all "of" <it>')
    assert not re.search(r"<b>|</table>.*</table>|&\s|<it>", cells)
    assert "&lt;b&gt;" in cells and "&quot;of&quot;" in cells
    data = json_data("one", {"text": "</script><!--"})
    assert data.count("</script>") == 1 and "<!--" not in data
    assert json.loads(re.sub(r"^<[^>]+>|<[^<]+$", "", data)) == {"text": "</script><!--"}


def test_packed_text_is_the_same_every_time_and_can_be_unpacked() -> None:
    text = "</script> äöü " * 1000
    one = packed("name", text)
    assert one == packed("name", text) and len(one) < 1000
    content = re.fullmatch(r'<script type="text/plain" id="name">(.*)</script>', one)
    assert content is not None
    assert gzip.decompress(base64.b64decode(content[1])).decode() == text


# The page


def section(page: str, name: str) -> str:
    found = re.search(rf'<section id="{name}".*?</section>', page, re.DOTALL)
    assert found is not None
    return found[0]


@pytest.fixture(scope="module")
def bare(tmp_path_factory: pytest.TempPathFactory) -> str:
    """The page of a study whose policies are gone, and that tested in other conditions alone."""
    out = tmp_path_factory.mktemp("bare")
    counts = {Conditions(Mix(0.4)): (18, 1, 1)}
    write_results([trained("oracle", 0, counts), trained("no_labels", 0, counts)], out)
    report = write_page(write_report(out), out, progress=False)
    assert report.page_file == out / "report.html"
    return report.page_file.read_text()


def test_sections_without_data_say_why_they_are_left_out(bare: str) -> None:
    for name, reason in (
        ("curves", "the study's folder has no learning curves"),
        ("conditions", "the conditions of their training alone"),
        ("worlds", "among the drivers of their training alone"),
        ("player", "none of the study's policies can be loaded"),
        ("failures", "no episodes were recorded"),
        ("latents", "no method of the study infers traits with a model"),
        ("making", "the study's folder has no settings"),
    ):
        assert "left out" in section(bare, name) and reason in section(bare, name).replace("&#x27;", "'")
    assert "no policy" in section(bare, "player")
    assert "90.0" in section(bare, "results")
    assert not re.search(r'id="(episode-|player-data|latent-data)', bare)


def test_the_page_says_first_what_came_out_and_what_p_is(bare: str) -> None:
    header = bare[bare.index("<header>") : bare.index("</header>")]
    first, second, _ = re.findall("<p>(.*?)</p>", header)
    assert first == "At P 0.4 all 2 methods succeeded in 90.0 % of the cases."
    assert second.startswith("P is P(conservative): the probability that a driver is conservative, and yields")


@pytest.mark.parametrize(
    ("results", "words"),
    [
        ({"ttc": {0.4: (3, 1, 0)}}, "At P 0.4 the method time to collision succeeded in 75.0 % of the cases."),
        (
            {"ttc": {0.25: (0, 4, 0), 0.4: (1, 3, 0)}, "oracle": {0.25: (4, 0, 0), 0.4: (3, 1, 0), 0.6: (0, 4, 0)}},
            "At P 0.25 and 0.4 the method oracle succeeded most often, in 87.5 % of the cases, and time to collision "
            "least often, in 12.5 %.",
        ),
        (
            {"no_labels": {0.4: (2, 2, 0)}, "vae": {0.4: (3, 1, 0)}, "morton": {0.4: (1, 3, 0)}},
            "At P 0.4 the method paper's method succeeded most often, in 75.0 % of the cases, and Morton least often, "
            "in 25.0 %. The best method that infers traits, paper's method, reached 75.0 %; no labels, which infers "
            "none, reached 50.0 %.",
        ),
        ({"ttc": {(0.1, 0.9): (1, 0, 0)}}, "At P 0.1 to 0.9 the method time to collision succeeded in 100.0 % of the"),
        ({"ttc": {0.4: (1, 0, 0)}, "oracle": {0.6: (1, 0, 0)}}, ""),
    ],
)
def test_what_came_out_is_told_of_the_mixes_that_all_methods_met(results: dict[str, Any], words: str) -> None:
    rows = tabulate(
        [
            (given if name == "ttc" else partial(trained, seed=0))(
                name, tested={Conditions(Mix.parse(p)): counts for p, counts in fared.items()}
            )
            for name, fared in results.items()
        ]
    )
    assert what_came_out(rows).startswith(words) and bool(words) == bool(what_came_out(rows))


def test_what_came_out_in_worlds_alone_is_the_mean_over_them() -> None:
    fared = {"relative": ((3, 1, 0), (1, 3, 0)), "no_labels": ((2, 2, 0), (0, 4, 0))}
    worlds = [Conditions(ALL_MIXES, world=name) for name in ("old", "eidm")]
    rows = tabulate([trained(name, 0, dict(zip(worlds, counts, strict=True))) for name, counts in fared.items()])
    assert what_came_out(rows) == (
        "Over 2 worlds the method relative traits succeeded most often, in 50.0 % of the cases, and no labels least "
        "often, in 25.0 %. The best method that infers traits, relative traits, reached 50.0 %; no labels, which "
        "infers none, reached 25.0 %."
    )
    assert what_came_out([row for row in rows if row.conditions.world == "eidm"]).startswith("In EIDM the method")


def test_failures_are_listed_folded_and_only_where_there_are_any() -> None:
    def recorded(method: str, fared: Evaluation, outcome: str, hit: Any = None) -> Recorded:
        return Recorded(Shown(method, "ttc", None, 0, fared), {0: {"outcome": outcome, "time_s": 10.0, "hit": hit}})

    good = recorded("good", outcomes("ss"), "success")
    bad = recorded("bad", outcomes("cs"), "collision", ["aggressive", "upper"])
    unlucky = recorded("unlucky", outcomes("sc"), "success")  # its failure is none of the recorded cases
    choice = Choice(Conditions(Mix(0.4)), (), (0,))
    lists = failure_lists(Recordings("t_intersection", choice, (good, bad, unlucky), ()))
    assert "good" not in lists
    assert re.findall("<details><summary>(.*?)</summary>", lists) == [
        "bad: 1 collision and 0 timeouts in 2 cases; 1 of them recorded"
    ]
    assert "Case 0: collision after 10.0 s (aggressive, upper)</button>" in lists
    assert "<p>unlucky: 1 collision and 0 timeouts in 2 cases; 0 of them recorded</p>" in lists
    assert failure_lists(Recordings("t_intersection", choice, (good,), ())) == ""


def test_the_page_leads_nowhere_else_and_is_small(bare: str) -> None:
    assert set(re.findall(r"https?://[^\"'\s)]+", bare)) == {"http://www.w3.org/2000/svg"}  # a name, not a place
    assert not re.search(r"<(link|script|img|iframe)[^>]+(src|href)=\"(?!data:)", bare)
    assert "default-src 'none'" in bare
    assert len(bare) < 10_000_000


def test_a_page_is_the_same_every_time(tmp_path: Path) -> None:
    out = write_results([given("always_go", {Conditions(ALL_MIXES): (1, 0, 0)})], tmp_path)
    Recording("always_go", None, 0, Conditions(ALL_MIXES), (0,), out).make(silent)
    first, second = (write_page(write_report(out), out, progress=False).page_file for _ in range(2))
    assert first is not None and second is not None
    assert first.read_bytes() == second.read_bytes()
