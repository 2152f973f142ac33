"""Gymnasium environments; those for Stable-Baselines3 stand in ``tint_sumo.envs.sb3``, which loads torch."""

from tint_sumo.envs.t_intersection import TIntersectionEnv
from tint_sumo.envs.vector import TIntersectionVectorEnv

__all__ = ["TIntersectionEnv", "TIntersectionVectorEnv"]
