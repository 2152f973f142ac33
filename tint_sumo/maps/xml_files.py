"""XML files of maps: whole elements by their tags, and numbers in them."""

import math
from collections.abc import Collection
from pathlib import Path
from xml.etree import ElementTree
from xml.etree.ElementTree import Element

from tint_sumo.core.errors import InputError, shown
from tint_sumo.core.reading import TABLE_BYTES, opened

ROLE = "map"


def read_elements(file: Path, wanted: Collection[str], left_out: Collection[str] = ()) -> dict[str, list[Element]]:
    """Return the elements of an XML file, gzipped or not, that have certain tags, by these.

    Args:
        file: to read.
        wanted: tags; elements within an element that is wanted belong to it.
        left_out: tags of large elements that are not kept in memory.

    Raises:
        InputError: there is no such file, or it is not whole XML.
    """
    found: dict[str, list[Element]] = {tag: [] for tag in wanted}
    try:
        with opened(file, ROLE, TABLE_BYTES) as content:
            for _, element in ElementTree.iterparse(content):
                if element.tag in found:
                    found[element.tag].append(element)
                elif element.tag in left_out:
                    element.clear()
    except (ElementTree.ParseError, LookupError, ValueError) as error:  # the last two are of encodings
        if isinstance(error, InputError):
            raise
        raise InputError(f"{file} is not whole XML ({error}); get it again") from None
    return found


def number(text: str | None, file: Path, what: str) -> float:
    """Return a finite number.

    Raises:
        InputError: it is none.
    """
    try:
        value = float(text or "")
    except ValueError:
        value = math.nan
    if not math.isfinite(value):
        raise InputError(f"{file}: {what} is {shown(text)}, not a number; get the file again")
    return value
