"""Several egos in one SUMO configuration, as PettingZoo has agents."""

import warnings
from collections.abc import Callable, Iterator
from contextlib import closing
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from pettingzoo.test import parallel_api_test

from tests.envs.test_copies import Copy, copies
from tests.scenes.networks import UserNetwork, netconvert, write_config
from tint_sumo.config import EgoController
from tint_sumo.core.errors import InputError
from tint_sumo.envs import SceneEnv, TaskSettings
from tint_sumo.envs.parallel import ParallelSceneEnv
from tint_sumo.scenes import SumocfgScene, from_sumocfg

STOP, GO = 0, 2
_NODES = "".join(
    f'<node id="{name}" x="{x}" y="{y}"/>'
    for name, x, y in (("west", -60, 0), ("east", 60, 0), ("south", 0, -60), ("north", 0, 60), ("middle", 0, 0))
)
_EDGES = "".join(
    f'<edge id="{edge}" from="{start}" to="{end}" numLanes="1" speed="10"/>'
    for edge, start, end in (
        ("from_west", "west", "middle"),
        ("to_east", "middle", "east"),
        ("from_south", "south", "middle"),
        ("to_north", "middle", "north"),
    )
)
_LATE = '<routes><vType id="car"/><trip id="late" type="car" from="from_west" to="to_east" depart="3000"/></routes>'

Makes = Callable[..., SumocfgScene]


@pytest.fixture(scope="module")
def crossing(tmp_path_factory: pytest.TempPathFactory) -> Makes:
    """Return a function that makes an ego's scene on two roads that cross, where nobody else drives."""
    folder = tmp_path_factory.mktemp("crossing")
    netconvert(folder, _NODES, _EDGES)
    (folder / "late.rou.xml").write_text(_LATE)
    sumocfg = write_config(folder / "x.sumocfg", "x.net.xml", "late.rou.xml", '<step-length value="0.1"/>')

    def scene(start: str, end: str, start_m: float = 30.0, **more: Any) -> SumocfgScene:
        controller = EgoController((0.0, 4.0, 8.0))
        return from_sumocfg(sumocfg, (start, end), start_m, 100.0, controller=controller, warm_up_s=1.0, **more)

    return scene


@pytest.fixture(scope="module")
def tasks(crossing: Makes) -> dict[str, TaskSettings]:
    return {
        "west": TaskSettings(crossing("from_west", "to_east"), tracks=True),
        "south": TaskSettings(crossing("from_south", "to_north", 32.0), tracks=True),
    }


@pytest.fixture(scope="module")
def env(tasks: dict[str, TaskSettings]) -> Iterator[ParallelSceneEnv]:
    with closing(ParallelSceneEnv(tasks)) as env:
        yield env


@pytest.fixture(scope="module")
def busy(user_network: Callable[[str], UserNetwork]) -> Iterator[ParallelSceneEnv]:
    """Two egos that merge among others, of which they see noisy positions."""
    network = user_network("merge")
    ramp = TaskSettings(network.scene(time_limit_s=15.0), sensor="noisy_0.1")
    main = TaskSettings(network.scene(ego_route=("in", "out"), start_m=60.0, time_limit_s=20.0), sensor="noisy_0.1")
    with closing(ParallelSceneEnv({"ramp": ramp, "main": main})) as env:
        yield env


def episode(env: ParallelSceneEnv, seed: int | None, choose: Callable[[str, int], int]) -> list[dict[str, Any]]:
    """Return what each step of an episode gives, the reset first."""
    begin = dict(zip(("observations", "infos"), env.reset(seed=seed), strict=True))
    return [begin, *rest_of_episode(env, choose)]


def rest_of_episode(env: ParallelSceneEnv, choose: Callable[[str, int], int]) -> list[dict[str, Any]]:
    """Return what each step gives until the episode has ended."""
    seen: list[dict[str, Any]] = []
    while env.agents:
        returned = env.step({agent: choose(agent, len(seen) + 1) for agent in env.agents})
        seen.append(dict(zip(("observations", "rewards", "terminated", "truncated", "infos"), returned, strict=True)))
    return seen


def at_random(seed: int) -> Callable[[str, int], int]:
    rng = np.random.default_rng(seed)
    return lambda agent, step: int(rng.integers(3))


