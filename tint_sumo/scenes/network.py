"""Road networks as data, SUMO's plain XML written from them, and ``netconvert`` to build it for any number of replicas.

Formats: https://sumo.dlr.de/docs/Networks/PlainXML.html
"""

import errno
import os
import re
import subprocess
import tempfile
from collections.abc import Iterable
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path

import sumo

from tint_sumo.core.errors import InputError

Point = tuple[float, float]  # x and y in m

REPLICA_SPACING_M = 128.0  # wide enough for people to tell replicas apart
REPLICAS_PER_ROW = 16
_NETCONVERT_OPTIONS = (
    "--no-turnarounds",
    "--offset.disable-normalization",
    *("--junctions.limit-turn-speed", "-1"),
    *("--roundabouts.guess", "false"),  # priorities are those of the edges, on rings, too
    *("--precision", "6"),
)


@dataclass(frozen=True)
class Node:
    """A junction, or a road's end."""

    id: str
    x_m: float
    y_m: float
    shape: tuple[Point, ...] = ()  # outline of the junction; netconvert chooses one if it is not given
    type: str = "priority"  # or dead_end. Never unregulated: SUMO then knows neither reactions nor collisions.


@dataclass(frozen=True)
class Edge:
    """A road of one lane."""

    id: str
    start: str  # node
    end: str
    priority: int
    shape: tuple[Point, ...] = ()  # the lane's middle; straight from node to node if not given


@dataclass(frozen=True)
class Connection:
    """A way from one edge to the next over their junction."""

    start: str  # edge
    end: str
    shape: tuple[Point, ...] = ()  # shape of the lane on the junction; netconvert chooses one if it is not given


@dataclass(frozen=True)
class Network:
    """One intersection in its own frame; ids hold no dots."""

    nodes: tuple[Node, ...]
    edges: tuple[Edge, ...]
    connections: tuple[Connection, ...]
    left_hand: bool
    lane_width_m: float = 4.0  # code
    speed_limit_mps: float = 10.0  # above every desired speed, so that it never binds


@dataclass(frozen=True)
class PlainXml:
    """The three sources netconvert needs."""

    nodes: str
    edges: str
    connections: str
    left_hand: bool


def name(part: str, replica: int) -> str:
    """Return the SUMO id of a network part, for example ``lower_in.0``."""
    return f"{part}.{replica}"


def replica_origin(replica: int, spacing_m: float = REPLICA_SPACING_M) -> Point:
    """Return the network coordinates (m) of a replica's origin."""
    return replica % REPLICAS_PER_ROW * spacing_m, replica // REPLICAS_PER_ROW * spacing_m


def plain_xml(network: Network, replicas: int, spacing_m: float = REPLICA_SPACING_M) -> PlainXml:
    """Write the sources of ``replicas`` copies of an intersection in one network.

    Vehicles of different replicas share no edge and no junction, so they never meet, not even with spacing 0. Then all
    replicas have the same coordinates, hence the same rounding, and a simulated episode is the same in each of them to
    the last bit.
    """
    parts = [_Replica(network, index, replica_origin(index, spacing_m)) for index in range(replicas)]
    return PlainXml(
        nodes=_document("nodes", (part.node(node) for part in parts for node in network.nodes)),
        edges=_document("edges", (part.edge(edge) for part in parts for edge in network.edges)),
        connections=_document(
            "connections", (part.connection(connection) for part in parts for connection in network.connections)
        ),
        left_hand=network.left_hand,
    )


def _document(tag: str, lines: Iterable[str]) -> str:
    return "\n".join([f"<{tag}>", *(f"    {line}" for line in lines), f"</{tag}>", ""])


@dataclass(frozen=True)
class _Replica:
    network: Network
    index: int
    origin: Point

    def _point(self, x: float, y: float) -> str:
        return f"{self.origin[0] + x:.3f},{self.origin[1] + y:.3f}"

    def _shape(self, points: tuple[Point, ...]) -> str:
        return f' shape="{" ".join(self._point(x, y) for x, y in points)}"' if points else ""

    def _ends(self, start: str, end: str) -> str:
        return f'from="{name(start, self.index)}" to="{name(end, self.index)}"'

    def node(self, node: Node) -> str:
        x, y = self._point(node.x_m, node.y_m).split(",")
        kind = ' type="dead_end"' if node.type == "dead_end" else f' type="{node.type}" keepClear="false"'
        return f'<node id="{name(node.id, self.index)}" x="{x}" y="{y}"{kind}{self._shape(node.shape)}/>'

    def edge(self, edge: Edge) -> str:
        lane = (
            f'numLanes="1" speed="{self.network.speed_limit_mps:g}" width="{self.network.lane_width_m:g}" '
            'spreadType="center"'
        )
        ends = self._ends(edge.start, edge.end)
        return (
            f'<edge id="{name(edge.id, self.index)}" {ends} {lane} priority="{edge.priority}"'
            f"{self._shape(edge.shape)}/>"
        )

    def connection(self, connection: Connection) -> str:
        # A place to wait in the middle of a junction would split its lane in two.
        lanes = 'fromLane="0" toLane="0" contPos="0"'
        return f"<connection {self._ends(connection.start, connection.end)} {lanes}{self._shape(connection.shape)}/>"


def sumo_program(program: str) -> str:
    """Return the path of a program of the ``eclipse-sumo`` package, such as ``netconvert``."""
    path = Path(sumo.SUMO_HOME) / "bin" / program
    if not path.exists():
        raise InputError(f"{program} is missing; install it with: pip install eclipse-sumo")
    return str(path)


def require_sumo_opens_temporary_files() -> None:
    """Check the folder of temporary files.

    Raises:
        InputError: its path has a comma; SUMO, which takes lists of files, splits all paths there.
    """
    if "," in tempfile.gettempdir():
        raise InputError(
            f"SUMO cannot open temporary files in {tempfile.gettempdir()}, for it splits paths at commas; "
            "set TMPDIR to a folder without one"
        )


@lru_cache(maxsize=8)  # copies of an environment, and one that begins anew, need the same network again
def build_network(sources: PlainXml) -> str:
    """Run netconvert on the sources and return the text of the network, without its dated header.

    Raises:
        InputError: the folder of temporary files has a comma in its path.
        OSError: the system refuses room for temporary files, or something else that netconvert needs.
    """
    require_sumo_opens_temporary_files()
    with tempfile.TemporaryDirectory() as folder:
        files = {kind: Path(folder) / f"net.{kind}.xml" for kind in ("nod", "edg", "con", "net")}
        files["nod"].write_text(sources.nodes, encoding="utf-8")
        files["edg"].write_text(sources.edges, encoding="utf-8")
        files["con"].write_text(sources.connections, encoding="utf-8")
        command = [
            sumo_program("netconvert"),
            *("--node-files", str(files["nod"])),
            *("--edge-files", str(files["edg"])),
            *("--connection-files", str(files["con"])),
            *("--output-file", str(files["net"])),
            *(("--lefthand",) if sources.left_hand else ()),
            *_NETCONVERT_OPTIONS,
        ]
        result = subprocess.run(command, capture_output=True, text=True, check=False)
        if result.returncode != 0:
            raise OSError(f"netconvert failed: {result.stderr.strip() or f'it ended with {result.returncode}'}")
        network = files["net"].read_text(encoding="utf-8")
    if not network.rstrip().endswith("</net>"):  # netconvert reports success on a full disk, too
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC), tempfile.gettempdir())
    return re.sub(r"<!--.*?-->\s*", "", network, flags=re.DOTALL)
