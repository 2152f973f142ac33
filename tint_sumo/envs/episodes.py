"""Episodes of the navigation task in a batch of intersections, as all environment classes have them."""

import hashlib
import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from itertools import pairwise
from typing import Any

import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray

from tint_sumo.config import (
    PERFECT,
    REWARD_PRESETS,
    SENSORS,
    Backend,
    Decisions,
    Mix,
    Perceivable,
    Sensor,
    TauS,
    TimeS,
)
from tint_sumo.core.errors import InputError, find_named, shown
from tint_sumo.core.ranges import require_ranges
from tint_sumo.core.structures import choose
from tint_sumo.envs.pedestrians import PedestrianSensing
from tint_sumo.envs.perceived import (
    Road,
    add_up_red_lights,
    judge_red_lights,
    observe_road,
    perceived_fields,
    perceived_spaces,
)
from tint_sumo.envs.rendering import render_scene
from tint_sumo.envs.replayed import observe_recording, replayed_fields, replayed_infos
from tint_sumo.envs.rows import (
    BOUND,
    COLLISION,
    COST,
    GOING_ON,
    OBSERVATION_KEYS,
    RED_LIGHT_TERM,
    REWARD_TERMS,
    TRACKS,
    TRUTH,
    Contents,
    Rows,
    Scales,
    TaskRules,
    add_up,
    judge,
    observe,
    observe_tracks,
    reveal,
    row_type,
)
from tint_sumo.envs.sensing import Sensing
from tint_sumo.scenes import AnyScene, Scene, SumocfgScene, find_scene, paper_scene, read_scene, require_built_in
from tint_sumo.scenes.buildings import corner_buildings
from tint_sumo.scenes.geometry import NO_VEHICLE, Floats
from tint_sumo.scenes.replay import ReplayScene
from tint_sumo.simulation import ReplaySimulation, Simulation, SumocfgSimulation, make_simulation
from tint_sumo.simulation.timing import StepPart, does

PEDESTRIAN, ANOTHER_EGO = "pedestrian", "ego"  # in place of the trait of somebody on foot, or of another ego
_SEED_LIMIT = 2**63
_STEP_TOLERANCE = 1e-6  # of decision_s in steps, for numbers such as 0.3 / 0.1


