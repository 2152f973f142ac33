"""Fitted drivers drive like the recorded ones, and SUMO's defaults do not."""

from dataclasses import asdict, replace
from xml.etree import ElementTree

import numpy as np
import pytest

from tests.drivers.conftest import KnownFit
from tests.drivers.recordings import population, simulated_pair
from tint_sumo.core.progress import Progress
from tint_sumo.drivers.check import DEFAULT, POPULATION, SAME, TOOL, Check, check, drawn_types, quantities, report_text


@pytest.fixture(scope="module")
def checked(known: KnownFit) -> Check:
    return check(known.fitted, known.pairs, repeats=2, seed=0)


def test_fitted_drivers_are_nearer_to_the_recording_than_sumo_s_own(checked: Check) -> None:
    found = {(one.quantity, one.drivers): one for one in checked.distances}
    for quantity in ("time gap", "acceleration"):
        own = found[quantity, SAME].distance.value
        assert own < 0.5 * min(found[quantity, other].distance.value for other in (DEFAULT, TOOL))
        assert found[quantity, POPULATION].distance.value < found[quantity, DEFAULT].distance.value
    for one in checked.distances:
        assert one.distance.low <= one.distance.high
        assert set(one.ratios) == ({DEFAULT, TOOL} if one.drivers in (SAME, POPULATION) else set())
        for other, ratio in one.ratios.items():
            assert ratio.value == pytest.approx(one.distance.value / found[one.quantity, other].distance.value)


def test_the_same_seed_gives_the_same_numbers_and_another_one_others(known: KnownFit) -> None:
    pairs = known.pairs[:2]
    first, again, other = (check(known.fitted, pairs, 1, seed) for seed in (0, 0, 1))
    assert asdict(first) == asdict(again) != asdict(other)


def test_drivers_that_were_not_fitted_are_compared_with_the_population_alone(known: KnownFit) -> None:
    pair = simulated_pair(population(1, 7)[0], 99, 200, follower="stranger")
    reports: list[Progress] = []
    found = check(known.fitted, [pair], 1, 0, report=reports.append)
    assert {one.drivers for one in found.distances} == {POPULATION, DEFAULT, TOOL}
    assert [(progress.done, progress.total) for progress in reports] == [(1, 3), (2, 3), (3, 3)]


def test_quantities_are_those_of_the_trajectory() -> None:
    pair = simulated_pair(population(1, 0)[0], rows=41)
    time_s = 0.1 * np.arange(41)
    found = quantities(pair, pair.leader_rear_m - 30.0, 10.0 + time_s**2)
    np.testing.assert_allclose(found["speed"], [10.0, 11.0, 14.0, 19.0, 26.0])
    np.testing.assert_allclose(found["time gap"], 30.0 / found["speed"])
    np.testing.assert_allclose(found["acceleration"], [1.0, 3.0, 5.0, 7.0])
    np.testing.assert_allclose(found["jerk"], [2.0, 2.0, 2.0])
    assert len(quantities(pair, pair.front_m, np.zeros(41))["time gap"]) == 0  # of a vehicle that stands


def test_drivers_want_to_drive_as_fast_as_the_follower_does(known: KnownFit) -> None:
    pairs = [replace(known.pairs[0], speed_mps=np.full(400, speed_mps)) for speed_mps in (5.0, 31.0)]
    population = known.fitted.population.population
    xml = drawn_types(known.fitted, pairs, [population.any_pair] * 2, 10, 0, 30.0)
    types = list(ElementTree.fromstring(f"<types>{xml}</types>"))
    assert [one.attrib["id"] for one in types] == [str(number) for number in range(20)]
    speeds_mps = np.array([float(one.attrib["maxSpeed"]) for one in types])
    assert speeds_mps[:10].min() < 31.0 <= speeds_mps[10:].min()


def test_the_report_has_a_line_for_each_distance(checked: Check) -> None:
    text = report_text(checked)
    assert "12 pairs of 6 drivers, each driven 2 times" in text
    assert len(text.splitlines()) == 2 + 4 * 4
