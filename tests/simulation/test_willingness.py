"""States of drivers who yield: who would do so now, and who does."""

from contextlib import closing
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from tests.simulation.scenes import GO, LOWER, STOP, UPPER, T
from tint_sumo.config import AGGRESSIVE, CONSERVATIVE, POPULATIONS, Mix, Population, Traffic, Willingness
from tint_sumo.core.errors import InputError
from tint_sumo.envs import SceneEnv, TaskSettings
from tint_sumo.scenes import Scene
from tint_sumo.scenes.layout import layout
from tint_sumo.simulation import SceneSimulation
from tint_sumo.simulation.demand import PlacedVehicle
from tint_sumo.simulation.slots import Slots
from tint_sumo.simulation.willingness import DriverStates

MEMBER = 0  # a driver who yields
FAR_M = 6.0


def played(**willingness: Any) -> Scene:
    return replace(
        T, population=Population(members=1, willingness=Willingness(**willingness)), traffic=Traffic(Mix(1.0))
    )


def states(drivers: int, **willingness: Any) -> tuple[DriverStates, Slots]:
    """A replica with so many drivers on the lower lane, at 2 m/s and of seeds 0, 1, ..."""
    scene = played(**willingness)
    slots = Slots(1, drivers)
    found = DriverStates(scene.population.willingness or Willingness(), layout(scene), slots)
    for slot in range(drivers):
        slots.take(0, slot, route=LOWER, member=MEMBER, number=slot, size_m=(5.0, 2.0))
        slots.front_m[0, slot] = FAR_M
        found.enter(0, slot, slot, 2.0, 0.0)
    return found, slots


def test_drivers_without_states_of_their_own_are_willing() -> None:
    found, slots = states(3)
    assert found.willing.tolist() == [[True] * 3]
    slots.leave(0, 1)
    found.leave(0, 1)
    assert found.willing.tolist() == [[True, False, True]]
    found.follow(np.full(1, 0.1), np.ones(1, bool))
    assert found.willing.tolist() == [[True, False, True]]


def test_drivers_are_willing_with_their_probability_which_grows_while_the_ego_waits() -> None:
    constant, _ = states(200, probability=0.3)
    growing, _ = states(200, probability=0.3, patience_s=10.0)
    assert growing.willing.tolist() == constant.willing.tolist()
    woken = np.zeros(200, bool)
    for step in range(1, 101):
        assert not constant.follow(np.full(1, step / 10), np.ones(1, bool)).any()
        before = growing.willing[0].copy()
        woke = growing.follow(np.full(1, step / 10), np.ones(1, bool))[0]
        assert (woke == (growing.willing[0] & ~before)).all() and (growing.willing[0] >= before).all()
        woken |= woke
    assert woken.any() and growing.waited_s.tolist() == pytest.approx([10.0])
    assert constant.willing.mean() == pytest.approx(0.3, abs=0.08)
    assert growing.willing.mean() == pytest.approx(1.0 - 0.7 / np.e, abs=0.08)
    growing.follow(np.full(1, 10.1), np.zeros(1, bool))
    assert growing.waited_s.tolist() == pytest.approx([10.0]), "an ego that drives does not wait"
    growing.clear(0)
    assert growing.waited_s.tolist() == [0.0]


def test_a_driver_is_willing_as_long_as_its_limit_of_braking_stops_it() -> None:
    found, slots = states(1, braking_mps2=(2.0, 2.0))
    stop_line_m = layout(T).zones.stop_line_m[LOWER]
    needed_m = 2.0 * T.claim.reaction_time_s + 2.0**2 / (2 * 2.0)
    for past_m, willing in ((-1e-6, True), (1e-6, False), (0.5, False)):
        slots.front_m[0, 0] = stop_line_m - needed_m + past_m
        found._was_m[0, 0] = slots.front_m[0, 0] - 2.0 * T.step_s
        found.follow(np.zeros(1), np.zeros(1, bool))
        assert found.willing.tolist() == [[willing]]
    woke = found.follow(np.zeros(1), np.zeros(1, bool))  # it has stopped there
    assert woke.tolist() == [[True]]
    slots.front_m[0, 0] = stop_line_m - 0.9 * needed_m
    for speed_mps, willing in ((2.0, False), (1.5, True)):  # already where it enters
        found.enter(0, 0, 0, speed_mps, 0.0)
        assert found.willing.tolist() == [[willing]]
    many, _ = states(300, braking_mps2=(1.0, 4.0))
    assert 1.0 <= many._braking_mps2.min() < 1.1 and 3.9 < many._braking_mps2.max() <= 4.0


def test_attention_lapses_for_times_of_exponential_lengths() -> None:
    found, _ = states(300, attentive_s=4.0, lapse_s=2.0)
    shares, ends = [], np.zeros(300, int)
    for step in range(1, 401):
        before = found.willing[0].copy()
        found.follow(np.full(1, step / 10), np.ones(1, bool))
        shares.append(found.willing.mean())
        ends += before & ~found.willing[0]
    assert np.mean(shares) == pytest.approx(4.0 / 6.0, abs=0.02)
    assert shares[0] == pytest.approx(4.0 / 6.0, abs=0.08), "from the beginning on"
    assert ends.mean() == pytest.approx(40.0 / 6.0, rel=0.06)
    assert ends.std() == pytest.approx(np.sqrt(40.0 / 6.0 * (4.0**2 + 2.0**2) / 6.0**2), rel=0.2)