@dataclass(frozen=True)
class TaskSettings:
    """Settings of an episode; ``tint_sumo.envs.scene_env.SceneEnv`` explains them.

    They are made once, by the user or by a command, and passed on as they are. A scene and a sensor may also be given
    by a name or as a mapping, as in configuration files, and ``p_conservative`` as one number or two: here, and
    nowhere below.

    Raises:
        InputError: a value makes no sense.
    """

    scene: AnyScene = field(default_factory=paper_scene)
    p_conservative: Mix | None = None
    reward: str = "paper"
    time_limit_s: TimeS | None = None
    sensor: Sensor = PERFECT
    tau_s: TauS | None = None
    tracks: bool = False
    decision_s: TimeS | None = None
    max_episode_steps: Decisions | None = None
    backend: Backend = "auto"

    def __post_init__(self) -> None:
        given: Any = self.scene
        object.__setattr__(
            self, "scene", read_scene(given, ("scene",)) if isinstance(given, Mapping) else find_scene(given)
        )
        if self.p_conservative is not None:
            object.__setattr__(self, "p_conservative", Mix.parse(self.p_conservative))
        object.__setattr__(self, "sensor", find_sensor(self.sensor))
        if self.reward not in REWARD_PRESETS:
            raise InputError(f"unknown reward preset {self.reward!r}; choose one of {', '.join(REWARD_PRESETS)}")
        require_ranges(self)
        if not isinstance(self.tracks, bool):
            raise InputError(f"tracks must be True or False, not {shown(self.tracks)}")
        if not self._is_multiple(self._decision_s) or self._decision_s < self._step_s / 2:
            raise InputError(f"decision_s must be a multiple of the step of {self._step_s:g} s, not {self.decision_s}")
        if not self._is_multiple(self.sensor.delay_s):
            raise InputError(
                f"delay_s must be a multiple of the step of {self._step_s:g} s, not {self.sensor.delay_s:g}"
            )
        scene = self.played
        if not scene.step_s <= scene.time_limit_s < math.inf:
            raise InputError(
                f"time_limit_s must be at least a step of {scene.step_s:g} s, and finite, not {scene.time_limit_s}"
            )

    def _is_multiple(self, time_s: float) -> bool:
        """Whether a time is so many steps of the simulation."""
        steps = time_s / self._step_s
        return math.isclose(steps, round(steps), rel_tol=_STEP_TOLERANCE)

    @property
    def _step_s(self) -> float:
        return self.scene.step_s

    @property
    def _decision_s(self) -> float:
        return self._step_s if self.decision_s is None else self.decision_s

    @property
    def steps_per_decision(self) -> int:
        """Simulation steps for which an action is held."""
        return round(self._decision_s / self._step_s)

    @property
    def render_fps(self) -> float:
        """Images per second that show episodes in real time, one for each step of the environment."""
        return 1.0 / self._decision_s

    @property
    def decisions_per_episode(self) -> int:
        """Most decisions in an episode."""
        return math.ceil(round(self.played.time_limit_s / self._step_s) / self.steps_per_decision)

    @cached_property
    def fingerprint(self) -> str:
        """Digest of all settings on which the course of an episode depends; 16 hexadecimal digits."""
        text = repr((self.played, self.sensor, self.steps_per_decision))
        return hashlib.sha256(text.encode()).hexdigest()[:16]

    @property
    def cases(self) -> int:
        """Number of a recording's cases, among which each episode draws one; 0 in scenes that are no recording."""
        return len(self.scene.cases) if isinstance(self.scene, ReplayScene) else 0

    @property
    def row(self) -> int:
        """Number of seeds in a row that belong together: of the episodes in a town, or of a recording's cases."""
        scene = self.scene
        return scene.population.episodes_per_town if isinstance(scene, Scene) else max(1, self.cases)

    def next_start(
        self, before: "EpisodeStart | None", rng: np.random.Generator, case: int | None = None
    ) -> "EpisodeStart":
        """Return the start of the episode that follows another one; ``case`` is the number of a recording's, if any."""
        return EpisodeStart.drawn(rng, self.row, case) if self.cases else EpisodeStart.after(before, rng, self.row)

    @cached_property
    def contents(self) -> Contents:
        """Fields of rows that observations and infos have."""
        truth = () if self.sensor == PERFECT else TRUTH
        slot_infos = ("traits", *(TRACKS if self.tracks else ()), *truth)
        if not isinstance(self.scene, SumocfgScene):
            return Contents(slot_infos=slot_infos)
        red_light = self.scene.red_light
        return Contents(
            (*OBSERVATION_KEYS, *perceived_spaces(self.scene.perceives, 1)),
            slot_infos,
            REWARD_TERMS if red_light == "ignore" else (*REWARD_TERMS, RED_LIGHT_TERM),
            (COST,) if red_light == "cost" else (),
            replayed_infos(self.scene),
        )

    @property
    def row_type(self) -> np.dtype[np.void]:
        """Type of an environment's record."""
        more = [*perceived_fields(self.scene), *replayed_fields(self.scene)]
        return row_type(self.played.max_vehicles, more)

    @property
    def observation_space(self) -> spaces.Dict:
        """Space of an environment's observations."""
        perceives = self.scene.perceives if isinstance(self.scene, SumocfgScene) else ()
        return observation_space(self.played.max_vehicles, perceives)

    @property
    def of_copy(self) -> "TaskSettings":
        """These settings for a copy of an environment, whose original may use this process's libsumo."""
        return replace(self, backend="auto") if self.backend == "libsumo" else self

    @cached_property
    def played(self) -> AnyScene:
        """The scene with these settings."""
        scene = self.scene.with_drivers(self.p_conservative, self.tau_s)
        limit_s = scene.time_limit_s if self.time_limit_s is None else self.time_limit_s
        if self.max_episode_steps is not None:
            limit_s = min(limit_s, self.max_episode_steps * self.steps_per_decision * scene.step_s)
        if self.sensor.corners_m is not None:
            built_in = require_built_in("corners_m", scene)
            buildings = built_in.buildings + corner_buildings(built_in, self.sensor.corners_m)
            scene = replace(built_in, buildings=buildings)
        return replace(scene, time_limit_s=limit_s)


