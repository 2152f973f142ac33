"""Top view of one replica of a scene."""

from collections.abc import Sequence
from functools import lru_cache

import numpy as np
import shapely
from numpy.typing import NDArray
from PIL import Image, ImageColor, ImageDraw

from tint_sumo.config import PERFECT, Sensor
from tint_sumo.core.errors import InputError
from tint_sumo.scenes import View
from tint_sumo.scenes.geometry import Bools, Boxes, Floats
from tint_sumo.scenes.roads import Roads
from tint_sumo.simulation import Simulation

RENDER_FPS = 10
_WIDTH = 736  # pixels
_OVERSAMPLING = 3  # the image is drawn larger and scaled down, for smooth edges
_GRASS, _ROAD, _LINE, _EGO, _GLASS = "#e9efe3", "#8f959b", "#ffffff", (240, 180, 0), "#2b2f33"

_PERSON, _PERSON_M = "#7a1f5c", 0.35  # colour and radius
BUILDING_COLOUR, _SIGHT = "#b9a994", "#1f5fa8"
_PALENESS = 0.65  # part of the road's colour in that of a vehicle that is not seen
_FAR_M = 1000.0  # beyond every picture


def require_render_mode(render_mode: str | None, choices: Sequence[str]) -> None:
    if render_mode is not None and render_mode not in choices:
        raise InputError(f"unknown render_mode {render_mode!r}; choose one of None, {', '.join(map(repr, choices))}")


def render_scene(
    simulation: Simulation, replica: int, sensor: Sensor = PERFECT, seen: Bools | None = None
) -> NDArray[np.uint8]:
    """Draw one replica as an (H, W, 3) image.

    Args:
        simulation: all replicas.
        replica: its number.
        sensor: its range and field of view are drawn.
        seen: (V,) which vehicles the ego perceives; the others are pale. All of them if not given.
    """
    view, colours = simulation.view(replica), simulation.scene.trait_colours
    canvas = Canvas(view, background(simulation.roads, view.moved(*simulation.origin_m)).copy())
    for building in simulation.buildings:
        canvas.fill(shapely.Polygon(building), BUILDING_COLOUR)
    slots, ego = simulation.slots, simulation.egos.box[replica]
    (traits,) = simulation.traits(slice(replica, replica + 1))
    for slot in np.flatnonzero(slots.present[replica]).tolist():
        colour = colours[traits[slot]]
        is_seen = seen is None or bool(seen[slot])
        shown = colour if is_seen else pale(colour)
        canvas.body(simulation.bodies.get(slot), shown)
        canvas.vehicle(slots.box[replica, slot], shown, with_glass=is_seen and slot not in simulation.bodies)
    canvas.persons(simulation.pedestrians)
    canvas.vehicle(ego, _EGO)
    canvas.sight(sensor, ego)
    return canvas.image()


def pale(colour: tuple[int, ...]) -> tuple[int, ...]:
    """Return the colour of a vehicle that the ego does not perceive."""
    road = ImageColor.getrgb(_ROAD)
    return tuple(round(_PALENESS * grey + (1.0 - _PALENESS) * part) for grey, part in zip(road, colour, strict=True))


@lru_cache(maxsize=8)  # a scene's view stays as it is, while one around the ego moves on
def background(roads: Roads, view: View, width_px: int = _WIDTH, oversampling: int = _OVERSAMPLING) -> Image.Image:
    """Return the empty roads, as a canvas of the same arguments has them; not to be drawn on."""
    canvas = Canvas(view, width_px=width_px, oversampling=oversampling)
    seen = shapely.box(view.left_m, view.bottom_m, view.right_m, view.top_m)
    for areas, colour in ((roads.paved, _ROAD), (roads.marks, _LINE)):
        for area in areas.geometries[areas.query(seen)]:
            canvas.fill(area, colour)
    return canvas.drawing


