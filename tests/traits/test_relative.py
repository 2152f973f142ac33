"""Relative traits: beliefs about drivers from how they and their neighbours follow."""

from dataclasses import replace

import numpy as np
import pytest

from tint_sumo.config import PERFECT, POPULATIONS, RelativeLatent, RelativeSettings, Sensor, Towns
from tint_sumo.core.errors import InputError
from tint_sumo.envs import TaskSettings
from tint_sumo.scenes import paper_scene
from tint_sumo.traits.perceived import Explorer, Perceived, perceive
from tint_sumo.traits.relative import RelativeStream, TownEstimate, densities, learn, numbers, prior, probability
from tint_sumo.traits.relative_fit import fit_relative, follow, traffic
from tint_sumo.traits.relative_reading import Reading, Readings, read

TOWNS = replace(paper_scene(), population=POPULATIONS["towns"])
SENSORS = (PERFECT, Sensor(noise_m=0.1, dropouts_per_s=1.0, dropout_s=0.3))
TASKS = [TaskSettings(TOWNS, (0.1, 0.9), time_limit_s=6.0, sensor=sensor) for sensor in SENSORS]
SETTINGS = RelativeSettings()
GAP_ONLY = RelativeSettings(RelativeLatent(0.0, 1.0, 5.0, 1.0, 0.2, 1.0, (0.25, 0.25, 0.25, 0.25)))
"""The gap in metres alone, 5 m in the mean; a step at which a driver follows steadily tells half of it."""


@pytest.fixture(scope="module")
def seen() -> Perceived:
    return perceive(TASKS, 130, 4, 3, Explorer(4, 3, 5))


def platoon(gaps_m: list[float], steps: int, speed_mps: float = 2.0) -> Perceived:
    """Drivers that follow one another at some gaps and one speed; each has a slot, and all are of one episode."""
    when = np.arange(steps)[:, None, None]
    shape = (steps, 1, len(gaps_m))
    return Perceived(
        present=np.ones(shape, bool),
        track=np.broadcast_to(np.arange(len(gaps_m)), shape),
        position_m=np.broadcast_to(0.1 * speed_mps * when, shape).astype(float),
        gap_m=np.broadcast_to(gaps_m, shape).astype(float),
        traits=np.zeros(shape, np.int64),
        begins=when[:, :, 0] == 0,
    )


def beliefs(settings: RelativeSettings, seen: Perceived) -> np.ndarray:
    """The beliefs (V,) about the drivers of one episode at its last step."""
    last: np.ndarray = follow(settings, seen)[0][-1, 0, :, 0]
    return last


def test_explorers_move_now_and_then_and_episodes_follow_one_another(seen: Perceived) -> None:
    assert seen.begins[0].all() and seen.begins[1:].sum() >= 4
    assert len(set(seen.episode.flatten().tolist())) == seen.begins.sum()
    again = perceive(TASKS, 130, 4, 3, Explorer(4, 3, 5))
    for name, values in vars(again).items():
        np.testing.assert_array_equal(values, getattr(seen, name), err_msg=name)
    waited = perceive(TASKS, 130, 4, 3)
    assert not np.array_equal(waited.position_m, seen.position_m), "egos that move change the traffic"


def test_of_two_groups_the_one_with_longer_gaps_is_believed_to_yield() -> None:
    found = beliefs(GAP_ONLY, platoon([4.0, 4.1, 5.9, 4.0, 6.0, 6.1], 41))
    assert (found[[0, 1, 3]] < -0.8).all() and (found[[2, 4, 5]] > 0.8).all()


def test_a_driver_is_compared_with_its_neighbours_alone() -> None:
    near, far = platoon([4.0, 4.1, 5.9, 4.0, 6.0, 6.1], 41), platoon([5.0, 5.1, 6.9, 5.0, 7.0, 7.1], 41)
    np.testing.assert_allclose(beliefs(GAP_ONLY, near), beliefs(GAP_ONLY, far), atol=0.2)
    assert beliefs(GAP_ONLY, platoon([5.0, 6.6], 41))[0] < -0.2 < 0.2 < beliefs(GAP_ONLY, platoon([5.0, 3.4], 41))[0]