def test_a_driver_s_attention_follows_from_its_seed() -> None:
    histories = []
    for others in (0, 3):
        found, slots = states(1 + others, attentive_s=1.0, lapse_s=1.0)
        slots.take(0, others, route=UPPER, member=MEMBER, number=9, size_m=(5.0, 2.0))
        found.enter(0, others, 77, 2.0, 0.0)
        history = []
        for step in range(1, 99):
            found.follow(np.full(1, step / 10), np.ones(1, bool))
            history.append(bool(found.willing[0, others]))
        histories.append(history)
    assert histories[0] == histories[1] and 10 < sum(histories[0]) < 90


def test_after_a_reset_nobody_remembers_that_the_ego_has_waited() -> None:
    simulation = SceneSimulation(1, replace(T, population=replace(POPULATIONS["polite"], members=2)))
    with closing(simulation):
        histories = []
        for _ in range(2):
            simulation.reset(0, 5)
            histories.append([])
            for _ in range(100):
                histories[-1].append(simulation.traits()[0].tolist())
                simulation.step(np.array([STOP]))
    assert histories[0] == histories[1] and len(set(map(str, histories[0]))) > 5


def drive(scene: Scene, seed: int, x_m: float = 3.0) -> tuple[SceneSimulation, list[bool], list[int]]:
    """Send the ego before a conservative driver on the lower lane; return who reacts and the labels, step by step."""
    simulation = SceneSimulation(1, scene)
    simulation.reset_to(0, [PlacedVehicle(LOWER, 25.0 - x_m, MEMBER, seed)])
    reacts, traits = [], []
    for _ in range(80):
        simulation.step(np.array([GO]))
        reacts.append(bool(simulation.yielding.reacts[0, 0]))
        traits.append(int(simulation.traits()[0, 0]))
        if simulation.egos.collided[0] or not simulation.slots.present[0, 0]:
            break
    return simulation, reacts, traits


@pytest.mark.parametrize(("probability", "label"), [(1.0, 0), (0.0, 1)])
def test_who_would_not_yield_has_the_other_label_and_drives_on(probability: float, label: int) -> None:
    simulation, reacts, traits = drive(played(probability=probability), seed=0, x_m=10.0)
    with closing(simulation):
        assert set(traits[:20]) == {label} and any(reacts) == (label == 0)
        collision = simulation.egos.collision[0]
        assert (collision is None) == (label == 0)
        assert collision is None or collision.trait == label


def test_a_driver_who_notices_the_claim_late_still_yields_and_goes_on_until_it_ends() -> None:
    """With lapses of 0.5 s, of the drivers who do not react at once most do so later."""
    scene = played(attentive_s=0.5, lapse_s=0.5)
    late = lapsed = 0
    for seed in range(12):
        simulation, reacts, traits = drive(scene, seed, x_m=12.0)
        with closing(simulation):
            pass
        if not any(reacts):
            continue
        first = reacts.index(True)
        assert {trait for trait, does in zip(traits, reacts, strict=True) if does} == {0}, "who yields is labelled so"
        late += traits[first - 1] == 1
        lapsed += reacts[first:].count(False) == 0
    assert late >= 2 and lapsed >= 2


def test_the_infos_have_what_drivers_would_do_whatever_the_batch() -> None:
    task = TaskSettings(replace(T, population=replace(POPULATIONS["inattentive"], members=2)), p_conservative=0.8)
    with closing(SceneEnv(task)) as env:
        _, info = env.reset(seed=4)
        profiles = env.simulation.trait_of_member[env.simulation.slots.member[0]]
        alone, changed = [], 0
        for step in range(60):
            alone.append(info["traits"].tolist())
            simulation = env.simulation
            assert isinstance(simulation, SceneSimulation)
            present = simulation.slots.present[0]
            assert (info["traits"][present] == np.where(simulation.yielding.yields[0], 0, 1)[present]).all()
            profiles = simulation.trait_of_member[simulation.slots.member[0]]
            changed += int((profiles != info["traits"])[present].sum())
            *_, info = env.step(2 if step > 30 else 0)
    assert changed > 20
    simulation = SceneSimulation(3, task.played)
    with closing(simulation):
        from gymnasium.utils import seeding

        from tint_sumo.envs.episodes import episode_seed

        simulation.reset(0, 1)
        simulation.reset(2, episode_seed(seeding.np_random(4)[0]))
        batch = []
        for step in range(60):
            batch.append(simulation.traits()[2].tolist())
            simulation.step(np.array([GO, GO, GO if step > 30 else STOP]))
    assert batch == alone


def test_a_population_with_states_has_labels_for_both() -> None:
    with pytest.raises(InputError, match="willingness needs a profile that yields and one that does not"):
        Population((CONSERVATIVE,), willingness=Willingness())
    assert Population((AGGRESSIVE, CONSERVATIVE), willingness=Willingness()).willingness == Willingness()


@pytest.mark.parametrize(
    ("wrong", "message"),
    [
        ({"probability": 1.5}, "probability must lie in 0 to 1, not 1.5"),
        ({"braking_mps2": (3.0, 1.0)}, "braking_mps2 must be two numbers from low to high, not 3 and 1"),
        ({"attentive_s": 0.0}, "attentive_s must lie in 0.01 to 86400, not 0.0"),
        ({"patience_s": -1.0}, "patience_s must lie in"),
    ],
)
def test_states_that_cannot_be_are_refused(wrong: dict[str, Any], message: str) -> None:
    with pytest.raises(InputError, match=message):
        Willingness(**wrong)
