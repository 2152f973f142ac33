"""The traffic of a SUMO configuration in a running simulation, for one ego or several."""

from tint_sumo.config import Backend
from tint_sumo.scenes.sumo_run import SumocfgRun
from tint_sumo.scenes.sumocfg import SumocfgScene
from tint_sumo.simulation.connection import connect
from tint_sumo.simulation.refusals import Refusals
from tint_sumo.simulation.warm_starts import WarmStarts


class SumocfgTraffic:
    """A running SUMO configuration; ``refusals`` stands around all that SUMO may refuse.

    Raises:
        InputError: SUMO refuses the configuration.
    """

    def __init__(self, scene: SumocfgScene, backend: Backend = "auto") -> None:
        self.refusals = Refusals(scene.config)
        with self.refusals:
            self._run = SumocfgRun(scene.config, scene.added_types_xml)
            self.connection = connect(self._run.options(seed=0), backend)
        self.warm_starts = WarmStarts(scene, self.connection, self._run)

    def close(self) -> None:
        """End the simulation; safe to call twice."""
        self.connection.close()
        self._run.close()