def test_where_all_are_alike_nobody_is_believed_to_be_anything() -> None:
    found, known = follow(GAP_ONLY, platoon([5.0] * 8, 41))[0][-1, 0].T
    assert (np.abs(found) < 0.15).all() and (known > 0.9).all()


def test_who_does_not_follow_steadily_is_unknown() -> None:
    for gaps_m, speed_mps in (([20.0] * 3, 2.0), ([5.0] * 3, 1.0)):
        traits = follow(SETTINGS, platoon(gaps_m, 41, speed_mps))[0]
        assert not traits[..., 1].any() and (np.abs(traits[..., 0]) < 1e-6).all()


def test_the_belief_is_bayes_rule() -> None:
    """Against sums over the grid written out, for two drivers."""
    latent, x = GAP_ONLY.latent, np.array([4.2, 6.1])
    given, town = numbers(latent), prior(latent)
    density = [densities(np.array([0.0, one]), 1.0, given, 4) for one in x]
    evidence = learn(town, density[0]) * learn(town, density[1])
    means = latent.town_mean + 0.3 * np.arange(-14, 15)
    std = 0.2 * np.sqrt(2.0)
    both = first = 0.0
    for share in (0.2, 0.5, 0.8):
        for half in (0.0, 0.3, 0.6, 0.9):
            around = (means + half, means - half)
            weight = np.exp(-0.5 * (means - 5.0) ** 2) / np.exp(-0.5 * (means - 5.0) ** 2).sum() / 12.0
            upper, lower = (
                0.99 * np.exp(-0.5 * ((x[:, None] - mean) / std) ** 2) / (std * np.sqrt(2 * np.pi)) + 0.01 * 0.05
                for mean in around
            )
            mixed = share * upper + (1.0 - share) * lower
            both += float((weight * mixed[0] * mixed[1]).sum())
            first += float((weight * share * upper[0] * mixed[1]).sum())
    assert evidence == pytest.approx(both, rel=1e-9)
    assert probability(town, density[0]) == pytest.approx(first / both, rel=1e-9)
    assert town.sum() == pytest.approx(1.0)


def test_drivers_who_have_left_still_count_for_the_town() -> None:
    gaps_m = [4.0, 4.1, 5.9, 4.0, 6.0, 6.1]
    whole = platoon(gaps_m, 81)
    alone = replace(whole, present=whole.present.copy())
    alone.present[41:, :, 1:] = False
    assert beliefs(GAP_ONLY, alone)[0] == pytest.approx(beliefs(GAP_ONLY, whole)[0], abs=0.05)
    never = replace(whole, present=whole.present.copy())
    never.present[:, :, 1:] = False
    assert beliefs(GAP_ONLY, never)[0] > beliefs(GAP_ONLY, whole)[0] + 0.2


def test_the_town_is_estimated_from_all_drivers_so_far() -> None:
    def town(gaps_m: list[float]) -> TownEstimate:
        stream, seen = RelativeStream(GAP_ONLY, 1, len(gaps_m)), platoon(gaps_m, 81)
        stream.begin(np.array([0]))
        for present, position_m, gap_m in zip(seen.present, seen.position_m, seen.gap_m, strict=True):
            stream.advance(np.array([0]), present, position_m, gap_m)
        before = stream.town(0)
        assert stream.town(0) == before, "looking changes nothing"
        return before

    nobody = RelativeStream(GAP_ONLY, 1, 2)
    nobody.begin(np.array([0]))
    assert nobody.town(0).rank == pytest.approx(0.5)
    assert nobody.town(0).differs == pytest.approx(0.75)
    alike, apart = town([6.0] * 6), town([5.5, 6.5] * 3)
    assert alike.rank > 0.7 and town([4.0] * 6).rank < 0.3
    assert alike.differs < 0.6 and apart.differs > 0.9


def test_traits_follow_from_the_past_of_the_episode_alone(seen: Perceived) -> None:
    traits, _, _ = follow(SETTINGS, seen)
    later = replace(seen, position_m=seen.position_m.copy())
    later.position_m[40:] *= 1.1
    np.testing.assert_array_equal(follow(SETTINGS, later)[0][:40], traits[:40])
    second = int(np.flatnonzero(seen.begins[:, 0])[1])
    only = Perceived(**{name: values[second : second + 20, :1] for name, values in vars(seen).items()})
    np.testing.assert_array_equal(follow(SETTINGS, only)[0][:, 0], traits[second : second + 20, 0])
    assert not traits[~seen.present].any() and np.abs(traits).max() <= 1.0


