"""SUMO configurations as SUMO reads them, and the vTypes of their vehicles.

The program ``sumo`` resolves a configuration: names of options, relative paths and default values are its own.
"""

import gzip
import hashlib
import math
import os
import re
import subprocess
import tempfile
from collections.abc import Collection, Iterator
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from shlex import quote
from typing import Any
from xml.etree import ElementTree

from sumolib.miscutils import parseTime

from tint_sumo.config import MOST_LABELS
from tint_sumo.core.errors import InputError
from tint_sumo.core.reading import TABLE_BYTES, require_file
from tint_sumo.scenes.network import require_sumo_opens_temporary_files, sumo_program

DEFAULT_VTYPE = "DEFAULT_VEHTYPE"  # SUMO's type for vehicles that name none
_VTYPE_OF_MODE = {"car": DEFAULT_VTYPE, "bicycle": "DEFAULT_BIKETYPE"}  # vehicles that SUMO makes for person trips
_DEFINED_FOR_ONE = "@"  # SUMO calls the type of a vehicle that has values of its own TYPE@VEHICLE
_DEFAULT_STEP_S = 1.0  # SUMO's
_READING_LIMIT_S = 60.0
_NET, _DEMAND = "net-file", ("additional-files", "route-files", "load-state")
_INPUTS = (_NET, *_DEMAND, "weight-files", "data-files")  # options that name files
# Sections of options about files that SUMO writes, messages, remote control and windows: a run has its own. But
# whether files are validated decides which ones SUMO reads.
_LEFT_OUT, _KEPT = {"output", "report", "traci_server", "gui_only"}, "xml-validation"
_REFUSED = {
    "mesosim": "is mesoscopic, and drivers have no positions then",
    "no-internal-links": "lets vehicles jump over junctions, and nobody meets there",
}
_OFF = ("0", "no", "false", "off", "-", "f")  # as SUMO reads it, in capital letters, too
# Options that would keep SUMO from saying how it reads a configuration.
_ONLY_READ = (
    *("--help", "false"),
    *("--version", "false"),
    *("--print-options", "false"),
    *("--save-configuration", "-"),
    *("--save-configuration.relative", "false"),
    *("--save-template.commented", "false"),
)
_UNSAFE = re.compile(r"[,;]")  # SUMO takes a path with these for several
_VARIABLE = re.compile(r"\$\{([^}]+)\}")


@dataclass(frozen=True)
class SumoConfig:
    """The options of a .sumocfg, as SUMO resolves them, without those about output, messages and windows."""

    file: Path
    options: tuple[tuple[str, str], ...]  # names and values; paths are absolute
    left_out: tuple[str, ...]  # names of options that a run here does not have

    @property
    def name(self) -> str:
        return re.sub(r"\.(sumocfg|xml|cfg)$", "", self.file.name)

    @property
    def net_file(self) -> Path:
        return self._named(_NET)[0]

    @property
    def demand_files(self) -> tuple[Path, ...]:
        """Additional files, routes and a saved state, with all files that they include."""
        found: dict[str, Path] = {}  # by real path: files can include each other
        waiting = [file for option in _DEMAND for file in self._named(option)]
        while waiting:
            file = waiting.pop(0)
            if found.setdefault(os.path.realpath(file), file) is file:
                waiting[:0] = _contents(file).included
        return tuple(found.values())

    @property
    def files(self) -> tuple[Path, ...]:
        """All files that the simulation follows from."""
        others = [file for option in _INPUTS if option not in (_NET, *_DEMAND) for file in self._named(option)]
        return (self.file, self.net_file, *self.demand_files, *others)

    @property
    def step_s(self) -> float:
        return _seconds(dict(self.options).get("step-length", str(_DEFAULT_STEP_S)), self.file)

    @property
    def digest(self) -> str:
        """Digest of the configuration's input."""
        whole = hashlib.sha256()
        for file in self.files:
            with file.open("rb") as content:
                whole.update(hashlib.file_digest(content, "sha256").digest())
        return whole.hexdigest()[:16]

    def values(self, scratch: Path) -> dict[str, str]:
        """Return the options for a run of SUMO.

        Args:
            scratch: folder for a link to the configuration's folder. Paths lead over it where SUMO would split that
                folder's own path, which has a comma or semicolon.
        """
        folder = str(self.file.parent)
        if not _UNSAFE.search(folder):
            return dict(self.options)
        link = scratch / "input"
        link.symlink_to(folder)
        return {name: value.replace(folder, str(link)) for name, value in self.options}

    def _named(self, option: str) -> list[Path]:
        """Return the files that an option names.

        Raises:
            InputError: one of them does not exist.
        """
        value = dict(self.options).get(option, "")
        folder = str(self.file.parent)  # may have commas itself
        parts = (part.strip().replace("\0", folder) for part in value.replace(folder, "\0").split(","))
        files = [Path(part) for part in parts if part]
        for file in files:
            if not file.is_file():
                raise InputError(f"{self.file} names {option} {file}, and there is no such file; correct the path")
        return files


