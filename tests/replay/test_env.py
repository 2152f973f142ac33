"""The environment among recorded vehicles."""

import copy
import pickle
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env

from tests.replay.recordings import LOWER_Y_M, STEM, UPPER_Y_M, Driven, built, recording
from tint_sumo import REPLAY_ENV_ID
from tint_sumo.config import FittedDriver
from tint_sumo.core.errors import InputError
from tint_sumo.drivers.fitted import DriverFit, Fit, Fitted, PairFit, PopulationFit
from tint_sumo.drivers.models import MODELS
from tint_sumo.envs import SceneEnv, TaskSettings
from tint_sumo.replay import EgoOnEdges, ReplayEnv, from_tracks
from tint_sumo.simulation import ReplaySimulation
from tint_sumo.tracks import Tracks

STOP, SLOW, FAST = range(3)
WEST = Driven("west", 90.0, LOWER_Y_M, -10.0)
FOLLOWER = Driven("follower", 75.0, LOWER_Y_M, -10.0, 3.0)
EAST = Driven("east", -90.0, UPPER_Y_M, 8.0, 1.0)
# Stands across the lower lane, just behind the end of the stem.
ACROSS = EgoOnEdges(STEM, start_m=20.0, goal_m=60.0, every_s=100.0)


@contextmanager
def made(net: Path, tracks: Tracks, **arguments: Any) -> Iterator[ReplayEnv]:
    env = ReplayEnv(net, tracks, **arguments)
    try:
        yield env
    finally:
        env.close()


def simulation_of(env: SceneEnv) -> ReplaySimulation:
    assert isinstance(env.simulation, ReplaySimulation)
    return env.simulation


def boxes(env: SceneEnv) -> dict[str, tuple[float, float]]:
    """Return the centres of the vehicles in slots, in the network's frame, by their names."""
    simulation = simulation_of(env)
    names, slots = simulation.scene.recording.vehicles, simulation.slots
    left_m, low_m = simulation.origin_m
    return {
        names[int(known)]: (slots.box["x_m"][0, slot] + left_m, slots.box["y_m"][0, slot] + low_m)
        for known, slot in simulation.slot.items()
    }


def play(env: SceneEnv, action: int, steps: int = 10_000) -> tuple[dict[str, Any], int]:
    """Take an action until the episode's end, or for so many steps; return the last info and the number of steps."""
    for step in range(steps):  # noqa: B007
        _, _, terminated, truncated, info = env.step(np.int64(action))
        if terminated or truncated:
            break
    return info, step + 1


@pytest.mark.parametrize("reactive", [False, True])
def test_vehicles_are_where_they_were_recorded(street: Path, reactive: bool) -> None:
    tracks = recording([WEST, FOLLOWER, EAST])
    with made(street, tracks, ego="east", reactive=reactive, sight_m=400.0) as env:
        env.reset(seed=0)
        scene = simulation_of(env).scene
        for step in range(100):
            time_s = 1.0 + step * 0.1  # the ego appears after a second
            expected = {"west": (90.0 - 10.0 * time_s, LOWER_Y_M)}
            if time_s > 3.0 - 1e-9:
                expected["follower"] = (75.0 - 10.0 * (time_s - 3.0), LOWER_Y_M)
            found = boxes(env)
            assert found.keys() == expected.keys()
            for name, at_m in expected.items():
                assert found[name] == pytest.approx(at_m, abs=1e-6)
                track = str(scene.recording.vehicles.index(name))
                in_sumo = env.simulation.connection.vehicle.getPosition(track)  # of its front
                assert in_sumo == pytest.approx((at_m[0] - 2.5, at_m[1]), abs=1e-6)
            env.step(np.int64(FAST))


def test_the_ego_takes_over_from_a_recorded_vehicle(street: Path) -> None:
    with made(street, recording([WEST, FOLLOWER, EAST]), ego="east", reactive=False) as env:
        observation, _ = env.reset(seed=0)
        simulation = simulation_of(env)
        assert simulation.origin_m == pytest.approx((-90.0, UPPER_Y_M))
        assert simulation.egos.speed_mps[0] == 8.0
        assert observation["ego"] == pytest.approx([0.0, 0.0, 8.0 / 15.0, 0.0], abs=1e-6)
        info, steps = play(env, SLOW)  # 7.5 m/s
        assert info["outcome"] == "timeout"  # the recording ends when the recorded vehicle is at the goal
        assert steps == round((15.0 - 1.0) / 0.1)
        env.reset(seed=0)
        info, steps = play(env, FAST)
        assert info["outcome"] == "success"
        assert simulation.egos.box["x_m"][0] == pytest.approx(8.0 * 14.0, abs=1.5)


