from collections import Counter
from dataclasses import replace
from xml.etree import ElementTree

import numpy as np
import pytest

from tint_sumo.config import AGGRESSIVE, CONSERVATIVE, POPULATIONS, Population, VehicleShape
from tint_sumo.scenes import T_INTERSECTION, find_scene
from tint_sumo.scenes.drivers import members, vtypes_xml
from tint_sumo.scenes.layout import layout
from tint_sumo.simulation.demand import DriverPool, DriverStream


def test_members_follow_the_papers_traits() -> None:
    drivers = members(Population(members=200))
    assert Counter(driver.profile.name for driver in drivers) == {"conservative": 200, "aggressive": 200}
    for profile in (CONSERVATIVE, AGGRESSIVE):
        gaps = [driver.min_gap_m for driver in drivers if driver.profile is profile]
        low, high = profile.min_gap_m
        assert low <= min(gaps) < low + 0.02
        assert high - 0.02 < max(gaps) <= high
        assert sum(gaps) / len(gaps) == pytest.approx((low + high) / 2, abs=0.015)
    assert {driver.desired_speed_mps for driver in drivers if driver.profile is CONSERVATIVE} == {2.4}
    assert {driver.desired_speed_mps for driver in drivers if driver.profile is AGGRESSIVE} == {3.0}


def test_members_are_drawn_with_the_stated_seed() -> None:
    population = Population()
    assert members(population) == members(population)
    assert members(population) != members(replace(population, seed=population.seed + 1))


def test_distribution_has_the_probability_of_conservative_drivers() -> None:
    xml = vtypes_xml(Population(members=4), 0.25, VehicleShape())
    line = next(line for line in xml.splitlines() if "probabilities" in line)
    weights = [float(weight) for weight in line.split('"')[1].split()]
    assert sum(weights[:4]) == pytest.approx(0.25)
    assert sum(weights) == pytest.approx(1.0)


def test_a_continuous_population_has_independent_speeds_and_gaps() -> None:
    population = POPULATIONS["continuous"]
    drivers = members(population)
    speed_mps = np.array([driver.desired_speed_mps for driver in drivers])
    min_gap_m = np.array([driver.min_gap_m for driver in drivers])
    assert len(drivers) == 512
    assert 2.0 <= speed_mps.min() < 2.05 and 3.35 < speed_mps.max() <= 3.4
    assert 0.2 <= min_gap_m.min() < 0.22 and 0.78 < min_gap_m.max() <= 0.8
    assert abs(np.corrcoef(speed_mps, min_gap_m)[0, 1]) < 0.1
    xml = vtypes_xml(population, 0.3, VehicleShape())
    probabilities = ElementTree.fromstring(xml).find("vTypeDistribution").attrib["probabilities"].split()
    assert sum(map(float, probabilities)) == pytest.approx(1.0, rel=1e-3)


def test_profiles_are_drawn_by_their_weights_in_plain_sumo_and_in_the_environments() -> None:
    """Two thirds of the yielding drivers are conservative here, one third is patient."""
    patient = replace(CONSERVATIVE, name="patient", weight=0.5)
    population = Population((CONSERVATIVE, patient, AGGRESSIVE), members=8)
    xml = vtypes_xml(population, 0.4, VehicleShape())
    line = next(line for line in xml.splitlines() if "probabilities" in line)
    weights = np.array([float(weight) for weight in line.split('"')[1].split()])
    names = np.array([driver.profile.name for driver in members(population)])
    shares = {"conservative": 0.4 * 2 / 3, "patient": 0.4 / 3, "aggressive": 0.6}
    for name, share in shares.items():
        assert weights[names == name].sum() == pytest.approx(share, rel=1e-4)
    pool = DriverPool(members(population), layout(replace(find_scene(T_INTERSECTION), population=population)))
    stream = DriverStream(np.random.default_rng(0), pool, 0.4)
    drawn = Counter(names[stream.take().member] for _ in range(4000))
    for name, share in shares.items():
        assert drawn[name] / 4000 == pytest.approx(share, abs=0.03)