def read_config(file: Path) -> SumoConfig:
    """Return a SUMO configuration as SUMO reads it.

    Raises:
        InputError: there is none, SUMO refuses it, files that it names are missing, or it is mesoscopic or without
            lanes on junctions.
    """
    file = file.absolute()  # not resolved: SUMO takes paths from where a link is
    require_file(file, "SUMO configuration", TABLE_BYTES)
    found = _ask_sumo(file)
    options = {name: value for section, name, value in found if _is_kept(section, name)}
    for name, reason in _REFUSED.items():
        if options.get(name, "false").lower() not in _OFF:
            raise InputError(f"{file} {reason}; leave {name} out")
    left_out = {name for _, name, _ in found} - options.keys() - {flag.removeprefix("--") for flag in _ONLY_READ}
    config = SumoConfig(file, tuple(options.items()), tuple(sorted(left_out)))
    if len(config._named(_NET)) != 1:
        raise InputError(f"{file} names no net-file; give a .sumocfg with one")
    _ = config.step_s, config.files  # refused here if they are wrong
    return config


def _is_kept(section: str, option: str) -> bool:
    return section not in _LEFT_OUT or option.startswith(_KEPT)


def _ask_sumo(file: Path) -> list[tuple[str, str, str]]:
    """Return section, name and value of each option of a configuration, with the names that SUMO prefers."""
    require_sumo_opens_temporary_files()
    with tempfile.TemporaryDirectory(prefix="tint_sumo_") as folder:
        here, there = str(file.parent), Path(folder) / "input"
        there.symlink_to(here)
        command = [sumo_program("sumo"), "--configuration-file", str(there / file.name), *_ONLY_READ]
        try:
            result = subprocess.run(command, capture_output=True, text=True, check=False, timeout=_READING_LIMIT_S)
            root = ElementTree.fromstring(result.stdout[max(result.stdout.find("<?xml"), 0) :])
        except subprocess.TimeoutExpired:
            raise refused(f"has not read {file} in {_READING_LIMIT_S:g} s", file) from None
        except ElementTree.ParseError:
            reason = first_reason(result.stderr.replace(str(there), here))
            raise refused(f"does not read {file} ({reason})", file) from None
        return [
            (section.tag, option.tag, _resolved(option.get("value", ""), str(there)).replace(str(there), here))
            for section in root
            for option in section
        ]


def refused(problem: str, file: Path) -> InputError:
    """Return the error that SUMO has a problem with a configuration, with the way to see it."""
    return InputError(f"SUMO {problem}; try it with: sumo -c {quote(str(file))}")


def first_reason(printed: str) -> str:
    """Return the first error among the lines that SUMO has printed, which others may follow from; "" without one."""
    _, _, rest = printed.partition("Error: ")
    first, _, _ = re.sub(r"\n(Error|Warning): |\nQuitting", "\0", rest).partition("\0")
    return " ".join(first.split())


def _resolved(value: str, folder: str) -> str:
    """Return an option's value with environment variables put in, and without blanks before the paths of a list.

    SUMO reads over such blanks, but writes the configuration's folder before them, even where the path is absolute.
    """
    value = _VARIABLE.sub(_value_of, value)
    return re.sub(rf"{re.escape(folder)}/\s+(/?)", lambda blanks: blanks[1] or f"{folder}/", value)


