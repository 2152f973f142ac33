from collections import Counter
from dataclasses import replace
from typing import Any
from xml.etree import ElementTree

import numpy as np
import pytest

from tint_sumo.config import (
    AGGRESSIVE,
    CONSERVATIVE,
    POPULATIONS,
    TOWN_LEVELS,
    TOWN_SHIFTS,
    FittedDriver,
    Idm,
    Population,
    Towns,
    VehicleShape,
)
from tint_sumo.core.errors import InputError
from tint_sumo.scenes import T_INTERSECTION, find_scene
from tint_sumo.scenes.drivers import draw_town, members, vtypes_xml
from tint_sumo.scenes.layout import layout
from tint_sumo.simulation.demand import Demand, DriverPool, DriverStream


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


FITTED = (FittedDriver(0.7, 2.1, 1.4, 1.9), FittedDriver(1.6, 3.2, 0.9, 2.8), FittedDriver(1.1, 2.5, 1.1, 1.5))


def test_members_follow_as_fitted_drivers_in_turn_and_keep_all_else() -> None:
    usual = members(Population(members=4))
    found = members(Population(members=4, fitted=FITTED))
    for turn, member, other in zip((0, 1, 2, 0) * 2, found, usual, strict=True):
        driver, idm = FITTED[turn], member.idm
        assert FittedDriver(idm.tau_s, member.min_gap_m, idm.accel_mps2, idm.decel_mps2) == driver
        assert replace(member, idm=other.idm, min_gap_m=other.min_gap_m) == other
    xml = vtypes_xml(Population(members=4, fitted=FITTED), 0.3, VehicleShape())
    assert 'minGap="3.2" accel="0.9" decel="2.8" emergencyDecel="9" tau="1.6"' in xml


def test_fitted_drivers_have_their_headways_or_all_the_same() -> None:
    population = Population(fitted=FITTED)
    assert (population.least_tau_s, population.middle_tau_s) == (0.7, 1.1)
    assert {member.idm.tau_s for member in members(population.with_tau(1.5))} == {1.5}
    assert members(population.with_tau(1.5))[1].min_gap_m == 3.2


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"towns": Towns()}, "fitted drivers are in no towns"),
        ({"idm": Idm(emergency_decel_mps2=2.5)}, "must not exceed emergency_decel_mps2 .2.5., 2.8 does"),
    ],
)
def test_fitted_drivers_that_do_not_fit_are_refused(changes: dict[str, Any], message: str) -> None:
    with pytest.raises(InputError, match=message):
        Population(fitted=FITTED, **changes)


TOWNS = Towns(count=400)
MANY = replace(POPULATIONS["towns"], members=1, towns=TOWNS)


def test_towns_follow_from_their_seed_and_number_alone() -> None:
    few = members(replace(MANY, towns=replace(TOWNS, count=3)))
    assert few == members(MANY)[: len(few)]
    assert members(replace(MANY, towns=replace(TOWNS, only=2))) == few[4:6]
    assert all(draw_town(TOWNS, town) != draw_town(replace(TOWNS, seed=1), town) for town in range(3))


def test_levels_of_towns_fill_their_ranges_and_each_shift_is_nothing_in_half_of_them() -> None:
    towns = [draw_town(TOWNS, number) for number in TOWNS.numbers]
    for name in (*TOWN_LEVELS, *TOWN_SHIFTS):
        low, high = getattr(TOWNS, name)
        drawn = np.array([getattr(town, name) for town in towns])
        drawn = drawn[drawn != 0.0] if name in TOWN_SHIFTS else drawn
        assert low <= drawn.min() < low + 0.05 * (high - low) and high - 0.05 * (high - low) < drawn.max() <= high
    none = np.array([[getattr(town, name) == 0.0 for name in TOWN_SHIFTS] for town in towns])
    assert none.mean(axis=0) == pytest.approx(0.5, abs=0.07)
    assert none.all(axis=1).mean() == pytest.approx(0.125, abs=0.04)


def test_drivers_differ_from_their_town_by_its_shifts() -> None:
    drivers = members(MANY)
    for number, (yielding, hasty) in enumerate(zip(drivers[::2], drivers[1::2], strict=True)):
        town = draw_town(TOWNS, number)
        assert yielding.town == hasty.town == number
        assert (yielding.profile, hasty.profile) == (CONSERVATIVE, AGGRESSIVE)
        assert yielding.idm.tau_s - hasty.idm.tau_s == pytest.approx(town.tau_shift_s, abs=2e-4)
        assert (yielding.idm.tau_s + hasty.idm.tau_s) / 2 == pytest.approx(town.tau_s, abs=2e-4)
        assert hasty.desired_speed_mps - yielding.desired_speed_mps == pytest.approx(town.speed_shift_mps, abs=2e-4)
        assert yielding.idm.accel_mps2 == hasty.idm.accel_mps2 == town.accel_mps2
        entry = np.subtract(yielding.entry_gap_m, hasty.entry_gap_m)
        assert entry == pytest.approx([town.gap_share] * 2)  # the profiles differ by 1 m
        assert np.mean([*yielding.entry_gap_m, *hasty.entry_gap_m]) == pytest.approx(4.5 + town.entry_gap_m)
        for driver, gap_m in ((yielding, 0.5 + 0.1 * town.gap_share), (hasty, 0.5 - 0.1 * town.gap_share)):
            assert abs(driver.min_gap_m / town.min_gap_factor - gap_m) <= 0.1 + 1e-3


