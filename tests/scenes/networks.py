"""SUMO configurations that were not made for this project.

``braunschweig`` and ``autobahn`` come with SUMO, in tools/game: a crossing with traffic lights, up to eight lanes,
bicycles, lorries and buses, and a junction of the A10 from an OpenStreetMap extract that an old netconvert has built.
``grid`` is netgenerate's, ``merge`` netconvert's with a vTypeDistribution and a lane that ends.
"""

import subprocess
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import sumo

from tint_sumo.config import EgoController
from tint_sumo.scenes import SumocfgScene, from_sumocfg
from tint_sumo.scenes.network import sumo_program

_SHIPPED = Path(sumo.SUMO_HOME) / "tools" / "game"
_GRID_FLOWS = "".join(
    f'    <flow id="{start}-{end}" {kind} from="{start}" to="{end}" begin="0" end="3600" period="exp(0.2)"/>\n'
    for start, end, kind in (
        ("left0A0", "C0right0", ""),
        ("left1A1", "C1right1", 'type="lorry"'),
        ("bottom0A0", "A2top0", ""),
        ("bottom1B0", "B2top1", 'type="lorry"'),
        ("top1B2", "B0bottom1", ""),
        ("right1C1", "A1left1", ""),
    )
)
_GRID_ROUTES = f'<routes>\n    <vType id="lorry" vClass="truck"/>\n{_GRID_FLOWS}</routes>\n'
_LIGHTS_ROUTES = """<routes>
    <vType id="car"/>
    <flow id="across" type="car" from="bottom0A0" to="A1top0" begin="0" end="3600" period="exp(0.2)"/>
    <flow id="oncoming" type="car" from="right0B0" to="A0left0" begin="0" end="3600" period="exp(0.2)"/>
</routes>
"""
_MERGE_NODES = """
    <node id="west" x="0" y="0"/>
    <node id="middle" x="150" y="0" type="priority"/>
    <node id="east" x="300" y="0"/>
    <node id="south" x="60" y="-60"/>
"""
_MERGE_EDGES = """
    <edge id="in" from="west" to="middle" numLanes="2" speed="13.9" priority="3"/>
    <edge id="ramp" from="south" to="middle" numLanes="1" speed="13.9" priority="1"/>
    <edge id="out" from="middle" to="east" numLanes="2" speed="13.9" priority="3"/>
"""
_MERGE_ROUTES = """<routes>
    <vTypeDistribution id="people">
        <vType id="calm" carFollowModel="IDM" maxSpeed="7" minGap="3" tau="1.5" probability="0.5"/>
        <vType id="hasty" carFollowModel="IDM" maxSpeed="11" minGap="1" tau="0.8" probability="0.5"/>
    </vTypeDistribution>
    <flow id="through" type="people" from="in" to="out" departLane="random" begin="0" end="3600" period="exp(0.4)"/>
    <flow id="joining" type="people" from="ramp" to="out" begin="0" end="3600" period="exp(0.1)"/>
</routes>
"""


@dataclass(frozen=True)
class UserNetwork:
    """A configuration and a task in it."""

    sumocfg: Path
    ego_route: tuple[str, ...]
    start_m: float
    goal_m: float
    speeds_mps: tuple[float, ...] = (0.0, 0.5, 3.0)

    def scene(self, **changes: Any) -> SumocfgScene:
        task: dict[str, Any] = {
            "ego_route": self.ego_route,
            "start_m": self.start_m,
            "goal_m": self.goal_m,
            "controller": EgoController(self.speeds_mps),
            "warm_up_s": 20.0,
        }
        return from_sumocfg(self.sumocfg, **(task | changes))


def braunschweig(_: Path) -> UserNetwork:
    return UserNetwork(_SHIPPED / "fokr_bs_demo.sumocfg", ("-3", "-3.22", "1", "1.16"), 5.0, 100.0)


def autobahn(_: Path) -> UserNetwork:
    route = ("4935288", "240042194#0", "308396219")
    return UserNetwork(_SHIPPED / "A10KW.sumocfg", route, 5.0, 300.0, (0.0, 5.0, 12.0))


def grid(folder: Path) -> UserNetwork:
    """Four crossings by four with two lanes per direction, in SUMO's default steps of a second."""
    options = "--grid --grid.x-number 3 --grid.y-number 3 --grid.length 80 --grid.attach-length 60 -L 2"
    _run("netgenerate", *options.split(), "-o", str(folder / "grid.net.xml"))
    (folder / "grid.rou.xml").write_text(_GRID_ROUTES)
    sumocfg = write_config(folder / "grid.sumocfg", "grid.net.xml", "grid.rou.xml")
    return UserNetwork(sumocfg, ("bottom2C0", "C0C1", "C1B1", "B1A1"), 10.0, 150.0)


def merge(folder: Path) -> UserNetwork:
    netconvert(folder, _MERGE_NODES, _MERGE_EDGES, "merge")
    (folder / "merge.rou.xml").write_text(_MERGE_ROUTES)
    step = '<step-length value="0.1"/>'
    sumocfg = write_config(folder / "merge.sumocfg", "merge.net.xml", "merge.rou.xml", step)
    return UserNetwork(sumocfg, ("ramp", "out"), 20.0, 130.0)


def lights(folder: Path, step_s: float = 0.1, program: str = "") -> UserNetwork:
    """Two crossings by two with traffic lights and two lanes per direction; the ego drives straight on over two.

    Args:
        folder: for the files.
        step_s: step length.
        program: a tlLogic for the additional file; without one, lights have the programs of netgenerate.
    """
    options = "--grid --grid.x-number 2 --grid.y-number 2 --grid.length 80 --grid.attach-length 80 -L 2"
    kind = ("--default-junction-type", "traffic_light")
    _run("netgenerate", *options.split(), *kind, "-o", str(folder / "lights.net.xml"))
    (folder / "lights.rou.xml").write_text(_LIGHTS_ROUTES)
    (folder / "lights.add.xml").write_text(f"<additional>{program}</additional>")
    more = f'<additional-files value="lights.add.xml"/><step-length value="{step_s}"/>'
    sumocfg = write_config(folder / f"lights_{step_s}.sumocfg", "lights.net.xml", "lights.rou.xml", more)
    return UserNetwork(sumocfg, ("left0A0", "A0B0", "B0right0"), 20.0, 200.0, (0.0, 5.0, 10.0))


USER_NETWORKS: dict[str, Callable[[Path], UserNetwork]] = {
    one.__name__: one for one in (braunschweig, autobahn, grid, merge)
}


def netconvert(folder: Path, nodes: str, edges: str, name: str = "x") -> Path:
    """Write a network of these nodes and edges, in SUMO's XML, into a folder; return its file."""
    (folder / f"{name}.nod.xml").write_text(f"<nodes>{nodes}</nodes>")
    (folder / f"{name}.edg.xml").write_text(f"<edges>{edges}</edges>")
    net = folder / f"{name}.net.xml"
    _run("netconvert", "-n", str(folder / f"{name}.nod.xml"), "-e", str(folder / f"{name}.edg.xml"), "-o", str(net))
    return net


def write_config(file: Path, net: str, routes: str, more: str = "") -> Path:
    file.write_text(
        f'<configuration>\n    <input>\n        <net-file value="{net}"/>\n        <route-files value="{routes}"/>\n'
        f"    </input>\n    {more}\n</configuration>\n"
    )
    return file


def _run(program: str, *options: str) -> None:
    subprocess.run([sumo_program(program), *options], check=True, capture_output=True)
