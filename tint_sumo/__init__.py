"""Driving among strangers: driver-trait inference and intersection navigation on Eclipse SUMO.

Importing this package registers its environments with gymnasium.
"""

from gymnasium.envs.registration import register, registry

__version__ = "0.1.0"

ENV_ID = "tint_sumo/TIntersection-v1"

if ENV_ID not in registry:
    register(
        id=ENV_ID,
        entry_point="tint_sumo.envs.t_intersection:TIntersectionEnv",
        vector_entry_point="tint_sumo.envs.vector:TIntersectionVectorEnv",
    )
