"""``tint-sumo net``."""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

from tint_sumo.cli.command import Command, Outcome
from tint_sumo.cli.values import Scene
from tint_sumo.core.ranges import Range


@dataclass(frozen=True, kw_only=True)
class Net(Command):
    """Build a scene's road network with netconvert, its drivers, and a configuration for plain SUMO."""

    scene: Scene = "t_intersection"
    replicas: Annotated[int, Range(1, 10_000)] = 1
    """Number of intersections in the network."""
    out: Path = Path("sumo_net")
    """Folder for the files; files of the same names are replaced if this command wrote them."""

    def run(self) -> Outcome:
        from tint_sumo.scenes import find_scene, require_built_in
        from tint_sumo.scenes.build import CONFIG_FILE, write_scene

        scene = require_built_in("a network", find_scene(self.scene))
        files = write_scene(self.out, scene, self.replicas)
        text = f"wrote {len(files)} files to {self.out}; run them with: sumo -c {self.out / CONFIG_FILE}"
        return Outcome(text, {"replicas": self.replicas, "files": [str(file) for file in files]})
