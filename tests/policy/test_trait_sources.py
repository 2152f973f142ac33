import math
from contextlib import closing
from typing import Any, NamedTuple

import numpy as np
import pytest
import torch
from gymnasium import spaces
from stable_baselines3.common.vec_env import VecMonitor

from tint_sumo.config import RelativeLatent, RelativeSettings
from tint_sumo.core.errors import InputError
from tint_sumo.dataset.windows import cut_windows
from tint_sumo.envs.sb3 import SceneVecEnv
from tint_sumo.policy.trait_sources import (
    ClassifierTraits,
    EncoderTraits,
    NeighbourTraits,
    NoTraits,
    OracleTraits,
    StreamingTraits,
    TraitSource,
    WithMotion,
)
from tint_sumo.policy.wrappers import TRUE_TRAITS, TraitObservation
from tint_sumo.traits import load
from tint_sumo.traits.evaluation import encode_windows
from tint_sumo.traits.relative import RelativeStream
from tint_sumo.traits.streaming import fuse_so_far

from .tasks import STREET, FakeVecEnv, Memory


class Seen(NamedTuple):
    """A vehicle on its route."""

    position_m: float
    gap_m: float = math.inf
    passed: bool = False


Scene = dict[int, Seen]  # by slot


class Script(FakeVecEnv):
    """Environments that play scenes written by hand: ``episodes[env]`` is a list of episodes, an episode a list of
    scenes, one each step. Traits are conservative in even slots, aggressive in odd ones."""

    slots: dict[str, np.ndarray]

    def __init__(self, episodes: list[list[list[Scene]]]) -> None:
        super().__init__(len(episodes), STREET, spaces.Discrete(3))
        self.episodes = episodes

    def frame(self, env: int) -> tuple[dict[str, np.ndarray], dict[str, np.ndarray]]:
        observation: dict[str, np.ndarray] = {key: np.zeros(box.shape, np.float32) for key, box in STREET.items()}
        slots: dict[str, np.ndarray] = {
            "traits": np.full(12, -1),
            "position_m": np.zeros(12),
            "gap_m": np.full(12, math.inf),
            "passed": np.zeros(12, np.int8),
        }
        for slot, seen in self.episodes[env][self.episode[env]][self.time[env]].items():
            observation["mask"][slot] = 1.0
            slots["traits"][slot] = slot % 2
            slots["position_m"][slot], slots["gap_m"][slot], slots["passed"][slot] = seen
        return observation, slots

    def frames(self) -> dict[str, np.ndarray]:
        observations, slots = zip(*map(self.frame, range(self.num_envs)), strict=True)
        self.slots = {key: np.stack([one[key] for one in slots]) for key in slots[0]}
        return {key: np.stack([one[key] for one in observations]) for key in STREET}

    def reset(self) -> dict[str, np.ndarray]:
        self.episode, self.time = [0] * self.num_envs, [0] * self.num_envs
        return self.frames()

    def step_async(self, actions: np.ndarray) -> None: ...

    def step_wait(self) -> Any:
        infos: list[dict[str, Any]] = [{} for _ in range(self.num_envs)]
        done = np.zeros(self.num_envs, bool)
        for env, info in enumerate(infos):
            self.time[env] += 1
            done[env] = self.time[env] == len(self.episodes[env][self.episode[env]]) - 1
            if done[env]:
                info["terminal_observation"], info["terminal_slots"] = self.frame(env)
                self.episode[env], self.time[env] = self.episode[env] + 1, 0
        return self.frames(), np.zeros(self.num_envs, np.float32), done, infos


