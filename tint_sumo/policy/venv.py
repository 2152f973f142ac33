"""The environments a policy is trained and tested in: a scene, traits in its observations, decisions now and then."""

import copy
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

from stable_baselines3.common.vec_env import VecEnv, VecEnvWrapper, VecMonitor

from tint_sumo.envs.batch import Snapshot
from tint_sumo.envs.sb3 import SceneVecEnv
from tint_sumo.policy.action_repeat import ActionRepeat
from tint_sumo.policy.trait_observation import TRUE_TRAITS, TraitObservation
from tint_sumo.policy.trait_sources import OracleTraits, TraitSource
from tint_sumo.scenes import SumocfgScene


def policy_venv(
    num_envs: int,
    source: TraitSource | None,
    *,
    action_repeat: int = 1,
    critic_sees_true_traits: bool = False,
    monitored: bool = False,
    **task: Any,
) -> VecEnv:
    """``num_envs`` environments of a scene, with what a policy needs around them.

    Args:
        num_envs: number of environments.
        source: where the traits in the observations come from; None leaves them out.
        action_repeat: simulation steps per decision.
        critic_sees_true_traits: observe the true traits, too, under a key of their own.
        monitored: count steps and rewards of each episode for Stable-Baselines3's logger.
        task: as in ``tint_sumo.envs.scene_env.SceneEnv``.
    """
    if isinstance(task.get("scene"), SumocfgScene):  # one simulation per process
        task["scene"] = [task["scene"]] * num_envs
    venv: VecEnv = SceneVecEnv(num_envs, tracks=source is not None and source.needs_tracks, **task)
    if source is not None:
        venv = TraitObservation(venv, source)
    if critic_sees_true_traits:
        venv = TraitObservation(venv, OracleTraits(), TRUE_TRAITS)
    return ActionRepeat(VecMonitor(venv) if monitored else venv, action_repeat)


@dataclass(frozen=True)
class VenvSnapshot:
    """Where environments made by ``policy_venv`` are, and what is remembered around them."""

    episodes: list[Snapshot]
    memories: list[dict[str, Any]]  # of each wrapper, from the outermost inwards


def snapshot(venv: VecEnv) -> VenvSnapshot:
    """What ``restore`` needs to come back to where the environments of ``policy_venv`` are, between two decisions."""
    *_, base = _layers(venv)
    assert isinstance(base, SceneVecEnv)
    return VenvSnapshot(base.snapshot(), memories(venv))


def memories(venv: VecEnv) -> list[dict[str, Any]]:
    """Return a copy of what the wrappers of ``policy_venv`` remember, from the outermost inwards."""
    *wrappers, _ = _layers(venv)
    return copy.deepcopy([_memory(wrapper) for wrapper in wrappers])


def restore(venv: VecEnv, there: VenvSnapshot) -> None:
    """Go to where environments were that were made with the same arguments; they then go on as those did."""
    *wrappers, base = _layers(venv)
    assert isinstance(base, SceneVecEnv)
    base.restore(there.episodes)
    for wrapper, saved in zip(wrappers, there.memories, strict=True):
        for name, array in _memory(wrapper).items():
            array[...] = saved[name]


def _layers(venv: VecEnv) -> Iterator[VecEnv]:
    while isinstance(venv, VecEnvWrapper):
        yield venv
        venv = venv.venv
    yield venv


def _memory(wrapper: VecEnv) -> dict[str, Any]:
    """The arrays and tensors in which a wrapper holds what it knows of the present episodes, by name."""
    if isinstance(wrapper, TraitObservation):
        return wrapper.source.memory()
    if isinstance(wrapper, VecMonitor):
        return {"returns": wrapper.episode_returns, "lengths": wrapper.episode_lengths}
    return {}
