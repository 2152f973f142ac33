"""The pictures that are shipped: ``scripts/make_shipped.py`` draws them again as they are, and shows a good moment."""

import sys
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest
from PIL import Image

from tint_sumo.envs import SceneEnv, TaskSettings

ROOT = Path(__file__).parents[1]
SCRIPTS, IMAGES = ROOT / "scripts", ROOT / "data" / "images"


@pytest.fixture
def make_shipped(monkeypatch: pytest.MonkeyPatch) -> ModuleType:
    monkeypatch.setattr(sys, "path", [str(SCRIPTS), *sys.path])
    import make_shipped  # type: ignore[import-not-found]

    return make_shipped


def test_figures_are_drawn_from_the_shipped_tables(make_shipped: ModuleType, tmp_path: Path) -> None:
    make_shipped.make_figures(tmp_path)
    assert_pictures_are_shipped(tmp_path, {"navigation.png", "conditions.png", "traits.png", "strangers.png"})


@pytest.mark.long
def test_pictures_of_scenes_are_those_of_their_episodes(make_shipped: ModuleType, tmp_path: Path) -> None:
    make_shipped.make_pictures(tmp_path)
    assert_pictures_are_shipped(tmp_path, {"scene.png", "scenes.png", "street.png"})


def test_pictures_of_sensors_show_the_same_moment(make_shipped: ModuleType, tmp_path: Path) -> None:
    make_shipped.make_sensor_pictures(tmp_path)
    assert_pictures_are_shipped(tmp_path, {"sensors.png"})


def test_the_picture_of_towns_shows_the_population(make_shipped: ModuleType, tmp_path: Path) -> None:
    make_shipped.make_towns_picture(tmp_path)
    assert_pictures_are_shipped(tmp_path, {"towns.png"})


def test_the_picture_of_willingness_shows_the_drivers(make_shipped: ModuleType, tmp_path: Path) -> None:
    make_shipped.make_willingness_picture(tmp_path)
    assert_pictures_are_shipped(tmp_path, {"willingness.png"})


def assert_pictures_are_shipped(folder: Path, names: set[str]) -> None:
    """Compare pictures in a folder with those in data/images, but for the edges of letters, which fonts decide."""
    assert {file.name for file in folder.iterdir()} == names
    for name in names:
        drawn, shipped = (
            np.asarray(Image.open(file).convert("RGB").reduce(4), int) for file in (folder / name, IMAGES / name)
        )
        assert drawn.shape == shipped.shape, name
        differs = (np.abs(drawn - shipped) > 40).any(axis=-1)
        assert differs.mean() < 0.01, name


def test_an_ego_is_shown_among_the_traffic_and_clear_of_it(make_shipped: ModuleType) -> None:
    env = SceneEnv(TaskSettings("four_way_turn"))
    env.reset(seed=1)
    assert not make_shipped.is_clear_in_traffic(env.simulation)  # it stands before the traffic
    seen, outcome = [], ""
    while not outcome:
        *_, info = env.step(np.int64(2))
        outcome = info["outcome"]
        seen.append(make_shipped.is_clear_in_traffic(env.simulation))
    assert (outcome, seen[-1]) == ("collision", False)  # it touches a car
    assert any(seen)
    env.close()


def test_a_picture_bears_the_name_of_its_scene(make_shipped: ModuleType) -> None:
    picture = np.full((40, 200, 3), 120, np.uint8)
    titled = np.asarray(make_shipped.titled_picture("on_ramp", picture))
    assert titled.shape[:2] == (20 + make_shipped.TITLE_PX, 100)
    assert (titled[make_shipped.TITLE_PX :] == 120).all()
    assert (titled[: make_shipped.TITLE_PX] < 128).any()
