"""Scenes in files: a built-in one with other numbers, or a SUMO configuration and the ego's task in it."""

import hashlib
import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, fields, replace
from pathlib import Path
from typing import Any, Self

from tint_sumo.config import (
    ArrivalsPerS,
    Claim,
    DistanceM,
    EgoControl,
    EgoController,
    Penalty,
    Perceivable,
    Population,
    RedLight,
    RouteM,
    Slots,
    StepS,
    TimeS,
    Towns,
    VehicleShape,
    WarmStarts,
    WarmUpS,
)
from tint_sumo.core.errors import InputError
from tint_sumo.core.ranges import require_ranges
from tint_sumo.core.structures import (
    FieldError,
    Many,
    Where,
    build,
    is_mapping,
    overlay,
    plain,
    require_base,
    require_known,
)
from tint_sumo.scenes.buildings import corner_buildings
from tint_sumo.scenes.drivers import PopulationSetting
from tint_sumo.scenes.registry import ALL_SCENES, SCENES, T_INTERSECTION, AnyScene, digest_of, find_scene, find_scenes
from tint_sumo.scenes.replay import ReplayScene
from tint_sumo.scenes.scene import Building, Scene, require_scene_name
from tint_sumo.scenes.sumocfg import SumocfgScene, from_sumocfg


@dataclass(frozen=True)
class SceneSettings:
    """The numbers that can be changed in a built-in scene; its roads cannot."""

    base: str
    """The built-in scene whose roads these are."""
    name: str | None
    """Name of the scene if it differs from its base; null: the base's name and a number are joined."""
    start_m: RouteM
    """Start of the ego's front on its way."""
    goal_m: RouteM
    """The ego's front past it is a success."""
    controller: EgoController
    """Controller of the ego; its desired speeds are the actions."""
    claim: Claim
    """Conditions of the ego's claim on a lane, and of the drivers' reaction to it."""
    population: PopulationSetting
    """Drivers: traits, towns or another name, a list of profiles, or a mapping of what differs from them."""
    arrivals_per_s: ArrivalsPerS | None
    """Rate of drivers who come on each route; null: as many as there is room for."""
    max_vehicles: Slots
    """Most vehicles on the roads, and in an observation."""
    step_s: StepS
    """Step of the simulation."""
    time_limit_s: TimeS
    """Longest time of an episode."""
    buildings: DistanceM | tuple[Building, ...] = ()
    """Buildings that hide vehicles from a sensor with occlusion: outlines, each a list of x and y of its corners; or a
    number, for a building at each corner of the roads, so many m from them."""

    def __post_init__(self) -> None:
        if self.name in SCENES:
            raise InputError(f"name must not be that of a built-in scene, {self.name}; choose another one")
        if self.name is not None:
            require_scene_name(self.name)
        require_ranges(self)

    @classmethod
    def of(cls, scene: Scene) -> Self:
        """Return the numbers of a scene that is built in, or made from one that is."""
        return cls(
            base=scene.base or scene.name,
            name=scene.name if scene.base else None,
            start_m=scene.ego.start_m,
            goal_m=scene.ego.goal_m,
            controller=scene.ego.controller,
            claim=scene.claim,
            population=scene.population,
            arrivals_per_s=scene.traffic.arrivals_per_s,
            max_vehicles=scene.max_vehicles,
            step_s=scene.step_s,
            time_limit_s=scene.time_limit_s,
            buildings=scene.buildings,
        )

    def scene(self) -> Scene:
        """Return the scene with these numbers; the built-in one where they are its numbers."""
        base = find_scene(self.base)
        if replace(self, name=None) == SceneSettings.of(base):
            return base
        ego = replace(base.ego, start_m=self.start_m, goal_m=self.goal_m, controller=self.controller)
        return replace(
            base,
            base=base.name,
            name=self.name or f"{base.name}-{_digest(self._named())}",
            ego=ego,
            claim=self.claim,
            population=self.population,
            traffic=replace(base.traffic, arrivals_per_s=self.arrivals_per_s),
            max_vehicles=self.max_vehicles,
            step_s=self.step_s,
            time_limit_s=self.time_limit_s,
            buildings=self.buildings if isinstance(self.buildings, tuple) else corner_buildings(base, self.buildings),
        )

    def _named(self) -> dict[str, Any]:
        """Return the settings from which a name is made; without what is newer it is that of earlier versions."""
        named = {name: value for name, value in plain(self).items() if name != "buildings" or value != []}
        drivers = _without(
            named["population"],
            {"towns": None, "car_following": Population.car_following, "fitted": [], "willingness": None},
        )
        if "towns" in drivers:
            drivers["towns"] = _without(drivers["towns"], {"episodes": Towns.episodes})
        return {**named, "population": drivers}


