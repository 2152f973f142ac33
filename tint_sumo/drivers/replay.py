"""SUMO itself behind recorded leaders: each pair has a road, on which the leader is moved along its recording."""

import tempfile
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from xml.sax.saxutils import quoteattr

import numpy as np
from numpy.typing import NDArray

from tint_sumo.core.errors import InputError
from tint_sumo.core.files import write_text
from tint_sumo.core.progress import Progress, Report, silent
from tint_sumo.drivers.pairs import Pair
from tint_sumo.scenes.network import PlainXml, build_network
from tint_sumo.simulation.connection import SUMO_ERRORS, Connection, connect

Floats = NDArray[np.float64]

NO_LIMIT_MPS = 200.0  # SUMO's highest speed limit that binds nobody
_LENGTH_M = 5.0  # of leaders, whose rears are as recorded
_LEADER = "leader"
_ENTRY_M = 100.0  # before the first position of a follower: vehicles enter there, and are moved at once
_BEYOND_M = 500.0  # behind the last position of a leader
_ROADS = 128  # in one simulation
_ROUTE_FILE = "routes.rou.xml"


@dataclass(frozen=True, eq=False)
class Driven:
    """A follower as SUMO drove it behind a recorded leader."""

    front_m: Floats  # (T,) as in the pair
    speed_mps: Floats  # (T,)


def vtype_xml(type_id: str, attributes: Mapping[str, str]) -> str:
    """Return a vType as SUMO reads it."""
    parts = " ".join(f"{name}={quoteattr(value)}" for name, value in attributes.items())
    return f"<vType id={quoteattr(type_id)} {parts}/>"


def drive(
    pairs: Sequence[Pair],
    types_xml: str,
    type_ids: Sequence[str],
    speed_limit_mps: float = NO_LIMIT_MPS,
    seed: int = 0,
    report: Report = silent,
) -> list[Driven]:
    """Let SUMO drive the followers of some pairs behind their recorded leaders.

    Args:
        pairs: all with the same step.
        types_xml: vTypes and vTypeDistributions, as in a file of routes.
        type_ids: the vType or vTypeDistribution of each pair's follower.
        speed_limit_mps: of the roads.
        seed: of SUMO's randomness.
        report: of the pairs done.

    Raises:
        InputError: the pairs have different steps, or SUMO refuses the types.
    """
    if len({pair.step_s for pair in pairs}) > 1:
        raise InputError("pairs must have the same step; read them with one `step`")
    driven: list[Driven] = []
    for first in range(0, len(pairs), _ROADS):
        part = slice(first, first + _ROADS)
        driven += _drive_together(pairs[part], types_xml, type_ids[part], speed_limit_mps, seed + first)
        report(Progress(len(driven), len(pairs), "pair"))
    return driven


def _drive_together(
    pairs: Sequence[Pair], types_xml: str, type_ids: Sequence[str], speed_limit_mps: float, seed: int
) -> list[Driven]:
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        write_text(folder / "net.net.xml", build_network(_roads(pairs, speed_limit_mps)))
        leader = vtype_xml(_LEADER, {"length": f"{_LENGTH_M:g}", "maxSpeed": f"{NO_LIMIT_MPS:g}", "speedDev": "0"})
        routes = "".join(f'<route id="{index}" edges="{index}"/>' for index in range(len(pairs)))
        write_text(folder / _ROUTE_FILE, f"<routes>{leader}{types_xml}{routes}</routes>")
        options = [
            *("--net-file", str(folder / "net.net.xml"), "--route-files", str(folder / _ROUTE_FILE)),
            *("--step-length", f"{pairs[0].step_s:g}", "--seed", str(seed), "--time-to-teleport", "-1"),
            *("--collision.action", "none", "--no-step-log", "true", "--no-warnings", "true"),
        ]
        try:
            connection = connect(options)
        except SUMO_ERRORS as error:
            raise InputError(f"SUMO refuses the vTypes ({' '.join(str(error).split())}); correct them") from None
        try:
            return _follow(connection, pairs, type_ids)
        finally:
            connection.close()


def _roads(pairs: Sequence[Pair], speed_limit_mps: float) -> PlainXml:
    """Return a straight road for each pair, one beside the other."""
    nodes, edges = [], []
    for index, pair in enumerate(pairs):
        end_m = _start_m(pair) + max(pair.leader_rear_m.max(), pair.front_m.max()) + _LENGTH_M + _BEYOND_M
        nodes.append(
            f'<node id="{index}a" x="0" y="{20 * index}"/><node id="{index}b" x="{end_m:.2f}" y="{20 * index}"/>'
        )
        edges.append(f'<edge id="{index}" from="{index}a" to="{index}b" numLanes="1" speed="{speed_limit_mps:g}"/>')
    return PlainXml(
        f"<nodes>{''.join(nodes)}</nodes>", f"<edges>{''.join(edges)}</edges>", "<connections/>", left_hand=False
    )


def _start_m(pair: Pair) -> float:
    """Return where on its road the first position of a pair's follower track lies."""
    return 2.0 * _ENTRY_M - min(float(pair.front_m[0]), 0.0)


def _follow(connection: Connection, pairs: Sequence[Pair], type_ids: Sequence[str]) -> list[Driven]:
    vehicle = connection.vehicle
    starts_m = [_start_m(pair) for pair in pairs]
    for index, type_id in enumerate(type_ids):
        vehicle.add(f"{index}l", str(index), _LEADER, departPos=str(2.0 * _ENTRY_M), departSpeed="0")
        vehicle.add(f"{index}f", str(index), type_id, departPos=str(_ENTRY_M), departSpeed="0")
    connection.step()
    for index, pair in enumerate(pairs):
        vehicle.setSpeedMode(f"{index}l", 32)
        vehicle.moveTo(f"{index}f", f"{index}_0", starts_m[index] + pair.front_m[0])
        vehicle.setPreviousSpeed(f"{index}f", pair.speed_mps[0], 0.0)
    driven = [Driven(np.empty(pair.rows), np.empty(pair.rows)) for pair in pairs]
    changes_mps2 = [np.diff(pair.leader_speed_mps, prepend=pair.leader_speed_mps[:1]) / pair.step_s for pair in pairs]
    for row in range(max(pair.rows for pair in pairs)):
        for index, pair in enumerate(pairs):
            leader, follower = f"{index}l", f"{index}f"
            if row >= pair.rows:
                if row == pair.rows:
                    vehicle.remove(leader)
                    vehicle.remove(follower)
                continue
            vehicle.moveTo(leader, f"{index}_0", starts_m[index] + pair.leader_rear_m[row] + _LENGTH_M)
            vehicle.setPreviousSpeed(leader, pair.leader_speed_mps[row], changes_mps2[index][row])
            driven[index].front_m[row] = connection.lane_position_m(follower) - starts_m[index]
            driven[index].speed_mps[row] = vehicle.getSpeed(follower)
        connection.step()
    return driven
