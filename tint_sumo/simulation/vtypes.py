"""Sizes of vTypes, as SUMO knows them: floating-car data name a vehicle's type, and not its size."""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory
from xml.sax import SAXException
from xml.sax.saxutils import quoteattr

import sumolib
from libsumo import TraCIException
from traci.exceptions import FatalTraCIError
from traci.exceptions import TraCIException as TraciException

from tint_sumo.core.errors import InputError
from tint_sumo.core.files import shipped
from tint_sumo.core.reading import TABLE_BYTES, require_file
from tint_sumo.scenes.sumocfg import read_config
from tint_sumo.simulation.connection import connect

_SIZES = ("id", "vClass", "length", "width")  # attributes of a vType that its size follows from
_DEFINED_FOR_ONE = "@"  # SUMO calls the type of a vehicle that has values of its own TYPE@VEHICLE


@dataclass(frozen=True)
class Size:
    """Size of the vehicles of a vType."""

    length_m: float
    width_m: float


def read_sizes(file: Path) -> Mapping[str, Size]:
    """Return the sizes of all vTypes in a route or additional file, or in those of a .sumocfg, and of SUMO's defaults.

    SUMO is asked for them, since sizes that a vType does not have follow from its vClass.

    Raises:
        InputError: there is no such file, it is damaged, or SUMO refuses a vType.
    """
    files = read_config(file).demand_files if file.suffix == ".sumocfg" else (file,)
    elements = {identity: element for found in files for identity, element in _elements(found).items()}
    with TemporaryDirectory(prefix="tint_sumo_") as folder:
        additional = Path(folder) / "vtypes.add.xml"
        additional.write_text(f"<additional>{''.join(elements.values())}</additional>", encoding="utf-8")
        options = ["--net-file", str(shipped("sumo_net") / "tint.net.xml"), "--additional-files", str(additional)]
        try:
            connection = connect([*options, "--no-step-log", "true", "--no-warnings", "true"])
        except (TraCIException, TraciException, FatalTraCIError) as error:
            raise InputError(f"SUMO refuses a vType of {file} ({' '.join(str(error).split())}); correct it") from None
        try:
            types = connection.vehicletype
            return {name: Size(types.getLength(name), types.getWidth(name)) for name in types.getIDList()}
        finally:
            connection.close()


def size_of(vtype: str, sizes: Mapping[str, Size], file: Path) -> Size:
    """Return the size of a vType, of which ``file`` has the sizes.

    Raises:
        InputError: it is not among them.
    """
    found = sizes.get(vtype) or sizes.get(vtype.partition(_DEFINED_FOR_ONE)[0])
    if found is None:
        raise InputError(f"{file} has no vType {vtype!r}, which vehicles of the data have; give the file that has it")
    return found


def _elements(file: Path) -> dict[str, str]:
    """Return the vTypes of a file by their ids, as XML with what their sizes follow from."""
    require_file(file, "vTypes", TABLE_BYTES)
    try:
        found = [
            {name: vtype.getAttribute(name) for name in _SIZES if vtype.hasAttribute(name)}
            for vtype in sumolib.xml.parse(str(file), "vType")
        ]
    except (SAXException, SyntaxError, ValueError, OSError, EOFError) as error:  # ElementTree's is a SyntaxError
        raise InputError(
            f"{file} is damaged ({error}); give a route or additional file of SUMO, or a .sumocfg"
        ) from None
    if any("id" not in vtype for vtype in found):
        raise InputError(f"{file} has a vType without an id; add it")
    return {
        vtype["id"]: f"<vType {' '.join(f'{name}={quoteattr(value)}' for name, value in vtype.items())}/>"
        for vtype in found
    }
