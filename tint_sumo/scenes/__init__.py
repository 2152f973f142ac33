"""Scenes: roads, routes, the ego's task and the drivers. Each scene is one module, imported here once."""

from tint_sumo.scenes import four_way as four_way
from tint_sumo.scenes import on_ramp as on_ramp
from tint_sumo.scenes import roundabout as roundabout
from tint_sumo.scenes import t_intersection as t_intersection
from tint_sumo.scenes import t_intersection_street as t_intersection_street
from tint_sumo.scenes.registry import (
    ALL_SCENES,
    SCENES,
    T_INTERSECTION,
    AnyScene,
    digest_of,
    find_scene,
    find_scenes,
    paper_scene,
    require_built_in,
    require_trait_steps,
)
from tint_sumo.scenes.scene import EgoTask, Route, Scene, View
from tint_sumo.scenes.settings import described, read_described, read_scene, scene_settings
from tint_sumo.scenes.sumocfg import SumocfgScene, from_sumocfg

__all__ = [
    "ALL_SCENES",
    "SCENES",
    "T_INTERSECTION",
    "AnyScene",
    "EgoTask",
    "Route",
    "Scene",
    "SumocfgScene",
    "View",
    "described",
    "digest_of",
    "find_scene",
    "find_scenes",
    "from_sumocfg",
    "paper_scene",
    "read_described",
    "read_scene",
    "require_built_in",
    "require_trait_steps",
    "scene_settings",
]
