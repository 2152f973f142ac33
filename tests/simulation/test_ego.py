import numpy as np
import pytest

from tint_sumo.config import Claim, EgoController, Street
from tint_sumo.simulation.ego import acceleration_mps2, claims, is_unsafe

CONTROLLER = EgoController()
NO = np.array([False])
YES = np.array([True])


@pytest.mark.parametrize(
    ("speed_mps", "desired_mps", "unsafe", "expected"),
    [
        (0.0, 0.5, NO, 1.0),  # gain 2 per second
        (2.0, 3.0, NO, 2.0),
        (0.0, 3.0, NO, 3.0),  # limited to 3
        (3.0, 0.0, NO, -3.0),
        (0.5, 3.0, YES, -2.5),  # the safety check brakes with gain 5
        (3.0, 3.0, YES, -6.0),  # limited to 6
        (0.0, 3.0, YES, 0.0),
    ],
)
def test_acceleration(speed_mps: float, desired_mps: float, unsafe: np.ndarray, expected: float) -> None:
    found = acceleration_mps2(np.array([speed_mps]), np.array([desired_mps]), unsafe, CONTROLLER)
    assert found[0] == pytest.approx(expected)


@pytest.mark.parametrize(
    ("distance_m", "closing_mps", "unsafe"),
    [
        (0.79, -1.0, True),  # too close, even while moving apart
        (0.81, 0.9, False),
        (0.99, 1.1, True),  # close and closing
        (1.01, 3.0, False),
        (np.inf, 0.0, False),  # nobody there
    ],
)
def test_safety_check(distance_m: float, closing_mps: float, unsafe: bool) -> None:
    found = is_unsafe(np.array([np.inf, distance_m]), np.array([0.0, closing_mps]), CONTROLLER)
    assert found.tolist() == [False, unsafe]


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
    found = claims(np.array([front_y_m]), np.array([towards_mps]), Claim(), Street())
    assert found.tolist() == [[lower, upper]]
