"""Imports maps of several formats as SUMO networks, with the plain XML that users can edit and build again."""

import errno
import os
import re
import subprocess
import tempfile
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import combinations
from pathlib import Path
from shutil import copyfileobj

import sumolib

from tint_sumo.core.errors import InputError, find_named
from tint_sumo.core.files import require_output_folder, write_text
from tint_sumo.core.reading import TABLE_BYTES, opened
from tint_sumo.maps import commonroad, lanelet2
from tint_sumo.maps.lanelets import Origin
from tint_sumo.maps.plain_xml import plain_xml
from tint_sumo.maps.roads import build_roads
from tint_sumo.maps.xml_files import ROLE
from tint_sumo.scenes.network import sumo_program

_PLAIN_FLAGS = {
    "nod": "--node-files",
    "edg": "--edge-files",
    "con": "--connection-files",
    "tll": "--tllogic-files",
}
_HEAD_BYTES = 2**16
_CHUNK_BYTES, _TAG_BYTES = 2**20, 100
_LANELET = re.compile(rb"""<tag\s+(k=["']type["']\s+v=["']lanelet["']|v=["']lanelet["']\s+k=["']type["'])""")
_SHOWN = 10  # lanelets in a report
_OPTIONS = ("--offset.disable-normalization", "--no-turnarounds", "--precision", "3", "--xml-validation", "never")
_LANELET_OPTIONS = ("--junctions.endpoint-shape",)  # roads end where their lanelets end
_OPENDRIVE_OPTIONS = ("--opendrive.curve-resolution", "1", "--opendrive.internal-shapes")
# As https://sumo.dlr.de/docs/Networks/Import/OpenStreetMap.html recommends; only roads for cars.
_OSM_OPTIONS = (
    *("--geometry.remove", "--ramps.guess", "--junctions.join", "--osm.turn-lanes", "--output.original-names"),
    *("--tls.guess-signals", "--tls.discard-simple", "--tls.join"),
    *("--keep-edges.by-vclass", "passenger", "--remove-edges.isolated"),
)
_NETCONVERT_READS = {
    "opendrive": ("--opendrive-files", "map.xodr", *_OPENDRIVE_OPTIONS),
    "osm": ("--osm-files", "map.osm.xml", *_OSM_OPTIONS),
}
LANELET_FORMATS = {found.name: found for found in (commonroad.FORMAT, lanelet2.FORMAT)}
FORMATS = {
    **{name: found.title for name, found in LANELET_FORMATS.items()},
    "opendrive": "OpenDRIVE",
    "osm": "OpenStreetMap",
}


@dataclass(frozen=True)
class ImportedMap:
    """A map as a SUMO network."""

    files: tuple[Path, ...]  # the network first
    format: str
    left_hand: bool
    roads: int
    lanes: int
    junctions: int  # where roads meet
    conflicts: int  # pairs of ways over junctions of which one yields to the other
    length_m: float  # of all lanes of roads
    left_out: tuple[str, ...]  # lanelets within junctions that come from nowhere or lead nowhere
    warnings: int  # of netconvert

    @property
    def net(self) -> Path:
        return self.files[0]


def import_map(
    file: Path,
    out: Path,
    *,
    format_name: str | None = None,
    left_hand: bool | None = None,
    origin: Origin | None = None,
    overwrite: bool = False,
) -> ImportedMap:
    """Write a map as a SUMO network in the map's own coordinates.

    Args:
        file: OpenDRIVE, OpenStreetMap, CommonRoad or lanelet2, gzipped or not.
        out: folder for the network and its plain XML, which are named after the map.
        format_name: one of ``FORMATS``; found by the file's contents if not given.
        left_hand: traffic drives on the left; as the map says if not given, else on the right.
        origin: latitude and longitude of x = y = 0 in a lanelet2 map. If not given: 0, 0 for maps that lie there, as
            INTERACTION's do; else x and y are those of UTM.
        overwrite: replace files of the same names.

    Raises:
        InputError: the file is no map, is damaged or has no roads, netconvert refuses it, or files are there already.
    """
    head = _head(file)
    if format_name is None:
        format_name = _format_of(file, head)
    find_named("format", format_name, FORMATS)
    require_output_folder(out)
    name = _name(file)
    targets = {kind: out / f"{name}.{kind}.xml" for kind in ("net", *_PLAIN_FLAGS)}
    there = [path.name for path in targets.values() if path.exists()]
    if there and not overwrite:
        raise InputError(f"{out} holds {there[0]} already; choose another `out`, or allow to `overwrite`")
    with tempfile.TemporaryDirectory() as folder:
        built = _build(file, Path(folder), format_name, left_hand, origin)
        counts = _counts(file, Path(folder) / "map.net.xml")
    for kind, text in built.texts.items():
        write_text(targets[kind], text)
    files = tuple(targets[kind] for kind in built.texts)
    return ImportedMap(files, format_name, built.left_hand, *counts, built.left_out, built.warnings)


