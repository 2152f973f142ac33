"""CommonRoad scenarios, versions 2018b and 2020a: the dynamic obstacles of an XML file.

commonroad-io reads them, too, but pins an old protobuf. Static obstacles and the ego's planning problem are no tracks.
A position that is an area is read as its centre, an interval as its middle.

Format: https://gitlab.lrz.de/tum-cps/commonroad-scenarios, documentation of the XML format.
"""

from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any
from xml.etree import ElementTree
from xml.etree.ElementTree import Element

import pandas as pd

from tint_sumo.core.errors import InputError
from tint_sumo.tracks.reading import Head, TrackFormat, opened, recording_name, register
from tint_sumo.tracks.schema import UNKNOWN


def _read(file: Path) -> Mapping[str, Any]:
    try:
        rows = list(_rows(file))
    except InputError:
        raise
    except (ElementTree.ParseError, LookupError, ValueError) as error:  # the last two are of encodings
        raise InputError(f"{file} is not whole XML ({error}); get it again") from None
    names = ["vehicle", "time_s", "x_m", "y_m", "heading_rad", "speed_mps", "length_m", "width_m", "vehicle_class"]
    return {"recording": recording_name(file), **pd.DataFrame(rows, columns=names)}


def _rows(file: Path) -> Iterator[tuple[Any, ...]]:
    """Yield one row for each state of each dynamic obstacle."""
    step_s = 0.0
    with opened(file) as content:
        for event, element in ElementTree.iterparse(content, ("start", "end")):
            if event == "start":
                if element.tag == "commonRoad":
                    step_s = _time_step_s(element, file)
                continue
            if element.tag == "dynamicObstacle" or (
                element.tag == "obstacle" and element.findtext("role") == "dynamic"
            ):
                yield from _obstacle_rows(element, step_s, file)
            if element.tag in ("dynamicObstacle", "obstacle", "lanelet"):
                element.clear()


def _time_step_s(root: Element, file: Path) -> float:
    step_s = _number(root.get("timeStepSize"), file, "timeStepSize")
    if step_s <= 0.0:
        raise InputError(f"{file}: timeStepSize is {step_s:g}, not above 0; get the file again")
    return step_s


def _obstacle_rows(obstacle: Element, step_s: float, file: Path) -> Iterator[tuple[Any, ...]]:
    name = obstacle.get("id", "")
    box = obstacle.find("shape/rectangle")
    if box is None:
        raise InputError(f"{file}: obstacle {name} is no rectangle; tracks of other shapes are not read")
    length_m = _number(box.findtext("length"), file, f"length of obstacle {name}")
    width_m = _number(box.findtext("width"), file, f"width of obstacle {name}")
    for state in obstacle.iter():
        if state.tag in ("initialState", "state"):
            values = [_value(state, part, file, name) for part in ("time", "orientation", "velocity")]
            x_m, y_m = _position(state, file, name)
            time, heading_rad, speed_mps = values
            size = (length_m, width_m, obstacle.findtext("type") or UNKNOWN)
            yield (name, time * step_s, x_m, y_m, heading_rad, speed_mps, *size)


def _position(state: Element, file: Path, name: str) -> tuple[float, float]:
    point = state.find("position/point")
    if point is None:
        point = state.find("position/*/center")
    if point is None:
        raise InputError(f"{file}: obstacle {name} has a state without a position; get the file again")
    x_m, y_m = (_number(point.findtext(axis), file, f"{axis} of obstacle {name}") for axis in ("x", "y"))
    return x_m, y_m


def _value(state: Element, part: str, file: Path, name: str) -> float:
    """Return a value of a state, or the middle of its interval."""
    exact = state.findtext(f"{part}/exact")
    ends = [exact] if exact is not None else [state.findtext(f"{part}/interval{end}") for end in ("Start", "End")]
    numbers = [_number(end, file, f"{part} of obstacle {name}") for end in ends]
    return sum(numbers) / len(numbers)


def _number(text: str | None, file: Path, what: str) -> float:
    try:
        return float(text or "")
    except ValueError:
        raise InputError(f"{file}: {what} is {text!r}, not a number; get the file again") from None


def _is_commonroad(head: Head) -> bool:
    return "<commonRoad" in head.text


register(TrackFormat("commonroad", "CommonRoad XML", _is_commonroad, _read))
