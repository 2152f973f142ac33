"""Drive one case step by step, and keep all that a film shows."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from stable_baselines3.common.vec_env import VecEnv

from tint_sumo.envs import TaskSettings
from tint_sumo.envs.batch import LocalBatch
from tint_sumo.envs.sb3 import SceneVecEnv
from tint_sumo.methods.evaluation import Case, evaluate
from tint_sumo.methods.loading import Contender
from tint_sumo.policy.network import GruPolicy
from tint_sumo.policy.trait_sources import NeighbourTraits, Observation, OracleTraits, one_hot
from tint_sumo.policy.wrappers import TRAITS, TRUE_TRAITS, source_of
from tint_sumo.scenes.geometry import Bools, Boxes, Floats, Numbers
from tint_sumo.scenes.scene import Building
from tint_sumo.scenes.sumocfg import SumocfgScene
from tint_sumo.simulation import SceneSimulation, Simulation
from tint_sumo.traits.relative import TownEstimate

_BRAKING_MPS2 = 0.5  # vehicles that slow down by more than this show it


@dataclass(frozen=True)
class Moment:
    """The visible state after a step of the simulation; V vehicle slots, K routes of the traffic."""

    time_s: float
    ego: np.void  # box of the ego
    ego_mps: float
    ego_brakes: bool
    is_held: bool  # the ego's safety check overrides the policy
    present: Bools  # (V,) of the simulation's slots, as all (V,)
    seen: Bools  # (V,) which of them the ego perceives
    vehicles: Numbers  # (V,) running numbers of the vehicles in the episode, -1 in empty slots
    boxes: Boxes  # (V,)
    bodies: Mapping[int, Boxes]  # pieces (P,) of vehicles that bend, by their slots
    pedestrians: Boxes  # (P,) persons on foot
    brakes: Bools  # (V,)
    traits: Numbers  # (V,) true ones: numbers of profiles, -1 in empty slots
    observed_traits: Floats | None  # (V, Z) traits in the policy's observation; None where it has none
    attention: Floats | None  # (V,)
    town: TownEstimate | None  # of policies that compare the drivers of a town
    claimed: Bools  # (K,); of no routes in a SUMO configuration
    desired_mps: float | None  # the policy's action; None before its first, and where SUMO's driver drives
    value: float | None  # return that the policy expected when it chose the action
    outcome: str  # empty until the end


@dataclass(frozen=True)
class Driven:
    """A case and its moments, the beginning first."""

    case: Case
    moments: tuple[Moment, ...]
    origin_m: tuple[float, float] = (0.0, 0.0)  # position of the scene's origin in the network
    buildings: tuple[Building, ...] = ()


def drive_case(contender: Contender, case: int, case_set: int, task: TaskSettings) -> Driven:
    """Evaluate a policy on case ``case`` of a case set, and keep every step of the simulation.

    Args:
        contender: the policy.
        case: number of the case, as in ``tint_sumo.methods.evaluation.evaluate``.
        case_set: number of the case set.
        task: settings of the environment.
    """
    recorder = _Recorder(contender)

    def make_venv(num_envs: int) -> VecEnv:
        venv = contender.make_venv(num_envs, task, on_step=recorder.record)
        recorder.attach(venv)
        return venv

    evaluation = evaluate(recorder, make_venv, 1, case_set, first=case)
    return Driven(evaluation.cases[0], tuple(recorder.moments), recorder.origin_m, recorder.buildings)


class _Recorder:
    """A contender's policy that keeps the moments of the first episode of its one environment."""

    def __init__(self, contender: Contender) -> None:
        self._policy = contender.policy
        inner: Any = getattr(contender.policy, "policy", contender.policy)  # a Stable-Baselines3 model holds its policy
        self._observed: NDArray[np.int16] = np.zeros(0, np.int16)  # true traits of the observation's slots
        self._network = inner if isinstance(inner, GruPolicy) else None
        self._desired_mps: float | None = None
        self._value: float | None = None
        self.moments: list[Moment] = []
        self.origin_m = (0.0, 0.0)
        self.buildings: tuple[Building, ...] = ()

    def attach(self, venv: VecEnv) -> None:
        """Look at the simulation of these environments from now on."""
        base = venv.unwrapped
        assert isinstance(base, SceneVecEnv) and isinstance(base.env.batch, LocalBatch)
        simulation = base.env.batch.episodes.simulation
        self._simulation = simulation
        source = source_of(venv)
        self._neighbours = source if isinstance(source, NeighbourTraits) else None
        self._episodes = base.env.batch.episodes
        self._speeds = _Speeds(simulation)

    def predict(
        self,
        observation: Observation,
        state: Any = None,
        episode_start: NDArray[np.bool_] | None = None,
        deterministic: bool = False,
    ) -> tuple[NDArray[Any], Any]:
        """Return the policy's actions and state, as ``Policy.predict`` does."""
        if self._network is not None and episode_start is not None:
            self._value = self._predict_value(self._network, observation, state, episode_start)
        actions, state = self._policy.predict(
            observation, state=state, episode_start=episode_start, deterministic=deterministic
        )
        scene = self._simulation.scene
        if not isinstance(scene, SumocfgScene) or scene.ego_control == "speed":
            self._desired_mps = scene.ego.controller.desired_speeds_mps[int(actions[0])]
        return actions, state

    @torch.no_grad()
    def _predict_value(
        self, network: GruPolicy, observation: Observation, state: Any, starts: NDArray[np.bool_]
    ) -> float:
        seen = dict(observation)
        if network.critic_extractor is not None:
            seen[TRUE_TRAITS] = one_hot(self._observed[None], OracleTraits().size)
        tensors, _ = network.obs_to_tensor(seen)
        device = network.device
        states = network.initial_states(1) if state is None else torch.as_tensor(state[0], device=device)
        return float(network.predict_values(tensors, states, torch.as_tensor(starts, device=device)))

    def record(self, observation: Observation, infos: list[dict[str, Any]]) -> None:
        """Keep the moment after a step, until the episode has ended."""
        if self.moments and self.moments[-1].outcome:
            return
        simulation, (info,) = self._simulation, infos
        self.origin_m, self.buildings = simulation.origin_m, simulation.buildings
        egos, slots = simulation.egos, simulation.slots
        brakes, ego_brakes = self._speeds.brakes()
        attention = None if self._network is None else self._network.attention_weights(observation)[0]
        self._observed = info["traits"]
        self.moments.append(
            Moment(
                time_s=len(self.moments) * simulation.scene.step_s,
                ego=egos.box[0].copy(),
                ego_mps=float(egos.speed_mps[0]),
                ego_brakes=ego_brakes,
                is_held=bool(egos.unsafe[0]),
                present=slots.present[0].copy(),
                seen=self._episodes.sensing(0).seen[0].copy(),
                vehicles=slots.vehicle_number[0].copy(),
                boxes=slots.box[0].copy(),
                bodies=simulation.bodies,
                pedestrians=simulation.pedestrians.copy(),
                brakes=brakes,
                traits=simulation.traits()[0],
                observed_traits=self._by_vehicle(observation[TRAITS][0]) if TRAITS in observation else None,
                attention=None if attention is None else self._by_vehicle(attention),
                town=None if self._neighbours is None else self._neighbours.town(0),
                claimed=_claimed(simulation),
                desired_mps=self._desired_mps,
                value=self._value,
                outcome=info.get("outcome", ""),  # the info of a reset has none
            )
        )

    def _by_vehicle(self, observed: NDArray[np.floating]) -> Floats:
        """Return values of the observation's slots (V, ...) in the simulation's slots, 0 where none belongs."""
        slot = self._episodes.rows["slot"][0]
        placed = np.zeros(observed.shape)
        placed[slot[slot >= 0]] = observed[slot >= 0]
        return placed


