"""The T-intersection as SUMO plain XML, and ``netconvert`` to build it for any number of replicas.

Each lane crosses its own priority junction, L on the lower lane and U on the upper one, joined by a very short edge on
the ego's arc: a driver then reacts to the ego only once it enters the junction of the driver's own lane. One junction
for both lanes would make upper-lane drivers brake for an ego that still stands in the lower lane.

Formats: https://sumo.dlr.de/docs/Networks/PlainXML.html
"""

import re
import subprocess
import tempfile
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import sumo

from tint_sumo.config import Street, VehicleShape
from tint_sumo.errors import InputError
from tint_sumo.scenario.geometry import EgoPath, junction_span_m, lane_border_y_m, path_point

LOWER_ROUTE = ("lower_in", "lower_out")
UPPER_ROUTE = ("upper_in", "upper_out")
EGO_ROUTE = ("stem", "mid", "upper_out")

# The SUMO lanes of the lower and the upper lane in driving order, the middle one on the junction (netconvert's naming).
_SUMO_LANES = (
    ("lower_in.{replica}_0", ":L.{replica}_1_0", "lower_out.{replica}_0"),
    ("upper_in.{replica}_0", ":U.{replica}_0_0", "upper_out.{replica}_0"),
)

REPLICA_SPACING_M = 128.0  # for people to look at
REPLICAS_PER_ROW = 16
_HALF_LINK_M = 0.06
_TURN_POINTS = 16
_NETCONVERT_OPTIONS = (
    "--lefthand",
    "--no-turnarounds",
    "--offset.disable-normalization",
    "--junctions.limit-turn-speed",
    "-1",
    "--precision",
    "6",
)


def name(part: str, replica: int) -> str:
    """SUMO id of a network part, for example ``lower_in.0``."""
    return f"{part}.{replica}"


def lane_id(lane: int, stage: int, replica: int) -> str:
    """SUMO id of the ``stage``-th SUMO lane (before, on, after the junction) of the lower (0) or upper (1) lane."""
    return _SUMO_LANES[lane][stage].format(replica=replica)


def replica_origin(replica: int, spacing_m: float = REPLICA_SPACING_M) -> tuple[float, float]:
    """Network coordinates (m) of a replica's own origin."""
    return replica % REPLICAS_PER_ROW * spacing_m, replica // REPLICAS_PER_ROW * spacing_m


@dataclass(frozen=True)
class PlainXml:
    """The three sources netconvert needs."""

    nodes: str
    edges: str
    connections: str


def plain_xml(replicas: int, street: Street, vehicle: VehicleShape, spacing_m: float = REPLICA_SPACING_M) -> PlainXml:
    """Write the sources of ``replicas`` intersections in one network.

    Vehicles of different replicas share no edge and no junction, so they never meet, not even with spacing 0. Then all
    replicas have the same coordinates, hence the same rounding, and a simulated episode is the same in each of them to
    the last bit.
    """
    parts = [_Replica(index, spacing_m, street, vehicle) for index in range(replicas)]
    return PlainXml(
        nodes=_document("nodes", [line for part in parts for line in part.nodes()]),
        edges=_document("edges", [line for part in parts for line in part.edges()]),
        connections=_document("connections", [line for part in parts for line in part.connections()]),
    )


def _document(tag: str, lines: list[str]) -> str:
    return "\n".join([f"<{tag}>", *(f"    {line}" for line in lines), f"</{tag}>", ""])


