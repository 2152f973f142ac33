"""Refused calls of environments, in one line and before anything is done: actions, seeds, masks, wrong phases."""

from collections.abc import Callable, Iterator
from contextlib import closing
from typing import Any

import gymnasium
import numpy as np
import pytest
import torch

from tests.envs.test_environments import ENV_ID, assert_equal
from tint_sumo.core.errors import InputError
from tint_sumo.envs import SceneEnv, SceneVectorEnv, TaskSettings
from tint_sumo.envs.sb3 import SceneVecEnv

INTEGERS: tuple[Any, ...] = (
    *(np.dtype(kind).type for kind in np.typecodes["AllInteger"]),
    int,
    np.array,
    torch.tensor,
    lambda value: torch.tensor(value, dtype=torch.uint8),
)
NO_INTEGERS: tuple[Any, ...] = (
    True,
    np.True_,
    1.0,
    np.float32(2),
    "2",
    None,
    -1,
    3,
    2**70,
    [2],
    [[2]],
    torch.tensor(1.0),
)


@pytest.fixture(scope="module")
def env() -> Iterator[SceneEnv]:
    with closing(SceneEnv(TaskSettings(backend="traci"))) as env:
        yield env


@pytest.fixture(scope="module")
def vector() -> Iterator[SceneVectorEnv]:
    with closing(SceneVectorEnv(2, TaskSettings(backend="traci"), workers=2)) as vector:
        yield vector


@pytest.mark.parametrize("integer", INTEGERS)
def test_integers_of_all_kinds_are_actions_and_seeds(
    integer: Callable[[int], Any], env: SceneEnv, vector: SceneVectorEnv
) -> None:
    first = env.reset(seed=3)[0]
    expected = env.step(2)[0]
    assert_equal(env.reset(seed=integer(3))[0], first)
    assert_equal(env.step(integer(2))[0], expected)
    for seed in (integer(3), [integer(3), 4]):
        assert_equal(vector.reset(seed=seed)[0]["vehicles"][0], first["vehicles"])
    assert_equal(vector.step([integer(2), integer(0)])[0]["vehicles"][0], expected["vehicles"])


def test_arrays_of_integers_of_all_kinds_are_actions(vector: SceneVectorEnv) -> None:
    vector.reset(seed=np.array([1, 2]))
    arrays: list[Any] = [np.array([2, 0], kind) for kind in np.typecodes["AllInteger"]]
    arrays += [[2, 0], (2, 0), torch.tensor([2, 0]), torch.tensor([2, 0], dtype=torch.int8)]
    for actions in arrays:
        infos = vector.step(actions)[-1]
    assert infos["time_s"].tolist() == pytest.approx([0.1 * len(arrays)] * 2)


@pytest.mark.parametrize("action", NO_INTEGERS)
def test_a_refused_action_does_nothing(action: Any, env: SceneEnv, vector: SceneVectorEnv) -> None:
    env.reset(seed=0), vector.reset(seed=0)
    env.step(2), vector.step(np.array([2, 2]))
    before, all_before = env.snapshot(), vector.snapshot()
    with pytest.raises(InputError, match=r"^an action must be one of 0, 1, 2, not [^\n]*$"):
        env.step(action)
    for actions in ([action, 2], [action, action], action, [action]):
        with pytest.raises(InputError, match=r"^actions must be 2 of 0, 1, 2, not [^\n]*$"):
            vector.step(actions)  # type: ignore[arg-type]
    assert env.snapshot() == before
    assert vector.snapshot() == all_before
    assert env.step(1)[-1]["time_s"] == vector.step(np.array([1, 1]))[-1]["time_s"][1] == pytest.approx(0.2)


@pytest.mark.parametrize(
    "actions", [np.ones(2), np.ones(2, bool), np.ones(3, int), np.ones((2, 1), int), [[1], [1, 2]]]
)
def test_refused_arrays_of_actions(actions: Any, vector: SceneVectorEnv) -> None:
    vector.reset(seed=0)
    with pytest.raises(InputError, match=r"^actions must be 2 of 0, 1, 2, not [^\n]*$"):
        vector.step(actions)
    assert vector.step(np.array([1, 1]))[-1]["time_s"].tolist() == [0.1, 0.1]


@pytest.mark.parametrize("seed", [True, np.True_, 1.0, "3", -1, np.array([[1]]), torch.tensor(True)])
def test_refused_seeds(seed: Any, env: SceneEnv, vector: SceneVectorEnv) -> None:
    env.reset(seed=0), vector.reset(seed=0)
    for reset in (lambda: env.reset(seed=seed), lambda: vector.reset(seed=[seed, 1])):
        with pytest.raises(InputError, match=r"^a seed must be an integer of at least 0, not "):
            reset()
    with pytest.raises(InputError, match=r"a seed must be|1 seeds do not fit 2 environments"):
        vector.reset(seed=seed)
    env.step(2), vector.step(np.array([2, 2]))


@pytest.mark.parametrize(
    "mask", [[True], [True] * 3, [1, 0], [[True, False]], "no", True, [False] * 2, np.array(["a", "b"])]
)
def test_refused_masks(mask: Any, vector: SceneVectorEnv) -> None:
    vector.reset(seed=0)
    vector.step(np.array([2, 2]))
    with pytest.raises(
        InputError, match=r"^reset_mask must be 2 booleans, one for each environment, at least one of them true; not "
    ):
        vector.reset(options={"reset_mask": mask})
    vector.reset(options={"reset_mask": [True, False]})
    assert [one.actions for one in vector.snapshot()] == [(), (2,)]


