"""Films in SUMO configurations."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from PIL import Image, ImageColor

from tests.scenes.networks import UserNetwork
from tint_sumo.envs.rendering import BUILDING_COLOUR
from tint_sumo.films.driving import drive_case
from tint_sumo.films.film import render_case
from tint_sumo.films.frames import EGO_COLOUR, SCENE_HEIGHT_PX, SIZE_PX, TITLE_HEIGHT_PX
from tint_sumo.films.network_frames import NetworkArtist, vtypes_in
from tint_sumo.methods.evaluation import evaluate
from tint_sumo.methods.loading import load_policy

Make = Callable[[str], UserNetwork]
SPACE = (0, TITLE_HEIGHT_PX, SIZE_PX[0], TITLE_HEIGHT_PX + SCENE_HEIGHT_PX)  # of the picture in a frame


@pytest.mark.parametrize(("name", "fps"), [("merge", 10.0), ("braunschweig", 10.0), ("grid", 1.0)])
def test_a_film_runs_in_real_time_whatever_the_step(name: str, fps: float, user_network: Make, tmp_path: Path) -> None:
    contender = load_policy("ttc", scene=user_network(name).scene(time_limit_s=3.0, warm_up_s=5.0))
    film = render_case(contender, 0, tmp_path / "film.gif")
    assert abs(film.frames - (1 + 3.0 * fps)) <= 1
    with Image.open(tmp_path / "film.gif") as shown:
        assert shown.info["duration"] == round(1000 / fps)
        assert shown.size == SIZE_PX


def test_a_frame_shows_the_ego_in_its_middle_and_each_vehicle_in_the_colour_of_its_vtype(user_network: Make) -> None:
    scene = user_network("merge").scene(start_m=60.0, time_limit_s=12.0)
    contender = load_policy("always_go", scene=scene)
    driven = drive_case(contender, 5, 0, contender.task)
    case = evaluate(contender.policy, lambda n: contender.make_venv(n, contender.task), 1, 0, first=5).cases[0]
    assert driven.case == case
    vtypes = vtypes_in(driven.moments)
    assert set(vtypes) == {0, 1}
    artist = NetworkArtist(scene, "title", (1, 2, 3), vtypes, driven.origin_m)
    shown = 0
    for moment in driven.moments[::10]:
        picture = np.asarray(artist.frame(moment).crop(SPACE))
        down, across = np.nonzero(np.isclose(picture, EGO_COLOUR, atol=6).all(axis=2))
        assert abs(down.mean() - SCENE_HEIGHT_PX / 2) < 3.0
        assert abs(across.mean() - SIZE_PX[0] / 2) < 3.0
        away_m = np.hypot(moment.boxes["x_m"] - moment.ego["x_m"], moment.boxes["y_m"] - moment.ego["y_m"])
        near = moment.present & (away_m < 24.0)  # the others may be outside of the frame
        shown += near.sum()
        for number in set(moment.traits[near].tolist()):
            assert np.isclose(picture, scene.trait_colours[number], atol=6).all(axis=2).sum() > 30
    assert shown > 0
    ego = driven.moments[0].ego
    beside = ((5.0, 20.0), (15.0, 20.0), (15.0, 12.0))  # ahead of the ego's start is north of no road
    built = replace(artist, buildings=(tuple((ego["x_m"] + x_m, ego["y_m"] + y_m) for x_m, y_m in beside),))
    was, now = (
        np.isclose(one.frame(driven.moments[0]).crop(SPACE), ImageColor.getrgb(BUILDING_COLOUR), atol=6).all(axis=2)
        for one in (artist, built)
    )
    assert was.sum() == 0 and now.sum() == pytest.approx(40.0 * (SIZE_PX[0] / 100.0) ** 2, rel=0.1)
    stays, moved = (np.asarray(artist.frame(driven.moments[index]).crop(SPACE)) for index in (0, -1))
    assert (stays != moved).any(axis=2).mean() > 0.02  # the roads pass by
