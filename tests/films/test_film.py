import sys
from dataclasses import replace
from functools import cache
from pathlib import Path

import gymnasium
import numpy as np
import pytest
from gymnasium.wrappers import RecordVideo
from PIL import Image, ImageColor

from tint_sumo import ENV_IDS
from tint_sumo.config import SENSORS, STEP_S
from tint_sumo.core.errors import InputError
from tint_sumo.core.progress import Progress
from tint_sumo.envs import TaskSettings
from tint_sumo.envs.rendering import BUILDING_COLOUR, pale
from tint_sumo.films.driving import Driven, Moment, drive_case
from tint_sumo.films.film import Film, render_case
from tint_sumo.films.frames import SIZE_PX, Artist
from tint_sumo.films.trait_probe import TraitReader, fit_reader
from tint_sumo.methods.evaluation import evaluate
from tint_sumo.methods.loading import load_policy
from tint_sumo.methods.registry import METHODS
from tint_sumo.scenes import find_scene
from tint_sumo.scenes.layout import layout

CASE, TASK = 3, TaskSettings(p_conservative=0.4)
COLOUR = (10, 20, 30)  # of no vehicle
BLUE, RED, LAMP, CLAIM = (40, 90, 200), (200, 40, 40), (255, 40, 40), (100, 149, 151)


@cache
def driven(name: str) -> Driven:
    """One case as a policy drives it."""
    return drive_case(load_policy(name), CASE, 0, TASK)


def moments(name: str) -> tuple[Moment, ...]:
    return driven(name).moments


def artist(name: str, reader: TraitReader | None = None) -> Artist:
    return Artist(layout(find_scene(load_policy(name).scene)), name, COLOUR, reader, has_attention=True)


def count(image: Image.Image, colour: tuple[int, ...]) -> int:
    """Pixels of a colour in the picture of the scene, legend left out."""
    pixels = np.asarray(image)[:370]
    return int(np.isclose(pixels, colour, atol=6).all(axis=2).sum())


@pytest.mark.parametrize("name", ["streaming_critic", "vae", "ttc"])
def test_a_film_shows_the_case_that_is_judged(name: str) -> None:
    contender = load_policy(name)
    case = evaluate(contender.policy, lambda n: contender.make_venv(n, TASK), CASE + 1, 0).cases[CASE]
    shown = moments(name)
    assert driven(name).case == case
    assert (shown[-1].outcome, round(shown[-1].time_s, 3)) == (case.outcome, case.time_s)
    assert [moment.outcome for moment in shown[:-1]] == [""] * (len(shown) - 1)
    np.testing.assert_allclose([moment.time_s for moment in shown], np.arange(len(shown)) * STEP_S)
    decided = {step for step in range(2, len(shown)) if shown[step].value != shown[step - 1].value}
    assert all(step % contender.action_repeat == 1 for step in decided)


def test_attention_and_traits_are_those_of_the_vehicles_that_are_there() -> None:
    for moment in moments("streaming_critic"):
        assert moment.attention is not None and moment.observed_traits is not None
        assert moment.attention.sum() == pytest.approx(1.0)
        for values in (moment.attention[:, None], moment.observed_traits):
            assert not values[~moment.present].any()
        np.testing.assert_array_equal(moment.traits >= 0, moment.present)
    assert all(moment.attention is None and moment.observed_traits is None for moment in moments("ttc"))


def test_only_those_that_slow_down_brake() -> None:
    shown, braked = moments("ttc"), 0
    for before, last, now in zip(shown, shown[1:], shown[2:], strict=False):
        for slot in np.flatnonzero(now.brakes):
            assert before.present[slot] and last.present[slot] and now.present[slot]
            was, is_ = (
                np.hypot(to.boxes["x_m"] - at.boxes["x_m"], to.boxes["y_m"] - at.boxes["y_m"])[slot]
                for at, to in ((before, last), (last, now))
            )
            assert is_ < was
            braked += 1
    assert braked > 0
    assert not any(moment.brakes[~moment.present].any() for moment in shown)


