"""Frames of a film in a SUMO configuration: the part of the network around the ego, from above."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import shapely
from PIL import Image, ImageDraw

from tint_sumo.config import PERFECT, Sensor
from tint_sumo.envs.rendering import BUILDING_COLOUR, Canvas, background, pale
from tint_sumo.films.driving import Moment
from tint_sumo.films.frames import (
    EGO_COLOUR,
    OVERSAMPLING,
    SCENE_HEIGHT_PX,
    SIZE_PX,
    TITLE_HEIGHT_PX,
    Colour,
    new_paper,
    write_key,
    write_state,
)
from tint_sumo.scenes import SumocfgScene, View
from tint_sumo.scenes.scene import Building
from tint_sumo.scenes.sumocfg import network_roads

_HALF_WIDTH_M = 50.0  # a frame shows so much to the left and right of the ego
_MOST_KEYS = 5  # vTypes in the legend


@dataclass(frozen=True)
class NetworkArtist:
    """Draws the moments of one case."""

    scene: SumocfgScene
    title: str  # what drives where
    colour: Colour  # of the method, as in all figures
    vtypes: tuple[int, ...]  # numbers of the vTypes in the legend
    origin_m: tuple[float, float]  # position of the scene's origin in the network
    sensor: Sensor = PERFECT
    buildings: tuple[Building, ...] = ()

    def frame(self, moment: Moment) -> Image.Image:
        """Return an RGB image of ``SIZE_PX``."""
        image = self._paper.copy()
        image.paste(self._scene(moment), (0, TITLE_HEIGHT_PX))
        write_state(ImageDraw.Draw(image), moment, "held by the safety check" if moment.is_held else "")
        return image

    def _scene(self, moment: Moment) -> Image.Image:
        half_height_m = _HALF_WIDTH_M * SCENE_HEIGHT_PX / SIZE_PX[0]
        around = View(-_HALF_WIDTH_M, -half_height_m, _HALF_WIDTH_M, half_height_m)
        view = around.moved(float(moment.ego["x_m"]), float(moment.ego["y_m"]))
        roads = background(
            network_roads(self.scene.config.net_file), view.moved(*self.origin_m), SIZE_PX[0], OVERSAMPLING
        )
        canvas = Canvas(view, roads.copy(), width_px=SIZE_PX[0], oversampling=OVERSAMPLING)
        for building in self.buildings:
            canvas.fill(shapely.Polygon(building), BUILDING_COLOUR)
        for slot in np.flatnonzero(moment.present).tolist():
            colour, is_seen = self.scene.trait_colours[moment.traits[slot]], bool(moment.seen[slot])
            shown = colour if is_seen else pale(colour)
            canvas.body(moment.bodies.get(slot), shown)
            canvas.vehicle(moment.boxes[slot], shown, with_glass=is_seen and slot not in moment.bodies)
        canvas.persons(moment.pedestrians)
        canvas.vehicle(moment.ego, EGO_COLOUR)
        canvas.sight(self.sensor, moment.ego)
        return canvas.drawing.reduce(OVERSAMPLING)

    @cached_property
    def _paper(self) -> Image.Image:
        """Draw the title and the legend, which are the same in all moments."""
        image, draw = new_paper(self.title, self.colour)
        left, top = 10, SIZE_PX[1] - 46
        left = write_key(draw, (left, top), "ego", fill=EGO_COLOUR)
        for number in self.vtypes[:_MOST_KEYS]:
            left = write_key(draw, (left, top), self.scene.vtypes[number], fill=self.scene.trait_colours[number])
        return image


def vtypes_in(moments: Sequence[Moment]) -> tuple[int, ...]:
    """Return the numbers of the vTypes that are seen in the moments, those of most vehicles first."""
    seen = {
        (int(vehicle), int(trait))
        for moment in moments
        for vehicle, trait in zip(moment.vehicles[moment.present], moment.traits[moment.present], strict=True)
    }
    numbers, counts = np.unique([trait for _, trait in seen], return_counts=True)
    return tuple(int(number) for number in numbers[np.argsort(-counts, kind="stable")])
