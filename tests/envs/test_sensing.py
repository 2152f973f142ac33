"""Sensors of the egos: statistics of noise and dropouts, tracks, delays, and observations without hidden vehicles."""

import math
from collections.abc import Iterator
from contextlib import closing, contextmanager
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from tint_sumo.config import PERFECT, SENSORS, Sensor
from tint_sumo.core.errors import InputError
from tint_sumo.envs import SceneEnv, SceneVectorEnv, TaskSettings
from tint_sumo.envs.episodes import Episodes, episode_seed
from tint_sumo.envs.rendering import pale
from tint_sumo.envs.rows import SEEN, TRACKS
from tint_sumo.envs.sensing import Memory, follow_dropouts, follow_noise, show_seen
from tint_sumo.scenes.geometry import BOX

STOP, CREEP, GO = 0, 1, 2
ALL_EFFECTS = Sensor(
    noise_m=0.1,
    noise_time_s=0.5,
    dropouts_per_s=1.0,
    dropout_s=0.3,
    range_m=18.0,
    field_of_view_deg=200.0,
    occlusion=True,
    corners_m=1.5,
    delay_s=0.2,
)


@contextmanager
def episodes(num_envs: int, sensor: Sensor, **task: Any) -> Iterator[Episodes]:
    batch = Episodes(num_envs, [TaskSettings(sensor=sensor, tracks=True, **task)])
    try:
        yield batch
    finally:
        batch.simulation.close()


@pytest.mark.parametrize(("time_s", "step_s"), [(1.0, 0.1), (1.0, 0.5), (0.0, 0.1)])
def test_noise_has_its_deviation_and_its_time_constant_at_any_step_length(time_s: float, step_s: float) -> None:
    memory, rng = Memory.of(Sensor(noise_m=0.2, noise_time_s=time_s), step_s), np.random.default_rng(0)
    shape, steps = (100, 20), 60
    number, noise_m, step = np.zeros(shape, np.int64), np.zeros((*shape, 2)), np.zeros(100, np.int64)
    drawn = rng.normal(0.0, 0.2, (100, steps, 20, 2))
    history = []
    for known in [-1] + [0] * (steps - 1):
        follow_noise(number, np.full(shape, known), drawn, step, memory, noise_m)
        history.append(noise_m.copy())
    found = np.array(history)
    assert step.tolist() == [steps] * 100
    assert found[0] == pytest.approx(drawn[:, 0])  # stationary from the first step on
    for moment in (0, 1, 5, -1):
        assert found[moment].std() == pytest.approx(0.2, rel=0.05)
    for lag in (1, 4):
        correlation = np.corrcoef(found[:-lag].ravel(), found[lag:].ravel())[0, 1]
        expected = math.exp(-lag * step_s / time_s) if time_s else 0.0
        assert correlation == pytest.approx(expected, abs=0.02)


def test_the_noise_of_a_new_vehicle_is_not_that_of_the_last_one_in_its_slot() -> None:
    memory = Memory.of(Sensor(noise_m=0.2, noise_time_s=100.0), 0.1)
    noise_m, drawn = np.full((1, 2, 2), 0.3), np.full((1, 1, 2, 2), -0.1)
    follow_noise(np.array([[4, 7]]), np.array([[4, 6]]), drawn, np.zeros(1, np.int64), memory, noise_m)
    assert noise_m[0, 0] == pytest.approx(0.3 * math.exp(-0.001), abs=0.01)
    assert noise_m[0, 1] == pytest.approx(-0.1)


@pytest.mark.parametrize("step_s", [0.1, 0.5])
def test_dropouts_have_their_share_and_their_duration_at_any_step_length(step_s: float) -> None:
    sensor, rng = Sensor(dropouts_per_s=0.5, dropout_s=0.8), np.random.default_rng(1)
    memory, shape, steps = Memory.of(sensor, step_s), (200, 20), 80
    lost, step, number = np.zeros(shape, bool), np.zeros(200, np.int64), np.zeros(shape, np.int64)
    drawn, history = rng.random((200, steps, 20)), []
    for known in [-1] + [0] * (steps - 1):
        seen = np.ones(shape, bool)
        follow_dropouts(number, np.full(shape, known), drawn, step, memory, lost, seen)
        assert (seen == ~lost).all()
        history.append(lost.copy())
    found, share = np.array(history), 0.4 / 1.4
    assert found[0].mean() == pytest.approx(share, rel=0.1)
    assert found[-1].mean() == pytest.approx(share, rel=0.1)
    stays = (found[1:] & found[:-1]).sum() / found[:-1].sum()
    assert stays == pytest.approx(share + (1.0 - share) * math.exp(-(0.5 + 1.0 / 0.8) * step_s), abs=0.01)