def test_stable_baselines3s_environment_takes_numpys_seeds_and_refuses_bad_actions_and_options() -> None:
    with closing(SceneVectorEnv(2)) as vector:
        expected = vector.reset(seed=5)[0]
    with closing(SceneVecEnv(2, seed=np.int64(5))) as venv:  # type: ignore[arg-type]
        assert_equal(venv.reset(), expected)
        with pytest.raises(InputError, match="actions must be 2 of 0, 1, 2"):
            venv.step(np.array([True, True]))
        for options in ({"case": 1}, [{}, {"case": 1}]):
            with pytest.raises(InputError, match="there is no reset option 'case'; this environment knows none"):
                venv.set_options(options)
        venv.set_options()
        venv.step(np.array([2, 2]))


MAKE: dict[str, Callable[[], Any]] = {
    "single": SceneEnv,
    "vector": lambda: SceneVectorEnv(2),
    "workers": lambda: SceneVectorEnv(2, workers=2),
    "stable-baselines3": lambda: SceneVecEnv(2),
}
TWO = np.array([2, 2])
CALLS: dict[str, Callable[[Any], Any]] = {
    "reset": lambda env: env.reset(),
    "step": lambda env: env.step(2 if isinstance(env, SceneEnv) else TWO),
    "snapshot": lambda env: env.snapshot(),
    "render": lambda env: env.get_images() if isinstance(env, SceneVecEnv) else env.render(),
    "park": lambda env: env.env_method("park") if isinstance(env, SceneVecEnv) else env.park(TWO > 0),
    "simulation": lambda env: env.simulation,
}


@pytest.mark.parametrize("kind", MAKE)
def test_the_wrong_moments(kind: str) -> None:
    env = MAKE[kind]()
    calls = {name for name in CALLS if name != "simulation" or kind == "single"}
    calls -= {"park"} if kind == "single" else set()
    for name in calls - {"reset", "simulation"}:
        with pytest.raises(InputError, match=r"^no episode has begun; reset the environment first$"):
            CALLS[name](env)
    env.reset()
    snapshot = env.snapshot()
    env.close()
    env.close()
    with closing(SceneEnv(TaskSettings(backend="libsumo"))) as other:  # libsumo is free again
        other.reset(seed=0)
        for name in calls:
            with pytest.raises(InputError, match=r"^the environment is closed; make a new one$"):
                CALLS[name](env)
        with pytest.raises(InputError, match=r"^the environment is closed; make a new one$"):
            env.restore(snapshot)
        env.close()
        other.step(2)


def test_an_environment_that_was_made_by_gymnasium_says_that_it_is_closed() -> None:
    env = gymnasium.make(ENV_ID)
    env.reset(seed=0)
    env.close()
    for call in (env.reset, lambda: env.step(2)):
        with pytest.raises(InputError, match=r"^the environment is closed; make a new one$"):
            call()


def test_a_mask_needs_episodes_that_have_begun() -> None:
    with closing(SceneVectorEnv(2)) as vector:
        with pytest.raises(InputError, match="no episode has begun"):
            vector.reset(options={"reset_mask": np.array([True, False])})
        vector.reset(options={"reset_mask": np.array([True, True])})


@pytest.mark.parametrize("options", [{"resetmask": np.array([True, False])}, {1: 2}, ["reset_mask"], "reset_mask"])
def test_unknown_options_of_a_reset_are_refused(options: Any, env: SceneEnv, vector: SceneVectorEnv) -> None:
    with pytest.raises(InputError, match=r"option.*this environment knows none") as refused:
        env.reset(options=options)
    assert "\n" not in str(refused.value)
    with pytest.raises(InputError, match=r"option.*known are: reset_mask"):
        vector.reset(options=options)


def test_a_reset_without_options_may_say_so(env: SceneEnv, vector: SceneVectorEnv) -> None:
    """As gymnasium's checker and its vector environments do."""
    first = env.reset(seed=3)[0]
    assert_equal(env.reset(seed=3, options={})[0], first)
    assert_equal(vector.reset(seed=3, options={})[0], vector.reset(seed=3)[0])


@pytest.mark.parametrize("count", [0, -1, 2.0, True, None, "2", 10**9, np.float64(2)])
def test_refused_numbers_of_environments(count: Any) -> None:
    with pytest.raises(InputError, match=r"^num_envs must (be an integer|lie in 1 to 100,000), not"):
        SceneVectorEnv(count)
    if count is not None:
        with pytest.raises(InputError, match=r"^workers must (be an integer|lie in 1 to 2), not"):
            SceneVectorEnv(2, workers=count)


def test_numpys_integers_are_numbers_of_environments() -> None:
    with closing(SceneVectorEnv(np.int64(2), workers=np.int8(1))) as vector:
        assert type(vector.num_envs) is int


@pytest.mark.parametrize("snapshot", [None, "x", {}, 3])
def test_what_is_no_snapshot_is_refused_and_the_episode_goes_on(
    snapshot: Any, env: SceneEnv, vector: SceneVectorEnv
) -> None:
    for one, bad in ((env, snapshot), (vector, snapshot), (vector, [snapshot] * 2)):
        one.reset(seed=3)
        with pytest.raises(InputError, match=r"^what snapshot\(\) has returned can be restored, not"):
            one.restore(bad)
        one.restore(one.snapshot())


@pytest.mark.parametrize("seed", [True, "x", 1.0, -1])
def test_stable_baselines3s_environment_refuses_bad_seeds(seed: Any) -> None:
    with pytest.raises(InputError, match=r"^a seed must be an integer"):
        SceneVecEnv(1, seed=seed)