def test_pettingzoo_finds_nothing_wrong(busy: ParallelSceneEnv) -> None:
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        parallel_api_test(busy, num_cycles=120)


def test_a_seed_gives_the_same_episode_whatever_was_before(busy: ParallelSceneEnv) -> None:
    first, following = episode(busy, 3, at_random(0)), episode(busy, None, at_random(1))
    other = episode(busy, 4, at_random(0))
    np.testing.assert_equal(episode(busy, 3, at_random(0)), first)
    np.testing.assert_equal(episode(busy, None, at_random(1)), following)
    assert not np.array_equal(
        first[0]["observations"]["ramp"]["vehicles"], other[0]["observations"]["ramp"]["vehicles"]
    )


@pytest.mark.parametrize("sensor", ["perfect", "noisy_0.1"])
def test_a_single_agent_lives_through_the_episodes_of_a_scene_env(
    user_network: Callable[[str], UserNetwork], sensor: str
) -> None:
    scene = user_network("merge").scene(perceives=("right_of_way", "lane"), time_limit_s=6.0)
    task = TaskSettings(scene, tracks=True, decision_s=0.4, sensor=sensor)
    with closing(ParallelSceneEnv({"only": task})) as shared:
        episodes = [episode(shared, seed, at_random(2)) for seed in (5, None)]
    with closing(SceneEnv(task)) as single:
        for seed, (begin, *steps) in zip((5, None), episodes, strict=True):
            expected = single.reset(seed=seed)
            np.testing.assert_equal((begin["observations"]["only"], begin["infos"]["only"]), expected)
            choose = at_random(2)
            for step in steps:
                np.testing.assert_equal([part["only"] for part in step.values()], single.step(np.int64(choose("", 0))))


def test_agents_see_each_other_where_they_are(env: ParallelSceneEnv) -> None:
    observations, infos = env.reset(seed=0)
    for _ in range(20):
        ways = []
        for agent in env.agents:
            assert infos[agent]["traits"].tolist().count(1) == 1  # the only other one; 0 is the vType car
            ways.append(observations[agent]["vehicles"][infos[agent]["traits"] == 1][0])
        np.testing.assert_allclose(ways[0], -ways[1], atol=1e-6)
        assert np.hypot(*ways[0]) > 0.3
        observations, *_, infos = env.step({"west": 1, "south": STOP})


def test_agents_that_touch_have_both_had_a_collision(env: ParallelSceneEnv) -> None:
    *_, last = episode(env, 0, lambda agent, step: GO)
    assert last["terminated"] == {"west": True, "south": True}
    for agent, info in last["infos"].items():
        assert info["outcome"] == "collision" and info["collision"]["trait"] == "ego"
        assert last["rewards"][agent] == info["reward_terms"]["collision"] == -2.0


def test_an_agent_that_has_arrived_is_gone_and_the_other_goes_on(env: ParallelSceneEnv) -> None:
    env.reset(seed=0)
    while len(env.agents) == 2:
        observations, *_, infos = env.step({"west": GO, "south": STOP})
    assert env.agents == ["south"] and infos["west"]["outcome"] == "success"
    with pytest.raises(InputError, match="actions must be those of south, not west, south"):
        env.step({"west": GO, "south": GO})
    for actions, message in (
        ([GO], r"a mapping with those of south, not \[2\]"),
        (None, "not None"),
        ({0: GO}, "south, not 0"),
    ):
        with pytest.raises(InputError, match=message):
            env.step(actions)  # type: ignore[arg-type]
    while env.agents:
        observations, *_, infos = env.step({"south": GO})
        assert set(observations) == set(infos) == {"south"}
        assert not observations["south"]["mask"].any()
    assert infos["south"]["outcome"] == "success"