def test_a_reader_is_the_less_sure_the_wider_the_spread() -> None:
    reader = TraitReader(np.array([2.0, 0.0]), 0.0, has_spread=True)
    inputs = np.array([[1.0, 0.0, 0.0, 0.0, 1.0], [1.0, 0.0, 2.0, 0.0, 1.0], [-1.0, 0.0, 0.0, 9.0, 1.0], [0.0] * 5])
    sure, unsure, aggressive, nobody = reader.p_conservative(inputs)
    assert sure > unsure > 0.5 > aggressive
    assert np.isnan(nobody)


def test_what_policies_are_told_separates_the_traits() -> None:
    reader = fit_reader(load_policy("streaming_critic"))
    assert reader is not None and reader.has_spread
    moment = moments("streaming_critic")[100]
    assert moment.observed_traits is not None
    probability = reader.p_conservative(moment.observed_traits)[moment.present]
    np.testing.assert_array_equal(probability > 0.5, moment.traits[moment.present] == 0)
    assert fit_reader(load_policy("no_labels")) is None
    assert fit_reader(load_policy("ttc")) is None


def test_fills_are_inferred_traits_and_outlines_true_ones() -> None:
    moment = moments("ttc")[50]
    plain = artist("ttc").frame(moment)
    assert plain.size == SIZE_PX and plain.mode == "RGB"
    outlines = count(plain, BLUE), count(plain, RED)
    assert all(outlines)
    inputs = np.where(moment.present[:, None], 1.0, 0.0)
    all_blue = artist("ttc", TraitReader(np.array([99.0]), 0.0, has_spread=False)).frame(
        replace(moment, observed_traits=inputs)
    )
    assert count(all_blue, BLUE) > outlines[0] + 300 * moment.present.sum()
    assert count(all_blue, RED) == pytest.approx(outlines[1], rel=0.05)
    unsure = artist("ttc", TraitReader(np.array([0.0]), 0.0, has_spread=False)).frame(
        replace(moment, observed_traits=inputs)
    )
    assert count(unsure, (190, 190, 190)) > 300 * moment.present.sum()


def test_a_film_has_the_colour_of_its_method(tmp_path: Path) -> None:
    render_case(load_policy("ttc"), 0, tmp_path / "strip.png")
    with Image.open(tmp_path / "strip.png") as strip:
        assert strip.getpixel((16, 16)) == ImageColor.getrgb(METHODS["ttc"].look.colour)


def test_lamps_claims_and_attention_are_seen() -> None:
    drawn = artist("ttc")
    moment = replace(moments("ttc")[0], claimed=np.array([False, False]), attention=None)
    frame = drawn.frame(moment)
    assert count(frame, LAMP) == count(frame, CLAIM) == 0
    assert count(drawn.frame(replace(moment, brakes=moment.present)), LAMP) > 0
    assert count(drawn.frame(replace(moment, claimed=np.array([True, False]))), CLAIM) > 10_000
    attention = np.where(moment.present, 1.0 / moment.present.sum(), 0.0)
    halos = np.asarray(drawn.frame(replace(moment, attention=attention))) != np.asarray(frame)
    assert halos.any(axis=2)[:370].sum() > 5_000


def test_vehicles_that_are_not_seen_are_pale_and_buildings_are_drawn() -> None:
    task = replace(TASK, sensor=SENSORS["corners"])
    shown = drive_case(load_policy("vae"), CASE, 0, task).moments
    drawn = replace(artist("vae"), layout=layout(task.played), sensor=task.sensor)  # type: ignore[arg-type]
    hidden = next(moment for moment in shown if (moment.present & ~moment.seen & (moment.traits == 0)).any())
    paled = pale(BLUE)
    assert count(drawn.frame(hidden), paled) > 300
    assert count(drawn.frame(replace(hidden, seen=hidden.present)), paled) == 0
    assert count(drawn.frame(hidden), ImageColor.getrgb(BUILDING_COLOUR)) > 20_000
    assert count(artist("vae").frame(hidden), ImageColor.getrgb(BUILDING_COLOUR)) == 0
    for moment in shown:
        assert moment.attention is not None and not moment.attention[~moment.seen].any()
        assert not moment.seen[~moment.present].any()
        np.testing.assert_array_equal(moment.traits >= 0, moment.present)
    assert any((moment.present & ~moment.seen).any() and moment.attention.any() for moment in shown)  # type: ignore[union-attr]


