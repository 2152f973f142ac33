import math

import pytest

from tint_sumo.scenes import T_INTERSECTION, find_scene
from tint_sumo.scenes.layout import layout
from tint_sumo.simulation.ego import EgoRules, Egos, acceleration_mps2, is_unsafe

T = find_scene(T_INTERSECTION)
RULES = EgoRules.of(T)


@pytest.mark.parametrize(
    ("speed_mps", "desired_mps", "unsafe", "expected"),
    [
        (0.0, 0.5, False, 1.0),  # gain 2 per second
        (2.0, 3.0, False, 2.0),
        (0.0, 3.0, False, 3.0),  # limited to 3
        (3.0, 0.0, False, -3.0),
        (0.5, 3.0, True, -2.5),  # the safety check brakes with gain 5
        (3.0, 3.0, True, -6.0),  # limited to 6
        (0.0, 3.0, True, 0.0),
    ],
)
def test_acceleration(speed_mps: float, desired_mps: float, unsafe: bool, expected: float) -> None:
    assert acceleration_mps2(speed_mps, desired_mps, unsafe, RULES) == pytest.approx(expected)


@pytest.mark.parametrize(
    ("distance_m", "closing_mps", "unsafe"),
    [
        (0.79, -1.0, True),  # too close, even while moving apart
        (0.81, 0.9, False),
        (0.99, 1.1, True),  # close and closing
        (1.01, 3.0, False),
        (math.inf, 0.0, False),  # nobody there
    ],
)
def test_safety_check(distance_m: float, closing_mps: float, unsafe: bool) -> None:
    assert is_unsafe(distance_m, closing_mps, RULES) == unsafe


@pytest.mark.parametrize(
    ("past_m", "speed_mps", "claimed"),
    [
        (-0.1, 3.0, False),
        (0.1, 0.6, True),
        (0.1, 0.5, False),  # creeping is no claim
        (0.9, 0.0, False),  # nor is standing short of the vehicles' path
        (1.1, 0.0, True),
    ],
)
def test_claims_on_the_first_lane(past_m: float, speed_mps: float, claimed: bool) -> None:
    egos = Egos(1, layout(T))
    egos.front_m[0], egos.speed_mps[0] = layout(T).zones.enter_m[0] + past_m, speed_mps
    assert egos.update_claims() is claimed
    assert egos.has_claimed.tolist() == [[claimed, False]]
    assert not egos.update_claims()


def test_speed_along_a_lane_is_no_claim_on_it() -> None:
    """In its turn the ego comes closer to the second lane by only a part of its speed."""
    zones = layout(T).zones
    egos = Egos(1, layout(T))
    egos.front_m[0] = zones.enter_m[1] + 0.1
    for speed_mps, claimed in ((0.6, False), (0.7, True)):
        egos.speed_mps[0] = speed_mps
        egos.update_claims()
        assert egos.has_claimed.tolist() == [[True, claimed]]
