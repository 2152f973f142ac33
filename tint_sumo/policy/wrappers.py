"""The environments of policies in training and tests: a scene, traits in observations, a decision for several steps."""

import copy
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from gymnasium import spaces
from stable_baselines3.common.vec_env import VecEnv, VecEnvWrapper, VecMonitor
from stable_baselines3.common.vec_env.base_vec_env import VecEnvObs, VecEnvStepReturn

from tint_sumo.core.errors import InputError
from tint_sumo.envs.batch import Snapshot
from tint_sumo.envs.episodes import TaskSettings
from tint_sumo.envs.rows import COST
from tint_sumo.envs.sb3 import SceneVecEnv
from tint_sumo.policy.trait_sources import Frame, Observation, OracleTraits, TraitSource, WithMotion
from tint_sumo.scenes import require_trait_steps

TRAITS, TRUE_TRAITS = "traits", "true_traits"
_NEEDED = frozenset({"ego", "vehicles", "mask"})
_STOP = 0  # action of an episode that began within a decision

OnStep = Callable[[Observation, list[dict[str, Any]]], None]  # takes observations, arrays (N, ...), and N infos


class TraitObservation(VecEnvWrapper):
    """Wrapper that adds traits, (V, size) under a key, to the observations of a scene, terminal ones included.

    Args:
        venv: a ``tint_sumo.envs.sb3.SceneVecEnv``, or a wrapper around one.
        source: of the traits; for this environment only.
        key: ``"traits"``, or ``"true_traits"`` for those that only a critic may see.

    Raises:
        InputError: the environment does not observe ego, vehicles and mask, or has no tracks, which the source takes.
    """

    def __init__(self, venv: VecEnv, source: TraitSource, key: str = TRAITS) -> None:
        if not isinstance(venv.observation_space, spaces.Dict) or not set(venv.observation_space.spaces) >= _NEEDED:
            raise InputError(
                f"traits belong to observations with {', '.join(sorted(_NEEDED))}, as a scene's; "
                f"this environment's space is {venv.observation_space}"
            )
        *_, base = _layers(venv)
        if source.needs_tracks and isinstance(base, SceneVecEnv) and "position_m" not in base.env.contents.slot_infos:
            raise InputError("these traits need tracks; make the environment with TaskSettings(tracks=True)")
        slots = venv.observation_space["mask"].shape
        assert slots is not None
        space = trait_space(slots[0], source.size)
        super().__init__(venv, spaces.Dict({**venv.observation_space.spaces, key: space}))
        self.source = source
        self.key = key
        source.attach(venv.num_envs, slots[0])

    def reset(self) -> Observation:
        observation = _dictionary(self.venv.reset())
        self.reset_infos = self.venv.reset_infos  # a wrapper around this one reads them
        self.source.begin(Frame(observation, self._slots(), np.ones(self.num_envs, bool)))
        return self._with_traits(observation)

    def step_wait(self) -> VecEnvStepReturn:
        fresh, rewards, done, infos = self.venv.step_wait()
        observation, slots = _dictionary(fresh), self._slots()
        ended = np.flatnonzero(done).tolist()
        last = {env: infos[env]["terminal_observation"] for env in ended}
        last_slots = {env: infos[env]["terminal_slots"] for env in ended}
        self.source.advance(Frame(_continued(observation, last), _continued(slots, last_slots), done))
        for env in ended:
            infos[env]["terminal_observation"][self.key] = self.source.traits[env].copy()
        if len(ended):
            self.source.begin(Frame(observation, slots, done))
        return self._with_traits(observation), rewards, done, infos

    def _slots(self) -> dict[str, np.ndarray]:
        slots: dict[str, np.ndarray] = self.venv.slots  # type: ignore[attr-defined]  # a wrapper asks what it wraps
        return slots

    def _with_traits(self, observation: Observation) -> Observation:
        return {**observation, self.key: self.source.traits.copy()}


def trait_space(max_vehicles: int, size: int) -> spaces.Box:
    """Return the space of the traits of all slots, with so many numbers each."""
    return spaces.Box(-np.inf, np.inf, (max_vehicles, size), np.float32)


def _continued(arrays: dict[str, np.ndarray], last: dict[int, dict[str, np.ndarray]]) -> dict[str, np.ndarray]:
    """Return arrays (N, ...) with the last values of ended episodes in place of their successors' first ones."""
    if not last:
        return arrays
    continued = {key: values.copy() for key, values in arrays.items()}
    for env, values in last.items():
        for key, array in continued.items():
            array[env] = values[key]
    return continued


def _dictionary(observation: Any) -> Observation:
    assert isinstance(observation, dict)
    return observation


