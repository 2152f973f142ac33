"""Meaning of settings, and how episodes follow from seeds."""

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from gymnasium import spaces

from tint_sumo.config import SENSORS, Mix, Population, Traffic
from tint_sumo.core.errors import InputError
from tint_sumo.envs.episodes import (
    Episodes,
    TaskSettings,
    action_space,
    episode_seed,
    observation_space,
)
from tint_sumo.envs.rows import Contents
from tint_sumo.scenes import find_scene
from tint_sumo.scenes.geometry import NO_VEHICLE

T = find_scene("t_intersection")
GO, STOP = 2, 0


@contextmanager
def episodes(num_envs: int, **settings: Any) -> Iterator[Episodes]:
    made = Episodes(num_envs, [TaskSettings(**settings)])
    try:
        yield made
    finally:
        made.simulation.close()


def test_without_settings_the_scene_is_as_it_is() -> None:
    assert TaskSettings().played == T == TaskSettings(scene=T).played
    assert TaskSettings().contents == Contents()
    assert TaskSettings(tracks=True).contents.slot_infos == (
        "traits",
        "position_m",
        "gap_m",
        "passed",
        "claimed",
        "to_stop_m",
    )


@pytest.mark.parametrize(
    ("settings", "field", "value"),
    [
        ({"p_conservative": 0.9}, "traffic", replace(T.traffic, p_conservative=Mix(0.9))),
        ({"p_conservative": 0.0}, "traffic", replace(T.traffic, p_conservative=Mix(0.0))),
        ({"time_limit_s": 3.0}, "time_limit_s", 3.0),
        ({"max_episode_steps": 30}, "time_limit_s", pytest.approx(3.0)),
        ({"max_episode_steps": 30, "decision_s": 0.4}, "time_limit_s", pytest.approx(12.0)),
        ({"max_episode_steps": 30, "time_limit_s": 2.0}, "time_limit_s", 2.0),
        ({"tau_s": 1.5}, "population", replace(T.population, idm=replace(T.population.idm, tau_s=1.5))),
    ],
)
def test_a_setting_replaces_that_of_the_scene(settings: dict[str, Any], field: str, value: object) -> None:
    found = TaskSettings(**settings).played
    assert getattr(found, field) == value
    assert replace(found, **{field: getattr(T, field)}) == T


@pytest.mark.parametrize(
    ("settings", "steps", "decisions"),
    [
        ({}, 1, 500),
        ({"decision_s": 0.1}, 1, 500),
        ({"decision_s": 0.3}, 3, 167),  # 0.3 / 0.1 is no whole number in floats
        ({"decision_s": 0.5, "time_limit_s": 2.0}, 5, 4),
        ({"decision_s": 0.4, "time_limit_s": 0.9}, 4, 3),
        ({"decision_s": 5.0, "time_limit_s": 0.1}, 50, 1),
    ],
)
def test_a_decision_holds_for_whole_steps(settings: dict[str, Any], steps: int, decisions: int) -> None:
    task = TaskSettings(**settings)
    assert (task.steps_per_decision, task.decisions_per_episode) == (steps, decisions)


@pytest.mark.parametrize(
    "settings",
    [
        {"time_limit_s": 0.09},
        {"time_limit_s": float("inf")},
        {"decision_s": 0.05},
        {"decision_s": 0.0},
        {"decision_s": -0.1},
        {"decision_s": 0.15},
        {"decision_s": 0.1001},
        {"decision_s": float("inf")},
        {"reward": "none"},
    ],
)
def test_values_without_sense_are_refused(settings: dict[str, Any]) -> None:
    assert TaskSettings(time_limit_s=0.1)
    with pytest.raises(InputError, match=next(iter(settings)).replace("reward", "unknown reward")):
        TaskSettings(**settings)


def test_spaces_are_of_the_scene() -> None:
    assert action_space(T) == spaces.Discrete(3)
    space = observation_space(5)
    assert {name: part.shape for name, part in space.items()} == {"ego": (4,), "vehicles": (5, 2), "mask": (5,)}
    limits = {name: (part.low.min(), part.high.max()) for name, part in space.items()}  # type: ignore[attr-defined]
    assert limits == {"ego": (-2.0, 2.0), "vehicles": (-2.0, 2.0), "mask": (0.0, 1.0)}


def test_episodes_have_seeds_over_the_whole_range() -> None:
    rng = np.random.default_rng(0)
    seeds = [episode_seed(rng) for _ in range(200)]
    assert len(set(seeds)) == 200
    assert 0 <= min(seeds) < 2**58 and 2**62 < max(seeds) < 2**63


