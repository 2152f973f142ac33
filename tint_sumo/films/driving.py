"""Drive one case step by step, and keep all that a film shows."""

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from tint_sumo.envs import SceneEnv
from tint_sumo.methods.evaluation import case_seed
from tint_sumo.methods.loading import Contender
from tint_sumo.policy.network import GruPolicy
from tint_sumo.policy.trait_sources import Frame, OracleTraits, TraitSource, one_hot
from tint_sumo.policy.wrappers import TRAITS, TRUE_TRAITS
from tint_sumo.scenes.geometry import Bools, Boxes, Floats, Numbers
from tint_sumo.simulation.scene import SceneSimulation

_BRAKING_MPS2 = 0.5  # vehicles that slow down by more than this show it


@dataclass(frozen=True)
class Moment:
    """The visible state after a step of the simulation; V vehicle slots, K routes of the traffic."""

    time_s: float
    ego: np.void  # box of the ego
    ego_mps: float
    ego_brakes: bool
    is_held: bool  # the ego's safety check overrides the policy
    present: Bools  # (V,)
    vehicles: Numbers  # (V,) running numbers of the vehicles in the episode, -1 in empty slots
    boxes: Boxes  # (V,)
    brakes: Bools  # (V,)
    traits: Numbers  # (V,) true ones: numbers of profiles, -1 in empty slots
    observed_traits: Floats | None  # (V, Z) traits in the policy's observation
    attention: Floats | None  # (V,)
    claimed: Bools  # (K,)
    desired_mps: float | None  # the policy's action; None before its first
    value: float | None  # return that the policy expected when it chose the action
    outcome: str  # empty until the end


class _Driver:
    """A policy with its recurrent state."""

    def __init__(self, contender: Contender) -> None:
        self._policy = contender.policy
        inner: Any = getattr(contender.policy, "policy", contender.policy)  # a Stable-Baselines3 model holds its policy
        self._network = inner if isinstance(inner, GruPolicy) else None
        self._state: Any = None
        self._starts = np.ones(1, bool)

    def act(self, observation: dict[str, NDArray[Any]], traits: Numbers) -> tuple[int, float | None]:
        """Return the likeliest action, and the expected return."""
        value = None if self._network is None else self._value(self._network, observation, traits)
        actions, self._state = self._policy.predict(
            observation, state=self._state, episode_start=self._starts, deterministic=True
        )
        self._starts = np.zeros(1, bool)
        return int(actions[0]), value

    @torch.no_grad()
    def _value(self, network: GruPolicy, observation: dict[str, NDArray[Any]], traits: Numbers) -> float:
        seen = dict(observation)
        if network.critic_extractor is not None:
            seen[TRUE_TRAITS] = one_hot(traits[None], OracleTraits().size)
        tensors, _ = network.obs_to_tensor(seen)
        device = network.device
        states = network.initial_states(1) if self._state is None else torch.as_tensor(self._state[0], device=device)
        return float(network.predict_values(tensors, states, torch.as_tensor(self._starts, device=device)))

    def attention(self, observation: dict[str, NDArray[Any]]) -> Floats | None:
        """Return the weights of the vehicles (V,); None without a network."""
        return None if self._network is None else self._network.attention_weights(observation)[0].astype(np.float64)


