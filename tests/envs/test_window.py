"""The window of ``render_mode="human"``, on a virtual screen."""

import os
import shutil
import subprocess
import sys
import time
from collections.abc import Iterator

import gymnasium
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env
from numpy.typing import NDArray
from PIL import ImageGrab

from tests.waiting import wait_until
from tint_sumo import ENV_IDS
from tint_sumo.core.errors import InputError
from tint_sumo.envs.rendering import render_scene
from tint_sumo.envs.scene_env import SceneEnv
from tint_sumo.scenes import T_INTERSECTION

ENV_ID = ENV_IDS[T_INTERSECTION]
GO, STOP = np.int64(2), np.int64(0)
BLACK = 0  # what the screen shows without a window


@pytest.fixture(scope="module")
def _virtual_display() -> Iterator[str]:
    if shutil.which("Xvfb") is None:
        pytest.skip("a window needs a virtual screen to be tested on: apt-get install xvfb")
    command = ["Xvfb", "-displayfd", "1", "-screen", "0", "800x400x24", "-nolisten", "tcp"]
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True) as xvfb:
        assert xvfb.stdout is not None
        yield f":{int(xvfb.stdout.readline())}"
        xvfb.terminate()


@pytest.fixture
def display(_virtual_display: str, monkeypatch: pytest.MonkeyPatch) -> str:
    monkeypatch.setenv("DISPLAY", _virtual_display)
    return _virtual_display


def wait_for(display: str, expected: NDArray[np.uint8] | int) -> None:
    """Wait until the screen shows this where a window of the scene's size lies, as nobody moves it."""

    def is_shown() -> bool:
        screen = np.asarray(ImageGrab.grab(xdisplay=display).convert("RGB"))
        return bool((screen[:320, :736] == expected).all())

    wait_until(is_shown)


def test_the_window_follows_the_episodes_in_real_time(display: str) -> None:
    env = gymnasium.make(ENV_ID, render_mode="human")
    unwrapped = env.unwrapped
    assert isinstance(unwrapped, SceneEnv)
    wait_for(display, BLACK)
    env.reset(seed=0)
    begun = render_scene(unwrapped.simulation, 0)
    wait_for(display, begun)
    assert env.render() is None  # type: ignore[func-returns-value]
    start = time.monotonic()
    for _ in range(5):
        env.step(GO)
        wait_for(display, render_scene(unwrapped.simulation, 0))
    assert time.monotonic() - start > 0.4
    stepped = render_scene(unwrapped.simulation, 0)
    snapshot = unwrapped.snapshot()
    env.reset(seed=0)
    wait_for(display, begun)
    unwrapped.restore(snapshot)
    wait_for(display, stepped)
    env.close()
    wait_for(display, BLACK)
    env.close()


def test_episodes_go_on_without_a_window_that_was_closed_by_hand(display: str) -> None:
    env = SceneEnv(render_mode="human")
    env.reset(seed=0)
    assert env._window is not None
    root = env._window._root
    root.eval(root.protocol("WM_DELETE_WINDOW"))  # what a click on the window's cross does
    wait_for(display, BLACK)
    for _ in range(3):
        env.step(STOP)
    assert env.reset()[1]["time_s"] == 0.0
    wait_for(display, BLACK)
    env.close()


def test_gymnasiums_checker_with_every_render_mode(display: str) -> None:
    env = gymnasium.make(ENV_ID, render_mode="rgb_array", tracks=True)
    check_env(env.unwrapped)
    env.close()


def test_without_a_display_one_line_says_what_to_do() -> None:
    code = f"""
import gymnasium, tint_sumo
from tint_sumo.core.errors import InputError
try:
    gymnasium.make("{ENV_ID}", render_mode="human")
except InputError as error:
    print(error)
"""
    headless = {name: value for name, value in os.environ.items() if name != "DISPLAY"}
    result = subprocess.run([sys.executable, "-c", code], env=headless, capture_output=True, text=True, check=True)
    (line,) = result.stdout.splitlines()
    assert line.startswith("there is no display to open a window on")
    assert 'use render_mode="rgb_array", or make a film with tint-sumo render' in line


def test_a_python_without_tkinter_is_an_error_that_says_how_to_get_it(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "tkinter", None)
    with pytest.raises(InputError, match=r"apt-get install python3-tk\); use render_mode=\"rgb_array\""):
        SceneEnv(render_mode="human")
