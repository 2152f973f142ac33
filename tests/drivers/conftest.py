"""A fit of simulated drivers with known parameters, shared by all tests that read one."""

from dataclasses import dataclass
from pathlib import Path

import pytest

from tests.drivers.recordings import population, simulated_pair, write_pairs
from tint_sumo.drivers.fitted import Fitted, fit_drivers
from tint_sumo.drivers.models import MODELS, Floats
from tint_sumo.drivers.pairs import Pair, read_pairs

DRIVERS, PAIRS = 6, 2  # pairs of each


@dataclass(frozen=True)
class KnownFit:
    """Drivers whose parameters are known, their recording, and the fit."""

    log_parameters: dict[str, Floats]  # by the driver's name
    pairs: tuple[Pair, ...]
    recording: Path
    out: Path
    fitted: Fitted


@pytest.fixture(scope="session")
def known(tmp_path_factory: pytest.TempPathFactory) -> KnownFit:
    """Do not write there."""
    folder = tmp_path_factory.mktemp("drivers")
    truth = population(DRIVERS, 1)
    simulated = [
        simulated_pair(truth[driver], PAIRS * driver + number, 400, follower=str(driver), noise_m=0.1)
        for driver in range(DRIVERS)
        for number in range(PAIRS)
    ]
    recording = write_pairs(folder / "recording", simulated)
    pairs = read_pairs(recording).pairs
    fitted = fit_drivers(pairs, MODELS["IDM"], folder / "fit")
    names = {f"1/{driver}": truth[driver] for driver in range(DRIVERS)}
    return KnownFit(names, pairs, recording, folder / "fit", fitted)