def test_a_stream_does_not_depend_on_which_environments_come_together(seen: Perceived) -> None:
    whole, _, _ = follow(SETTINGS, seen)
    stream = RelativeStream(SETTINGS, 4, 12)
    for step in range(60):
        stream.begin(np.flatnonzero(seen.begins[step]))
        for envs in (np.array([2, 3]), np.array([0, 1])):
            now = (values[step, envs] for values in (seen.present, seen.position_m, seen.gap_m))
            np.testing.assert_array_equal(stream.advance(envs, *now), whole[step, envs])


@pytest.fixture(scope="module")
def fitted() -> tuple[RelativeSettings, Perceived]:
    """Traits fitted to some towns with plain differences, and the traffic."""
    towns = Towns(count=24, seed=3, alike=0.0, tau_shift_s=(0.4, 0.5))
    scene = replace(paper_scene(), population=replace(POPULATIONS["towns"], towns=towns))
    seen = traffic([TaskSettings(scene, (0.3, 0.7))], 5, steps=300, num_envs=24)
    return fit_relative(seen), seen


def test_a_fit_reads_no_label_and_finds_who_yields(fitted: tuple[RelativeSettings, Perceived]) -> None:
    found, seen = fitted
    assert fit_relative(replace(seen, traits=-seen.traits)) == found
    assert found.latent.time_gap_weight > 0.0 > found.latent.gap_weight and sum(found.latent.differences) > 0.99
    readings = Readings.of(seen, follow(found, seen)[0])
    old = readings.age_steps >= 50
    reading = Reading((readings.values[old, 0] + 1.0) / 2.0, readings.yields[old])
    assert reading.accuracy > 0.85 and reading.brier < 0.12


def test_traffic_without_two_who_follow_is_refused() -> None:
    with pytest.raises(InputError, match="relative traits need two episodes with two drivers each"):
        fit_relative(platoon([5.0, 6.0], 60))
    with pytest.raises(InputError, match="relative traits need two episodes"):
        fit_relative(platoon([20.0, 20.0], 60))


def test_readings_are_of_every_tenth_step_with_the_age_of_the_track(seen: Perceived) -> None:
    values = np.arange(seen.present.size, dtype=float).reshape(*seen.present.shape, 1)
    readings = Readings.of(seen, values)
    when, env, slot = np.unravel_index(readings.values[:, 0].astype(int), seen.present.shape)
    assert set((when % 10).tolist()) == {9} and len(when) == seen.present[9::10].sum()
    np.testing.assert_array_equal(readings.yields, seen.traits[when, env, slot] == 0)
    for index in range(0, len(when), 17):
        t, age = int(when[index]), int(readings.age_steps[index])
        tracks = seen.track[: t + 1, env[index], slot[index]]
        since = seen.episode[: t + 1, env[index]]
        same = (tracks == tracks[-1]) & (since == since[-1])
        assert same[t - age :].all() and (t == age or not same[t - age - 1])


def test_scores_of_readings_by_hand() -> None:
    reading = Reading(np.array([0.9, 0.92, 0.2, 0.6]), np.array([True, False, False, True]))
    assert reading.accuracy == 0.75
    assert reading.brier == pytest.approx((0.01 + 0.92**2 + 0.04 + 0.16) / 4)
    assert reading.calibration_error == pytest.approx((0.5 * 0.41) + 0.25 * 0.2 + 0.25 * 0.4)
    np.testing.assert_allclose(reading.reliability()[-1], [0.5, 0.91, 0.5])


def test_a_linear_reading_is_fitted_to_other_drivers() -> None:
    rng = np.random.default_rng(0)
    yields = rng.random(400) < 0.5
    values = np.where(yields, 1.0, -1.0)[:, None] + rng.normal(size=(400, 1))
    both = Readings(values, yields, np.zeros(400, np.int64))
    training, test = (
        Readings(values[part], yields[part], both.age_steps[part]) for part in (slice(200), slice(200, 400))
    )
    assert read(training, test).accuracy > 0.75 and read(training, test).calibration_error < 0.12
