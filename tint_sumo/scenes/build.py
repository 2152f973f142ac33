"""A scene as files that plain ``sumo -c tint.sumocfg`` runs."""

from pathlib import Path

from tint_sumo.core.errors import InputError
from tint_sumo.core.files import require_output_folder, require_own_files, write_text
from tint_sumo.scenes.drivers import DISTRIBUTION_ID, vtypes_xml
from tint_sumo.scenes.layout import EGO
from tint_sumo.scenes.network import REPLICA_SPACING_M, build_network, name, plain_xml, replica_origin
from tint_sumo.scenes.scene import BUILDING, Scene

NET_FILE = "tint.net.xml"
DRIVERS_FILE = "drivers.add.xml"
ROUTES_FILE = "routes.add.xml"
BUILDINGS_FILE = "buildings.add.xml"  # of a scene that has buildings
CONFIG_FILE = "tint.sumocfg"
DEMO_POISSON_RATE_PER_S = 0.2  # per route; about two thirds of saturation
_SATURATED_RATE_PER_S = 1.0  # more than a road can take: drivers for whom there is no room do not wait
_BUILDING_COLOUR = "168,158,146"
_WRITTEN_BY = "<!-- Written by tint-sumo net"
_MARK = f"{_WRITTEN_BY}; change tint_sumo/scenes and run it again. -->\n"


def scene_files(scene: Scene, replicas: int, spacing_m: float = REPLICA_SPACING_M) -> dict[str, str]:
    """Return name and text of every file of a scene; ``spacing_m`` as in ``tint_sumo.scenes.network.plain_xml``.

    Raises:
        InputError: fewer than one replica.
    """
    if replicas < 1:
        raise InputError(f"replicas must be at least 1, not {replicas}")
    sources = plain_xml(scene.network, replicas, spacing_m)
    texts = {
        "tint.nod.xml": sources.nodes,
        "tint.edg.xml": sources.edges,
        "tint.con.xml": sources.connections,
        NET_FILE: build_network(sources),
        DRIVERS_FILE: vtypes_xml(scene.population, scene.traffic.p_conservative.mean, scene.vehicle),
        ROUTES_FILE: _routes_xml(scene, replicas),
        "saturated.rou.xml": _flows_xml(scene, replicas, f"exp({_SATURATED_RATE_PER_S:g})"),
        "poisson.rou.xml": _flows_xml(scene, replicas, f"exp({DEMO_POISSON_RATE_PER_S:g})"),
        CONFIG_FILE: _config_xml(scene),
    }
    if scene.buildings:
        texts[BUILDINGS_FILE] = _buildings_xml(scene, replicas, spacing_m)
    return {file: _marked(text) for file, text in texts.items()}


def write_scene(folder: Path, scene: Scene, replicas: int) -> list[Path]:
    """Write the scene's files into ``folder`` and return the paths.

    Raises:
        InputError: a file of the same name exists that this function did not write, or the folder is a run's.
    """
    require_output_folder(folder)
    texts = scene_files(scene, replicas)
    files = [folder / file for file in texts]
    require_own_files(files, _WRITTEN_BY)
    for file, text in zip(files, texts.values(), strict=True):
        write_text(file, text)
    return files


def _marked(text: str) -> str:
    """Return a text with the mark in front, or behind the XML declaration."""
    if text.startswith("<?xml"):
        declaration, rest = text.split("\n", 1)
        return f"{declaration}\n{_MARK}{rest}"
    return _MARK + text


def _routes_xml(scene: Scene, replicas: int) -> str:
    routes = {route.name: route.edges for route in scene.routes} | {EGO: scene.ego.edges}
    lines = [
        f'    <route id="{name(route, replica)}" edges="{" ".join(name(edge, replica) for edge in edges)}"/>'
        for replica in range(replicas)
        for route, edges in routes.items()
    ]
    return "\n".join(["<additional>", *lines, "</additional>", ""])


def _flows_xml(scene: Scene, replicas: int, period: str) -> str:
    lines = [
        f'    <flow id="{name(route.name, replica)}" route="{name(route.name, replica)}" type="{DISTRIBUTION_ID}" '
        f'begin="0" period="{period}" departPos="base" departSpeed="desired"/>'
        for replica in range(replicas)
        for route in scene.routes
    ]
    return "\n".join(["<routes>", *lines, "</routes>", ""])


def _buildings_xml(scene: Scene, replicas: int, spacing_m: float) -> str:
    lines = [
        f'    <poly id="{name(f"{BUILDING}{number}", replica)}" type="{BUILDING}" color="{_BUILDING_COLOUR}" fill="1" '
        f'layer="0" shape="{" ".join(f"{left_m + x_m:.3f},{low_m + y_m:.3f}" for x_m, y_m in building)}"/>'
        for replica in range(replicas)
        for left_m, low_m in [replica_origin(replica, spacing_m)]
        for number, building in enumerate(scene.buildings)
    ]
    return "\n".join(["<additional>", *lines, "</additional>", ""])


def _config_xml(scene: Scene) -> str:
    additional = [DRIVERS_FILE, ROUTES_FILE, *([BUILDINGS_FILE] if scene.buildings else [])]
    return f"""<configuration>
    <input>
        <net-file value="{NET_FILE}"/>
        <additional-files value="{",".join(additional)}"/>
        <route-files value="saturated.rou.xml"/>
    </input>
    <time>
        <begin value="0"/>
        <end value="300"/>
        <step-length value="{scene.step_s:g}"/>
    </time>
    <processing>
        <max-depart-delay value="1"/>
        <time-to-teleport value="-1"/>
        <collision.action value="warn"/>
        <collision.check-junctions value="true"/>
        <collision.mingap-factor value="0"/>
    </processing>
    <random_number>
        <seed value="2022"/>
    </random_number>
    <report>
        <no-step-log value="true"/>
        <duration-log.statistics value="true"/>
    </report>
</configuration>
"""
