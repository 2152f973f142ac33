"""Persons on foot in the observation of SUMO configurations."""

import math
from collections.abc import Iterator
from contextlib import closing
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from tests.envs.test_environments import assert_equal
from tests.simulation.test_persons import net, street
from tint_sumo.config import SENSORS, Sensor
from tint_sumo.envs import TaskSettings
from tint_sumo.envs.pedestrians import PEDESTRIANS
from tint_sumo.envs.scene_env import SceneEnv
from tint_sumo.scenes import SumocfgScene
from tint_sumo.simulation import SumocfgSimulation

__all__ = ["net"]  # a fixture
SPEED_MPS = 8.0  # the ego's top speed, and so the scale of velocities


@pytest.fixture(scope="module")
def scene(net: Path) -> SumocfgScene:
    """A crossing in use, without buildings; a car stands beyond it."""
    return replace(street(net, period_s=2.0), perceives=("pedestrians",), time_limit_s=8.0)


def episode(scene: SumocfgScene, sensor: Sensor, **settings: Any) -> Iterator[tuple[dict[str, Any], SumocfgSimulation]]:
    """Yield observation and simulation at each step of an episode."""
    with closing(SceneEnv(TaskSettings(scene, sensor=sensor, **settings))) as env:
        simulation = env.simulation
        assert isinstance(simulation, SumocfgSimulation)
        observation, _ = env.reset(seed=1)
        ended = False
        while not ended:
            assert env.observation_space.contains(observation)
            yield observation, simulation
            observation, _, terminated, truncated, _ = env.step(1)
            ended = terminated or truncated


def distances_m(observation: dict[str, Any], scene: SumocfgScene) -> np.ndarray:
    """Return the distances of the persons in an observation."""
    at = observation["pedestrians"][observation["pedestrian_mask"] > 0.5, :2]
    return np.hypot(*at.T) * scene.position_scale_m


def test_the_nearest_are_where_sumo_has_them_and_move_so(scene: SumocfgScene) -> None:
    most = 0
    for observation, simulation in episode(scene, Sensor()):
        person, (left_m, low_m) = simulation.connection.person, simulation.origin_m
        ego = simulation.egos.box[0]
        there = {}
        for name in person.getIDList():
            x_m, y_m = person.getPosition(name)
            angle, speed_mps = math.radians(person.getAngle(name)), person.getSpeed(name)
            ahead = np.array([math.sin(angle), math.cos(angle)])
            at_m = np.array([x_m - left_m - ego["x_m"], y_m - low_m - ego["y_m"]]) - ahead * person.getLength(name) / 2
            moves, at = ahead * speed_mps / SPEED_MPS, at_m / scene.position_scale_m
            there[name] = np.hypot(*at_m), np.concatenate([at, moves])
        near = sorted((one for one in there.values() if one[0] <= scene.sight_m), key=lambda one: float(one[0]))
        shown = observation["pedestrians"][observation["pedestrian_mask"] > 0.5]
        assert len(shown) == min(len(near), PEDESTRIANS)
        expected = np.array([values for _, values in near[: len(shown)]]).reshape(-1, 4)
        np.testing.assert_allclose(shown, np.clip(expected, -2.0, 2.0), atol=1e-5)
        assert not observation["pedestrians"][observation["pedestrian_mask"] < 0.5].any()
        most = max(most, len(near))
    assert most > PEDESTRIANS


def test_range_field_of_view_occlusion_and_dropouts_hide_them(scene: SumocfgScene) -> None:
    perfect = [int(one["pedestrian_mask"].sum()) for one, _ in episode(scene, Sensor())]
    near = [distances_m(one, scene) for one, _ in episode(scene, Sensor(range_m=15.0))]
    assert max(map(len, near)) > 0
    assert all((one <= 15.0 + 1e-5).all() for one in near)
    ahead = [one for one, _ in episode(scene, Sensor(field_of_view_deg=40.0))]
    for observation in ahead:
        seen = observation["pedestrians"][observation["pedestrian_mask"] > 0.5]
        assert (np.abs(seen[:, 1]) <= math.tan(math.radians(20.0)) * seen[:, 0] + 1e-5).all()
    lost = [int(one["pedestrian_mask"].sum()) for one, _ in episode(scene, Sensor(dropouts_per_s=1.0))]
    assert sum(lost) < 0.9 * sum(perfect)
    assert any(before > after > 0 for before, after in zip(perfect, lost, strict=True))


def test_buildings_hide_them(scene: SumocfgScene) -> None:
    with closing(SceneEnv(TaskSettings(scene, sensor=Sensor(occlusion=True)))) as env:
        env.reset(seed=1)
        simulation = env.simulation
        before = int(env.step(0)[0]["pedestrian_mask"].sum())
        simulation.walls = np.array([[8.0, -40.0, 8.0, 40.0]])  # right across the ego's way
        assert before > 0
        seen = env.step(0)[0]
        assert (seen["pedestrians"][seen["pedestrian_mask"] > 0.5, 0] * scene.position_scale_m <= 8.01).all()
        assert seen["pedestrian_mask"].sum() < before


def test_noise_is_on_positions_and_follows_from_the_seed_alone(scene: SumocfgScene) -> None:
    sensor = Sensor(noise_m=0.3, noise_time_s=0.5, dropouts_per_s=0.2, range_m=12.0)
    runs = [[one for one, _ in episode(scene, sensor, backend=backend)] for backend in ("libsumo", "traci")]
    for one, other in zip(*runs, strict=True):
        assert_equal(one, other)
    errors = []
    exact = episode(scene, Sensor(range_m=100.0))
    for (true, _), noisy in zip(exact, [one for one, _ in episode(scene, Sensor(noise_m=0.1))], strict=True):
        both = min(true["pedestrian_mask"].sum(), noisy["pedestrian_mask"].sum(), 2)
        for place in range(int(both)):
            off = noisy["pedestrians"] - true["pedestrians"][place]
            nearest = off[np.hypot(*off[:, :2].T).argmin()]
            errors.append(nearest[:2] * scene.position_scale_m)
    assert 0.05 < np.std(errors) < 0.15


def test_a_delay_shows_them_as_they_were(scene: SumocfgScene) -> None:
    now = [one for one, _ in episode(scene, Sensor())]
    late = [one for one, _ in episode(scene, SENSORS["delay_0.2"])]
    for step, observation in enumerate(late):
        earlier = now[max(step - 2, 0)]
        for key in ("pedestrians", "pedestrian_mask", "vehicles", "mask"):
            np.testing.assert_array_equal(observation[key], earlier[key])
        np.testing.assert_array_equal(observation["ego"], now[step]["ego"])