class Spy:
    """A trait model whose trait is (offset, gap) at the window's last step; it keeps what it was asked."""

    latent_size = 2

    def __init__(self) -> None:
        self.calls: list[tuple[torch.Tensor, torch.Tensor]] = []

    def encode(self, states: torch.Tensor, length: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        self.calls.append((states, length))
        last = states[torch.arange(len(length)), length - 1]
        return last, torch.zeros_like(last)


def play(episodes: list[list[list[Scene]]], source: TraitSource, steps: int) -> tuple[np.ndarray, Any]:
    """Traits (steps + 1, N, 12, 2) and all infos of a run."""
    env = TraitObservation(Script(episodes), source)
    traits, infos = [env.reset()["traits"]], []
    for _ in range(steps):
        observation, _, _, info = env.step(np.zeros(env.num_envs))
        assert env.observation_space.contains({key: value[0] for key, value in observation.items()})
        traits.append(observation["traits"])
        infos.append(info)
    return np.stack(traits), infos


def drive(steps: int) -> list[Scene]:
    """Slot 3 drives at 2 m/s, slot 5 at 3 m/s; nobody is ahead of them."""
    return [{3: Seen(15.0 + 0.2 * k), 5: Seen(10.0 + 0.3 * k)} for k in range(steps)]


def test_windows_of_the_last_twenty_steps() -> None:
    spy = Spy()
    traits, _ = play([[drive(60)]], EncoderTraits(spy), 45)
    assert (traits[:20] == 0.0).all()
    assert len(spy.calls) == 2
    for states, length in spy.calls:
        assert states.dtype == torch.float32 and states.shape == (2, 20, 2)
        assert length.dtype == torch.int64 and length.tolist() == [20, 20]
        steps = torch.arange(20)
        torch.testing.assert_close(states[0, :, 0], 0.2 * steps, atol=1e-4, rtol=0)
        torch.testing.assert_close(states[1, :, 0], 0.3 * steps, atol=1e-4, rtol=0)
        assert (states[..., 1] == 20.0).all()  # nobody ahead
    np.testing.assert_allclose(traits[20:, 0, 3], [[3.8, 20.0]] * 26, atol=1e-4)
    np.testing.assert_allclose(traits[20:, 0, 5], [[5.7, 20.0]] * 26, atol=1e-4)
    assert (traits[:, 0, [0, 1, 2, 4, 6, 7, 8, 9, 10, 11]] == 0.0).all()


def test_gaps_are_those_seen_up_to_the_largest_that_counts() -> None:
    scene = {0: Seen(10.0, 7.0), 1: Seen(22.0, 5.5), 2: Seen(33.0), 8: Seen(9.0, 21.0)}
    spy = Spy()
    play([[[scene] * 30]], EncoderTraits(spy), 20)
    ((states, _),) = spy.calls
    expected = torch.tensor([7.0, 5.5, 20.0, 20.0])
    torch.testing.assert_close(states[..., 1], expected[:, None].expand(4, 20), atol=1e-4, rtol=0)
    assert (states[..., 0].abs() < 1e-4).all()


def test_short_windows_of_vehicles_seen_for_a_shorter_time() -> None:
    """Slot 0 appears at step 13, slot 1 at step 19, slot 2 at step 20."""
    episode = [
        {
            **scene,
            **({0: Seen(5.0 + 0.1 * k)} if k >= 13 else {}),
            **({1: Seen(5.0 + 0.1 * k)} if k >= 19 else {}),
            **({2: Seen(30.0)} if k >= 20 else {}),
        }
        for k, scene in enumerate(drive(30))
    ]
    spy = Spy()
    traits, _ = play([[episode]], EncoderTraits(spy), 20)
    ((states, length),) = spy.calls
    assert length.tolist() == [8, 2, 20, 20]  # slots 0, 1, 3, 5
    torch.testing.assert_close(states[0, :8, 0], 0.1 * torch.arange(8), atol=1e-4, rtol=0)
    assert (states[0, 8:] == 0.0).all() and (states[1, 2:] == 0.0).all()
    assert (traits[20, 0, 2] == 0.0).all()  # seen once only
    assert (traits[20, 0, [0, 1, 3, 5]] != 0.0).any(axis=-1).all()


def test_a_slot_is_zeroed_when_its_vehicle_leaves() -> None:
    """Slot 3's vehicle leaves at step 25; another one takes the slot at step 27."""
    episode = [
        {slot: seen for slot, seen in scene.items() if slot != 3 or not 25 <= k < 27}
        for k, scene in enumerate(drive(50))
    ]
    spy = Spy()
    traits, _ = play([[episode]], EncoderTraits(spy), 42)
    assert (traits[20:25, 0, 3] != 0.0).any(axis=-1).all()
    assert (traits[25:40, 0, 3] == 0.0).all()
    assert (traits[40:, 0, 3] != 0.0).any(axis=-1).all()
    assert spy.calls[1][1].tolist() == [14, 20]  # steps 27..40 of the new vehicle only
    assert (traits[20:, 0, 5] != 0.0).any(axis=-1).all()


def test_drivers_in_a_passed_lane_keep_their_trait() -> None:
    """From step 30 on the vehicles stand; the first ego has passed the lane of slot 5 then, the second one has not."""
    first, second = (drive(31) + [{3: Seen(21.0), 5: Seen(19.0, passed=passed)}] * 40 for passed in (True, False))
    spy = Spy()
    traits, _ = play([[first], [second]], EncoderTraits(spy), 62)
    assert [len(length) for _, length in spy.calls] == [4, 3, 3]
    np.testing.assert_array_equal(traits[62, 0, 5], traits[20, 0, 5])
    np.testing.assert_allclose(traits[62, 1, 5, 0], 0.0, atol=1e-4)
    np.testing.assert_allclose(traits[62, :, 3, 0], 0.0, atol=1e-4)


def test_a_new_episode_starts_over() -> None:
    """Episodes of 26 and 21 steps side by side; the second ends just when its traits are inferred."""
    spy = Spy()
    long, short = drive(26), drive(21)
    traits, infos = play([[long, long, long], [short, short, short]], EncoderTraits(spy), 50)
    known = (traits[:, :, 3] != 0.0).any(axis=-1)
    assert np.flatnonzero(known[:, 0]).tolist() == [20, 21, 22, 23, 24, 45, 46, 47, 48, 49]
    assert not known[:, 1].any()  # at step 20 the next episode's first observation is shown
    assert len(spy.calls) == 3  # both environments together at step 20, then one by one at 40 and 45
    np.testing.assert_allclose(infos[19][1]["terminal_observation"]["traits"][3], [3.8, 20.0], atol=1e-4)
    np.testing.assert_array_equal(infos[24][0]["terminal_observation"]["traits"], traits[24, 0])


def test_reset_in_the_middle_of_an_episode_starts_over() -> None:
    spy = Spy()
    env = TraitObservation(Script([[drive(60)]]), EncoderTraits(spy))
    env.reset()
    for _ in range(25):
        env.step(np.zeros(1))
    assert (env.reset()["traits"] == 0.0).all()
    for _ in range(19):
        assert (env.step(np.zeros(1))[0]["traits"] == 0.0).all()
    assert (env.step(np.zeros(1))[0]["traits"] != 0.0).any()
    assert spy.calls[-1][1].tolist() == [20, 20]


def test_no_vehicles_no_call() -> None:
    spy = Spy()
    traits, _ = play([[[{}] * 30]], EncoderTraits(spy), 25)
    assert not spy.calls and (traits == 0.0).all()


def test_scale_divides_traits() -> None:
    plain, _ = play([[drive(30)]], EncoderTraits(Spy()), 20)
    scaled, _ = play([[drive(30)]], EncoderTraits(Spy(), scale=8.0), 20)
    np.testing.assert_allclose(scaled, plain / 8.0)


def test_oracle_knows_at_once() -> None:
    """Slot 5 is aggressive; slot 4, conservative, is on the street at the terminal observation only."""
    first = drive(3)
    first[2] = {4: Seen(20.0)}
    traits, infos = play([[first, drive(9)], [drive(9)]], OracleTraits(), 3)
    expected = np.zeros((12, 2))
    expected[[3, 5]] = (0.0, 1.0)
    np.testing.assert_array_equal(traits[0, 0], expected)
    np.testing.assert_array_equal(traits, np.broadcast_to(expected, traits.shape))
    terminal = np.zeros((12, 2))
    terminal[4] = (1.0, 0.0)
    np.testing.assert_array_equal(infos[1][0]["terminal_observation"]["traits"], terminal)


def test_no_traits() -> None:
    traits, infos = play([[drive(3), drive(9)]], NoTraits(), 4)
    assert (traits == 0.0).all()
    assert (infos[1][0]["terminal_observation"]["traits"] == 0.0).all()


def test_observations_are_not_changed_later() -> None:
    env = TraitObservation(Script([[drive(60)]]), EncoderTraits(Spy()))
    shown = env.reset()["traits"]
    for _ in range(20):
        env.step(np.zeros(1))
    assert (shown == 0.0).all()


def test_model_of_another_latent_size_is_refused() -> None:
    spy = Spy()
    spy.latent_size = 3
    with pytest.raises(InputError, match="2 numbers, this trait model's have 3"):
        EncoderTraits(spy)


def test_other_environments_are_refused() -> None:
    with pytest.raises(InputError, match="ego, mask, vehicles"):
        TraitObservation(Memory(2), NoTraits())
    with (
        closing(VecMonitor(SceneVecEnv(1))) as env,
        pytest.raises(
            InputError, match=r"these traits need tracks; make the environment with TaskSettings\(tracks=True\)"
        ),
    ):
        TraitObservation(env, EncoderTraits(load("vae")))


def test_streaming_is_the_posterior_of_the_track_so_far() -> None:
    """Slot 0 appears at step 13, behind slot 3, whose vehicle is followed over more than two windows."""
    model = load("cross_window")
    gap_m = 5.0 - 0.04 * np.arange(60)
    episode = [
        {**scene, **({0: Seen(5.0 + 0.24 * k, gap_m[k])} if k >= 13 else {})} for k, scene in enumerate(drive(60))
    ]
    traits, _ = play([[episode]], StreamingTraits(model), 55)
    for slot, start, speed_m in ((3, 0, 0.2), (0, 13, 0.24)):
        for step in (start + 1, start + 19, start + 20, start + 21, start + 38):
            count = step - start + 1
            gaps_m = np.full(count, np.inf) if slot == 3 else gap_m[start : step + 1]
            windows = cut_windows(np.zeros(count, int), np.zeros(count, int), speed_m * np.arange(count), gaps_m)
            expected = fuse_so_far(encode_windows(model, windows), windows.driver)
            np.testing.assert_allclose(traits[step, 0, slot, :2], expected.mean[-1], atol=2e-3)
            np.testing.assert_allclose(traits[step, 0, slot, 2:4], expected.std[-1], atol=2e-3)
            assert traits[step, 0, slot, 4] == pytest.approx(count / 100)


def test_streaming_begins_with_the_prior_and_leaves_empty_slots_zero() -> None:
    traits, _ = play([[drive(12), drive(9)]], StreamingTraits(load("cross_window")), 14)
    np.testing.assert_allclose(traits[0, 0, 3], [0.0, 0.0, 1.0, 1.0, 0.01])
    np.testing.assert_allclose(traits[11, 0, 3], [0.0, 0.0, 1.0, 1.0, 0.01])  # the next episode's first step
    np.testing.assert_allclose(traits[14, 0], traits[3, 0], atol=1e-6)  # the same drive again
    assert (traits[:, :, [0, 1, 2, 4, 6, 7, 8, 9, 10, 11]] == 0.0).all()
    assert (traits[2:11, 0, 3, 2:4] < 1.0).all()  # surer with each step


def test_streaming_forgets_a_vehicle_that_has_left() -> None:
    episode = [
        {slot: seen for slot, seen in scene.items() if slot != 3 or not 25 <= k < 27}
        for k, scene in enumerate(drive(50))
    ]
    traits, _ = play([[episode]], StreamingTraits(load("cross_window")), 30)
    assert (traits[25:27, 0, 3] == 0.0).all()
    np.testing.assert_allclose(traits[27, 0, 3], [0.0, 0.0, 1.0, 1.0, 0.01])


@pytest.mark.parametrize("method", ["vae", "morton", "classifier"])
def test_streaming_needs_posteriors(method: str) -> None:
    with pytest.raises(InputError, match=f"of a cross_window model, not of {method}; give a trait model of"):
        StreamingTraits(load(method))


def test_classes_need_a_classifier() -> None:
    with pytest.raises(InputError, match="not of vae; give a trait model of the method classifier"):
        ClassifierTraits(load("vae"))


def test_a_classifiers_predictions_look_like_true_traits() -> None:
    """Slot 3 drives at 2 m/s, slot 5 at 3 m/s, as an aggressive driver does; nobody is ahead of them."""
    traits, _ = play([[drive(60)]], ClassifierTraits(load("classifier")), 25)
    assert (traits[:20] == 0.0).all()
    np.testing.assert_array_equal(traits[20:, 0, 3], [[1.0, 0.0]] * 6)
    np.testing.assert_array_equal(traits[20:, 0, 5], [[0.0, 1.0]] * 6)


def test_true_traits_beside_inferred_ones() -> None:
    """For a critic that may see more than the actor; terminal observations hold both."""
    env = TraitObservation(
        TraitObservation(Script([[drive(3), drive(9)]]), StreamingTraits(load("cross_window"))),
        OracleTraits(),
        TRUE_TRAITS,
    )
    assert {key: env.observation_space[key].shape for key in ("traits", TRUE_TRAITS)} == {  # type: ignore[index]
        "traits": (12, 5),
        TRUE_TRAITS: (12, 2),
    }
    assert env.reset()[TRUE_TRAITS][0, 3].tolist() == [0.0, 1.0]
    for _ in range(2):
        observation, _, done, infos = env.step(np.zeros(1))
    assert done.all()
    assert observation[TRUE_TRAITS][0, 3].tolist() == [0.0, 1.0]  # type: ignore[call-overload]
    assert infos[0]["terminal_observation"][TRUE_TRAITS][3].tolist() == [0.0, 1.0]
    assert infos[0]["terminal_observation"]["traits"].shape == (12, 5)


def test_relative_traits_are_those_of_the_stream_and_begin_anew_with_each_episode() -> None:
    settings = RelativeSettings(RelativeLatent(0.0, 1.0, 5.0, 1.0, 0.2, 1.0))
    first = [{slot: Seen(10.0 + 0.2 * k, gap_m) for slot, gap_m in ((0, 6.0), (3, 4.0), (4, 4.0))} for k in range(16)]
    second = [{0: Seen(5.0 + 0.2 * k, 4.0), 1: Seen(0.2 * k, 6.0)} for k in range(16)]
    traits, infos = play([[first, second]], NeighbourTraits(settings), 26)

    def expected(episode: list[Scene]) -> list[np.ndarray]:
        stream, found = RelativeStream(settings, 1, 12), []
        stream.begin(np.array([0]))
        for scene in episode:
            present, position_m, gap_m = np.zeros((1, 12), bool), np.zeros((1, 12)), np.full((1, 12), np.inf)
            for slot, seen in scene.items():
                present[0, slot], position_m[0, slot], gap_m[0, slot] = True, seen.position_m, seen.gap_m
            found.append(stream.advance(np.arange(1), present, position_m, gap_m)[0])
        return found

    assert traits[14, 0, 0, 0] > 0.2 > -0.2 > traits[14, 0, 3, 0]
    assert traits[24, 0, 1, 0] > 0.2 > -0.2 > traits[24, 0, 0, 0]
    np.testing.assert_array_equal(traits[:15, 0], expected(first)[:15])
    np.testing.assert_array_equal(infos[14][0]["terminal_observation"]["traits"], expected(first)[15])
    np.testing.assert_array_equal(traits[15:, 0], expected(second)[: len(traits) - 15])


def test_motion_stands_before_the_traits_and_begins_anew_with_each_vehicle() -> None:
    """Slot 3 drives at 2 m/s and then at 1 m/s; slot 5 leaves, and another vehicle comes to it."""
    speeds = [2.0] * 8 + [1.0] * 8
    along_m = 15.0 + 0.1 * np.cumsum(speeds)
    scenes = [{3: Seen(float(position_m), 8.0), 5: Seen(10.0 + 0.3 * k)} for k, position_m in enumerate(along_m)]
    del scenes[10][5]
    for k in range(11, 16):
        scenes[k][5] = Seen(1.0 + 0.1 * k, 30.0)
    traits, _ = play([[scenes]], WithMotion(OracleTraits()), 14)
    assert traits.shape[-1] == 5
    np.testing.assert_array_equal(traits[:, 0, 3, 3:], [[0.0, 1.0]] * 15)
    np.testing.assert_allclose(traits[:, 0, 3, 2], 0.8, rtol=1e-6)
    assert not traits[0, 0, 3, :2].any()
    np.testing.assert_allclose(traits[1:8, 0, 3, :2], [[2.0 / 3.0, 0.0]] * 7, atol=1e-5)
    assert 1.0 / 3.0 < traits[9, 0, 3, 0] < 0.6 and traits[9, 0, 3, 1] < -0.3
    np.testing.assert_allclose(traits[14, 0, 3, 0], 1.0 / 3.0, atol=0.05)
    assert not traits[10, 0, 5].any() and not traits[11, 0, 5, :2].any()
    np.testing.assert_allclose(traits[12:, 0, 5, :3], [[1.0 / 3.0, 0.0, 2.0]] * 3, atol=1e-5)