def test_nothing_but_yielding_tells_drivers_apart_where_no_shift_differs() -> None:
    drivers = members(replace(MANY, towns=replace(TOWNS, alike=1.0)))
    for yielding, hasty in zip(drivers[::2], drivers[1::2], strict=True):
        assert (yielding.idm, yielding.desired_speed_mps) == (hasty.idm, hasty.desired_speed_mps)
        assert yielding.entry_gap_m == pytest.approx(hasty.entry_gap_m)
    gaps_m = np.array([driver.min_gap_m for driver in drivers]).reshape(-1, 2)
    assert abs(np.subtract(*gaps_m.T).mean()) < 0.02


def test_an_episode_draws_from_the_drivers_of_one_town_whatever_the_batch() -> None:
    scene = replace(find_scene(T_INTERSECTION), population=replace(MANY, towns=replace(TOWNS, count=20)))
    drivers, towns = members(scene.population), []
    for seed in range(40):
        demands = [Demand(replicas, drivers, layout(scene)) for replicas in (1, 3)]
        placed = [demand.begin(len(demand.town) - 1, np.random.SeedSequence(seed)) for demand in demands]
        assert placed[0] == placed[1]
        (town,) = {drivers[vehicle.member].town for vehicle in placed[0]}
        assert {int(demand.town[-1]) for demand in demands} == {town}
        towns.append(town)
    assert len(set(towns)) > 10


@pytest.mark.parametrize("seeds", [range(30, 60), [[7, number] for number in range(30, 60)]])
def test_episodes_of_a_row_of_seeds_are_in_one_town_and_differ(seeds: Any) -> None:
    rows_of_5, alone = (replace(MANY, towns=replace(TOWNS, count=20, episodes=episodes)) for episodes in (5, 1))
    demands = []
    for population in (rows_of_5, alone):
        scene = replace(find_scene(T_INTERSECTION), population=population)
        demands.append(Demand(1, members(population), layout(scene)))
    towns, placed = [], []
    for seed in seeds:
        first, other = (demand.begin(0, np.random.SeedSequence(seed)) for demand in demands)
        towns.append(int(demands[0].town[0]))
        placed.append(first)
        is_first = (seed if isinstance(seed, int) else seed[-1]) % 5 == 0
        assert not is_first or first == other, "the first episode of a row is as without rows"
    rows = np.array(towns).reshape(-1, 5)
    assert (rows == rows[:, :1]).all() and len(set(rows[:, 0].tolist())) > 3
    assert len({tuple(one) for one in placed}) == len(placed)


def test_there_is_a_distribution_for_each_town_and_plain_sumo_drives_the_first_one() -> None:
    for only, numbers in ((None, (0, 1, 2)), (2, (2,))):
        xml = vtypes_xml(replace(MANY, towns=replace(TOWNS, count=3, only=only)), 0.4, VehicleShape())
        found = {entry.attrib["id"]: entry.attrib for entry in ElementTree.fromstring(xml).iter("vTypeDistribution")}
        assert list(found) == ["drivers", *(f"drivers.{number}" for number in numbers)]
        for number in numbers:
            named = found[f"drivers.{number}"]
            assert named["vTypes"] == f"conservative.{number}.0 aggressive.{number}.0"
            assert named["probabilities"] == "0.4 0.6"
        assert found["drivers"]["vTypes"] == found[f"drivers.{numbers[0]}"]["vTypes"]


@pytest.mark.parametrize(
    ("wrong", "message"),
    [
        ({"tau_s": (1.8, 0.6)}, "tau_s must be two numbers from low to high, not 1.8 and 0.6"),
        ({"only": 128}, "only must be the number of a town, 0 to 127, not 128"),
        ({"tau_s": (0.2, 1.0)}, "tau_s must exceed half of tau_shift_s, 0.25 s, in every town"),
        ({"desired_speed_mps": (0.3, 1.0)}, "desired_speed_mps must exceed half of speed_shift_mps, 0.35 m/s"),
        ({"count": 0}, "count must lie in 1 to 10,000, not 0"),
    ],
)
def test_towns_that_cannot_be_are_refused(wrong: dict[str, Any], message: str) -> None:
    with pytest.raises(InputError, match=message):
        Towns(**wrong)


def test_populations_of_towns_that_cannot_be_are_refused() -> None:
    with pytest.raises(InputError, match="times towns must be 10,000 at most, not 16,000"):
        Population(members=8, towns=Towns(count=1000))
    with pytest.raises(InputError, match=r"decel_mps2 of towns must not exceed emergency_decel_mps2 \(9\), 10 does"):
        Population(towns=Towns(count=2, decel_mps2=(1.0, 10.0)))
    scene = find_scene(T_INTERSECTION)
    with pytest.raises(InputError, match=r"limit of 10 m/s, 10\.35 m/s does"):
        replace(scene, population=Population(towns=Towns(count=2, desired_speed_mps=(2.0, 10.0))))


def test_a_headway_for_everybody_is_that_of_all_towns() -> None:
    scene = replace(find_scene(T_INTERSECTION), population=MANY).with_drivers(None, 1.5)
    assert {driver.idm.tau_s for driver in members(scene.population)} == {1.5}
    assert scene.tau_s == 1.5
