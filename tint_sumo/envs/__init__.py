"""Gymnasium environments; those for Stable-Baselines3 stand in ``tint_sumo.envs.sb3``, which loads torch."""

from tint_sumo.envs.episodes import TaskSettings
from tint_sumo.envs.scene_env import SceneEnv
from tint_sumo.envs.vector import SceneVectorEnv

__all__ = ["SceneEnv", "SceneVectorEnv", "TaskSettings"]