@pytest.mark.parametrize("scene", ENV_IDS)
def test_every_scene_can_be_filmed(scene: str, tmp_path: Path) -> None:
    contender = load_policy("always_go", scene=scene)
    film = render_case(contender, CASE, tmp_path / "strip.png", task=replace(contender.task, p_conservative=0.4))
    assert film.frames == 8 and film.outcome and film.time_s > 0.0
    with Image.open(tmp_path / "strip.png") as strip:
        assert strip.size == (4 * 640 + 3 * 4, 2 * 480 + 4)
    assert list(tmp_path.iterdir()) == [tmp_path / "strip.png"]


def test_a_gif_runs_in_real_time(tmp_path: Path) -> None:
    reports: list[Progress] = []
    film = render_case(
        load_policy("always_go"),
        CASE,
        tmp_path / "film.gif",
        task=TASK,
        report=reports.append,
    )
    assert film == Film("collision", 2.4, 25)
    assert reports == [Progress(done, 25, "frame") for done in range(1, 26)]
    with Image.open(tmp_path / "film.gif") as gif:
        assert (gif.n_frames, gif.size, gif.info["duration"]) == (25, SIZE_PX, 100)  # type: ignore[attr-defined]


def test_an_mp4_has_every_step(tmp_path: Path) -> None:
    ffmpeg = pytest.importorskip("imageio_ffmpeg", reason="no .mp4 without the extra tint_sumo[video]")
    render_case(load_policy("always_go"), CASE, tmp_path / "film.mp4", task=TASK)
    properties = next(ffmpeg.read_frames(str(tmp_path / "film.mp4")))
    assert (properties["size"], properties["fps"], properties["pix_fmt"]) == (SIZE_PX, 10.0, "yuv420p(progressive)")
    frames, _ = ffmpeg.count_frames_and_secs(str(tmp_path / "film.mp4"))
    assert frames == 25 + 15  # the last one stays for a while


def test_mp4_without_its_extra_names_it(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "imageio_ffmpeg", None)
    with pytest.raises(InputError, match=r'pip install "tint_sumo\[video\]"'):
        render_case(load_policy("always_go"), 0, tmp_path / "film.mp4")


def test_bad_input_leaves_no_file(tmp_path: Path) -> None:
    contender = load_policy("always_go")
    for case, case_set, name, message in (
        (0, 0, "film.avi", r"film\.avi must end in \.mp4, \.gif or \.png; choose another `out`"),
        (-1, 0, "film.gif", "case must lie in 0 to 999999, not -1"),
        (1_000_000, 0, "film.gif", "case must lie in 0 to 999999"),
        (0, 1001, "film.gif", r"case_set must lie in 0 to 1,?000"),
    ):
        with pytest.raises(InputError, match=message):
            render_case(contender, case, tmp_path / name, case_set=case_set)
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("scene", ["t_intersection", "roundabout"])
def test_gymnasiums_videos(scene: str, tmp_path: Path) -> None:
    pytest.importorskip("moviepy", reason="no RecordVideo without the extra tint_sumo[video]")
    ffmpeg = pytest.importorskip("imageio_ffmpeg")
    env = RecordVideo(gymnasium.make(ENV_IDS[scene], render_mode="rgb_array"), str(tmp_path))
    env.reset(seed=0)
    for _ in range(5):
        env.step(0)
    env.close()
    (file,) = tmp_path.glob("*.mp4")
    properties = next(ffmpeg.read_frames(str(file)))
    assert (properties["fps"], properties["pix_fmt"]) == (10.0, "yuv420p(progressive)")  # what every player plays