def find_sensor(sensor: str | Mapping[str, Any] | Sensor) -> Sensor:
    """Return the sensor of this name, the one that a mapping describes as in a configuration file, or itself.

    Raises:
        InputError: there is none of this name, it is no sensor, or a value does not fit.
    """
    if isinstance(sensor, Sensor):
        return sensor
    if isinstance(sensor, Mapping):
        sensor = choose(sensor, SENSORS, "perfect", ("sensor",))
        return sensor if isinstance(sensor, Sensor) else SENSORS[sensor]
    if not isinstance(sensor, str):
        raise InputError(f"sensor must be a Sensor or a name ({', '.join(SENSORS)}), not {shown(sensor)}")
    return find_named("sensor", sensor, SENSORS)


def checked_settings(settings: Any) -> TaskSettings:
    """Return settings of an environment; the default ones where they are None.

    Raises:
        InputError: they are none, such as the name of a scene.
    """
    if settings is None:
        return TaskSettings()
    if not isinstance(settings, TaskSettings):
        raise InputError(f'settings must be TaskSettings, such as TaskSettings("on_ramp"), not {shown(settings)}')
    return settings


def action_space(scene: AnyScene) -> spaces.Discrete:
    return spaces.Discrete(len(scene.ego.controller.desired_speeds_mps))


def observation_space(max_vehicles: int, perceives: Iterable[Perceivable] = ()) -> spaces.Dict:
    """Return the space of observations with so many vehicle slots, and with further keys by their names."""
    return spaces.Dict(
        {
            "ego": spaces.Box(-BOUND, BOUND, (4,), np.float32),
            "vehicles": spaces.Box(-BOUND, BOUND, (max_vehicles, 2), np.float32),
            "mask": spaces.Box(0.0, 1.0, (max_vehicles,), np.float32),
            **perceived_spaces(perceives, max_vehicles),
        }
    )


def episode_seed(rng: np.random.Generator, row: int = 1) -> int:
    """Return the seed of the next episode of an environment with this generator, where a row of episodes begins.

    Args:
        rng: the generator.
        row: number of seeds in a row that belong together; the seed is a multiple of it, and the others follow.
    """
    return int(rng.integers(_SEED_LIMIT)) // row * row


