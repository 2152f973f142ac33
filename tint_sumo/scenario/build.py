"""The whole scenario as files that plain ``sumo -c tint.sumocfg`` runs."""

from pathlib import Path

from tint_sumo.config import Scenario
from tint_sumo.errors import InputError
from tint_sumo.files import write_text
from tint_sumo.scenario.drivers import DISTRIBUTION_ID, vtypes_xml
from tint_sumo.scenario.network import (
    EGO_ROUTE,
    LOWER_ROUTE,
    REPLICA_SPACING_M,
    UPPER_ROUTE,
    build_network,
    name,
    plain_xml,
)

NET_FILE = "tint.net.xml"
DRIVERS_FILE = "drivers.add.xml"
ROUTES_FILE = "routes.add.xml"
CONFIG_FILE = "tint.sumocfg"
DEMO_POISSON_RATE_PER_S = 0.2  # per lane; about two thirds of saturation
_SATURATED_RATE_PER_S = 1.0  # more than a lane can take: drivers who find no room are not kept waiting
_MARK = "<!-- Written by tint-sumo net; change tint_sumo/scenario and run it again. -->\n"


def scenario_files(
    replicas: int, scenario: Scenario | None = None, spacing_m: float = REPLICA_SPACING_M
) -> dict[str, str]:
    """Name and text of every file of the scenario; ``spacing_m`` as in :func:`plain_xml`.

    Raises:
        InputError: fewer than one replica.
    """
    if replicas < 1:
        raise InputError(f"replicas must be at least 1, not {replicas}")
    scenario = scenario or Scenario()
    sources = plain_xml(replicas, scenario.street, scenario.vehicle, spacing_m)
    texts = {
        "tint.nod.xml": sources.nodes,
        "tint.edg.xml": sources.edges,
        "tint.con.xml": sources.connections,
        NET_FILE: build_network(sources),
        DRIVERS_FILE: vtypes_xml(scenario.population, scenario.traffic.mean_p_conservative, scenario.vehicle),
        ROUTES_FILE: _routes_xml(replicas),
        "saturated.rou.xml": _flows_xml(replicas, f"exp({_SATURATED_RATE_PER_S:g})"),
        "poisson.rou.xml": _flows_xml(replicas, f"exp({DEMO_POISSON_RATE_PER_S:g})"),
        CONFIG_FILE: _config_xml(scenario.episode.step_s),
    }
    return {file: _marked(text) for file, text in texts.items()}


def write_scenario(folder: Path, replicas: int, scenario: Scenario | None = None) -> list[Path]:
    """Write the scenario into ``folder`` and return the paths.

    Raises:
        InputError: a file of the same name exists that this function did not write.
    """
    texts = scenario_files(replicas, scenario)
    if folder.exists() and not folder.is_dir():
        raise InputError(f"{folder} is a file, not a folder; choose another --out")
    foreign = [file for file in texts if (folder / file).exists() and not _is_ours(folder / file)]
    if foreign:
        raise InputError(f"{folder} holds a {foreign[0]} that tint-sumo did not write; choose another --out")
    for file, text in texts.items():
        write_text(folder / file, text)
    return [folder / file for file in texts]


def _is_ours(path: Path) -> bool:
    return _MARK.strip() in path.read_text(encoding="utf-8", errors="replace")


def _marked(text: str) -> str:
    """Put the mark first, or behind the XML declaration."""
    if text.startswith("<?xml"):
        declaration, rest = text.split("\n", 1)
        return f"{declaration}\n{_MARK}{rest}"
    return _MARK + text


def _routes_xml(replicas: int) -> str:
    routes = {"lower": LOWER_ROUTE, "upper": UPPER_ROUTE, "ego": EGO_ROUTE}
    lines = [
        f'    <route id="{name(route, replica)}" edges="{" ".join(name(edge, replica) for edge in edges)}"/>'
        for replica in range(replicas)
        for route, edges in routes.items()
    ]
    return "\n".join(["<additional>", *lines, "</additional>", ""])


def _flows_xml(replicas: int, period: str) -> str:
    lines = [
        f'    <flow id="{name(lane, replica)}" route="{name(lane, replica)}" type="{DISTRIBUTION_ID}" begin="0" '
        f'period="{period}" departPos="base" departSpeed="desired"/>'
        for replica in range(replicas)
        for lane in ("lower", "upper")
    ]
    return "\n".join(["<routes>", *lines, "</routes>", ""])


def _config_xml(step_s: float) -> str:
    return f"""<configuration>
    <input>
        <net-file value="{NET_FILE}"/>
        <additional-files value="{DRIVERS_FILE},{ROUTES_FILE}"/>
        <route-files value="saturated.rou.xml"/>
    </input>
    <time>
        <begin value="0"/>
        <end value="300"/>
        <step-length value="{step_s:g}"/>
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
