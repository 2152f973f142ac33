"""``tint-sumo net``."""

from dataclasses import asdict, dataclass
from pathlib import Path
from shlex import quote
from typing import Annotated, Literal

from tyro.conf import Positional, Suppress, subcommand

from tint_sumo.cli.command import Command, Outcome, wrote
from tint_sumo.cli.values import Scene, optional
from tint_sumo.core.ranges import Range

_FORMAT = optional("NAME", "Format: commonroad, lanelet2, opendrive or osm.", "recognised by the contents")
_Latitude = Annotated[float, Range(-90.0, 90.0)]
_Longitude = Annotated[float, Range(-180.0, 180.0)]
_ORIGIN = optional(
    "LATITUDE LONGITUDE",
    "Degrees of x = y = 0 in a lanelet2 map.",
    "0 0 for maps that lie there, as INTERACTION's; else x and y are those of UTM",
)
_LEFT_HAND = optional("true|false", "Traffic drives on the left.", "as the map says, else on the right")


@dataclass(frozen=True, kw_only=True)
class BuildNet(Command):
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
        text = f"wrote {len(files)} files to {self.out}; run them with: sumo -c {quote(str(self.out / CONFIG_FILE))}"
        return Outcome(text, {"replicas": self.replicas, "files": [str(file) for file in files]})


@dataclass(frozen=True, kw_only=True)
class ImportNet(Command):
    """Import a map as a SUMO network: OpenDRIVE, OpenStreetMap, CommonRoad or lanelet2."""

    file: Positional[Path]
    """Map, gzipped or not."""
    out: Path
    """Folder for the network and its plain XML."""
    format: Annotated[str | None, _FORMAT] = None
    left_hand: Annotated[Literal["true", "false"] | None, _LEFT_HAND] = None
    origin: Annotated[tuple[_Latitude, _Longitude] | None, _ORIGIN] = None
    overwrite: bool = False
    """Replace files of the same names."""

    def run(self) -> Outcome:
        from tint_sumo.maps import import_map
        from tint_sumo.maps.importing import report

        left_hand = None if self.left_hand is None else self.left_hand == "true"
        found = import_map(
            self.file,
            self.out,
            format_name=self.format,
            left_hand=left_hand,
            origin=self.origin,
            overwrite=self.overwrite,
        )
        files = [str(file) for file in found.files]
        return Outcome("\n".join([report(found), *wrote(files)]), {**asdict(found), "files": files})


# tyro makes subcommands of unions only, hence the None.
@dataclass(frozen=True)
class Net:
    """Road networks for SUMO: of the built-in scenes, or imported from maps. Alone it is net build."""

    command: Annotated[BuildNet, subcommand("build")] | Annotated[ImportNet, subcommand("import")] | Suppress[None]
