import math

import pytest

from tint_sumo.config import Scenario
from tint_sumo.simulation.ego import EgoRules, acceleration_mps2, claims, is_unsafe

RULES = EgoRules.of(Scenario())


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
    ("front_y_m", "towards_mps", "lower", "upper"),
    [
        (-0.1, 3.0, False, False),
        (0.1, 0.6, True, False),
        (0.1, 0.5, False, False),  # creeping is no claim
        (0.9, 0.0, False, False),  # nor is standing short of the path
        (1.1, 0.0, True, False),
        (3.9, 3.0, True, False),
        (4.1, 0.6, True, True),
        (4.1, 0.0, True, False),
        (5.1, 0.0, True, True),
    ],
)
def test_claims(front_y_m: float, towards_mps: float, lower: bool, upper: bool) -> None:
    assert claims(front_y_m, towards_mps, RULES.lower_border_y_m, RULES) == lower
    assert claims(front_y_m, towards_mps, RULES.upper_border_y_m, RULES) == upper