def _claimed(simulation: Simulation) -> Bools:
    """Return which routes (K,) the ego claims."""
    if isinstance(simulation, SceneSimulation):
        return np.array(simulation.yielding.has_claimed[0])
    return np.zeros(0, bool)


class _Speeds:
    """Finds the vehicles that brake, from their positions at each step."""

    def __init__(self, simulation: Simulation) -> None:
        self._simulation = simulation
        self._step_s = simulation.scene.step_s
        self._who = np.full(simulation.scene.max_vehicles, -1)
        self._front_m = np.zeros(len(self._who))
        self._mps = np.full(len(self._who), np.nan)
        self._ego_mps = 0.0

    def brakes(self) -> tuple[Bools, bool]:
        """Return whether the vehicles (V,) braked in the step just made, and whether the ego did."""
        slots = self._simulation.slots
        stays = slots.present[0] & (slots.vehicle_number[0] == self._who)
        mps = np.where(stays, (slots.front_m[0] - self._front_m) / self._step_s, np.nan)
        ego_mps = float(self._simulation.egos.speed_mps[0])
        limit_mps = _BRAKING_MPS2 * self._step_s
        brakes, ego_brakes = self._mps - mps > limit_mps, self._ego_mps - ego_mps > limit_mps
        self._who, self._front_m = slots.vehicle_number[0].copy(), slots.front_m[0].copy()
        self._mps, self._ego_mps = mps, ego_mps
        return brakes, ego_brakes