def find_format(file: Path) -> str:
    """Return the format of a map by its contents.

    Raises:
        InputError: there is no such file, or it is none of these.
    """
    return _format_of(file, _head(file))


def _head(file: Path) -> str:
    """Return the beginning of a file.

    Raises:
        InputError: there is no such file, it is empty, or it refers to other files.
    """
    with opened(file, ROLE, TABLE_BYTES) as content:
        head = content.read(_HEAD_BYTES).decode("utf-8", "replace")
    if not head.strip():
        raise InputError(f"{file} is empty; give a map")
    if "<!ENTITY" in head:
        raise InputError(f"{file} has XML entities, which may stand for other files; remove them")
    return head


def _format_of(file: Path, head: str) -> str:
    found = re.search(r"<(OpenDRIVE|commonRoad|osm|net|nodes|edges|fcd-export)\b", head)
    element = found[1] if found else ""
    if element == "osm":
        return "lanelet2" if _has_lanelets(file) else "osm"
    if element in ("OpenDRIVE", "commonRoad"):
        return element.lower()
    if element in ("net", "nodes", "edges"):
        raise InputError(f"{file} is a network of SUMO already; use it as it is")
    raise InputError(f"{file} is no map of a known format; give one of these: {', '.join(FORMATS.values())}")


def _has_lanelets(file: Path) -> bool:
    """Return whether an OSM file has relations of type lanelet."""
    kept = b""
    with opened(file, ROLE, TABLE_BYTES) as content:
        while chunk := content.read(_CHUNK_BYTES):
            if _LANELET.search(kept + chunk):
                return True
            kept = chunk[-_TAG_BYTES:]
    return False


def _name(file: Path) -> str:
    """Return the name of a file without what tells its format."""
    return re.sub(r"(\.(osm|xodr|xml))*(\.gz)?$", "", file.name) or "map"


@dataclass(frozen=True)
class _Built:
    texts: Mapping[str, str]  # by kind, the network first
    left_hand: bool
    left_out: tuple[str, ...]
    warnings: int


def _build(file: Path, folder: Path, format_name: str, left_hand: bool | None, origin: Origin | None) -> _Built:
    """Run netconvert in a folder, where it leaves ``map.net.xml``."""
    if format_name in LANELET_FORMATS:
        lanelet_map = LANELET_FORMATS[format_name].read(file, origin)
        if not lanelet_map.lanelets:
            raise InputError(f"{file} has no lanelets; give a map with roads")
        if left_hand is not None:
            lanelet_map = replace(lanelet_map, left_hand=left_hand)
        roads = build_roads(lanelet_map)
        if not roads.roads:
            raise InputError(
                f"{file} has no roads: all of its lanelets lie in a junction; give a map with its surroundings"
            )
        texts = plain_xml(lanelet_map, roads)
        for part, text in texts.items():
            write_text(folder / f"map.{part}.xml", text)
        inputs = [word for part in texts for word in (_PLAIN_FLAGS[part], f"map.{part}.xml")]
        warnings = _netconvert(file, folder, [*inputs, *_LANELET_OPTIONS], lanelet_map.left_hand)
        return _Built({"net": _text(folder, "net"), **texts}, lanelet_map.left_hand, roads.left_out, warnings)
    if origin is not None:
        raise InputError("an `origin` goes with lanelet2 maps; leave it out")
    flag, name, *options = _NETCONVERT_READS[format_name]
    with opened(file, ROLE, TABLE_BYTES) as content, (folder / name).open("wb") as copy:
        copyfileobj(content, copy)
    is_left = _drives_on_the_left(folder / name) if left_hand is None else left_hand
    warnings = _netconvert(file, folder, [flag, name, *options, "--plain-output-prefix", "map"], is_left)
    parts = [part for part in _PLAIN_FLAGS if (folder / f"map.{part}.xml").exists()]
    return _Built({part: _text(folder, part) for part in ("net", *parts)}, is_left, (), warnings)


