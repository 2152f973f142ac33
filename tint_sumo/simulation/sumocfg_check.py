"""Says what is in a SUMO configuration, and where the ego could drive in it.

SUMO runs the traffic of the first seconds, with its outputs off: the numbers are those of what an episode meets.
"""

import shlex
from collections import Counter
from contextlib import closing
from dataclasses import asdict, dataclass
from itertools import pairwise
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

from tint_sumo.core.reading import TABLE_BYTES, open_file, unpacked
from tint_sumo.scenes.ego_routes import EgoRoute, Turn, suggest_routes
from tint_sumo.scenes.sumo_config import SumoConfig, read_config, read_vtypes
from tint_sumo.scenes.sumo_run import SumocfgRun, require_loads
from tint_sumo.scenes.sumocfg import EGO_CLASS, SumocfgScene, read_net
from tint_sumo.simulation.connection import connect
from tint_sumo.simulation.refusals import Refusals
from tint_sumo.simulation.vtypes import VType, find_vtype, read_vtype_table

WATCHED_S = 100.0  # so much traffic is looked at
_JUNCTIONS_SHOWN = 6  # kinds of junctions in the report


@dataclass(frozen=True)
class Network:
    """Sizes of a SUMO network; edges are those outside of junctions."""

    file: str
    version: str
    is_lefthand: bool
    edges: int
    lanes: int
    open_edges: int  # to passenger cars
    road_km: float
    width_m: float
    height_m: float
    junctions: dict[str, int]  # by type
    traffic_lights: int


@dataclass(frozen=True)
class Traffic:
    """Traffic of the first seconds of a configuration, without the ego."""

    begin_s: float
    watched_s: float
    vehicles: dict[str, int]  # that departed, by vType
    persons: int
    most_at_once: int
    teleports: int
    turns: Counter[Turn]  # of the routes of those that departed


@dataclass(frozen=True)
class Check:
    """Contents of a SUMO configuration."""

    config: SumoConfig
    network: Network
    vtypes: dict[str, VType]  # the labels; those that SUMO makes at run time have that of their base
    traffic: Traffic
    routes: tuple[EgoRoute, ...]  # suggestions
    scene: SumocfgScene | None  # with the ego's route, if one was given
    passed: dict[str, str]  # junctions on that route with their types

    def summary(self) -> dict[str, Any]:
        """Return all numbers, ready for JSON."""
        traffic = asdict(self.traffic)
        del traffic["turns"]
        return {
            "sumocfg": str(self.config.file),
            "step_s": self.config.step_s,
            "network": asdict(self.network),
            "vtypes": {name: asdict(vtype) for name, vtype in self.vtypes.items()},
            "traffic": traffic,
            "turned_off": list(self.config.left_out),
            "not_supported": _limits(self),
            "routes": [asdict(route) for route in self.routes],
            "passed": self.passed,
        }


def check_sumocfg(sumocfg: Path, scene: SumocfgScene | None = None) -> Check:
    """Return what is in a configuration.

    Args:
        sumocfg: SUMO configuration.
        scene: one that ``from_sumocfg`` made of it, with an ego.

    Raises:
        InputError: it cannot be read, or SUMO refuses it.
    """
    config = read_config(sumocfg)
    net = read_net(config.net_file)
    require_loads(config)
    labels = read_vtypes(config)
    known = read_vtype_table(config.file)
    vtypes = {name: vtype for name in labels if (vtype := find_vtype(name, known)) is not None}
    traffic = _watch(config)
    routes = suggest_routes(net, traffic.turns) if scene is None else ()
    passed = {} if scene is None else _passed(scene, net)
    return Check(config, _network(config.net_file, net), vtypes, traffic, routes, scene, passed)


def _passed(scene: SumocfgScene, net: Any) -> dict[str, str]:
    """Return the junctions between the ego's start and goal, with their types."""
    starts_m = scene.route_edge_start_m
    nodes = [
        net.getEdge(edge).getToNode()
        for edge, after_m in zip(scene.ego_route, starts_m[1:], strict=False)
        if scene.start_m < after_m <= scene.goal_m
    ]
    return {node.getID(): node.getType() for node in nodes}


def _network(file: Path, net: Any) -> Network:
    edges = net.getEdges(withInternal=False)
    (left_m, bottom_m), (right_m, top_m) = net.getBBoxXY()
    return Network(
        file=str(file),
        version=".".join(str(int(part)) for part in net.getVersion()),
        is_lefthand=_is_lefthand(file),
        edges=len(edges),
        lanes=sum(edge.getLaneNumber() for edge in edges),
        open_edges=sum(edge.allows(EGO_CLASS) for edge in edges),
        road_km=sum(edge.getLength() for edge in edges) / 1000.0,
        width_m=right_m - left_m,
        height_m=top_m - bottom_m,
        junctions=dict(Counter(node.getType() for node in net.getNodes()).most_common()),
        traffic_lights=len(net.getTrafficLights()),
    )


def _is_lefthand(file: Path) -> bool:
    """Return whether vehicles drive on the left; sumolib does not say it."""
    with open_file(file, "SUMO network", TABLE_BYTES) as raw:
        _, root = next(iter(ElementTree.iterparse(unpacked(raw), ("start",))))
        return root.get("lefthand") in ("1", "true")