@dataclass(frozen=True)
class SumocfgSettings:
    """The arguments of ``tint_sumo.scenes.from_sumocfg``."""

    sumocfg: Path
    """SUMO configuration; its step length is the scene's."""
    ego_route: Many[str]
    """Edges that the ego drives along, one after the other."""
    start_m: RouteM
    """Position of the ego's front on its route at the beginning; not on a junction."""
    goal_m: RouteM
    """The ego's front past it is a success."""
    max_vehicles: Slots = SumocfgScene.max_vehicles
    """Most vehicles in an observation, the nearest ones."""
    sight_m: DistanceM | None = None
    """Farthest distance at which they are observed; null: 50 m, or more where the ego is fast."""
    warm_up_s: WarmUpS = SumocfgScene.warm_up_s
    """Time for which the traffic runs before the ego appears."""
    warm_up_spread_s: WarmUpS = SumocfgScene.warm_up_spread_s
    """Each episode draws by how much longer that is, from 0 to this."""
    warm_starts: WarmStarts = SumocfgScene.warm_starts
    """The traffic of so many seeds is warmed up once each for all episodes; 0: each has a warm-up of its own."""
    time_limit_s: TimeS = SumocfgScene.time_limit_s
    """Longest time of an episode."""
    vehicle: VehicleShape = field(default_factory=VehicleShape)
    """The ego's shape."""
    controller: EgoController | None = None
    """Controller of the ego; its desired speeds are the actions. null: nothing, half and all of the speed limit."""
    ego_control: EgoControl = SumocfgScene.ego_control
    """Driver of the ego: the actions (speed), or SUMO's driver (sumo)."""
    perceives: Many[Perceivable] = SumocfgScene.perceives
    """Further keys of the observation."""
    red_light: RedLight = SumocfgScene.red_light
    """Consequence of driving over a stop line at red: none (ignore), a cost, or the episode's end."""
    red_light_penalty: Penalty = SumocfgScene.red_light_penalty
    """Taken from the reward for each stop line driven over at red, if that is a cost."""

    @classmethod
    def of(cls, scene: SumocfgScene) -> Self:
        found = {field.name: getattr(scene, field.name) for field in fields(cls) if field.name != "sumocfg"}
        return cls(sumocfg=scene.config.file, **found)

    def scene(self) -> SumocfgScene:
        return from_sumocfg(**{field.name: getattr(self, field.name) for field in fields(self)})


def _without(values: Mapping[str, Any], newer: Mapping[str, Any]) -> dict[str, Any]:
    """Return values without those that are newer, as long as they are the defaults given."""
    return {key: value for key, value in values.items() if key not in newer or value != newer[key]}


_NEWER = ("ego_control", "perceives", "red_light", "red_light_penalty")  # settings that former cards do not have


def _digest(settings: Mapping[str, Any]) -> str:
    return hashlib.sha256(json.dumps(settings, sort_keys=True).encode()).hexdigest()[:6]


def read_scene(value: Any, where: Where = ()) -> AnyScene:
    """Return the scene of a file: a name, what differs from a ``base``, or a ``sumocfg`` and the ego's task.

    Raises:
        FieldError: there is no such scene, or a value does not fit.
    """
    if not is_mapping(value, SCENES, where):
        return find_scene(require_known(value, SCENES, where))
    if "sumocfg" in value:
        settings: Any = build(SumocfgSettings, value, where)
    else:
        base = require_base(value, SCENES, T_INTERSECTION, where)
        settings = overlay(SceneSettings.of(find_scene(base)), value, where)
    try:
        made: AnyScene = settings.scene()
    except InputError as error:
        raise FieldError(where, str(error)) from None
    return made


def scene_settings(scene: AnyScene) -> SceneSettings | SumocfgSettings:
    """Return a scene as a file describes it, in full.

    Raises:
        InputError: its roads are those of no built-in scene, or it is a recording, which no file describes.
    """
    if isinstance(scene, ReplayScene):
        raise InputError(
            f"scene {scene.name} is a recording, which the files of policies and datasets cannot describe; "
            "use a built-in scene or a SUMO configuration"
        )
    if isinstance(scene, SumocfgScene):
        return SumocfgSettings.of(scene)
    if (scene.base or scene.name) not in SCENES:
        raise InputError(f"the roads of scene {scene.name} are of no built-in scene; register it in SCENES")
    return SceneSettings.of(scene)


def described(scenes: Sequence[AnyScene]) -> dict[str, Any]:
    """Return the entries that name a scene, or all scenes, in cards and settings of runs; for ``read_described``.

    Raises:
        InputError: as in ``scene_settings``.
    """
    scene, *others = scenes
    if others:
        return {"scene": ALL_SCENES, "scene_digest": digest_of(scenes)}
    changed = scene.sumocfg or scene.base
    settings = {"scene_settings": _recorded(scene_settings(scene))} if changed else {}
    return {"scene": scene.name, "scene_digest": scene.digest, **settings}


def _recorded(settings: SceneSettings | SumocfgSettings) -> dict[str, Any]:
    """Return settings for cards and runs; without what is newer they are those of earlier versions."""
    return _without(plain(settings), {name: plain(getattr(SumocfgSettings, name)) for name in _NEWER})


def read_described(card: Mapping[str, Any]) -> tuple[AnyScene, ...]:
    """Return the scene of a card, or all scenes.

    Raises:
        FieldError: there is no such scene, or a value does not fit.
    """
    if card.get("scene") == ALL_SCENES:
        return find_scenes(ALL_SCENES)
    return (read_scene(card.get("scene_settings", card.get("scene")), ("scene",)),)