def _value_of(variable: re.Match[str]) -> str:
    """Return an environment variable's value; one that is not set stays as it is, and SUMO has some of its own."""
    return os.environ.get(variable[1], variable[0])


def _seconds(text: str, file: Path) -> float:
    """Return a step length that SUMO reads, in seconds or as hours:minutes:seconds."""
    try:
        step_s = float(parseTime(text) or math.nan)
    except ValueError:
        step_s = math.nan
    if not 0.001 <= step_s <= 10.0:  # SUMO's shortest
        raise InputError(f"{file} has step-length {text!r}; give a number of seconds from 0.001 to 10, such as 0.1")
    return step_s


@dataclass(frozen=True)
class _Demand:
    """The parts of a route or additional file on which labels depend."""

    included: tuple[Path, ...]
    defined: frozenset[str]  # ids of vTypes
    used: frozenset[str]  # ids of the vTypes or distributions of vehicles
    distributions: frozenset[str]  # ids


def _contents(file: Path) -> _Demand:
    """Read a demand file, unless it has been read before and is still the same.

    Raises:
        InputError: there is no such file, it is damaged, or it includes a file that does not exist.
    """
    require_file(file, "demand", TABLE_BYTES)
    state = file.stat()
    found = _read(file, state.st_mtime_ns, state.st_size)
    for included in found.included:
        if not included.is_file():
            raise InputError(f"{file} includes {included}, and there is no such file; correct the path")
    return found


@lru_cache(maxsize=64)
def _read(file: Path, _changed_ns: int, _size: int) -> _Demand:
    included: list[Path] = []
    defined: set[str] = set()
    used: set[str] = set()
    distributions: set[str] = set()
    for element in _elements(file):
        if element.tag == "include" and element.get("href"):
            included.append(file.parent / element.get("href"))
        elif element.tag == "vType" and element.get("vClass") != "pedestrian":
            defined.add(element.get("id"))
        elif element.tag == "vTypeDistribution":
            distributions.add(element.get("id"))
        elif element.tag in ("vehicle", "trip", "flow"):
            used.add(element.get("type", DEFAULT_VTYPE))
        elif element.tag == "personTrip":
            used |= set(_vtypes_of_person_trip(element.get("vTypes", ""), element.get("modes", "")))
    return _Demand(tuple(included), frozenset(defined), frozenset(used), frozenset(distributions))


def _elements(file: Path) -> Iterator[Any]:
    """Yield all elements of an XML file, each of which is then dropped."""
    try:
        with gzip.open(file) if file.suffix == ".gz" else file.open("rb") as text:
            for _, element in ElementTree.iterparse(text):
                yield element
                element.clear()
    except (ElementTree.ParseError, OSError, EOFError) as error:
        raise InputError(f"demand: {file} is damaged ({error}); make it anew") from None


def _vtypes_of_person_trip(vtypes: str, modes: str) -> list[str]:
    """Return the types of the vehicles that SUMO makes for a person's trip."""
    return vtypes.split() or [_VTYPE_OF_MODE[mode] for mode in modes.split() if mode in _VTYPE_OF_MODE]


def read_vtypes(config: SumoConfig) -> tuple[str, ...]:
    """Return the ids of the vTypes of a configuration's vehicles, in place of distributions their members; sorted.

    Raises:
        InputError: a file is damaged, or there are too many vTypes.
    """
    parts = [_contents(file) for file in config.demand_files]
    defined = frozenset[str]().union(*(part.defined for part in parts))
    used = frozenset[str]().union(*(part.used for part in parts))
    distributions = frozenset[str]().union(*(part.distributions for part in parts))
    found = tuple(sorted({base_vtype(vtype, defined) for vtype in defined | (used - distributions)}))
    if len(found) > MOST_LABELS:
        raise InputError(f"{config.file} has {len(found):,} vTypes; at most {MOST_LABELS:,} fit into labels: use fewer")
    return found


def base_vtype(vtype: str, known: Collection[str]) -> str:
    """Return a vType, or the known one from which SUMO has made it for a single vehicle."""
    base, _, _ = vtype.rpartition(_DEFINED_FOR_ONE)
    return base if vtype not in known and base in known else vtype