def test_an_ego_that_stands_in_the_way_is_hit_unless_others_react(street: Path) -> None:
    tracks = recording([WEST, FOLLOWER])
    outcomes = {}
    for reactive in (False, True):
        with made(street, tracks, ego=ACROSS, reactive=reactive) as env:
            env.reset(seed=0)
            play(env, SLOW, 8)  # onto the lower lane
            info, _ = play(env, STOP)
            outcomes[reactive] = info["outcome"]
            if reactive:
                assert info["released"] == 2  # the follower as well, behind the one that waits for the ego
            else:
                assert info["released"] == 0
                assert info["collision"]["replayed"]
                assert info["collision"]["trait"] == "car"
    assert outcomes == {False: "collision", True: "timeout"}


def test_drivers_that_do_not_yield_take_no_notice_of_the_ego(street: Path) -> None:
    with made(street, recording([WEST, FOLLOWER]), ego=ACROSS, yields={"west": False}) as env:
        env.reset(seed=0)
        play(env, SLOW, 8)
        info, _ = play(env, STOP)
        assert info["outcome"] == "collision"
        assert not info["collision"]["replayed"]


def test_a_released_vehicle_brakes_as_its_model_does(street: Path) -> None:
    """Drivers with a long headway are slower behind an ego that drives slowly."""
    leader, behind = Driven("ego", 20.0, UPPER_Y_M, 9.0), Driven("behind", -15.0, UPPER_Y_M, 9.0)
    at_m = {}
    for tau_s in (0.8, 2.5):
        with made(street, recording([leader, behind]), ego="ego", drivers=FittedDriver(tau_s, 2.0, 2.0, 3.0)) as env:
            env.reset(seed=0)
            for _ in range(100):
                action = STOP if env.simulation.egos.speed_mps[0] > 4.0 else SLOW
                _, _, terminated, _, info = env.step(np.int64(action))
                assert not terminated
            assert info["released"] == 1
            at_m[tau_s] = boxes(env)["behind"][0]
    assert at_m[2.5] < at_m[0.8] - 3.0


def test_vehicles_that_the_ego_comes_up_to_stay_as_recorded(street: Path) -> None:
    ahead = Driven("ahead", 30.0, UPPER_Y_M, 4.0, last_s=8.0)
    with made(street, recording([Driven("ego", 15.0, UPPER_Y_M, 5.0, last_s=8.0), ahead]), ego="ego") as env:
        env.reset(seed=0)
        play(env, FAST, 40)
        assert env.simulation.egos.distance_m[0].min() < 2.0
        info, _ = play(env, FAST)
        assert info["released"] == 0


def test_faults_of_the_recording_and_of_the_map_are_not_the_egos(street: Path) -> None:
    tracks = recording(
        [
            Driven("ego", 20.0, UPPER_Y_M - 0.5, 8.0, last_s=10.0),
            Driven("beside", 22.0, UPPER_Y_M - 1.0, 8.0, last_s=10.0),  # touches the ego's vehicle in the recording
            Driven("one", 40.0, LOWER_Y_M, -5.0, last_s=10.0),
            Driven("other", 42.0, LOWER_Y_M, -5.0, last_s=10.0),  # touches the one before
            Driven("parked", 60.0, UPPER_Y_M + 3.6, 0.0, last_s=10.0, size_m=(5.0, 5.4)),  # on no lane, and
            # its box lies in the lane of the ego
        ]
    )
    with made(street, tracks, ego="ego", reactive=False) as env:
        env.reset(seed=0)
        assert boxes(env).keys() == {"one", "other"}
        info, _ = play(env, FAST)
        assert info["outcome"] == "success"
        assert [info[name] for name in ("overlaps", "left_out", "off_road", "map_contacts")] == [1, 1, 1, 1]


def test_gymnasium_makes_and_checks_it(street: Path) -> None:
    tracks = recording([WEST, FOLLOWER, EAST])
    env = gymnasium.make(REPLAY_ENV_ID, net=street, tracks=tracks, decision_s=0.4, render_mode="rgb_array")
    try:
        check_env(env.unwrapped, skip_render_check=True)
        env.reset(seed=0)
        image = env.render()
        assert isinstance(image, np.ndarray)
        assert image.shape[2] == 3
    finally:
        env.close()


