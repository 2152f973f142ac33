"""The steps of the car-following models are SUMO's."""

import numpy as np
import pytest

from tests.drivers.recordings import simulated_pair
from tint_sumo.drivers.models import MODELS, Floats
from tint_sumo.drivers.pairs import Pair
from tint_sumo.drivers.replay import drive, vtype_xml

CASES = 24


def rounded(log_parameters: Floats) -> Floats:
    """The parameters as SUMO reads them of a file."""
    return np.log([float(f"{value:.6g}") for value in np.exp(log_parameters)])


def cases(model: str, step_s: float) -> tuple[list[Pair], list[Floats]]:
    """Pairs at all kinds of gaps and speeds, with parameters from all of their ranges."""
    rng = np.random.default_rng(len(model))
    found, every = MODELS[model], round(step_s / 0.1)
    pairs, parameters = [], []
    for seed in range(CASES):
        near = rng.uniform(-0.3, 0.3, len(found.low))
        wide = rng.uniform(found.low, found.high)
        parameters.append(rounded(found.usual + near if seed % 2 else wide))
        recorded = simulated_pair(MODELS["IDM"].usual, seed, mean_mps=rng.uniform(5.0, 30.0))
        shift_m = rng.uniform(-15.0, 30.0)  # the first gap is 5 to 50 m
        columns = [column[::every] for column in (recorded.leader_rear_m + shift_m, recorded.leader_speed_mps)]
        pairs.append(
            Pair("1", "1", str(seed), 0.0, step_s, *columns, recorded.front_m[::every], recorded.speed_mps[::every])
        )
    return pairs, parameters


@pytest.mark.parametrize("model", MODELS)
@pytest.mark.parametrize("step_s", [0.1, 0.5, 1.0])
def test_steps_are_those_of_sumo(model: str, step_s: float) -> None:
    pairs, parameters = cases(model, step_s)
    ids = [f"driver{index}" for index in range(CASES)]
    types = "".join(vtype_xml(name, MODELS[model].vtype(z)) for name, z in zip(ids, parameters, strict=True))
    compared = 0
    for pair, z, driven in zip(pairs, parameters, drive(pairs, types, ids), strict=True):
        front_m, speed_mps = MODELS[model].follow(
            pair.leader_rear_m, pair.leader_speed_mps, pair.front_m[0], pair.speed_mps[0], z, step_s
        )
        # SUMO knows no leader that a follower has passed.
        passed = np.append(pair.leader_rear_m - front_m <= 0.0, True)
        until = int(np.argmax(passed)) + 1
        assert np.abs(front_m - driven.front_m)[:until].max() < 0.01, (pair.leader, np.exp(z))
        assert np.abs(speed_mps - driven.speed_mps)[:until].max() < 0.01
        compared += until
    assert compared > 0.8 * sum(pair.rows for pair in pairs)
