"""The bound of inference, ``scripts/supervised.py``: statistics of drivers beside those of the others around them."""

import sys
from dataclasses import replace
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest

from tests.traits.test_relative import SETTINGS, platoon
from tint_sumo.traits.perceived import Perceived
from tint_sumo.traits.relative_fit import follow

STATISTICS, BELIEF = 5, 2  # numbers; the inputs are the belief, own statistics, the others', differences and weights
SPEED_MPS, GAPS_M = 2.0, [3.0, 3.0, 6.0]


@pytest.fixture(scope="module")
def supervised() -> ModuleType:
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(sys, "path", [str(Path(__file__).resolve().parents[2] / "scripts"), *sys.path])
        import supervised as script

    found: ModuleType = script
    return found


def parts(inputs: np.ndarray) -> tuple[np.ndarray, ...]:
    """Own statistics, those of the others, and the differences."""
    own, others, differences, *_ = np.split(inputs[..., BELIEF:], 5, axis=-1)
    return own, others, differences


def test_drivers_are_compared_with_the_mean_of_the_others(supervised: ModuleType) -> None:
    own, others, differences = parts(supervised.compared(platoon(GAPS_M, 100, SPEED_MPS))[-1, 0])
    np.testing.assert_allclose(own[:, 0], np.array(GAPS_M) / SPEED_MPS, rtol=0.02)
    np.testing.assert_allclose(own[:, 1], GAPS_M)
    np.testing.assert_allclose(own[:, 2:], [[SPEED_MPS, 0.0, SPEED_MPS]] * 3, atol=1e-5)
    np.testing.assert_allclose(others[:, 1], [4.5, 4.5, 3.0], rtol=1e-5)
    np.testing.assert_allclose(differences, own - others, rtol=1e-4, atol=1e-5)


def test_drivers_who_have_left_still_count_until_the_episode_ends(supervised: ModuleType) -> None:
    seen = platoon(GAPS_M, 100, SPEED_MPS)
    present = seen.present.copy()
    present[60:, :, 2] = False
    _, others, _ = parts(supervised.compared(replace(seen, present=present))[-1, 0])
    assert 3.0 < others[0, 1] < 4.5, "the one who has left had a gap of 6 m, for fewer steps"
    begins = seen.begins.copy()
    begins[70] = True
    _, others, _ = parts(supervised.compared(replace(seen, present=present, begins=begins))[-1, 0])
    assert others[0, 1] == pytest.approx(3.0)


def test_one_episode_has_no_influence_on_another_and_relative_traits_come_first(supervised: ModuleType) -> None:
    one, other = platoon(GAPS_M, 80), platoon([9.0, 2.0, 4.0], 80, 3.0)
    both = Perceived(**{name: np.concatenate([part, getattr(other, name)], axis=1) for name, part in vars(one).items()})
    np.testing.assert_array_equal(supervised.compared(both)[:, 1:], supervised.compared(other))
    np.testing.assert_array_equal(supervised.compared(both)[..., :BELIEF], follow(SETTINGS, both)[0])
