"""Drivers of each of SUMO's car-following models keep their traits."""

from dataclasses import replace
from typing import get_args, get_type_hints

import numpy as np
import pytest

from tests.simulation.scenes import T
from tint_sumo.config import Mix, Population, Traffic
from tint_sumo.scenes import Scene
from tint_sumo.scenes.geometry import Floats
from tint_sumo.simulation.scene import SceneSimulation

MODELS = get_args(get_type_hints(Population)["car_following"])
EGO_MPS = 3.0
STEPS = 100


@pytest.mark.parametrize("model", MODELS)
@pytest.mark.parametrize("p_conservative", [0.0, 1.0])
def test_drivers_of_each_model_drive_and_only_conservative_ones_yield(model: str, p_conservative: float) -> None:
    population = replace(T.population, members=2, car_following=model)
    scene = replace(T, population=population, traffic=Traffic(Mix(p_conservative)))
    simulation = SceneSimulation(4, scene)
    try:
        for replica in range(4):
            simulation.reset(replica, replica)
        reacted, stood, moved_m = 0, 0, 0.0
        for step in range(STEPS):
            before_m, before = simulation.slots.front_m.copy(), simulation.slots.vehicle_number.copy()
            # The ego stands for 2 s, enters the lower lane, and stands in it: conservative drivers wait for it.
            enters = step >= 20 and (simulation.egos.front_m < scene.ego.start_m + 4.5).any()
            simulation.step(np.full(4, EGO_MPS if enters else 0.0))
            reacts = simulation.yielding.reacts
            same = (simulation.slots.vehicle_number == before) & (before >= 0)
            ahead_m = (simulation.slots.front_m - before_m)[same]
            assert (ahead_m >= -1e-9).all()
            moved_m += float(ahead_m.sum())
            reacted += int(reacts.sum())
            stood += int((reacts & same & (np.abs(simulation.slots.front_m - before_m) < 0.01)).sum())
        assert moved_m > 100.0
        assert (reacted > 0, stood > 0) == ((True, True) if p_conservative == 1.0 else (False, False))
    finally:
        simulation.close()


@pytest.mark.parametrize("model", MODELS)
def test_episodes_of_each_model_do_not_depend_on_the_batch(model: str) -> None:
    scene = replace(T, population=replace(T.population, members=2, car_following=model))
    alone, among_others = fronts_m(scene, replicas=1, steps_before=0), fronts_m(scene, replicas=3, steps_before=15)
    np.testing.assert_array_equal(alone, among_others)


def fronts_m(scene: Scene, replicas: int, steps_before: int) -> Floats:
    """The fronts in each step of an episode in the last replica, begun after some steps of other episodes."""
    simulation = SceneSimulation(replicas, scene)
    try:
        for replica in range(replicas):
            simulation.reset(replica, 100 + replica)
        for _ in range(steps_before):
            simulation.step(np.zeros(replicas))
        simulation.reset(replicas - 1, 7)
        fronts = []
        for step in range(60):
            simulation.step(np.full(replicas, EGO_MPS if step > 20 else 0.0))
            fronts.append(simulation.slots.front_m[-1].copy())
        return np.array(fronts)
    finally:
        simulation.close()