class Canvas:
    """A top view in metres, drawn ``oversampling`` times as large as the image; colours may have an opacity."""

    def __init__(
        self,
        view: View,
        drawing: Image.Image | None = None,
        *,
        width_px: int = _WIDTH,
        oversampling: int = _OVERSAMPLING,
    ) -> None:
        self._left_m, self._top_m = view.left_m, view.top_m
        self.pixels_per_m = width_px / (view.right_m - view.left_m) * oversampling
        self._oversampling = oversampling
        half_height_px = round((view.top_m - view.bottom_m) * self.pixels_per_m / oversampling / 2)
        size = (width_px * oversampling, 2 * half_height_px * oversampling)  # even, as videos have to be
        self.drawing = drawing or Image.new("RGB", size, _GRASS)
        self.draw = ImageDraw.Draw(self.drawing, "RGBA")

    def pixels(self, points_m: Floats) -> list[tuple[float, float]]:
        across, down = (
            (points_m[:, 0] - self._left_m) * self.pixels_per_m,
            (self._top_m - points_m[:, 1]) * self.pixels_per_m,
        )
        return list(zip(across.tolist(), down.tolist(), strict=True))

    def fill(self, shape: shapely.Geometry, colour: str | tuple[int, ...]) -> None:
        for part in shapely.get_parts(shape):
            self.draw.polygon(self.pixels(shapely.get_coordinates(part.exterior)), fill=colour)
            for hole in part.interiors:
                self.draw.polygon(self.pixels(shapely.get_coordinates(hole)), fill=_GRASS)

    def vehicle(self, box: np.void, colour: tuple[int, ...], *, with_glass: bool = True) -> None:
        """Draw a vehicle's box, with its windscreen towards the front."""
        length_m, half_width_m = box["length_m"], box["width_m"] / 2
        self.draw.polygon(self.part(box, (-length_m / 2, length_m / 2), (-half_width_m, half_width_m)), fill=colour)
        if not with_glass:
            return
        half_glass_m = 0.8 * half_width_m
        self.draw.polygon(self.part(box, (0.16 * length_m, 0.3 * length_m), (-half_glass_m, half_glass_m)), fill=_GLASS)

    def body(self, pieces: Boxes | None, colour: tuple[int, ...]) -> None:
        """Draw the pieces of a vehicle that bends, if it does."""
        for piece in () if pieces is None else pieces:
            self.vehicle(piece, colour, with_glass=False)

    def persons(self, boxes: Boxes) -> None:
        """Draw persons on foot as discs, a little larger than they are, so that they can be seen."""
        for across, down in self.pixels(np.stack([boxes["x_m"], boxes["y_m"]], axis=1)):
            radius = _PERSON_M * self.pixels_per_m
            self.draw.ellipse((across - radius, down - radius, across + radius, down + radius), fill=_PERSON)

    def sight(self, sensor: Sensor, ego: np.void) -> None:
        """Draw the border of an ego's range and field of view, if there are any."""
        all_around = sensor.field_of_view_deg >= 360.0
        if sensor.range_m is None and all_around:
            return
        facing, half_rad = np.arctan2(ego["heading_y"], ego["heading_x"]), np.radians(sensor.field_of_view_deg / 2)
        angles = np.linspace(facing - half_rad, facing + half_rad, 181)
        centre = np.array([[ego["x_m"], ego["y_m"]]])
        range_m = _FAR_M if sensor.range_m is None else sensor.range_m
        border = centre + range_m * np.stack([np.cos(angles), np.sin(angles)], axis=1)
        points = border if all_around else np.concatenate([centre, border, centre])
        self.draw.line(self.pixels(points), fill=_SIGHT, width=2 * self._oversampling)

    def part(
        self, box: np.void, along_m: tuple[float, float], across_m: tuple[float, float]
    ) -> list[tuple[float, float]]:
        """Return the corners of a part of a vehicle: from and to, ahead of its centre and to its left."""
        centre = np.array([box["x_m"], box["y_m"]])
        ahead = np.array([box["heading_x"], box["heading_y"]])
        abreast = np.array([-ahead[1], ahead[0]])
        (back_m, front_m), (right_m, left_m) = along_m, across_m
        corners = np.array([(back_m, right_m), (front_m, right_m), (front_m, left_m), (back_m, left_m)])
        return self.pixels(centre + corners @ np.stack([ahead, abreast]))

    def image(self) -> NDArray[np.uint8]:
        return np.array(self.drawing.reduce(self._oversampling))  # a copy, which users may draw on
