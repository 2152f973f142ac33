"""SUMO's driver in place of the actions."""

import math
from dataclasses import replace

import numpy as np
import pytest

from tests.scenes.networks import USER_NETWORKS
from tests.simulation.test_sumocfg import begun
from tint_sumo.config import EgoController
from tint_sumo.core.errors import InputError
from tint_sumo.scenes import SumocfgScene
from tint_sumo.simulation import SumocfgSimulation
from tint_sumo.simulation.ego_way import EGO

_TOP_MPS = 14.0
_LIMIT_S = 60.0


@pytest.fixture(scope="module")
def by_actions(tmp_path_factory: pytest.TempPathFactory) -> SumocfgScene:
    """A crossing whose light is red when an ego at top speed comes to it."""
    network = USER_NETWORKS["braunschweig"](tmp_path_factory.mktemp("braunschweig"))
    return network.scene(controller=EgoController((0.0, _TOP_MPS)), warm_up_s=0.0)


def drive_through(simulation: SumocfgSimulation, desired_mps: float) -> tuple[list[float], list[str]]:
    """Return where the ego's front was after each step, and the states of lights as it drove past them."""
    scene, egos, vehicle = simulation.scene, simulation.egos, simulation.connection.vehicle
    front_m: list[float] = []
    passed: list[str] = []
    lights = vehicle.getNextTLS(EGO)
    for _ in range(round(_LIMIT_S / scene.step_s)):
        simulation.step(np.array([desired_mps]))
        front_m.append(float(egos.front_m[0]))
        if egos.front_m[0] > scene.goal_m or egos.collided[0] or egos.lost[0]:
            break
        before, lights = lights, vehicle.getNextTLS(EGO)
        if before and (not lights or lights[0][:2] != before[0][:2]):
            passed.append(before[0][3])
    return front_m, passed


def test_sumos_driver_stops_at_a_red_light_that_actions_pass(by_actions: SumocfgScene) -> None:
    with begun(by_actions) as simulation:
        traffic = simulation.slots.box.copy()
        _, passed = drive_through(simulation, _TOP_MPS)
        assert passed == ["r"]
    with begun(replace(by_actions, ego_control="sumo")) as simulation:
        np.testing.assert_array_equal(simulation.slots.box, traffic)
        front_m, passed = drive_through(simulation, _TOP_MPS)
        assert passed == ["G"]
        assert front_m[-1] > by_actions.goal_m
        assert max(np.diff(front_m)) > 5.0 * by_actions.step_s, "it drives as fast as it may, not at a set speed"
        assert not simulation.egos.collided[0]


def test_sumos_driver_takes_no_notice_of_actions_and_follows_from_the_seed(by_actions: SumocfgScene) -> None:
    scene = replace(by_actions, ego_control="sumo", warm_up_s=5.0, warm_starts=1)
    with begun(scene) as simulation:
        stands, _ = drive_through(simulation, 0.0)
        simulation.reset(0, 1)
        goes, _ = drive_through(simulation, _TOP_MPS)
    assert stands == goes
    assert goes[-1] > scene.start_m + 10.0


def test_sumos_driver_that_comes_to_the_end_of_its_route_has_arrived(by_actions: SumocfgScene) -> None:
    with begun(replace(by_actions, ego_control="sumo", goal_m=10_000.0), seed=2) as simulation:
        front_m, _ = drive_through(simulation, _TOP_MPS)
        assert not simulation.egos.lost[0]
    assert front_m[-1] == math.inf


def test_other_drivers_of_the_ego_are_refused(by_actions: SumocfgScene) -> None:
    with pytest.raises(InputError, match=r"ego_control must be one of speed, sumo, not 'human'"):
        replace(by_actions, ego_control="human")  # type: ignore[arg-type]