@dataclass(frozen=True)
class EpisodeStart:
    """The start of an environment's episode: its seed, and what it follows from."""

    began: dict[str, Any]  # state of the environment's generator before it drew the seed of the row's first episode
    seed: int
    number: int = 0  # of the episode in its row: in its town, or of its case in a recording

    @classmethod
    def drawn(cls, rng: np.random.Generator, row: int, number: int | None = 0) -> "EpisodeStart":
        """Return the episode of this number in the next row of the generator; of a number that it draws, if None."""
        began = dict(rng.bit_generator.state)
        seed = episode_seed(rng)
        number = seed % row if number is None else number
        return cls(began, seed // row * row + number, number)

    @classmethod
    def after(cls, before: "EpisodeStart | None", rng: np.random.Generator, row: int) -> "EpisodeStart":
        """Return the episode that follows, in the same row or at the beginning of the next one."""
        if before is None or before.number + 1 == row:
            return cls.drawn(rng, row)
        return replace(before, seed=before.seed + 1, number=before.number + 1)


def share_simulation(settings: Sequence[TaskSettings]) -> bool:
    """Whether the environments of several settings can be in one simulation: they differ in their sensors alone."""
    first, *others = settings
    are_alike = all(
        replace(task, sensor=first.sensor) == first and task.played == first.played and not task.scene.sumocfg
        for task in others
    )
    return are_alike and len({task.sensor for task in settings}) == len(settings)


def shares_of(num_envs: int, parts: int) -> list[slice]:
    """Return which environments belong to which part: in order, and as evenly as can be."""
    return [slice(*share) for share in pairwise(num_envs * part // parts for part in range(parts + 1))]


def fingerprints(num_envs: int, settings: Sequence[TaskSettings]) -> list[str]:
    """Return the fingerprint of each environment's settings."""
    shares = shares_of(num_envs, len(settings))
    return [task.fingerprint for task, share in zip(settings, shares, strict=True) for _ in range(num_envs)[share]]


class Episodes:
    """``num_envs`` episodes at a time, each in its own replica with its own random stream.

    Args:
        all_settings: settings among which the environments are shared out; they differ in their sensors alone.
        rows: (N,) written at each step; new if none are given.
        simulation: of the episodes; a new one if none is given.
    """

    def __init__(
        self,
        num_envs: int,
        all_settings: Sequence[TaskSettings],
        rows: Rows | None = None,
        simulation: Simulation | None = None,
    ) -> None:
        settings = self.settings = all_settings[0]
        scene = settings.played
        self.simulation = simulation or make_simulation(num_envs, scene, settings.backend)
        self.rows = np.zeros(num_envs, settings.row_type) if rows is None else rows
        self._rules = TaskRules.of(scene, REWARD_PRESETS[settings.reward])
        self._scales = Scales(scene.position_scale_m, scene.ego_scale_m, scene.speed_scale_mps, scene.step_s)
        self._speeds_mps = np.array(scene.ego.controller.desired_speeds_mps)
        self._steps_per_decision = settings.steps_per_decision
        self.steps = np.zeros(num_envs, np.int64)  # simulation steps since each episode's start
        self._parked: set[int] = set()
        shares = shares_of(num_envs, len(all_settings))
        self._sensors = [
            (share, Sensing(task.sensor, self.simulation, scene.step_s))
            for share, task in zip(shares, all_settings, strict=True)
        ]
        self._road: Road | None = None  # of a scene whose rows have more fields
        if isinstance(self.simulation, SumocfgSimulation) and perceived_fields(scene):
            sensing = self.sensing(0)
            pedestrians = PedestrianSensing(sensing.sensor, self.simulation)
            self._road = Road(self.simulation, sensing.source[0], pedestrians)

    def begin(self, index: int, seed: int) -> None:
        """Start a new episode in an environment."""
        self.simulation.reset(index, seed)
        if isinstance(self.simulation, ReplaySimulation):  # its cases have goals and time limits of their own
            self._rules = TaskRules.of(self.simulation.scene, REWARD_PRESETS[self.settings.reward])
        self._parked.discard(index)
        self._clear(index)
        self.sensing(index).begin(index, seed)
        if self._road is not None:
            self._road.pedestrians.begin(seed)
        self._observe(slice(index, index + 1))

    def park(self, index: int) -> None:
        """Empty an environment, whose ego stands and whose time does not pass until its next episode begins."""
        self.simulation.clear(index)
        self._parked.add(index)
        self._clear(index)
        self._observe(slice(index, index + 1))

    def _clear(self, index: int) -> None:
        self.rows[index] = np.zeros((), self.rows.dtype)
        self.rows["town"][index] = self.simulation.town[index]
        self.steps[index] = 0

    @does(StepPart.OTHER)
    def step(self, actions: NDArray[np.integer]) -> bool:
        """Take a decision in each environment: an action, the number of a desired speed, for ``steps_per_decision``.

        An episode that ends within the decision is shown as it ended, while the others go on; its ego brakes to a stop.

        Args:
            actions: (N,).

        Returns:
            whether any episode has ended.
        """
        desired_mps = self._speeds_mps[actions]
        any_ended = self._step(desired_mps)
        for _ in range(self._steps_per_decision - 1):
            over = self.rows["outcome"] != GOING_ON
            if over.all():
                break
            before = self.rows.copy()
            any_ended |= self._step(np.where(over, 0.0, desired_mps))
            self.add_up(before)
        return any_ended

    def add_up(self, before: Rows) -> None:
        """Add the rows (N,) of a decision's earlier steps to those of the step just made."""
        add_up(before, self.rows)
        if self._road is not None:
            add_up_red_lights(before, self.rows)

    def _step(self, desired_mps: Floats) -> bool:
        """Simulate one step; return whether any episode has ended."""
        simulation = self.simulation
        if self._parked:
            parked = list(self._parked)
            desired_mps[parked], self.steps[parked] = 0.0, -1
        simulation.step(desired_mps)
        self.steps += 1
        self._observe(slice(0, len(self.steps)))
        egos = simulation.egos
        ends = (egos.collided, egos.ran_red, egos.lost)
        any_ended = judge(egos.front_m, egos.speed_mps, *ends, self.steps, self._rules, self.rows)
        if self._road is not None:
            judge_red_lights(self._road.simulation, self._rules.collision, self.rows)
        return any_ended

    def sensing(self, index: int) -> Sensing:
        """Return the sensor of an environment."""
        return next(sensing for share, sensing in self._sensors if index < share.stop)

    @does(StepPart.OBSERVATION)
    def _observe(self, envs: slice) -> None:
        """Write the observations of some environments, as their sensors have them."""
        for share, sensing in self._sensors:
            both = slice(max(envs.start, share.start), min(envs.stop, share.stop))
            if both.start < both.stop:
                self._observe_with(sensing, both)

    def _observe_with(self, sensing: Sensing, envs: slice) -> None:
        egos, slots, rows = self.simulation.egos, self.simulation.slots, self.rows[envs]
        traits = self.simulation.traits(envs)
        sensing.look(envs)
        observe(
            egos.box[envs],
            egos.speed_mps[envs],
            sensing.source[envs],
            slots.box[envs],
            traits,
            sensing.track[envs],
            sensing.noise_m[envs],
            self.steps[envs],
            self._scales,
            rows,
        )
        if self._road is not None:
            observe_road(self._road, rows)
        if isinstance(self.simulation, ReplaySimulation):
            observe_recording(self.simulation, rows)
        if self.settings.tracks:
            self._observe_tracks(sensing, envs)
        reveal(egos.box[envs], slots.present[envs], slots.box[envs], traits, self._scales, rows)
        sensing.delay(self.steps, envs, rows)

    def _observe_tracks(self, sensing: Sensing, envs: slice) -> None:
        egos, slots = self.simulation.egos, self.simulation.slots
        leader, gap_m = self.simulation.leaders(envs, sensing.seen[envs])
        observe_tracks(
            egos.front_m[envs],
            self.simulation.claims[envs],
            self.simulation.passed_m,
            self.simulation.stop_line_m,
            sensing.source[envs],
            slots.route[envs],
            slots.box[envs],
            slots.front_m[envs],
            leader,
            gap_m,
            sensing.noise_m[envs],
            self.rows[envs],
        )

    def render(self, index: int) -> NDArray[np.uint8]:
        """Draw an environment as an (H, W, 3) image, with what its sensor perceives."""
        sensing = self.sensing(index)
        return render_scene(self.simulation, index, sensing.sensor, sensing.seen[index])

    def collision_info(self, index: int) -> dict[str, Any]:
        """Return whom the ego has hit, and where; empty if the episode has not ended with a collision."""
        event = self.simulation.egos.collision[index]
        if event is None or self.rows["outcome"][index] != COLLISION:
            return {}
        trait = PEDESTRIAN if event.trait == NO_VEHICLE else (*self.simulation.scene.traits, ANOTHER_EGO)[event.trait]
        found = {"trait": trait, "route": event.route, "slot": event.slot, "ego_m": (event.ego_x_m, event.ego_y_m)}
        if isinstance(self.simulation, ReplaySimulation):
            found["replayed"] = self.simulation.is_replayed(event.slot)
        return found
