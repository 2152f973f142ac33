"""Reading traits for viewers."""

import numpy as np

from tint_sumo.films.trait_probe import fit_reader
from tint_sumo.methods.loading import Contender
from tint_sumo.methods.rules import AlwaysGo
from tint_sumo.policy.trait_sources import NoTraits, OracleTraits, TraitSource, WithMotion
from tint_sumo.scenes import paper_scene


def contender(source: TraitSource) -> Contender:
    return Contender("of a test", AlwaysGo(2), paper_scene(), lambda: source)


def test_motion_is_no_trait() -> None:
    """Speed and gap tell who yields in the old world, and are in the observation of policies that infer nothing."""
    assert fit_reader(contender(WithMotion(NoTraits()))) is None
    plain, behind = (fit_reader(contender(source)) for source in (OracleTraits(), WithMotion(OracleTraits())))
    assert plain is not None and behind is not None and (plain.before, behind.before) == (0, 3)
    np.testing.assert_allclose(plain.weights, behind.weights)
    traits = np.array([[1.0, 0.0], [0.0, 1.0], [0.0, 0.0]])
    moving = np.hstack([np.full((3, 3), 0.7), traits])
    yields = behind.p_conservative(moving)
    assert yields[0] > 0.9 and yields[1] < 0.1 and np.isnan(yields[2])