def test_a_lost_vehicle_that_nothing_else_hides_is_not_seen_and_a_hidden_one_stays_hidden() -> None:
    memory = Memory.of(Sensor(dropouts_per_s=1.0), 0.1)
    lost, seen = np.array([[True, False, False]]), np.array([[True, True, False]])
    drawn = np.array([[[0.0, 0.999, 0.999]]])
    number = np.zeros((1, 3), np.int64)
    follow_dropouts(number, number, drawn, np.zeros(1, np.int64), memory, lost, seen)
    assert (lost.tolist(), seen.tolist()) == ([[True, False, False]], [[False, True, False]])


def test_white_noise_is_drawn_step_by_step_from_the_second_stream_of_the_episode_s_seed() -> None:
    with episodes(2, Sensor(noise_m=0.1)) as batch:
        rngs = [np.random.default_rng(index) for index in (4, 5)]
        seeds = [int(np.random.default_rng(index).integers(2**63)) for index in (4, 5)]
        for index, rng in enumerate(rngs):
            batch.begin(index, episode_seed(rng))
        drawn = [np.random.default_rng([seed, 1]) for seed in seeds]
        for _ in range(40):
            for index, rng in enumerate(drawn):
                np.testing.assert_array_equal(batch.sensing(0).noise_m[index], rng.normal(0.0, 0.1, (12, 2)))
            batch.step(np.array([STOP, CREEP]))


def test_a_perfect_sensor_shows_all_vehicles_in_their_slots() -> None:
    with episodes(2, PERFECT) as batch:
        for index in range(2):
            batch.begin(index, episode_seed(np.random.default_rng(index)))
        for _ in range(30):
            slots, rows = batch.simulation.slots, batch.rows
            np.testing.assert_array_equal(rows["mask"], slots.present)
            np.testing.assert_array_equal(rows["track"], slots.vehicle_number)
            np.testing.assert_array_equal(rows["slot"], np.where(slots.present, np.arange(12), -1))
            batch.step(np.array([STOP, GO]))
        assert rows["mask"].sum() > 10 and not batch.sensing(0).noise_m.any()


class Street:
    """Three vehicles ahead of an ego, at 10, 20 and 30 m in the simulation's slots 2, 1 and 0."""

    def __init__(self) -> None:
        self.ego = np.array([(0.0, 0.0, 1.0, 0.0, 5.0, 2.0)], BOX)
        self.vehicles = np.array([[(x_m, 0.0, 1.0, 0.0, 5.0, 2.0) for x_m in (30.0, 20.0, 10.0)]], BOX)
        self.noise_m = np.zeros((1, 3, 2))
        self.number = np.array([[5, 6, 7]])
        self.source, self.shown, self.track = (np.full((1, 3), -1) for _ in range(3))
        self.tracks = np.zeros(1, np.int64)

    def look(self, *seen: int) -> tuple[list[int], list[int]]:
        """Slots and tracks that the observation shows when these slots of the simulation are seen."""
        found = np.isin(np.arange(3), seen)[None]
        show_seen(
            self.ego,
            self.vehicles,
            self.noise_m,
            self.number,
            found,
            self.source,
            self.shown,
            self.track,
            self.tracks,
        )
        assert set(self.source[self.source >= 0].tolist()) == set(np.flatnonzero(found[0]).tolist())
        return self.source[0].tolist(), self.track[0].tolist()


def test_new_tracks_take_slots_by_what_is_seen_the_nearest_first() -> None:
    assert Street().look(0, 1, 2) == ([2, 1, 0], [0, 1, 2])
    street = Street()
    street.noise_m[0, 2, 0] = 15.0  # the nearest one seems to be between the others
    assert street.look(0, 1, 2) == ([1, 2, 0], [0, 1, 2])
    assert Street().look(0) == ([0, -1, -1], [0, -1, -1])


def test_a_vehicle_that_is_detected_again_is_a_new_track_in_a_slot_that_was_empty_for_a_step() -> None:
    street = Street()
    assert street.look(1, 2) == ([2, 1, -1], [0, 1, -1])
    assert street.look(1) == ([-1, 1, -1], [-1, 1, -1])
    assert street.look(1, 2) == ([2, 1, -1], [2, 1, -1])
    assert street.look(2, 0) == ([2, -1, 0], [2, -1, 3])  # the slot of the lost one stays empty
    assert street.look(2, 0) == ([2, -1, 0], [2, -1, 3])


def test_another_vehicle_in_a_slot_of_the_simulation_is_another_track() -> None:
    street = Street()
    assert street.look(0) == ([0, -1, -1], [0, -1, -1])
    street.number[0, 0] = 8
    assert street.look(0) == ([-1, 0, -1], [-1, 1, -1])


def test_a_vehicle_for_which_no_slot_is_free_waits_a_step() -> None:
    street = Street()
    street.look(0, 1, 2)
    street.number[0, 1] = 8
    assert street.look(0, 1, 2) == ([2, -1, 0], [0, -1, 2])
    assert street.look(0, 1, 2) == ([2, 1, 0], [0, 3, 2])