def test_seeds_and_options_choose_cases(street: Path) -> None:
    tracks = recording([WEST, FOLLOWER, EAST])
    with made(street, tracks) as env, made(street, tracks) as other:
        cases = [env.reset(seed=seed)[1]["case"] for seed in range(12)]
        assert set(cases) == {0, 1, 2}
        assert cases[:3] == [other.reset(seed=seed)[1]["case"] for seed in range(3)]
        assert env.simulation.backend != other.simulation.backend  # libsumo is one per process
        for case, name in enumerate(["west", "east", "follower"]):  # as they appear
            _, info = env.reset(options={"case": case})
            assert info["case"] == case
            recorded = simulation_of(env).scene
            assert recorded.recording.vehicles[recorded.cases[case].track] == name
        with pytest.raises(InputError, match="case must be an integer from 0 to 2, not 3"):
            env.reset(options={"case": 3})


def test_snapshots_and_copies_go_on_as_the_episode_does(street: Path) -> None:
    with made(street, recording([WEST, FOLLOWER]), ego=ACROSS) as env:
        env.reset(seed=3)
        play(env, SLOW, 10)
        snapshot = pickle.loads(pickle.dumps(env.snapshot()))
        twin = copy.deepcopy(env)
        try:
            rest = [env.step(np.int64(STOP))[0]["vehicles"] for _ in range(40)]
            np.testing.assert_array_equal([twin.step(np.int64(STOP))[0]["vehicles"] for _ in range(40)], rest)
        finally:
            twin.close()
        env.restore(snapshot)
        np.testing.assert_array_equal([env.step(np.int64(STOP))[0]["vehicles"] for _ in range(40)], rest)


def test_unknown_arguments_are_named(street: Path) -> None:
    tracks = recording([WEST])
    with pytest.raises(InputError, match="p_conservative"):
        gymnasium.make(REPLAY_ENV_ID, net=street, tracks=tracks, p_conservative=0.4)
    with pytest.raises(InputError, match="there is no reset option 'case'"), made_scene() as env:
        env.reset(options={"case": 0})


@contextmanager
def made_scene() -> Iterator[SceneEnv]:
    env = SceneEnv()
    try:
        yield env
    finally:
        env.close()


def test_scenes_can_be_given_to_other_environments(street: Path) -> None:
    scene = from_tracks(street, recording([WEST, FOLLOWER, EAST]), "east", sight_m=400.0)
    env = SceneEnv(TaskSettings(scene, tracks=True))
    try:
        _, info = env.reset(seed=0)
        assert info["position_m"][0] == pytest.approx(10.0)  # of the only one there, since it was recorded
    finally:
        env.close()


def test_persons_on_foot_are_seen_where_they_are_on_lanes_and_never_released(street: Path) -> None:
    north = Driven("walker", 40.0, UPPER_Y_M, 0.0, size_m=(0.5, 0.5), vehicle_class="pedestrian").rows()
    north["y_m"], north["heading_rad"] = -4.0 + north["time_s"], np.pi / 2.0
    tracks = built([Driven("ego", 20.0, UPPER_Y_M, 1.0).rows(), north])
    with made(street, tracks, ego="ego") as env:
        env.reset(seed=0)
        times = [step for step in range(140) if (env.step(np.int64(STOP)), boxes(env))[1]]
        assert times[0] * 0.1 == pytest.approx(2.5 - 0.25, abs=0.2)  # its front is 1.5 m from the lower lane's border
        assert times[-1] * 0.1 == pytest.approx(13.5 - 0.25, abs=0.2)
        assert np.diff(times).max() == 1
    with made(street, tracks, ego="ego") as env:
        env.reset(seed=0)
        info, _ = play(env, STOP)
        assert info["released"] == 0