@dataclass(frozen=True)
class _Replica:
    index: int
    spacing_m: float
    street: Street
    vehicle: VehicleShape

    def _point(self, x: float, y: float) -> str:
        origin_x, origin_y = replica_origin(self.index, self.spacing_m)
        return f"{origin_x + x:.3f},{origin_y + y:.3f}"

    def _shape(self, *points: tuple[float, float]) -> str:
        return " ".join(self._point(x, y) for x, y in points)

    def _turn(self, start_m: float, end_m: float, points: int) -> str:
        """Part of the ego's path, between two path lengths."""
        path = EgoPath.of(self.street, self.vehicle)
        return self._shape(*(path_point(path_m, path)[:2] for path_m in np.linspace(start_m, end_m, points).tolist()))

    @property
    def _link_m(self) -> tuple[float, float]:
        """Path lengths between which the edge from the lower junction to the upper one lies."""
        border_m = EgoPath.of(self.street, self.vehicle).crossing_m(lane_border_y_m(self.street))
        return border_m - _HALF_LINK_M, border_m + _HALF_LINK_M

    def nodes(self) -> list[str]:
        street, half_width = self.street, self.street.lane_width_m / 2
        # Lanes reach half a vehicle past the street, so that a vehicle enters with departPos="base" and arrives at its
        # lane's end just when its centre crosses the border.
        end = street.half_length_m + self.vehicle.length_m / 2
        low, high = street.lower_y_m - half_width, street.upper_y_m + half_width
        middle = lane_border_y_m(street)
        (east, west), (upper_west, upper_east) = junction_span_m(street, self.vehicle).tolist()
        stem = half_width
        lower_shape = self._shape((-stem, low), (stem, low), (east, low), (east, middle), (west, middle), (west, low))
        upper_shape = self._shape((upper_west, middle), (upper_east, middle), (upper_east, high), (upper_west, high))

        def node(part: str, x: float, y: float, extra: str) -> str:
            px, py = self._point(x, y).split(",")
            return f'<node id="{name(part, self.index)}" x="{px}" y="{py}" {extra}/>'

        return [
            node("S", 0, -street.stem_length_m, 'type="dead_end"'),
            node("WL", -end, street.lower_y_m, 'type="dead_end"'),
            node("EL", end, street.lower_y_m, 'type="dead_end"'),
            node("WU", -end, street.upper_y_m, 'type="dead_end"'),
            node("EU", end, street.upper_y_m, 'type="dead_end"'),
            node("L", 0, street.lower_y_m, f'type="priority" keepClear="false" shape="{lower_shape}"'),
            node("U", 0, street.upper_y_m, f'type="priority" keepClear="false" shape="{upper_shape}"'),
        ]

    def edges(self) -> list[str]:
        street = self.street
        lane = f'numLanes="1" speed="{street.speed_limit_mps:g}" width="{street.lane_width_m:g}" spreadType="center"'

        def edge(part: str, start: str, end: str, priority: int, shape: str = "") -> str:
            ends = f'from="{name(start, self.index)}" to="{name(end, self.index)}"'
            return f'<edge id="{name(part, self.index)}" {ends} {lane} priority="{priority}"{shape}/>'

        stem = self._shape((0, -street.stem_length_m), (0, 0))
        link = self._turn(*self._link_m, points=2)
        return [
            edge("lower_in", "EL", "L", 3),
            edge("lower_out", "L", "WL", 3),
            edge("upper_in", "WU", "U", 3),
            edge("upper_out", "U", "EU", 3),
            edge("stem", "S", "L", 1, f' shape="{stem}"'),
            edge("mid", "L", "U", 1, f' shape="{link}"'),
        ]

    def connections(self) -> list[str]:
        def connection(start: str, end: str, shape: str = "") -> str:
            ends = f'from="{name(start, self.index)}" to="{name(end, self.index)}"'
            return f'<connection {ends} fromLane="0" toLane="0"{shape}/>'

        path = EgoPath.of(self.street, self.vehicle)
        link_start_m, link_end_m = self._link_m
        first = f"{self._shape((0, 0))} {self._turn(path.turn_start_m, link_start_m, _TURN_POINTS)}"
        second = self._turn(link_end_m, path.turn_end_m, _TURN_POINTS)
        return [
            connection("lower_in", "lower_out"),
            connection("upper_in", "upper_out"),
            connection("stem", "mid", f' shape="{first}"'),
            connection("mid", "upper_out", f' shape="{second}"'),
        ]


def sumo_program(program: str) -> str:
    """Path of a program of the ``eclipse-sumo`` package, such as ``netconvert``."""
    path = Path(sumo.SUMO_HOME) / "bin" / program
    if not path.exists():
        raise InputError(f"{program} is missing; install it with: pip install eclipse-sumo")
    return str(path)


def build_network(sources: PlainXml) -> str:
    """Run netconvert on the sources and return the text of the network, without its dated header."""
    with tempfile.TemporaryDirectory() as folder:
        files = {kind: Path(folder) / f"tint.{kind}.xml" for kind in ("nod", "edg", "con", "net")}
        files["nod"].write_text(sources.nodes, encoding="utf-8")
        files["edg"].write_text(sources.edges, encoding="utf-8")
        files["con"].write_text(sources.connections, encoding="utf-8")
        command = [
            sumo_program("netconvert"),
            *("--node-files", str(files["nod"])),
            *("--edge-files", str(files["edg"])),
            *("--connection-files", str(files["con"])),
            *("--output-file", str(files["net"])),
            *_NETCONVERT_OPTIONS,
        ]
        result = subprocess.run(command, capture_output=True, text=True, check=False)
        if result.returncode != 0:
            raise RuntimeError(f"netconvert failed: {result.stderr.strip()}")
        return re.sub(r"<!--.*?-->\s*", "", files["net"].read_text(encoding="utf-8"), flags=re.DOTALL)
