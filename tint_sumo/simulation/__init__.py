"""Simulations of scenes in SUMO."""

from tint_sumo.config import Backend
from tint_sumo.scenes.replay import ReplayScene
from tint_sumo.scenes.scene import Scene
from tint_sumo.scenes.sumocfg import SumocfgScene
from tint_sumo.simulation.replay import ReplaySimulation
from tint_sumo.simulation.scene import SceneSimulation
from tint_sumo.simulation.shared import EgoView, SharedTraffic
from tint_sumo.simulation.simulation import Simulation
from tint_sumo.simulation.sumocfg import SumocfgSimulation

__all__ = [
    "EgoView",
    "ReplaySimulation",
    "SceneSimulation",
    "SharedTraffic",
    "Simulation",
    "SumocfgSimulation",
    "make_simulation",
]


def make_simulation(replicas: int, scene: Scene | SumocfgScene, backend: Backend = "auto") -> Simulation:
    """Return the simulation that plays a scene.

    Raises:
        InputError: SUMO refuses a configuration, or it shall have more than one replica.
    """
    if isinstance(scene, Scene):
        return SceneSimulation(replicas, scene, backend=backend)
    if isinstance(scene, ReplayScene):
        return ReplaySimulation(replicas, scene, backend=backend)
    return SumocfgSimulation(replicas, scene, backend=backend)