class ActionRepeat(VecEnvWrapper):
    """Wrapper that takes each action for ``repeat`` steps and returns the sum of their rewards, terms and costs.

    An episode that ends within a decision ends the decision; the next episode then waits, with desired speed 0, for
    the rest of it. The controller and its safety check go on working at every step.

    It differs from the environments' ``decision_s`` in two ways, and trainings depend on both. The wrapped environments
    go step by step, so that traits are inferred at each of them; an environment with ``decision_s`` shows only the
    state after the decision. And with ``decision_s`` the next episode begins when the decision is over, and does not
    wait.

    Args:
        venv: the environments.
        repeat: number of steps.
        on_step: called after each reset of all environments and after each of the steps. Where an episode ends, the
            observation is its last one.

    Raises:
        InputError: ``repeat`` is less than 1.
    """

    def __init__(self, venv: VecEnv, repeat: int, on_step: OnStep | None = None) -> None:
        if repeat < 1:
            raise InputError(f"an action is taken for at least 1 step, not {repeat}")
        super().__init__(venv)
        self.repeat = repeat
        self._on_step = on_step
        self._actions = np.zeros(venv.num_envs, np.int64)

    def reset(self) -> VecEnvObs:
        observation = self.venv.reset()
        if self._on_step is not None:
            self._on_step(_dictionary(observation), self.venv.reset_infos)
        return observation

    def step_async(self, actions: np.ndarray) -> None:
        self._actions = np.asarray(actions)

    def step_wait(self) -> VecEnvStepReturn:
        total = np.zeros(self.num_envs, np.float32)
        ended = np.zeros(self.num_envs, bool)
        last: list[dict[str, Any]] = [{} for _ in range(self.num_envs)]
        for _ in range(self.repeat):
            observation, rewards, done, infos = self.venv.step(np.where(ended, _STOP, self._actions))
            total += np.where(ended, 0.0, rewards)
            for index in np.flatnonzero(~ended):
                _add_up(infos[index], last[index])
                last[index] = infos[index]
            ended |= done
            if self._on_step is not None:
                terminal = {env: infos[env]["terminal_observation"] for env in np.flatnonzero(done).tolist()}
                self._on_step(_continued(_dictionary(observation), terminal), infos)
        return observation, total, ended, last


def _add_up(info: dict[str, Any], before: dict[str, Any]) -> None:
    """Add to the info of a step what the decision's earlier steps, if any, have cost and been rewarded."""
    if COST in info:
        info[COST] += before.get(COST, 0.0)
    for term, value in before.get("reward_terms", {}).items():
        info["reward_terms"][term] += value


def source_of(venv: VecEnv) -> TraitSource | None:
    """Return the source of the traits in the observations of vectorised environments; None if these have no traits."""
    while isinstance(venv, VecEnvWrapper):
        if isinstance(venv, TraitObservation) and venv.key == TRAITS:
            return venv.source.inner if isinstance(venv.source, WithMotion) else venv.source
        venv = venv.venv
    return None


def policy_venv(
    num_envs: int,
    source: TraitSource | None,
    settings: Sequence[TaskSettings],
    *,
    action_repeat: int = 1,
    critic_sees_true_traits: bool = False,
    monitored: bool = False,
    on_step: OnStep | None = None,
) -> VecEnv:
    """Return ``num_envs`` environments of a scene with the wrappers that a policy needs.

    Args:
        num_envs: number of environments.
        source: of the traits in the observations; None leaves them out.
        settings: of all environments; of several, each has a process for itself, and an equal share of them.
        action_repeat: simulation steps per decision.
        critic_sees_true_traits: observe the true traits, too, under another key.
        monitored: count steps and rewards of each episode for Stable-Baselines3's logger.
        on_step: called with every step of the simulation, as in ``ActionRepeat``; the environments then show the end of
            an episode until they are parked or reset.

    Raises:
        InputError: the source takes tracks, and a scene has steps of another length than those that traits are
            inferred in.
    """
    tracks = source is not None and source.needs_tracks
    for task in settings if tracks else ():
        require_trait_steps(task.scene)
    seen = [replace(task, tracks=tracks) for task in settings]
    if seen[0].scene.sumocfg:  # one simulation per process
        seen *= num_envs
    venv: VecEnv = SceneVecEnv(num_envs, seen, autoreset=on_step is None)
    if source is not None:
        venv = TraitObservation(venv, source)
    if critic_sees_true_traits:
        venv = TraitObservation(venv, OracleTraits(), TRUE_TRAITS)
    return ActionRepeat(VecMonitor(venv) if monitored else venv, action_repeat, on_step)


@dataclass(frozen=True)
class VenvSnapshot:
    """State of environments made by ``policy_venv`` and of their wrappers."""

    episodes: list[Snapshot]
    memories: list[dict[str, Any]]  # of each wrapper, from the outermost inwards


def snapshot(venv: VecEnv) -> VenvSnapshot:
    """Return the state of the environments of ``policy_venv`` between two decisions, for ``restore``."""
    *_, base = _layers(venv)
    assert isinstance(base, SceneVecEnv)
    return VenvSnapshot(base.snapshot(), memories(venv))


def memories(venv: VecEnv) -> list[dict[str, Any]]:
    """Return a copy of all that the wrappers of ``policy_venv`` know, from the outermost inwards."""
    *wrappers, _ = _layers(venv)
    return copy.deepcopy([_memory(wrapper) for wrapper in wrappers])


def restore(venv: VecEnv, saved: VenvSnapshot) -> None:
    """Bring environments to the state of others that were made with the same arguments; they go on as those did."""
    *wrappers, base = _layers(venv)
    assert isinstance(base, SceneVecEnv)
    base.restore(saved.episodes)
    for wrapper, memory in zip(wrappers, saved.memories, strict=True):
        for name, array in _memory(wrapper).items():
            array[...] = memory[name]


def _layers(venv: VecEnv) -> Iterator[VecEnv]:
    while isinstance(venv, VecEnvWrapper):
        yield venv
        venv = venv.venv
    yield venv


def _memory(wrapper: VecEnv) -> dict[str, Any]:
    """Return the arrays and tensors with all that a wrapper knows of the present episodes, by name."""
    if isinstance(wrapper, TraitObservation):
        return wrapper.source.memory()
    if isinstance(wrapper, VecMonitor):
        return {"returns": wrapper.episode_returns, "lengths": wrapper.episode_lengths}
    return {}