def test_a_delayed_sensor_shows_what_was_seen_so_many_steps_before() -> None:
    now, later = (replace(ALL_EFFECTS, delay_s=delay_s) for delay_s in (0.0, 0.3))
    history: list[list[np.ndarray]] = []
    with (
        episodes(2, now, p_conservative=0.9) as direct,
        episodes(2, later, p_conservative=0.9, backend="traci") as delayed,
    ):
        for _ in range(2):  # a second episode begins in one of them
            for batch in (direct, delayed):
                for index in range(2 - len(history) // 30):
                    batch.begin(index, episode_seed(np.random.default_rng([index, len(history)])))
            begun = len(history) - 1
            for step in range(30):
                history.append([direct.rows[field].copy() for field in SEEN])
                then = history[max(begun + 1 + step - 3, begun + 1)]
                other = history[max(len(history) - 4, 0)]
                for number, field in enumerate(SEEN):
                    np.testing.assert_array_equal(delayed.rows[field][0], then[number][0], field)
                    np.testing.assert_array_equal(delayed.rows[field][1], other[number][1], field)
                np.testing.assert_array_equal(delayed.rows["ego"], direct.rows["ego"])
                for batch in (direct, delayed):
                    batch.step(np.array([CREEP, GO if step < 5 else STOP]))


def test_with_everything_hidden_the_observation_is_that_of_an_empty_street() -> None:
    blind = Sensor(range_m=0.0, noise_m=0.1)
    task: dict[str, Any] = {"sensor": blind, "tracks": True, "time_limit_s": 10.0}
    with closing(SceneVectorEnv(3, TaskSettings(**task))) as env:
        observation, infos = env.reset(seed=1)
        assert infos["true_mask"].sum() > 10
        for _ in range(40):
            assert not observation["vehicles"].any() and not observation["mask"].any()
            assert not infos["position_m"].any() and not infos["passed"].any()
            assert (infos["gap_m"] == np.inf).all() and (infos["track"] == -1).all() and (infos["traits"] == -1).all()
            observation, *_, infos = env.step(np.full(3, STOP))


@pytest.mark.parametrize("sensor", [ALL_EFFECTS, SENSORS["corners"]], ids=["all", "corners"])
def test_all_that_is_observed_is_of_vehicles_that_are_seen(sensor: Sensor) -> None:
    """Gaps lead to the next vehicle ahead that is seen, and no track lives longer than the sight of its vehicle."""
    sensor = replace(sensor, noise_m=0.0, delay_s=0.0)
    hidden = missed = 0
    with episodes(3, sensor, p_conservative=(0.1, 0.9)) as batch:
        simulation, sensing = batch.simulation, batch.sensing(0)
        for index in range(3):
            batch.begin(index, episode_seed(np.random.default_rng(index)))
        numbers: dict[tuple[int, int], int] = {}
        for _ in range(120):
            slots, rows = simulation.slots, batch.rows
            np.testing.assert_array_equal(rows["true_mask"], slots.present)
            assert not (sensing.seen & ~slots.present).any()
            for env in range(3):
                shown = sensing.source[env][rows["mask"][env] == 1.0].tolist()
                assert sorted(shown) == np.flatnonzero(sensing.seen[env]).tolist()
                for place in np.flatnonzero(rows["mask"][env]).tolist():
                    slot, track = int(sensing.source[env, place]), int(rows["track"][env, place])
                    vehicle = int(slots.vehicle_number[env, slot])
                    assert numbers.setdefault((env, track), vehicle) == vehicle
                    box, ego = slots.box[env, slot], simulation.egos.box[env]
                    offset_m = [box["x_m"] - ego["x_m"], box["y_m"] - ego["y_m"]]
                    assert rows["vehicles"][env, place] * 20.0 == pytest.approx(offset_m, abs=1e-4)
                    assert rows["position_m"][env, place] == slots.front_m[env, slot]
                    route = slots.route[env] == slots.route[env, slot]
                    ahead_m = slots.front_m[env] - slots.front_m[env, slot]
                    ahead_m = np.where(route & (ahead_m > 0.0), ahead_m, np.inf)
                    gap_m = np.where(sensing.seen[env], ahead_m, np.inf).min() - 5.0
                    assert rows["gap_m"][env, place] == pytest.approx(gap_m)
                    missed += gap_m > ahead_m.min() - 5.0
            hidden += int((slots.present & ~sensing.seen).sum())
            batch.step(np.array([CREEP, STOP, GO]))
    assert hidden > 300 and missed > 10


def test_what_a_sensor_perceives_follows_from_the_seed_alone() -> None:
    task: dict[str, Any] = {"sensor": ALL_EFFECTS, "tracks": True, "time_limit_s": 4.0}
    actions = np.random.default_rng(0).integers(0, 3, (90, 4))
    found = []
    for num_envs, index, backend in ((4, 2, "auto"), (1, 0, "traci")):
        env = SceneVectorEnv(num_envs, TaskSettings(backend=backend, **task), autoreset_mode="SameStep")
        with closing(env):
            observation, infos = env.reset(seed=12 - index)
            history = []
            for action in actions:
                history.append([observation[key][index].tolist() for key in observation])
                history[-1] += [infos[key][index].tolist() for key in ("traits", "track", *TRACKS)]
                observation, *_, infos = env.step(action[2 - index : 2 - index + num_envs])
            found.append(history)
    assert repr(found[0]) == repr(found[1])


def test_copies_and_snapshots_go_on_as_the_original_does() -> None:
    from copy import deepcopy

    with closing(SceneEnv(TaskSettings(sensor=ALL_EFFECTS, tracks=True))) as env:
        env.reset(seed=3)
        for _ in range(25):
            env.step(np.int64(CREEP))
        with closing(deepcopy(env)) as copy:
            snapshot = env.snapshot()
            ahead = [env.step(np.int64(STOP)) for _ in range(20)]
            again = [copy.step(np.int64(STOP)) for _ in range(20)]
        env.restore(snapshot)
        restored = [env.step(np.int64(STOP)) for _ in range(20)]
    for one, other, third in zip(ahead, again, restored, strict=True):
        for key in ("vehicles", "mask"):
            assert one[0][key].tolist() == other[0][key].tolist() == third[0][key].tolist()
        for key in ("track", *TRACKS):
            assert one[4][key].tolist() == other[4][key].tolist() == third[4][key].tolist()


def test_pictures_show_range_buildings_and_vehicles_that_are_not_seen() -> None:
    sensor, border, road = Sensor(occlusion=True, corners_m=1.5, range_m=12.0), (31, 95, 168), "#b9a994"
    building = tuple(int(road[at : at + 2], 16) for at in (1, 3, 5))

    def count(picture: np.ndarray, colour: tuple[int, ...]) -> int:
        return int(np.isclose(picture, colour, atol=4).all(axis=2).sum())

    pictures = []
    for one in (sensor, PERFECT):
        with closing(SceneEnv(TaskSettings(sensor=one), render_mode="rgb_array")) as env:
            env.reset(seed=3)
            picture = env.render()
            assert picture is not None
            pictures.append(picture)
            sensing = env._episodes.sensing(0)
            hidden = env.simulation.slots.present & ~sensing.seen
            traits = env.simulation.trait_of_member[env.simulation.slots.member[hidden]]
            expected = [trait in traits for trait in (0, 1)]
            pales = [count(picture, pale(colour)) > 500 for colour in env.simulation.scene.trait_colours]
            assert pales == expected
            assert hidden.any() == (one == sensor)
    limited, perfect = pictures
    assert count(limited, border) > 200 > count(perfect, border)
    assert count(limited, building) > 20_000 and count(perfect, building) == 0


def test_corners_are_for_built_in_scenes_and_delays_are_whole_steps() -> None:
    assert len(TaskSettings(sensor=SENSORS["corners"]).played.buildings) == 2  # type: ignore[union-attr]
    with pytest.raises(InputError, match=r"delay_s must be a multiple of the step of 0\.1 s, not 0\.15"):
        TaskSettings(sensor=Sensor(delay_s=0.15))


@pytest.mark.parametrize(
    ("settings", "problem"),
    [
        ({"noise_m": -0.1}, "noise_m must lie in 0 to 1000, not -0.1"),
        ({"dropout_s": 0.0}, "dropout_s must lie in 0.01 to 86400, not 0.0"),
        ({"field_of_view_deg": 0.0}, "field_of_view_deg must lie in 1 to 360, not 0.0"),
        ({"range_m": math.nan}, "range_m must lie in 0 to 1000, not nan"),
        ({"occlusion": 1}, "occlusion must be True or False, not 1"),
        ({"delay_s": 2.0}, "delay_s must lie in 0 to 1, not 2.0"),
    ],
)
def test_bad_values_of_a_sensor(settings: dict[str, Any], problem: str) -> None:
    with pytest.raises(InputError, match=problem):
        Sensor(**settings)


def test_named_sensors_differ_and_1_is_1_0() -> None:
    assert len(set(SENSORS.values())) == len(SENSORS) and SENSORS["perfect"] == PERFECT
    assert repr(Sensor(range_m=15)) == repr(Sensor(range_m=15.0))
    assert [name for name, sensor in SENSORS.items() if not sensor.hides] == [
        "perfect",
        "noisy_0.1",
        "noisy_0.2",
        "correlated",
        "delay_0.2",
    ]
