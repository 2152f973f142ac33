"""Several egos in one SUMO configuration, as PettingZoo's parallel environments have agents."""

from collections.abc import Mapping, Sequence
from copy import copy
from dataclasses import replace
from functools import cached_property
from typing import Any

import numpy as np
from gymnasium import spaces
from gymnasium.utils import seeding
from pettingzoo import ParallelEnv

from tint_sumo.core.errors import InputError, shown
from tint_sumo.envs.calls import Calls, Phase, checked_actions, checked_seed
from tint_sumo.envs.episodes import Episodes, TaskSettings, action_space, checked_settings, episode_seed
from tint_sumo.envs.rows import GOING_ON, Observation, fields_of, observation_of, start_info, step_info
from tint_sumo.scenes import SumocfgScene
from tint_sumo.scenes.replay import ReplayScene
from tint_sumo.simulation import SharedTraffic

Decision = dict[str, np.ndarray]  # action (1,) of each agent that goes on, by its name
_SHARED = ("config", "warm_up_s", "warm_up_spread_s", "warm_starts")  # fields in which the scenes of all agents agree


class ParallelSceneEnv(ParallelEnv):  # type: ignore[misc]  # PettingZoo has no types to check
    """Egos that meet in the traffic of one SUMO configuration; each drives along a route of its own.

    ## Description
    Each agent is an ego as in ``SceneEnv``, with its task in its ``TaskSettings``: a scene that ``from_sumocfg`` makes
    of the same configuration, sensor, reward and time limit. To an agent the others are vehicles: they are in its
    observation, its safety check brakes for them, touching one is a collision of both, and SUMO's drivers meet all of
    them by SUMO's rules. The egos appear at the same time; one for which there is no room yet lets the others wait.

    ## Spaces, rewards and infos
    Those of ``SceneEnv`` for each agent. In `traits`, other egos have the number after the last of `scene.vtypes`; in
    `collision`, `trait` is `"ego"` after a collision with one.

    ## Episode End
    An agent whose episode ends, as in ``SceneEnv``, leaves ``agents``, and its vehicle the roads. The others go on.

    ## Seeds
    ``reset(seed=...)`` determines traffic and sensors to the last bit. Without a seed the next episode follows.

    ## Copies
    As those of ``SceneEnv``: ``copy.deepcopy`` and pickles make independent environments in the same state.

    Args:
        tasks: settings of each agent, by its name, with the same ``decision_s`` and ``backend``.

    Raises:
        InputError: there are no agents, or their settings do not fit each other.
    """

    metadata = {"name": "tint_sumo/ParallelScene-v0", "render_modes": [], "is_parallelizable": True}  # noqa: RUF012
    render_mode = None

    def __init__(self, tasks: Mapping[str, TaskSettings]) -> None:
        _require_fitting(tasks)
        self.possible_agents = list(tasks)
        self.agents: list[str] = []
        self.observation_spaces: dict[str, spaces.Space[Any]] = {}
        self.action_spaces: dict[str, spaces.Space[Any]] = {}
        for agent, task in tasks.items():
            self.observation_spaces[agent] = task.observation_space
            self.action_spaces[agent] = action_space(task.played)
        self._steps_per_decision = next(iter(tasks.values())).steps_per_decision
        # A decision's steps are taken here, in all episodes one after the other.
        self._tasks = {
            agent: replace(task, decision_s=None, max_episode_steps=None, time_limit_s=task.played.time_limit_s)
            for agent, task in tasks.items()
        }
        self._np_random = seeding.np_random()[0]
        self._began: dict[str, Any] = {}  # state of the generator before the present episode
        self._decisions: list[Decision] = []  # of the present episode
        self._calls = Calls()
        self._traffic = self._make_traffic()

    def _make_traffic(self) -> SharedTraffic:
        first = next(iter(self._tasks.values()))
        return SharedTraffic([_scene_of(task) for task in self._tasks.values()], first.backend)

    @cached_property
    def _traffic(self) -> SharedTraffic:
        """The running simulation; started when it is needed in a copy, or after a call that was interrupted."""
        self._calls.require_open()
        return self._make_traffic()

    @cached_property
    def _episodes(self) -> dict[str, Episodes]:
        """The agents' episodes in the running simulation."""
        return {
            agent: Episodes(1, [task], simulation=view)
            for (agent, task), view in zip(self._tasks.items(), self._traffic.views, strict=True)
        }

    def _stop(self) -> None:
        """End the simulation, if one runs."""
        self.__dict__.pop("_episodes", None)
        if "_traffic" in self.__dict__:
            self._traffic.close()
            del self._traffic

    def observation_space(self, agent: str) -> spaces.Space[Any]:
        return self.observation_spaces[agent]

    def action_space(self, agent: str) -> spaces.Space[Any]:
        return self.action_spaces[agent]

    def reset(
        self,
        seed: int | None = None,
        options: dict[str, Any] | None = None,  # noqa: ARG002 - PettingZoo's tests give some
    ) -> tuple[dict[str, Observation], dict[str, dict[str, Any]]]:
        """Start a new episode of all agents."""
        self._calls.require_open()
        seed = checked_seed(seed)
        if seed is not None:
            self._np_random = seeding.np_random(seed)[0]
        self._play(())
        self.agents = list(self.possible_agents)
        fields = {agent: fields_of(self._episodes[agent].rows) for agent in self.agents}
        infos = {agent: start_info(fields[agent], self._tasks[agent].contents) for agent in self.agents}
        return {agent: self._observation(agent, fields[agent]) for agent in self.agents}, infos

    def _play(self, decisions: Sequence[Decision]) -> None:
        """Begin the generator's next episode, and take these decisions in it."""
        if self._calls.phase is Phase.BUSY:  # an interrupted call may have been done in part
            self._stop()
        with self._calls:
            self._began, self._decisions = dict(self._np_random.bit_generator.state), []
            drawn = episode_seed(self._np_random)
            self._traffic.begin(drawn)
            for number, episodes in enumerate(self._episodes.values()):
                episodes.begin(0, _sensor_seed(drawn, number))
            for taken in decisions:
                self._decide(taken)

    def step(
        self, actions: Mapping[str, int]
    ) -> tuple[dict[str, Observation], dict[str, float], dict[str, bool], dict[str, bool], dict[str, dict[str, Any]]]:
        """Take a decision of each agent whose episode goes on."""
        self._calls.require_episode()
        wanted = ", ".join(self.agents) or "nobody"
        if not isinstance(actions, Mapping):
            raise InputError(f"actions must be a mapping with those of {wanted}, not {shown(actions)}")
        if set(actions) != set(self.agents):
            raise InputError(f"actions must be those of {wanted}, not {', '.join(map(str, actions))}")
        taken = {agent: self._checked(agent, actions[agent]) for agent in self.agents}
        with self._calls:
            self._decide(taken)
        fields = {agent: fields_of(self._episodes[agent].rows) for agent in taken}
        infos = {
            agent: step_info(fields[agent], self._tasks[agent].contents, self._episodes[agent].collision_info(0))
            for agent in taken
        }
        self.agents = [agent for agent in taken if not infos[agent]["outcome"]]
        return (
            {agent: self._observation(agent, fields[agent]) for agent in taken},
            {agent: fields[agent]["reward"] for agent in taken},
            {agent: fields[agent]["terminated"] for agent in taken},
            {agent: fields[agent]["truncated"] for agent in taken},
            infos,
        )

    def _checked(self, agent: str, action: Any) -> np.ndarray:
        space = self.action_spaces[agent]
        assert isinstance(space, spaces.Discrete)
        return checked_actions(action, (), int(space.n)).reshape(1)

    def _decide(self, taken: Decision) -> None:
        """Take the steps of a decision; the ego of an episode that ends leaves the roads."""
        self._decisions.append(taken)
        going_on = list(taken)
        for step in range(self._steps_per_decision):
            if not going_on:
                return
            desired_mps = {}
            for number, agent in enumerate(self.possible_agents):
                if agent in going_on:
                    speeds_mps = self._tasks[agent].played.ego.controller.desired_speeds_mps
                    desired_mps[number] = speeds_mps[int(taken[agent][0])]
            self._traffic.step(desired_mps)
            for agent in going_on:
                episodes = self._episodes[agent]
                before = episodes.rows.copy()
                episodes.step(taken[agent])
                if step > 0:
                    episodes.add_up(before)
            going_on = [agent for agent in going_on if self._goes_on(agent)]

    def _goes_on(self, agent: str) -> bool:
        """Return whether an agent's episode goes on; take its ego off the roads if not."""
        if self._episodes[agent].rows["outcome"][0] == GOING_ON:
            return True
        self._traffic.views[self.possible_agents.index(agent)].leave()
        return False

    def _observation(self, agent: str, fields: dict[str, Any]) -> Observation:
        return {key: part.copy() for key, part in observation_of(fields, self._tasks[agent].contents).items()}

    def close(self) -> None:
        """End the simulation; safe to call twice. Everything else is refused from then on."""
        self._calls.phase = Phase.CLOSED
        self._stop()

    def __getstate__(self) -> dict[str, Any]:
        """Return what a copy or a pickle consists of: everything but the simulation."""
        return {name: value for name, value in self.__dict__.items() if name not in ("_traffic", "_episodes")}

    def __setstate__(self, state: dict[str, Any]) -> None:
        """Restore a copy from its state, as in ``SceneEnv``."""
        self.__dict__.update(state)
        self._calls = copy(self._calls)
        self._tasks = {agent: task.of_copy for agent, task in self._tasks.items()}
        if self._calls.phase is Phase.READY:
            self._np_random.bit_generator.state = self._began
            self._play(self._decisions)


