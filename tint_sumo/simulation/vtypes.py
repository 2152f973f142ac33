"""The vTypes of route and additional files, as SUMO knows them: floating-car data name a vehicle's type alone."""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory
from xml.sax import SAXException
from xml.sax.saxutils import quoteattr

import sumolib

from tint_sumo.core.errors import InputError
from tint_sumo.core.files import shipped
from tint_sumo.core.reading import TABLE_BYTES, require_file
from tint_sumo.scenes.network import require_sumo_opens_temporary_files
from tint_sumo.scenes.sumo_config import base_vtype, read_config
from tint_sumo.scenes.sumo_run import why_not_loaded
from tint_sumo.simulation.connection import connect

_ATTRIBUTES = ("id", "vClass", "length", "width")  # of a vType: its size follows from them
_MODEL, _USUAL_MODEL = "carFollowModel", "Krauss"  # SUMO does not say which model a type has


@dataclass(frozen=True)
class VType:
    """Size and kind of the vehicles of a vType."""

    length_m: float
    width_m: float
    vehicle_class: str
    car_following: str  # model


def read_vtype_table(file: Path) -> Mapping[str, VType]:
    """Return the vTypes of a route or additional file, or of those of a .sumocfg, and SUMO's defaults, by their ids.

    SUMO is asked for sizes, since those that a vType does not have follow from its vClass.

    Raises:
        InputError: there is no such file, it is damaged, or SUMO refuses a vType.
    """
    files = read_config(file).demand_files if file.suffix == ".sumocfg" else (file,)
    defined = {vtype["id"]: vtype for found in files for vtype in _defined(found)}
    elements = [
        f"<vType {' '.join(f'{name}={quoteattr(vtype[name])}' for name in _ATTRIBUTES if name in vtype)}/>"
        for vtype in defined.values()
    ]
    require_sumo_opens_temporary_files()
    with TemporaryDirectory(prefix="tint_sumo_") as folder:
        additional = Path(folder) / "vtypes.add.xml"
        additional.write_text(f"<additional>{''.join(elements)}</additional>", encoding="utf-8")
        options = [
            *("--net-file", str(shipped("sumo_net") / "tint.net.xml"), "--additional-files", str(additional)),
            *("--no-step-log", "true", "--no-warnings", "true"),
        ]
        reason = why_not_loaded(options)
        if reason:
            raise InputError(f"SUMO refuses a vType of {file} ({reason}); correct it")
        connection = connect(options)
        try:
            types = connection.vehicletype
            return {
                name: VType(
                    types.getLength(name),
                    types.getWidth(name),
                    types.getVehicleClass(name),
                    defined.get(name, {}).get(_MODEL, _USUAL_MODEL),
                )
                for name in types.getIDList()
            }
        finally:
            connection.close()


def find_vtype(name: str, vtypes: Mapping[str, VType]) -> VType | None:
    """Return the vType with this id, or the one that a single vehicle's type was made of."""
    return vtypes.get(base_vtype(name, vtypes))


def _defined(file: Path) -> list[dict[str, str]]:
    """Return the attributes of the vTypes that a file defines."""
    require_file(file, "vTypes", TABLE_BYTES)
    try:
        found = [
            {name: vtype.getAttribute(name) for name in (*_ATTRIBUTES, _MODEL) if vtype.hasAttribute(name)}
            for vtype in sumolib.xml.parse(str(file), "vType")
        ]
    except (SAXException, SyntaxError, ValueError, OSError, EOFError) as error:  # ElementTree's is a SyntaxError
        raise InputError(f"{file} is damaged ({error}); give a route file, additional file or .sumocfg") from None
    if any("id" not in vtype for vtype in found):
        raise InputError(f"{file} has a vType without an id; add it")
    return found
