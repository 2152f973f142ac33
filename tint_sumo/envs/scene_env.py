"""The single environment."""

from collections.abc import Sequence
from copy import copy
from dataclasses import replace
from functools import cached_property
from typing import Any

import gymnasium
import numpy as np
from gymnasium.envs.registration import EnvSpec
from numpy.typing import NDArray

from tint_sumo.envs.batch import Snapshot, checked_snapshots
from tint_sumo.envs.calls import Calls, Phase, checked_actions, checked_case, checked_seed
from tint_sumo.envs.episodes import Episodes, EpisodeStart, TaskSettings, action_space, checked_settings
from tint_sumo.envs.rendering import RENDER_FPS, require_render_mode
from tint_sumo.envs.rows import Observation, fields_of, observation_of, start_info, step_info
from tint_sumo.envs.window import Window, has_display
from tint_sumo.simulation import Simulation


class SceneEnv(gymnasium.Env[Any, Any]):
    """Cross or join the traffic of a scene, among drivers whose traits are unknown.

    ## Description
    One intersection simulated by Eclipse SUMO. In the scene of Liu et al. (ICRA 2022), `tint_sumo/TIntersection-v1`,
    an uncontrolled T-intersection with left-hand traffic, the ego comes up the stem, crosses the lower lane (westbound)
    and merges into the upper lane (eastbound). The other scenes are listed in `tint_sumo.scenes.SCENES`. Conservative
    drivers yield to an ego that moves into their lane while they can still stop clear of its way; aggressive
    drivers do not and hit it. The ego's path is fixed; the agent chooses its desired speed, which a PD controller
    follows and a safety check can override.

    ## Action Space
    `Discrete(3)`: desired speed 0, 0.5 or 3 m/s; in `t_intersection_street` 0, 1 or 8.33 m/s (30 km/h). A SUMO
    configuration has an action for each desired speed of its `controller`.

    ## Observation Space
    A `Dict` of float32 arrays, lengths divided by 20 m, speeds by 3 m/s, clipped to [-2, 2]; V is the scene's
    `max_vehicles`, 12 in the T-intersection. In `t_intersection_street`, lengths are divided by 100 m, speeds by
    8.33 m/s, and V is 20; for a SUMO configuration see `scene` under Arguments:

    | Key        | Shape    | Content                                                                            |
    |------------|----------|------------------------------------------------------------------------------------|
    | `ego`      | `(4,)`   | x, y, x velocity, y velocity of the ego's centre in the scene's frame              |
    | `vehicles` | `(V, 2)` | x, y of each vehicle's centre minus the ego's, with noise; 0 in empty slots        |
    | `mask`     | `(V,)`   | 1 where the slot holds a vehicle                                                   |

    In a SUMO configuration, `perceives` of the scene adds keys of the ego's road:

    * `traffic_light`, `(8,)`: the next traffic light on the ego's route: six numbers of which one is 1 (red or red
      with yellow, yellow, green with priority, green without priority, stop and then go, switched off); the
      distance from the ego's front to its stop line / 20 m, up to 5 (100 m); time in this state / 10 s, up to 10
      (100 s). Without one to come the distance is 5, and all else 0
    * `right_of_way`, `(2,)`: at the next junction, or the one that the ego is on: 1 if the ego's link has no
      priority there (signs, red, the right before the left), and the distance from its front to the junction / 20
      m, up to 5. Without one to come, 0 and 5
    * `priority`, `(V,)`: comes with `right_of_way`: 1 where the vehicle in the slot has priority over the ego there
      by SUMO's rules: it is on its way to the junction, or on it, its way meets the ego's, and its light, if any,
      is not red
    * `speed_limit`, `(1,)`: speed limit of the ego's lane, divided by the scale of its velocity, up to 2
    * `lane`, `(2,)`: number of the ego's lane, 0 at the outer side of its edge (to the right in right-hand
      traffic), and how many lanes the edge has; on junctions of their lanes
    * `pedestrians`, `(8, 4)`: the nearest persons on foot in sight, nearest first: x, y of their centres minus the
      ego's, scaled as in `vehicles`, and their x, y velocity, scaled as the ego's, all up to 2; 0 in empty places
    * `pedestrian_mask`, `(8,)`: comes with `pedestrians`: 1 where there is one

    The sensor is for other road users: `priority` goes with the vehicles' slots, and persons are seen as vehicles are,
    with noise on their positions. The ego knows all else as it is.

    A vehicle keeps its slot for as long as it is on the roads and perceived; a slot stays empty for at least one step
    between two vehicles. The others' velocities and traits are not observed.

    ## Rewards
    The sum of named terms, also found in `info["reward_terms"]`:

    | Term        | Paper                             | `reward="authors"`                |
    |-------------|-----------------------------------|-----------------------------------|
    | `goal`      | 2.5 at the goal                   | 2.5                               |
    | `collision` | -2 on collision                   | -2                                |
    | `speed`     | 0.05 x ego speed (m/s) otherwise  | 0.05 / 3 x ego speed otherwise    |
    | `step`      | -0.0013 otherwise                 | -0.013 otherwise                  |

    `reward="careful"` has the paper's values, but -10 on collision.

    In a SUMO configuration with steps of T s and L m from the ego's start to its goal, `step` is multiplied by T / 0.1,
    and `speed` by T / 0.1 x 17.2 / L: all of the way is worth as much as in the T-intersection, whose way has 17.2 m.
    If red lights have consequences there (see Arguments), `red_light` is a term, too.

    ## Starting State
    The ego stands at its start (in the T-intersection with its centre at (0, -5)). All of the traffic's routes are
    filled at random; each driver is conservative with probability `p_conservative`.

    ## Episode End
    Termination: the ego passes its goal (`success`; in the T-intersection its centre is at x = 8 m on the upper lane
    then), or its box touches another vehicle's (`collision`). In a SUMO configuration with `red_light="end"`, so is
    driving over a stop line at red (`red_light`). Truncation: the time limit (`timeout`), or, in a SUMO
    configuration, that SUMO takes the ego off the road (`lost`): it removes or teleports vehicles that have
    waited for longer than `time-to-teleport`, and calibrators remove them.

    ## Information
    * `traits`: `(V,)` int16, true traits: number of the driver's profile, 0 conservative and 1 aggressive; -1 in
      empty slots. In a population with `willingness`: would it yield now? 0 yes, 1 no
    * `position_m`: with `tracks`: `(V,)` where each vehicle's front is seen on its route; 0 in empty slots
    * `gap_m`: with `tracks`: `(V,)` the gap that is seen to the next vehicle ahead; infinite without one
    * `passed`: with `tracks`: `(V,)` int8, 1 where the ego has left the vehicle's route behind
    * `claimed`: with `tracks`: `(V,)` int8, 1 where the ego claims the vehicle's route
    * `to_stop_m`: with `tracks`: `(V,)` from each vehicle's front to where it would stop for the ego; negative past
      it, infinite where it never meets the ego
    * `track`, `slot`: with a sensor: `(V,)` number of the track in the episode that the slot shows, and of the
      simulation's slot with its vehicle; -1 in empty slots
    * `true_mask`, `true_vehicles`: with a sensor: `(V,)` and `(V, 2)`, the simulation's slots as they are, seen or
      not, with their traits in `true_traits`: not to be used by policies
    * `outcome`: `"success"`, `"collision"`, `"timeout"`, `"lost"`, `"red_light"`, or `""` while the episode goes on
    * `reward_terms`: the reward's named terms (after a step)
    * `time_s`: time since the episode's start
    * `town`: in a population with towns: number of the episode's town
    * `is_success`: after a step: whether the outcome is `"success"`
    * `cost`: after a step, with `red_light="cost"`: number of stop lines driven over at red in it
    * `collision`: after a collision: the other driver's `trait`, `route`, `slot`, and `ego_m`; for a person on foot
      in a SUMO configuration, `trait` is `"pedestrian"` and `slot` is -1

    ## Arguments
    `gymnasium.make` takes all of these as keyword arguments. The class itself takes `render_mode`, and all others as a
    `tint_sumo.envs.TaskSettings`: `SceneEnv(TaskSettings("on_ramp", p_conservative=0.4), render_mode="human")`.

    * `scene`: name of a scene, a mapping as in configuration files (`{"base": "four_way", "max_vehicles": 8}`), a
      `tint_sumo.scenes.Scene`, or what `tint_sumo.scenes.from_sumocfg` makes of a SUMO configuration of your own. Then
      the traffic is the configuration's, several lanes and changes between them included;
      `ego` is seen from where it starts, with the network's axes, its position divided by half of the way
      from its start to its goal, and its velocities by its top speed, if these are above 20 m and 3 m/s; `vehicles` are
      the nearest in sight, divided by half of `sight_m` if that is above 20 m;
      `traits` are the numbers of their vTypes in `scene.vtypes`; `position_m` is what their odometers show, and
      `passed` is always 0. `perceives`, `red_light` and `ego_control` are arguments of the scene, which `from_sumocfg`
      describes. Such an environment is one simulation: a vector of them needs as many `workers` as
      environments.
    * `p_conservative`: probability that a driver is conservative, in [0, 1]; default 0.4. Two numbers are a range, from
      which each episode draws its probability uniformly, by its seed.
    * `reward`: `"paper"` (default), `"authors"` (the values of the authors' code) or `"careful"`.
    * `time_limit_s`: default that of the scene: 50 s, but 60 s in `t_intersection_street`.
    * `max_episode_steps`: gymnasium's way to say it, in steps of the environment. `gymnasium.make` does not pass it on:
      it wraps the environment in a `TimeLimit`, with which `outcome` stays empty; so does `gymnasium.make_vec` with a
      `vectorization_mode`. Without one `gymnasium.make_vec` passes it on.
    * `sensor`: how the ego perceives the other vehicles: a `tint_sumo.config.Sensor`, a mapping as in
      configuration files, or the name of one in `tint_sumo.config.SENSORS`; default perfect. It may have noise,
      dropouts, a range, a field of view, occlusion and a delay.
      `vehicles`, `mask`, and all infos of `tracks` are what it perceives: a vehicle that is not seen has no
      slot, is nobody's leader, and comes back as a new track. The ego's controller and its safety check, and the
      drivers, do not look through it.
    * `position_noise_m`: shorthand of `gymnasium.make` for a sensor that has only this noise: standard deviation of
      that on the others' x and y, independent per vehicle and step.
    * `tau_s`: time headway of the others' car following (SUMO's `tau`); default the scene's, 1 s in the built-in
      ones.
    * `tracks`: the infos contain the observed positions of vehicles on their routes, too, with the same noise as in
      the observations; trait models take them. Default False.
    * `decision_s`: an action holds for so long, a multiple of the simulation's step (0.1 s in the built-in scenes), or
      until the episode ends. A step of the environment then is so many steps of the simulation, at each of which the
      controller and its safety check work; `reward` and `reward_terms` are their sums, and everything else is as after
      the last of them. Default: one step of the simulation. Policies with traits look at every step of the simulation;
      they take `tint_sumo.policy.ActionRepeat` instead, whose docstring says how it differs.
    * `backend`: `"libsumo"`, `"traci"` (a sumo subprocess), or `"auto"` (default): libsumo if neither another
      environment nor your own program uses it in this process, since libsumo holds one simulation per process.
    * `render_mode`: `None`, `"rgb_array"`, or `"human"`: a window follows the episodes in real time. It needs a
      display and a Python with tkinter; if you close it, the episodes go on without it. The wrapper
      `gymnasium.wrappers.RecordVideo` takes `"rgb_array"`, and moviepy: `pip install "tint_sumo[video]"`.

    ## Copies
    `copy.deepcopy(env)` is an independent environment in the same state, as planners need it, and a pickle can be
    loaded in another process. The episode so far is simulated once more for that. As long as the original uses libsumo,
    copies in its process go through TraCI. A copy has no window.

    ## Version History
    TIntersection:
    * v1: a conservative driver that can no longer stop clear of the ego's way drives on. Before, it braked and stood so
      close that the ego's safety check held the ego: both waited until the time limit, in up to 30 % of the episodes.
      `p_conservative` takes a range; new argument `tau_s`.
    * v0: first release.
    """

    metadata = {"render_modes": ["human", "rgb_array"], "render_fps": RENDER_FPS}  # noqa: RUF012 - gymnasium's way

    def __init__(self, settings: TaskSettings | None = None, render_mode: str | None = None) -> None:
        require_render_mode(render_mode, self.metadata["render_modes"])
        self.render_mode = render_mode
        settings = checked_settings(settings)
        fps = settings.render_fps
        modes = [mode for mode in self.metadata["render_modes"] if mode != "human" or has_display()]
        self.metadata = {**self.metadata, "render_modes": modes, "render_fps": fps}  # what is possible here
        self._spec: EnvSpec | None = None
        self._max_episode_steps = settings.decisions_per_episode
        self._window = Window(settings.played.name, fps) if render_mode == "human" else None
        self.observation_space = settings.observation_space
        self.action_space: gymnasium.spaces.Discrete = action_space(settings.played)
        self._contents = settings.contents
        self._settings = settings
        self._calls = Calls()
        self._episodes = Episodes(1, [settings])
        self._start: EpisodeStart | None = None  # of the present episode
        self._actions: list[int] = []

    @property
    def spec(self) -> EnvSpec | None:
        """Gymnasium's specification of the environment, with the length of its longest episode, for wrappers."""
        return self._spec

    @spec.setter
    def spec(self, spec: EnvSpec | None) -> None:
        # With max_episode_steps registered, gymnasium.make would wrap the environment in a second time limit.
        self._spec = spec and replace(spec, max_episode_steps=self._max_episode_steps)

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Observation, dict[str, Any]]:
        """Start a new episode; among recorded vehicles, the option ``case`` chooses the case by its number.

        Raises:
            InputError: the seed is none, or there is no such option or case.
        """
        self._calls.require_open()
        case = checked_case(options, self._settings.cases)
        super().reset(seed=checked_seed(seed))
        before = self._start if seed is None else None
        self._play(self._settings.next_start(before, self.np_random, case), ())
        self._show()
        return self._shown()

    @cached_property
    def _episodes(self) -> Episodes:
        """The running simulation; started when it is needed in a copy, or after a call that was interrupted."""
        self._calls.require_open()
        return Episodes(1, [self._settings])

    def _stop(self) -> None:
        """End the simulation, if one runs."""
        if "_episodes" in vars(self):
            self._episodes.simulation.close()
            del self._episodes

    def _play(self, start: EpisodeStart, actions: Sequence[int]) -> None:
        """Begin an episode, and take these actions in it."""
        if self._calls.phase is Phase.BUSY:  # an interrupted call may have been done in part
            self._stop()
        with self._calls:
            self._start, self._actions = start, []
            self._episodes.begin(0, start.seed)
            for action in actions:
                self._step(np.array([action]))

    def step(self, action: np.int64) -> tuple[Observation, float, bool, bool, dict[str, Any]]:
        self._calls.require_episode()
        actions = checked_actions(action, (), int(self.action_space.n)).reshape(1)
        with self._calls:
            self._step(actions)
        self._show()
        fields = fields_of(self._episodes.rows)
        info = step_info(fields, self._contents, self._episodes.collision_info(0))
        return self._observation(fields), fields["reward"], fields["terminated"], fields["truncated"], info

    def _step(self, actions: NDArray[np.integer]) -> None:
        self._actions.append(int(actions[0]))
        self._episodes.step(actions)

    @property
    def simulation(self) -> Simulation:
        """The simulation, which is read only; the environment is its replica 0."""
        return self._episodes.simulation

    def snapshot(self) -> Snapshot:
        """Return what ``restore`` needs to come back to this step of the episode; it can be pickled.

        Raises:
            InputError: no episode has begun.
        """
        self._calls.require_episode()
        start = self._start
        assert start is not None
        return Snapshot(start.began, tuple(self._actions), self._settings.fingerprint, start.number)

    def restore(self, snapshot: Snapshot) -> tuple[Observation, dict[str, Any]]:
        """Replay an episode of this environment, or of one with the same arguments; return observation and info there.

        The episode is simulated once more, which takes as long as it took: SUMO's own saved states do not
        hold all that its vehicles remember, and would not go on to the last bit as the episode did.

        Raises:
            InputError: it is no snapshot, or one of another scene or other settings.
        """
        self._calls.require_open()
        (snapshot,) = checked_snapshots([snapshot], [self._settings.fingerprint])
        self.np_random.bit_generator.state = snapshot.began
        row = self._settings.row
        self._play(EpisodeStart.drawn(self.np_random, row, snapshot.number), snapshot.actions)
        self._show()
        return self._shown()

    def _shown(self) -> tuple[Observation, dict[str, Any]]:
        """Return the observation and info of the present step."""
        fields = fields_of(self._episodes.rows)
        return self._observation(fields), start_info(fields, self._contents)

    def _observation(self, fields: dict[str, Any]) -> Observation:
        return {key: part.copy() for key, part in observation_of(fields, self._contents).items()}

    def render(self) -> NDArray[np.uint8] | None:
        """Return an (H, W, 3) image of the scene; conservative drivers blue, aggressive red, the ego yellow.

        Vehicles that the ego's sensor does not perceive are pale, and its range and field of view have a blue border.

        None with ``render_mode="human"``, where the window follows by itself.
        """
        self._calls.require_episode()
        return self._episodes.render(0) if self.render_mode == "rgb_array" else None

    def _show(self) -> None:
        if self._window:
            self._window.show(self._episodes.render(0))

    def close(self) -> None:
        """End the simulation; safe to call twice. Everything else is refused from then on."""
        self._calls.phase = Phase.CLOSED
        if self._window:
            self._window.close()
        self._stop()

    def __getstate__(self) -> dict[str, Any]:
        """Return what a copy or a pickle consists of: everything but the window and the simulation."""
        return {name: value for name, value in vars(self).items() if name not in ("_window", "_episodes")}

    def __setstate__(self, state: dict[str, Any]) -> None:
        """Restore a copy from its state, in a simulation that it alone uses.

        Libsumo may be in use by the original; then the copy goes through TraCI.
        """
        vars(self).update(state)
        self._calls = copy(self._calls)
        self._window = None
        if self.render_mode == "human":
            self.render_mode = None
        self._settings = self._settings.of_copy
        if self._calls.phase is Phase.READY:
            drawn = self.np_random.bit_generator.state
            self.restore(self.snapshot())
            self.np_random.bit_generator.state = drawn  # also what the user has drawn from it since the reset