def test_a_decision_is_as_many_steps(tasks: dict[str, TaskSettings], env: ParallelSceneEnv) -> None:
    def choose(agent: str, step: int) -> int:
        return STOP if agent == "south" and step > 2 else GO

    decided = {agent: replace(task, decision_s=0.3) for agent, task in tasks.items()}
    with closing(ParallelSceneEnv(decided)) as coarse:
        decisions = episode(coarse, 1, choose)
    steps = episode(env, 1, lambda agent, step: choose(agent, (step + 2) // 3))
    for agent in tasks:
        rewards = [
            sum(one["rewards"][agent] for one in part if agent in one["rewards"]) for part in _parts(steps[1:], 3)
        ]
        found = [one["rewards"][agent] for one in decisions[1:] if agent in one["rewards"]]
        np.testing.assert_allclose(rewards[: len(found)], found)
        assert len(found) > 5
        ends = [one["infos"][agent]["outcome"] for one in (*decisions, *steps) if agent in one["infos"]]
        assert len([end for end in ends if end]) == 2 and len(set(ends)) == 2


def _parts(items: list[Any], size: int) -> list[list[Any]]:
    return [items[first : first + size] for first in range(0, len(items), size)]


def test_after_an_interrupt_it_begins_anew(env: ParallelSceneEnv, monkeypatch: pytest.MonkeyPatch) -> None:
    expected = episode(env, 2, at_random(0))

    def interrupt(_: Any) -> None:
        raise KeyboardInterrupt

    env.reset(seed=0)
    with monkeypatch.context() as patch, pytest.raises(KeyboardInterrupt):
        patch.setattr(env._traffic, "step", interrupt)
        env.step({"west": GO, "south": GO})
    with pytest.raises(InputError, match="reset the environment first"):
        env.step({"west": GO, "south": GO})
    np.testing.assert_equal(episode(env, 2, at_random(0)), expected)


@copies
def test_a_copy_goes_on_like_the_original_which_does_not_notice(copied: Copy, busy: ParallelSceneEnv) -> None:
    busy.reset(seed=3)
    for _ in range(8):
        busy.step(dict.fromkeys(busy.agents, GO))
    with closing(copied(busy)) as twin:
        planned = [rest_of_episode(twin, at_random(4)), episode(twin, None, at_random(5))]
    went_on = [rest_of_episode(busy, at_random(4)), episode(busy, None, at_random(5))]
    np.testing.assert_equal(planned, went_on)
    assert len(went_on[0]) > 5


@copies
def test_a_copy_without_an_episode_is_as_the_original(copied: Copy, tasks: dict[str, TaskSettings]) -> None:
    env = ParallelSceneEnv({"west": replace(tasks["west"], backend="traci")})
    with closing(copied(env)) as new:
        with pytest.raises(InputError, match="no episode has begun"):
            new.step({"west": GO})
        np.testing.assert_equal(new.reset(seed=2), env.reset(seed=2))
    env.close()
    closed = copied(env)
    with pytest.raises(InputError, match="is closed"):
        closed.reset()
    closed.close()


def test_a_closed_one_refuses_everything(tasks: dict[str, TaskSettings]) -> None:
    env = ParallelSceneEnv({"west": tasks["west"]})
    with pytest.raises(InputError, match="no episode has begun"):
        env.step({})
    env.close()
    env.close()
    with pytest.raises(InputError, match="is closed"):
        env.reset()


def test_what_cannot_be_together_is_refused(
    tasks: dict[str, TaskSettings], crossing: Makes, user_network: Callable[[str], UserNetwork]
) -> None:
    west = tasks["west"]
    for other, message in (
        (TaskSettings(), "several egos need a SUMO configuration"),
        (TaskSettings(user_network("merge").scene()), "give their scenes the same config"),
        (TaskSettings(replace(west.scene, warm_up_s=2.0)), "give their scenes the same warm_up_s"),
        (replace(west, decision_s=0.2), "give them the same decision_s"),
        (TaskSettings(crossing("from_south", "to_north", ego_control="sumo")), "leave ego_control out"),
    ):
        with pytest.raises(InputError, match=message):
            ParallelSceneEnv({"west": west, "south": other})
    with pytest.raises(InputError, match="there are no agents"):
        ParallelSceneEnv({})


def test_starts_without_room_are_refused(tasks: dict[str, TaskSettings]) -> None:
    with (
        closing(ParallelSceneEnv({"first": tasks["west"], "same": tasks["west"]})) as env,
        pytest.raises(InputError, match="found no room at its start"),
    ):
        env.reset(seed=0)
