"""Contents of the figures, and that they are pictures."""

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from matplotlib.figure import Figure
from PIL import Image

from tests.study.scenes import given, trained
from tint_sumo.config import ALL_MIXES, Mix
from tint_sumo.envs.rows import BUILT_IN_OUTCOMES
from tint_sumo.methods.registry import METHODS
from tint_sumo.study import figures
from tint_sumo.study.budgets import Conditions
from tint_sumo.study.figures import plot_bars, plot_conditions, plot_curves, plot_profiles, plot_worlds
from tint_sumo.study.summary import at_mixes, in_other_conditions, in_worlds, tabulate

AS_TRAINED = Conditions(ALL_MIXES)
OTHERS = (
    AS_TRAINED,
    *(Conditions(ALL_MIXES, position_noise_m=noise_m) for noise_m in (0.05, 0.1)),
    *(Conditions(ALL_MIXES, tau_s=tau_s) for tau_s in (0.7, 1.5)),
    *(Conditions(ALL_MIXES, percent=percent) for percent in (25, 50)),
)
MIXES = tuple(Conditions(Mix(p)) for p in (0.1, 0.25, 0.4, 0.9))
ROWS = tabulate(
    [
        *(trained("oracle", seed, dict.fromkeys((*MIXES, *OTHERS), (8 + seed, 1, 1 - seed))) for seed in (0, 1)),
        given("ttc", dict.fromkeys((*MIXES[1:], *OTHERS[:5]), (5, 4, 1))),
    ]
)


