"""Driving among recorded vehicles: scenes and an environment from a SUMO network and recorded tracks."""

from tint_sumo.replay.cases import EgoOnEdges
from tint_sumo.replay.env import ReplayEnv
from tint_sumo.replay.scene import from_tracks

__all__ = ["EgoOnEdges", "ReplayEnv", "from_tracks"]