class _Stage:
    """The environment of one case, with the source of the traits in its observation."""

    def __init__(self, contender: Contender, task: dict[str, Any]) -> None:
        source: TraitSource | None = None if contender.source is None else contender.source()
        tracks = source is not None and source.needs_tracks
        self.env = SceneEnv(contender.scene, tracks=tracks, **task)
        self.source = source
        assert isinstance(self.env.simulation, SceneSimulation)  # policies drive in built-in scenes
        self.simulation: SceneSimulation = self.env.simulation
        if source is not None:
            source.attach(1, self.simulation.scene.max_vehicles)

    def begin(self, seed: int) -> None:
        self._take(*self.env.reset(seed=seed), done=True)
        if self.source is not None:
            self.source.begin(self.frame)

    def step(self, action: int) -> None:
        observation, _, terminated, truncated, info = self.env.step(np.int64(action))
        self._take(observation, info, done=terminated or truncated)
        if self.source is not None:
            self.source.advance(self.frame)

    def _take(self, observation: dict[str, NDArray[Any]], info: dict[str, Any], *, done: bool) -> None:
        slots = {key: value[None] for key, value in info.items() if isinstance(value, np.ndarray)}
        self.frame = Frame({key: value[None] for key, value in observation.items()}, slots, np.array([done]))
        self.info = info

    @property
    def observation(self) -> dict[str, NDArray[Any]]:
        """The observation as a batch of one, with the traits."""
        traits = {} if self.source is None else {TRAITS: self.source.traits.copy()}
        return {**self.frame.observation, **traits}


class _Speeds:
    """Speeds between two steps, which show who brakes."""

    def __init__(self, simulation: SceneSimulation) -> None:
        self._simulation = simulation
        self._step_s = simulation.scene.step_s
        self._who = np.full(simulation.scene.max_vehicles, -1)
        self._front_m = np.zeros(len(self._who))
        self._mps = np.full(len(self._who), np.nan)
        self._ego_mps = 0.0

    def brakes(self) -> tuple[Bools, bool]:
        """Return whether the vehicles (V,) and the ego have braked in the last step."""
        slots = self._simulation.slots
        stays = slots.present[0] & (slots.vehicle_number[0] == self._who)
        mps = np.where(stays, (slots.front_m[0] - self._front_m) / self._step_s, np.nan)
        ego_mps = float(self._simulation.egos.speed_mps[0])
        limit_mps = _BRAKING_MPS2 * self._step_s
        brakes, ego_brakes = self._mps - mps > limit_mps, self._ego_mps - ego_mps > limit_mps
        self._who, self._front_m = slots.vehicle_number[0].copy(), slots.front_m[0].copy()
        self._mps, self._ego_mps = mps, ego_mps
        return brakes, ego_brakes


def drive_case(contender: Contender, case: int, seed: int, **task: Any) -> Iterator[Moment]:
    """Yield the beginning and every step of case ``case`` of the set ``seed``; ``task`` as in ``SceneEnv``.

    The case goes as it does in ``tint_sumo.methods.evaluation.evaluate``: the policy decides every
    ``action_repeat`` steps.
    """
    stage, driver = _Stage(contender, task), _Driver(contender)
    speeds = _Speeds(stage.simulation)
    desired_mps = stage.simulation.scene.ego.controller.desired_speeds_mps
    try:
        stage.begin(case_seed(seed, case))
        yield _moment(stage, driver, speeds, None, None)
        step = 0
        while not stage.info["outcome"]:
            if step % contender.action_repeat == 0:
                action, value = driver.act(stage.observation, stage.info["traits"])
            stage.step(action)
            step += 1
            yield _moment(stage, driver, speeds, desired_mps[action], value)
    finally:
        stage.env.close()


def _moment(stage: _Stage, driver: _Driver, speeds: _Speeds, desired_mps: float | None, value: float | None) -> Moment:
    egos, slots, observation = stage.simulation.egos, stage.simulation.slots, stage.observation
    brakes, ego_brakes = speeds.brakes()
    return Moment(
        time_s=stage.info["time_s"],
        ego=egos.box[0].copy(),
        ego_mps=float(egos.speed_mps[0]),
        ego_brakes=ego_brakes,
        is_held=bool(egos.unsafe[0]),
        present=slots.present[0].copy(),
        vehicles=slots.vehicle_number[0].copy(),
        boxes=slots.box[0].copy(),
        brakes=brakes,
        traits=stage.info["traits"].astype(np.int64),
        observed_traits=observation[TRAITS][0].astype(np.float64) if TRAITS in observation else None,
        attention=driver.attention(observation),
        claimed=stage.simulation.yielding.has_claimed[0].copy(),
        desired_mps=desired_mps,
        value=value,
        outcome=stage.info["outcome"],
    )