def played(index: int, num_envs: int, rng: np.random.Generator, **settings: Any) -> list[Any]:
    """Rows of two episodes of an environment among others."""
    found = []
    with episodes(num_envs, **settings) as batch:
        for other in range(num_envs):
            if other != index:
                batch.begin(other, episode_seed(np.random.default_rng([other, 99])))
        for _ in range(2):
            batch.begin(index, episode_seed(rng))
            found.append(batch.rows[index].tolist())
            for _ in range(8):
                batch.step(np.full(num_envs, GO))
                found.append(batch.rows[index].tolist())
    return found


def test_an_episode_and_its_noise_follow_from_the_generator_alone() -> None:
    task: dict[str, Any] = {"sensor": "noisy_0.1", "time_limit_s": 0.5, "tracks": True}
    alone = played(0, 1, np.random.default_rng(5), **task)
    assert repr(alone) == repr(played(1, 3, np.random.default_rng(5), **task))
    assert repr(alone) != repr(played(1, 3, np.random.default_rng(6), **task))


def test_noise_is_drawn_anew_in_every_step_and_episode() -> None:
    with episodes(1, sensor=SENSORS["noisy_0.1"]) as noisy, episodes(1, backend="traci") as clear:
        drawn = []
        for seed in (1, 2):
            for batch in (noisy, clear):
                batch.begin(0, episode_seed(np.random.default_rng(seed)))
            for _ in range(3):
                noise = (noisy.rows["vehicles"] - clear.rows["vehicles"])[0]
                drawn.append(noise[0].tolist())
                shown = np.round(noise[clear.rows["mask"][0] == 1.0], 6)
                assert len(np.unique(shown, axis=0)) == len(shown) > 1, "each vehicle has noise of its own"
                for batch in (noisy, clear):
                    batch.step(np.array([STOP]))
        assert not clear.sensing(0).noise_m.any()
    assert len(np.unique(np.round(drawn, 6), axis=0)) == 6
    assert np.abs(drawn).max() < 0.6 / 20.0


def test_empty_slots_have_no_trait_and_others_the_number_of_their_profile() -> None:
    scene = replace(T, population=Population(tuple(reversed(T.population.profiles))), traffic=Traffic(Mix(1.0)))
    with episodes(1, scene=scene) as batch:
        batch.begin(0, episode_seed(np.random.default_rng(0)))
        row = batch.rows[0]
        assert set(row["traits"][row["mask"] == 1.0].tolist()) == {1}  # the second profile is the conservative one
        assert set(row["traits"][row["mask"] == 0.0].tolist()) == {NO_VEHICLE} == {-1}


def test_actions_are_numbers_of_desired_speeds() -> None:
    with episodes(2) as batch:
        for index in range(2):
            batch.begin(index, episode_seed(np.random.default_rng(index)))
        for _ in range(12):
            batch.step(np.array([1, GO]))
        assert batch.simulation.egos.speed_mps == pytest.approx([0.5, 2.7], abs=0.1)
        assert batch.rows["time_s"] == pytest.approx([1.2, 1.2])


def test_a_decision_ends_with_its_episode() -> None:
    with episodes(2, decision_s=0.5, time_limit_s=0.7) as batch:
        batch.begin(0, episode_seed(np.random.default_rng(0)))
        assert not batch.step(np.array([GO, GO]))
        batch.begin(1, episode_seed(np.random.default_rng(1)))
        assert batch.step(np.array([GO, GO]))
        assert batch.rows["time_s"] == pytest.approx([0.7, 0.5])
        assert batch.rows["truncated"].tolist() == [True, False]
        assert batch.rows["step"] == pytest.approx([2 * -0.0013, 5 * -0.0013])


def test_a_parked_environment_stands_until_its_next_episode() -> None:
    with episodes(2, time_limit_s=0.3) as batch:
        for index in range(2):
            batch.begin(index, episode_seed(np.random.default_rng(index)))
        batch.park(1)
        for _ in range(5):
            batch.step(np.array([GO, GO]))
        assert batch.steps.tolist() == [5, 0] and not batch.rows["mask"][1].any()
        assert batch.simulation.egos.speed_mps[1] == 0.0 and batch.rows["outcome"][1] == 0
        batch.begin(1, episode_seed(np.random.default_rng(1)))
        batch.step(np.array([GO, GO]))
        assert batch.steps.tolist() == [6, 1] and batch.simulation.egos.speed_mps[1] > 0.0


def test_an_episode_that_ended_with_a_collision_has_its_details() -> None:
    with episodes(1, p_conservative=0.0) as batch:
        for seed in range(9):
            batch.begin(0, episode_seed(np.random.default_rng(seed)))
            assert batch.collision_info(0) == {}
            while not batch.step(np.array([GO])):
                assert batch.collision_info(0) == {}
            if batch.rows["terminated"][0] and batch.simulation.egos.collision[0] is not None:
                break
        event, info = batch.simulation.egos.collision[0], batch.collision_info(0)
        assert event is not None and info["trait"] == "aggressive"
        assert (info["route"], info["slot"], info["ego_m"]) == (event.route, event.slot, (event.ego_x_m, event.ego_y_m))
