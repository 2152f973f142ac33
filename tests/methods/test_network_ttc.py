"""The time-to-collision rule in SUMO configurations."""

from collections.abc import Callable

import numpy as np
import pytest

from tests.scenes.networks import UserNetwork
from tint_sumo.config import POSITION_SCALE_M, EgoController
from tint_sumo.methods.network_ttc import NetworkTimeToCollision
from tint_sumo.methods.rules import Observation

STEP_S = 0.1
Make = Callable[[str], UserNetwork]


@pytest.fixture(scope="module")
def rule(user_network: Make) -> NetworkTimeToCollision:
    controller = EgoController((0.0, 4.0, 8.0))
    return NetworkTimeToCollision(
        user_network("merge").scene(controller=controller, sight_m=2 * POSITION_SCALE_M), threshold_s=2.0, margin_m=0.5
    )


def seen(at_m: tuple[float, float], ego_mps: tuple[float, float] = (8.0, 0.0)) -> Observation:
    """An ego in the middle of the frame, and a vehicle in the second of three slots."""
    vehicles, mask = np.zeros((1, 3, 2), np.float32), np.zeros((1, 3), np.float32)
    vehicles[0, 1], mask[0, 1] = np.array(at_m) / POSITION_SCALE_M, 1.0
    ego = np.array([[0.0, 0.0, ego_mps[0] / 8.0, ego_mps[1] / 8.0]], np.float32)
    return {"ego": ego, "vehicles": vehicles, "mask": mask}


def choice(rule: NetworkTimeToCollision, at_m: tuple[float, float], mps: tuple[float, float], **ego: object) -> int:
    """Return the action for a vehicle at a position and with a velocity, seen twice."""
    relative = np.array(mps) - np.array(ego.get("ego_mps", (8.0, 0.0)))
    before = tuple(np.array(at_m) - STEP_S * relative)
    _, state = rule.predict(seen(before, **ego), episode_start=np.array([True]))  # type: ignore[arg-type]
    actions, _ = rule.predict(seen(at_m, **ego), state, np.array([False]))  # type: ignore[arg-type]
    return int(actions[0])


@pytest.mark.parametrize(
    ("at_m", "mps", "action"),
    [
        ((15.0, 0.0), (0.0, 0.0), 1),  # stands 15 m ahead: reached in 2 s at 8 m/s, not at 4
        ((8.0, 0.0), (0.0, 0.0), 0),  # stands close ahead
        ((15.0, 0.0), (8.0, 0.0), 2),  # drives on as fast
        ((15.0, 3.2), (0.0, 0.0), 2),  # stands on the next lane
        ((-8.0, 0.0), (12.0, 0.0), 2),  # behind
        ((12.0, 10.0), (0.0, -7.0), 1),  # comes from the left, and is there with an ego at 8 m/s
        ((12.0, 10.0), (0.0, 7.0), 2),  # goes away
    ],
)
def test_it_takes_the_highest_speed_without_a_touch(
    at_m: tuple[float, float], mps: tuple[float, float], action: int, rule: NetworkTimeToCollision
) -> None:
    assert choice(rule, at_m, mps) == action
    turned = tuple((-one[1], one[0]) for one in (at_m, mps))
    assert choice(rule, *turned, ego_mps=(0.0, 8.0)) == action  # whatever the ego's heading


def test_it_remembers_its_heading_and_nothing_of_the_last_episode(rule: NetworkTimeToCollision) -> None:
    stands = seen((8.0, 0.0), ego_mps=(0.0, 0.0))
    actions, _ = rule.predict(stands, None, np.array([True]))
    assert actions[0] == 2  # its heading is not known
    _, state = rule.predict(seen((9.0, 0.0)), None, np.array([True]))
    assert rule.predict(stands, state, np.array([False]))[0][0] == 0
    assert rule.predict(stands, state, np.array([True]))[0][0] == 2