def _require_fitting(tasks: Mapping[str, TaskSettings]) -> None:
    """Raise InputError unless egos with these settings can be in one simulation."""
    if not tasks:
        raise InputError("there are no agents; give settings of at least one")
    scenes = [_scene_of(task) for task in tasks.values()]
    for name in _SHARED:
        if any(getattr(scene, name) != getattr(scenes[0], name) for scene in scenes):
            raise InputError(f"all agents are in one simulation; give their scenes the same {name}")
    for name in ("steps_per_decision", "backend"):
        if len({getattr(task, name) for task in tasks.values()}) > 1:
            given = "decision_s" if name == "steps_per_decision" else name
            raise InputError(f"all agents are in one simulation; give them the same {given}")


def _scene_of(task: TaskSettings) -> SumocfgScene:
    """Return the scene of an agent.

    Raises:
        InputError: it is none in which there can be others.
    """
    scene = checked_settings(task).played
    if not isinstance(scene, SumocfgScene) or isinstance(scene, ReplayScene):
        raise InputError("several egos need a SUMO configuration (from_sumocfg): built-in scenes have the way of one")
    if scene.ego_control != "speed":
        raise InputError("agents drive by their actions; leave ego_control out of their scenes")
    return scene


def _sensor_seed(seed: int, number: int) -> int:
    """Return the seed of an agent's sensor; that of the first is the episode's, as in ``SceneEnv``."""
    return seed if number == 0 else int(np.random.SeedSequence((seed, number)).generate_state(1)[0])
