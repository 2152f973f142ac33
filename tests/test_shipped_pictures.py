"""The pictures of scenes that are shipped: what ``scripts/make_shipped.py`` takes for a moment to show."""

import sys
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest

from tint_sumo.envs import SceneEnv

SCRIPTS = Path(__file__).parents[1] / "scripts"


@pytest.fixture
def make_shipped(monkeypatch: pytest.MonkeyPatch) -> ModuleType:
    monkeypatch.setattr(sys, "path", [str(SCRIPTS), *sys.path])
    import make_shipped  # type: ignore[import-not-found]

    return make_shipped


def test_an_ego_is_shown_among_the_traffic_and_clear_of_it(make_shipped: ModuleType) -> None:
    env = SceneEnv("four_way_turn")
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