def _watch(config: SumoConfig) -> Traffic:
    """Run a configuration for a while."""
    vehicles: Counter[str] = Counter()
    turns: Counter[Turn] = Counter()
    persons = most_at_once = teleports = 0
    with Refusals(config), closing(SumocfgRun(config)) as run:
        connection = connect(run.options(seed=0))
        try:
            simulation, vehicle = connection.simulation, connection.vehicle
            begin_s = simulation.getTime()
            for _ in range(round(WATCHED_S / config.step_s)):
                connection.step()
                for vehicle_id in simulation.getDepartedIDList():
                    vehicles[vehicle.getTypeID(vehicle_id)] += 1
                    turns.update(pairwise(vehicle.getRoute(vehicle_id)))
                persons += simulation.getDepartedPersonNumber()
                teleports += simulation.getStartingTeleportNumber()
                most_at_once = max(most_at_once, vehicle.getIDCount())
        finally:
            connection.close()
    return Traffic(begin_s, WATCHED_S, dict(vehicles.most_common()), persons, most_at_once, teleports, turns)


def report(found: Check) -> str:
    """Return a page for people."""
    network, traffic = found.network, found.traffic
    kinds = [f"{count:,} {kind}" for kind, count in network.junctions.items()][:_JUNCTIONS_SHOWN]
    side = "left" if network.is_lefthand else "right"
    departed = sum(traffic.vehicles.values())
    lines = [
        f"configuration     {found.config.file.name}, steps of {found.config.step_s:g} s",
        f"network           {Path(network.file).name}, version {network.version}, traffic on the {side}",
        f"edges             {network.edges:,} with {network.lanes:,} lanes, {network.open_edges:,} open to the ego, "
        f"{network.road_km:.1f} km; the network is {network.width_m:,.0f} m by {network.height_m:,.0f} m",
        f"junctions         {sum(network.junctions.values()):,}: {', '.join(kinds)}",
        f"traffic lights    {network.traffic_lights:,}",
        f"traffic           {departed:,} vehicles and {traffic.persons:,} persons depart in the first "
        f"{traffic.watched_s:g} s from {traffic.begin_s:g} s on, up to {traffic.most_at_once:,} vehicles at a time"
        + (f"; {traffic.teleports:,} teleports" if traffic.teleports else ""),
        f"vTypes            {len(found.vtypes):,}, the labels of drivers",
    ]
    width = max(map(len, found.vtypes), default=0)
    for name, vtype in sorted(found.vtypes.items(), key=lambda item: -traffic.vehicles.get(item[0], 0)):
        lines.append(
            f"  {name:{width}}  {traffic.vehicles.get(name, 0):5,} vehicles, {vtype.car_following}, "
            f"{vtype.vehicle_class}, {vtype.length_m:g} m by {vtype.width_m:g} m"
        )
    made = sum(count for name, count in traffic.vehicles.items() if name not in found.vtypes)
    if made:
        lines.append(f"  {made:,} vehicles have vTypes that SUMO makes at run time")
    if found.config.left_out:
        lines.append(f"turned off        {', '.join(found.config.left_out)}")
    lines += [f"limits            {limit}" for limit in _limits(found)]
    lines += ["", *_ego_lines(found)]
    return "\n".join(lines)


def _limits(found: Check) -> list[str]:
    """Return what the configuration has that the ego does not perceive, or need not obey."""
    perceives, red_light = ((), "ignore") if found.scene is None else (found.scene.perceives, found.scene.red_light)
    limits = []
    if found.network.traffic_lights:
        if "traffic_light" not in perceives:
            limits.append("traffic lights are not observed; perceives: traffic_light adds the next one")
        if red_light == "ignore":
            limits.append("the ego may drive through red; red_light: cost or end changes that")
    if found.traffic.persons and "pedestrians" not in perceives:
        limits.append(
            "persons are not observed, but the ego can hit them, and its safety check counts them; "
            "perceives: pedestrians adds them"
        )
    return limits


def _ego_lines(found: Check) -> list[str]:
    """Return lines on the ego's route, or on routes that it could take."""
    if found.scene is not None:
        scene = found.scene
        passed = ", ".join(f"{junction} ({kind})" for junction, kind in found.passed.items()) or "none"
        return [
            f"ego               starts at {scene.start_m:g} m of its route, on edge {scene.departure[0][0]}, and has "
            f"arrived at {scene.goal_m:g} m",
            f"  junctions       {passed}",
        ]
    if not found.routes:
        return ["ego               meets others at no junction; any edges that follow each other will do as its route"]
    lines = ["ego               can take one of these routes, for example (flags of this command and of policy train):"]
    for number, route in enumerate(found.routes, 1):
        edges = shlex.quote(" ".join(route.edges))
        lines += [
            f"  {number}  --ego-route={edges} --start-m {route.start_m:g} --goal-m {route.goal_m:g}",
            f"     {route.turn} at junction {route.junction} ({route.junction_type}); {route.streams} turns of others "
            f"are in conflict with it, {route.vehicles:,} vehicles take those",
        ]
    return lines
