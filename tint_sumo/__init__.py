"""Driving among strangers: driver-trait inference and intersection navigation on Eclipse SUMO.

Importing this package registers its environments with gymnasium.
"""

from gymnasium.envs.registration import register, registry

__version__ = "0.1.0"

# Each scene's environment; a version grows when its episodes change.
ENV_IDS = {
    "t_intersection": "tint_sumo/TIntersection-v1",
    "t_intersection_right": "tint_sumo/TIntersectionRight-v0",
    "t_intersection_street": "tint_sumo/TIntersectionStreet-v0",
    "four_way": "tint_sumo/FourWay-v0",
    "four_way_turn": "tint_sumo/FourWayTurn-v0",
    "roundabout": "tint_sumo/Roundabout-v0",
    "on_ramp": "tint_sumo/OnRamp-v0",
}
SCENE_ENV_ID = "tint_sumo/Scene-v0"  # the environment of any scene, which is given as ``scene``
STRANGERS_ENV_ID = "tint_sumo/Strangers-v0"  # a scene in a world of strangers
REPLAY_ENV_ID = "tint_sumo/Replay-v0"  # an ego among recorded vehicles


def _register(env_id: str, module: str = "envs.entry_points", prefix: str = "Gymnasium", **scene: str) -> None:
    if env_id not in registry:
        register(
            id=env_id,
            entry_point=f"tint_sumo.{module}:{prefix}Env",
            vector_entry_point=f"tint_sumo.{module}:{prefix}VectorEnv",
            kwargs=scene,
        )


for _scene, _env_id in ENV_IDS.items():
    _register(_env_id, scene=_scene)
_register(SCENE_ENV_ID)
_register(STRANGERS_ENV_ID, prefix="Strangers")
_register(REPLAY_ENV_ID, "replay.env", "Replay")
