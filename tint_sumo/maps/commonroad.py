"""CommonRoad scenarios, versions 2018b and 2020a: the lanelets of an XML file.

Signs and lights count where they are at the end of a lanelet. Format:
https://gitlab.lrz.de/tum-cps/commonroad-scenarios, documentation of the XML format.
"""

from collections.abc import Mapping
from pathlib import Path
from xml.etree.ElementTree import Element

from tint_sumo.core.errors import InputError
from tint_sumo.maps.lanelets import Lanelet, LaneletMap, Light, MapFormat, Origin, bound, by_id
from tint_sumo.maps.xml_files import number, read_elements

_SPEED_SIGNS = ("274", "R2-1")  # of Germany and the United States, as the format names them; values in m/s
_RIGHT_OF_WAY = {
    **dict.fromkeys(("205", "R1-2"), "yield"),
    **dict.fromkeys(("206", "R1-1", "R1-3P"), "stop"),
    **dict.fromkeys(("301", "306"), "priority"),
}
_READ = frozenset({"commonRoad", "lanelet", "trafficSign", "trafficLight", "location"})
_LEFT_OUT = frozenset({"obstacle", "dynamicObstacle", "staticObstacle"})


def _read(file: Path, origin: Origin | None) -> LaneletMap:
    if origin is not None:
        raise InputError(f"{file} has x and y in metres; leave the `origin` out")
    found = read_elements(file, _READ, _LEFT_OUT)
    signs = {sign.get("id", ""): sign for sign in found["trafficSign"]}
    whole = [
        element for element in found["lanelet"] if element.find("leftBound") is not None
    ]  # goals name lanelets, too
    step_s = next((root.get("timeStepSize") for root in found["commonRoad"]), None)
    lights = {light.get("id", ""): _light(light, step_s, file) for light in found["trafficLight"]}
    lanelets = [_lanelet(element, signs, lights, file) for element in whole]
    opposite = [beside.tag for element in whole for beside in element.findall("*[@drivingDir='opposite']")]
    projection, offset_m = _location(found["location"], file)
    return LaneletMap(
        file,
        by_id(lanelets, file),
        left_hand=opposite.count("adjacentRight") > opposite.count("adjacentLeft"),
        projection=projection,
        offset_m=offset_m,
    )


def _lanelet(element: Element, signs: Mapping[str, Element], lights: Mapping[str, Light], file: Path) -> Lanelet:
    name = element.get("id", "")
    left, right = (
        bound(
            [
                [number(point.findtext(axis), file, f"{axis} of lanelet {name}") for axis in ("x", "y")]
                for point in points
            ],
            file,
            name,
        )
        for points in (element.findall(f"{side}/point") for side in ("leftBound", "rightBound"))
    )
    own_signs = [signs[reference] for reference in _references(element, "trafficSignRef") if reference in signs]
    neighbours = {
        side: next((beside.get("ref") for beside in element.findall(f"{side}[@drivingDir='same']")), None)
        for side in ("adjacentLeft", "adjacentRight")
    }
    return Lanelet(
        name,
        left,
        right,
        successors=tuple(_references(element, "successor", "")),
        left_neighbour=neighbours["adjacentLeft"],
        right_neighbour=neighbours["adjacentRight"],
        speed_mps=_speed_mps(element, own_signs, file),
        sign=next((_RIGHT_OF_WAY[one] for sign in own_signs for one in _sign_ids(sign) if one in _RIGHT_OF_WAY), None),
        light=next((lights.get(ref, Light()) for ref in _references(element, "trafficLightRef")), None),
    )


def _light(element: Element, step: str | None, file: Path) -> Light:
    """Return a traffic light, without its cycle if it has none that lasts."""
    step_s = number(step, file, "timeStepSize")
    parts = [(part.findtext("duration"), part.findtext("color")) for part in element.findall("cycle/cycleElement")]
    durations_s = [number(steps, file, "a duration of a traffic light") * step_s for steps, _ in parts]
    begin_s = number(element.findtext("cycle/timeOffset") or "0", file, "timeOffset of a traffic light") * step_s
    if element.findtext("active") == "false" or not all(duration_s > 0.0 for duration_s in durations_s):
        return Light()
    return Light(tuple(zip(durations_s, ((colour or "").strip() for _, colour in parts), strict=True)), begin_s)


def _references(element: Element, tag: str, depth: str = ".//") -> list[str]:
    return [found.get("ref", "") for found in element.findall(f"{depth}{tag}")]


def _sign_ids(sign: Element) -> list[str]:
    return [(found.text or "").strip() for found in sign.findall("trafficSignElement/trafficSignID")]


def _speed_mps(element: Element, signs: list[Element], file: Path) -> float | None:
    """Return the lowest limit of a lanelet: of its element in 2018b, of its signs in 2020a."""
    texts = [element.findtext("speedLimit")]
    for sign in signs:
        for part in sign.findall("trafficSignElement"):
            if (part.findtext("trafficSignID") or "").strip() in _SPEED_SIGNS:
                texts.append(part.findtext("additionalValue"))
    limits = [number(text, file, "a speed limit") for text in texts if text is not None]
    return min((limit for limit in limits if 0.0 < limit < float("inf")), default=None)


def _location(elements: list[Element], file: Path) -> tuple[str | None, tuple[float, float]]:
    """Return the projection of the map's plane and the map's shift in it; a map that is turned or scaled has none."""
    for transformation in (element.find("geoTransformation") for element in elements):
        reference = transformation.findtext("geoReference") if transformation is not None else None
        if transformation is None or not (reference or "").strip().startswith("+proj"):
            continue
        values = {
            name: number(transformation.findtext(f"additionalTransformation/{name}") or default, file, name)
            for name, default in (("xTranslation", "0"), ("yTranslation", "0"), ("zRotation", "0"), ("scaling", "1"))
        }
        if values["zRotation"] == 0.0 and values["scaling"] == 1.0:
            return " ".join((reference or "").split()), (values["xTranslation"], values["yTranslation"])
    return None, (0.0, 0.0)


FORMAT = MapFormat("commonroad", "CommonRoad XML", _read)