@pytest.fixture
def drawn(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Callable[[], Figure]:
    """The figure that was written last."""
    seen: list[Figure] = []
    write = figures._write

    def remember(figure: Figure, file: Path) -> Path:
        seen.append(figure)
        return write(figure, file)

    monkeypatch.setattr(figures, "_write", remember)
    return lambda: seen[-1]


def curve(*shares: float) -> pd.DataFrame:
    return pd.DataFrame({"decisions": [64.0 * (1 + step) for step in range(len(shares))], "success": shares})


def assert_picture(file: Path) -> None:
    with Image.open(file) as picture:
        assert picture.format == "PNG"
        assert picture.width > 500 and picture.height > 200
        assert len(picture.convert("L").getcolors()) > 10, "an empty picture"
    assert [path.name for path in file.parent.iterdir()] == [file.name]


def test_bars_have_a_panel_for_each_mix_and_add_up_to_all_cases(tmp_path: Path, drawn: Callable[[], Figure]) -> None:
    assert_picture(plot_bars(at_mixes(ROWS), tmp_path / "bars.png"))
    panels = [axes for axes in drawn().axes if axes.get_visible()]
    assert [axes.get_title() for axes in panels] == [f"P(conservative) = {p:g}" for p in (0.1, 0.25, 0.4, 0.9)]
    for axes, methods in zip(panels, (1, 2, 2, 2), strict=True):
        widths = np.array([bar.get_width() for bar in axes.patches]).reshape(3, methods)
        np.testing.assert_allclose(widths.sum(axis=0), 100.0)
        assert widths[0, -1] == pytest.approx(85.0)  # success of the oracle
    shown = [[label.get_text() for label in axes.get_yticklabels()] for axes in panels]
    both = ["time to collision", "oracle"]
    assert shown == [["oracle"], both, [], both], "names are left out where the panel to the left has the same"


def test_the_paper_s_success_is_marked_where_there_is_one(tmp_path: Path, drawn: Callable[[], Figure]) -> None:
    plot_bars(at_mixes(ROWS), tmp_path / "bars.png")
    marked = {}
    for axes in drawn().axes:
        lines = [line for line in axes.get_lines() if line.get_label() == "success in the paper"]
        marked[axes.get_title()] = [float(value) for line in lines for value in line.get_xdata() if value > 0.0]
    assert marked["P(conservative) = 0.25"] == [85.0] and marked["P(conservative) = 0.4"] == [90.0]
    assert marked["P(conservative) = 0.9"] == []
    entries = [text.get_text() for text in drawn().legends[0].get_texts()]
    assert sorted(entries) == sorted([*BUILT_IN_OUTCOMES, "95 % interval of success", "success in the paper"])


def test_no_label_of_a_bar_rounds_to_all_or_to_the_even_number(tmp_path: Path, drawn: Callable[[], Figure]) -> None:
    rows = tabulate([given("ttc", {Conditions(Mix(0.25)): (199, 1, 0), Conditions(Mix(0.4)): (197, 3, 0)})])
    plot_bars(rows, tmp_path / "bars.png")
    assert [text.get_text() for axes in drawn().axes for text in axes.texts] == ["99.5", "98.5"]


def test_a_single_bar_is_a_figure_too(tmp_path: Path) -> None:
    rows = tabulate([given("always_go", {Conditions(Mix(0.4)): (0, 0, 3)})])
    assert_picture(plot_bars(rows, tmp_path / "bars.png"))


def test_curves_are_means_over_seeds(tmp_path: Path, drawn: Callable[[], Figure]) -> None:
    curves = {("oracle", ALL_MIXES): [curve(0.2, 0.4), curve(0.4, 0.8)], ("ma", ALL_MIXES): [curve(0.1, 0.1)]}
    assert_picture(plot_curves(curves, tmp_path / "curves.png"))
    axes = drawn().axes[0]
    oracle, ma = axes.get_lines()
    assert [line.get_label() for line in (oracle, ma)] == [METHODS["oracle"].title, METHODS["ma"].title]
    np.testing.assert_allclose(oracle.get_xdata(), [64, 128])
    np.testing.assert_allclose(oracle.get_ydata(), [30.0, 45.0])  # of 0.2 and 0.4, then smoothed 0.3 and 0.6


def test_seeds_are_compared_as_far_as_all_of_them_have_come(tmp_path: Path, drawn: Callable[[], Figure]) -> None:
    curves = {("oracle", ALL_MIXES): [curve(0.2, 0.2, 0.2), curve(0.4)]}
    assert_picture(plot_curves(curves, tmp_path / "curves.png"))
    np.testing.assert_allclose(drawn().axes[0].get_lines()[0].get_ydata(), [30.0])


def test_every_method_has_a_curve_of_its_own_look(tmp_path: Path, drawn: Callable[[], Figure]) -> None:
    curves = {(name, ALL_MIXES): [curve(0.2, 0.4)] for name in METHODS}
    assert_picture(plot_curves(curves, tmp_path / "curves.png"))
    lines = drawn().axes[0].get_lines()
    looks = [(line.get_color(), line.get_marker(), line.get_linestyle()) for line in lines]
    assert looks == [(one.look.colour, one.look.marker, one.look.dash) for one in METHODS.values()]


def test_trainings_at_several_mixes_have_curves_of_their_own(tmp_path: Path, drawn: Callable[[], Figure]) -> None:
    curves = {("oracle", Mix(0.25)): [curve(0.2)], ("oracle", Mix(0.4)): [curve(0.4), curve(0.6)]}
    assert_picture(plot_curves(curves, tmp_path / "curves.png"))
    axes = drawn().axes[0]
    first, second = axes.get_lines()
    assert [first.get_label(), second.get_label()] == ["oracle (trained at P 0.25)", "oracle (trained at P 0.4)"]
    assert [list(first.get_ydata()), list(second.get_ydata())] == [[20.0], [50.0]]
    assert first.get_color() == second.get_color() and first.get_marker() != second.get_marker()
    assert axes.get_ylabel() == "success in training (%)"


def test_each_condition_has_a_panel_through_the_training_s_conditions(
    tmp_path: Path, drawn: Callable[[], Figure]
) -> None:
    assert_picture(plot_conditions(in_other_conditions(ROWS), tmp_path / "conditions.png"))
    noise, tau, percent = drawn().axes
    shown = [[list(container.lines[0].get_xdata()) for container in axes.containers] for axes in (noise, tau, percent)]
    assert shown[0] == [[0.0, 0.05, 0.1]] * 2
    assert shown[1] == [[0.7, 1.0, 1.5]] * 2
    assert shown[2] == [[100], [25, 50, 100]], "a rule has no training to be cut short"
    assert [container.get_label() for container in noise.containers] == ["time to collision", "oracle"]
    colours = [container.lines[0].get_color() for axes in (noise, tau, percent) for container in axes.containers]
    assert colours == [METHODS[name].look.colour for name in ("ttc", "oracle")] * 3


def test_methods_of_the_past_are_drawn_under_their_names(tmp_path: Path, drawn: Callable[[], Figure]) -> None:
    rows = tabulate([trained("forgotten", 0, {AS_TRAINED: (1, 1, 0), Conditions(Mix(0.4)): (1, 1, 0)})])
    assert_picture(plot_conditions(in_other_conditions(rows), tmp_path / "conditions.png"))
    assert [container.get_label() for container in drawn().axes[0].containers] == ["forgotten"]
    plot_bars(at_mixes(rows), tmp_path / "bars.png")
    assert drawn().axes[0].get_yticklabels()[0].get_text() == "forgotten"


def test_worlds_have_a_line_each_and_methods_a_marker(tmp_path: Path, drawn: Callable[[], Figure]) -> None:
    worlds = [Conditions(ALL_MIXES, world=name) for name in ("range_15", "old", "eidm")]
    rows = tabulate(
        [trained("oracle", 0, dict.fromkeys(worlds, (8, 1, 1))), given("ttc", dict.fromkeys(worlds[:2], (5, 1, 4)))]
    )
    assert_picture(plot_worlds(in_worlds(rows), tmp_path / "worlds.png"))
    success, collision = drawn().axes
    assert [label.get_text() for label in success.get_yticklabels()] == ["the old world", "EIDM", "range 15 m"]
    for axes, shown in ((success, [[50.0] * 2, [80.0] * 3]), (collision, [[40.0] * 2, [10.0] * 3])):
        markers = [container[0].get_xdata() for container in axes.containers]  # type: ignore[union-attr]
        assert [list(x) for x in markers] == shown


def test_profiles_fall_from_all_trainings_to_none(tmp_path: Path, drawn: Callable[[], Figure]) -> None:
    found = {"oracle": np.array([[0.9, 0.8], [0.9, 0.2]]), "own": np.array([[0.5, 0.5]])}
    assert_picture(plot_profiles(found, tmp_path / "profiles.png"))
    lines = drawn().axes[0].get_lines()
    assert [line.get_label() for line in lines] == ["oracle", "own"], "a method that nobody has registered has a line"
    oracle, other = (line.get_xydata() for line in lines)
    at = {round(float(success)): share for success, share in oracle.tolist()}
    assert [at[success] for success in (0, 30, 85, 95)] == [100.0, 75.0, 50.0, 0.0]
    assert other[0, 1] == 100.0 and other[-1, 1] == 0.0