def test_fitted_drivers_drive_on_as_they_were_fitted(street: Path) -> None:
    """The vType of a vehicle with a fit has its parameters, that of another one those of the median driver."""
    tracks = recording([WEST, FOLLOWER, EAST])
    fit = fit_of("street/follower", [20.0, 2.0, 3.0, 1.0, 1.5], median=[12.0, 1.1, 2.0, 1.4, 2.2])
    with made(street, tracks, ego=ACROSS, drivers=fit) as env:
        env.reset(seed=0)
        play(env, STOP, 50)
        vehicle, types = env.simulation.connection.vehicle, env.simulation.connection.vehicletype
        names = simulation_of(env).scene.recording.vehicles
        found = {name: vehicle.getTypeID(str(names.index(name))) for name in ("follower", "west")}
        values = {name: (types.getTau(one), types.getMinGap(one), types.getAccel(one)) for name, one in found.items()}
        assert values["follower"] == pytest.approx((2.0, 3.0, 1.0))
        assert values["west"] == pytest.approx((1.1, 2.0, 1.4))
        # Nobody wants to be faster than recorded, and on slower roads they are as much slower.
        for one in found.values():
            assert types.getMaxSpeed(one) == pytest.approx(10.0)
            assert types.getSpeedFactor(one) == pytest.approx(10.0 / 15.0)


def fit_of(driver: str, parameters: list[float], median: list[float]) -> Fitted:
    """A fit of one driver of the Intelligent Driver Model among others."""
    model = MODELS["IDM"]
    covariance = tuple(tuple(row) for row in (0.01 * np.eye(len(parameters))).tolist())
    one, mean = (Fit(tuple(np.log(values)), covariance) for values in (parameters, median))
    return Fitted(
        model.name,
        tuple(parameter.name for parameter in model.parameters),
        0.1,
        PopulationFit(mean, covariance, covariance, 0.9, 1.0),
        (DriverFit(driver, 1, 10.0, one),),
        (PairFit("pair", driver, 10.0, 0.1, 1.0, one),),
    )


def test_a_vector_has_a_process_for_each_environment(street: Path) -> None:
    tracks = recording([WEST, FOLLOWER, EAST])
    vector = gymnasium.make_vec(REPLAY_ENV_ID, num_envs=2, net=street, tracks=tracks)
    try:
        _, infos = vector.reset(seed=5)
        with made(street, tracks) as env:
            assert [env.reset(seed=seed)[1]["case"] for seed in (5, 6)] == infos["case"].tolist()
        *_, infos = vector.step(np.array([FAST, FAST]))
        assert infos["released"].tolist() == [0, 0]
    finally:
        vector.close()


def test_sumo_can_drive_the_ego(street: Path) -> None:
    slow = Driven("slow", 40.0, UPPER_Y_M, 4.0, last_s=14.0)
    with made(street, recording([Driven("ego", -60.0, UPPER_Y_M, 10.0, last_s=14.0), slow]), ego_control="sumo") as env:
        env.reset(options={"case": 0})
        assert simulation_of(env).egos.speed_mps[0] == 10.0
        for _ in range(139):
            env.step(np.int64(STOP))
        assert env.simulation.egos.distance_m[0].min() > 0.5
        assert env.simulation.egos.speed_mps[0] == pytest.approx(4.0, abs=1.0)  # behind the slow one


def test_the_vehicle_that_the_ego_has_taken_over_does_not_come_again(street: Path) -> None:
    parts = [Driven("west", 90.0, LOWER_Y_M, -10.0, last_s=4.0), Driven("west", 40.0, LOWER_Y_M, -10.0, 6.0)]
    with made(street, built([one.rows() for one in [*parts, FOLLOWER]]), ego="west", sight_m=400.0) as env:
        env.reset(options={"case": 0})
        seen: set[str] = set()
        for _ in range(100):
            env.step(np.int64(FAST))
            seen |= boxes(env).keys()
        assert seen == {"follower"}


@pytest.mark.parametrize("route", [("ab", "bc"), ("ab", "bd")])
def test_an_ego_on_edges_drives_the_way_that_others_expect(pavements: Path, route: tuple[str, ...]) -> None:
    ego = EgoOnEdges(route, start_m=12.0, goal_m=100.0, every_s=100.0)
    with made(pavements, recording([Driven("far", 120.0, -1.6, 1.0)]), ego=ego) as env:
        env.reset(seed=0)
        simulation, way = simulation_of(env), simulation_of(env).scene.cases[0].way
        over = False
        while not over:
            _, _, terminated, truncated, info = env.step(np.int64(FAST))
            over = terminated or truncated
            driven_m = simulation.egos.front_m[0] - ego.start_m
            box, expected = simulation.egos.box[0], way.box[np.abs(way.driven_m - driven_m).argmin()]
            x_m, y_m = box["x_m"] + simulation.origin_m[0], box["y_m"] + simulation.origin_m[1]
            assert np.hypot(x_m - expected["x_m"], y_m - expected["y_m"]) < 2.0
        assert info["outcome"] == "success"