def _drives_on_the_left(file: Path) -> bool:
    """Return whether most roads of an OpenDRIVE file say that their rule is left-hand traffic."""
    roads = re.findall(rb"<road\b[^>]*>", file.read_bytes())
    return 2 * sum(re.search(rb"""\brule\s*=\s*["']LHT""", road) is not None for road in roads) > len(roads)


def _netconvert(file: Path, folder: Path, options: Sequence[str], left_hand: bool) -> int:
    """Run netconvert in a folder, and return its number of warnings.

    Raises:
        InputError: it refuses the map.
    """
    side = ("--lefthand",) if left_hand else ()
    command = [sumo_program("netconvert"), *options, *_OPTIONS, *side, "--output-file", "map.net.xml"]
    result = subprocess.run(command, cwd=folder, capture_output=True, text=True, errors="replace", check=False)
    lines = result.stderr.splitlines()
    if result.returncode != 0 or not (folder / "map.net.xml").exists():
        problem = next((line for line in lines if line.startswith("Error")), f"it ended with {result.returncode}")
        problem = problem.removeprefix("Error: ").rstrip(".")
        raise InputError(f"{file} cannot be made a network: netconvert says {problem!r}; correct the map")
    return sum(line.startswith("Warning") for line in lines)


def _text(folder: Path, kind: str) -> str:
    """Return a file of netconvert without its header, which has a date."""
    text = (folder / f"map.{kind}.xml").read_text(encoding="utf-8")
    if not text.rstrip().endswith(">"):  # netconvert reports success on a full disk, too
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC), tempfile.gettempdir())
    return re.sub(r"<!--.*?-->\s*", "", text, flags=re.DOTALL)


def _counts(file: Path, net: Path) -> tuple[int, int, int, int, float]:
    """Return the numbers of roads, lanes, junctions and conflicts of a network, and the length of its lanes.

    Raises:
        InputError: the network has no roads.
    """
    found = sumolib.net.readNet(str(net), withPrograms=False)
    roads = found.getEdges()
    if not roads:
        raise InputError(f"{file} has no roads for cars; give another map")
    junctions = [node for node in found.getNodes() if node.getIncoming() and node.getOutgoing()]
    lanes = [lane for road in roads for lane in road.getLanes()]
    conflicts = sum(
        node.areFoes(first, second)
        for node in junctions
        for first, second in combinations(range(len(node.getConnections())), 2)
    )
    return len(roads), len(lanes), len(junctions), conflicts, float(sum(lane.getLength() for lane in lanes))


def report(found: ImportedMap) -> str:
    """Return what was imported as lines for people."""
    lines = [
        f"format            {FORMATS[found.format]}, traffic on the {'left' if found.left_hand else 'right'}",
        f"roads             {found.roads:,} with {found.lanes:,} lanes, {found.length_m:,.0f} m of lanes in all",
        f"junctions         {found.junctions:,}, {found.conflicts:,} pairs of ways over them that conflict",
        f"netconvert        {found.warnings:,} warnings",
    ]
    if found.left_out:
        names = ", ".join(found.left_out[:_SHOWN]) + (", ..." if len(found.left_out) > _SHOWN else "")
        lines.append(f"left out          {len(found.left_out):,} lanelets that lead nowhere within a junction: {names}")
    return "\n".join(lines)
