"""Frames of a film: the scene from above, with the inferred traits and the attention of the policy."""

from dataclasses import dataclass
from functools import cache, cached_property

import numpy as np
import shapely
from PIL import Image, ImageDraw, ImageFont

from tint_sumo.config import PERFECT, Sensor
from tint_sumo.envs.rendering import BUILDING_COLOUR, Canvas, background, pale
from tint_sumo.films.driving import Moment
from tint_sumo.films.trait_probe import TraitReader
from tint_sumo.scenes import View
from tint_sumo.scenes.geometry import SPACING_M, Floats
from tint_sumo.scenes.layout import Layout

Colour = tuple[int, ...]

SIZE_PX = (640, 480)
TITLE_HEIGHT_PX, SCENE_HEIGHT_PX = 30, 346  # the rest of a frame is words
OVERSAMPLING = 2
_OUTLINE_M, _RING_M = 0.28, 0.12  # outline of the true trait, and white line around the inferred one
_LAMP_M, _EDGE_M = 0.45, 0.12
HALO_M = (1.6, 5.5)  # radius of the halo of a vehicle without weight, and of one that has it all
LEAST_WEIGHT = 0.03  # a vehicle with less has no halo
EGO_COLOUR, _UNSURE, _WHITE = (240, 180, 0), (190, 190, 190), (255, 255, 255)
_LAMP, _GLASS, _INK, _PAPER, _FAINT = (255, 40, 40), (43, 47, 51), (30, 33, 37), (250, 250, 247), (110, 116, 122)
_HALO, _CLAIM, _WAY = (255, 225, 60, 105), (0, 150, 140, 75), (240, 180, 0, 130)
_HALO_KEY, _CLAIM_KEY = (225, 210, 95), (100, 149, 151)  # how they look on the road
_OUTCOMES = {
    "success": (30, 140, 70),
    "collision": (200, 40, 40),
    "timeout": (150, 90, 0),
    "lost": (110, 60, 140),
    "red_light": (200, 40, 40),
}


@dataclass(frozen=True)
class Artist:
    """Draws the moments of one case."""

    layout: Layout
    title: str  # what drives where
    colour: Colour  # of the method, as in all figures
    reader: TraitReader | None  # None without traits in the observation
    has_attention: bool
    sensor: Sensor = PERFECT

    def frame(self, moment: Moment) -> Image.Image:
        """Return an RGB image of ``SIZE_PX``."""
        image = self._paper.copy()
        image.paste(self._scene(moment), (0, TITLE_HEIGHT_PX))
        write_state(ImageDraw.Draw(image), moment, _noticed(self.layout, moment))
        return image

    def _scene(self, moment: Moment) -> Image.Image:
        empty = _roads(self.layout)
        canvas = Canvas(_view(self.layout), empty.copy(), width_px=SIZE_PX[0], oversampling=OVERSAMPLING)
        lanes = _lanes(self.layout)
        for route in np.flatnonzero(moment.claimed).tolist():
            canvas.fill(lanes[route], _CLAIM)
        slots = np.flatnonzero(moment.present).tolist()
        if moment.attention is not None:
            for slot in slots:
                _draw_halo(canvas, moment.boxes[slot], float(moment.attention[slot]))
        fills = self._fills(moment)
        for slot in slots:
            profile = self.layout.scene.population.profiles[moment.traits[slot]]
            outline = _parts(profile.colour)
            if moment.seen[slot]:
                self._draw_vehicle(canvas, moment.boxes[slot], outline, fills[slot], bool(moment.brakes[slot]))
            else:
                canvas.vehicle(moment.boxes[slot], pale(outline), with_glass=False)
        self._draw_vehicle(canvas, moment.ego, _INK, EGO_COLOUR, moment.ego_brakes)
        canvas.sight(self.sensor, moment.ego)
        return canvas.drawing.reduce(OVERSAMPLING)

    def _fills(self, moment: Moment) -> list[Colour]:
        """Return the colour of each slot's likelier trait, the greyer the less sure; white where none is inferred."""
        if self.reader is None or moment.observed_traits is None:
            return [_WHITE] * len(moment.present)
        conservative, aggressive = (_parts(profile.colour) for profile in self.layout.scene.population.profiles)
        return [
            _WHITE if np.isnan(probability) else _shade(probability, conservative, aggressive)
            for probability in self.reader.p_conservative(moment.observed_traits).tolist()
        ]

    def _draw_vehicle(self, canvas: Canvas, pose: np.void, outline: Colour, fill: Colour, brakes: bool) -> None:
        shape = self.layout.scene.vehicle
        back_m, side_m = -shape.length_m / 2, shape.width_m / 2
        for inset_m, colour in ((0.0, outline), (_OUTLINE_M, _WHITE), (_OUTLINE_M + _RING_M, fill)):
            half_length_m, half_width_m = -back_m - inset_m, side_m - inset_m
            corners = canvas.part(pose, (-half_length_m, half_length_m), (-half_width_m, half_width_m))
            canvas.draw.polygon(corners, fill=colour)
        glass_m = (0.16 * shape.length_m, 0.3 * shape.length_m)
        canvas.draw.polygon(canvas.part(pose, glass_m, (-half_width_m, half_width_m)), fill=_GLASS)
        if brakes:
            _draw_lamp(canvas, pose, back_m, (-side_m, -side_m + 2 * _LAMP_M))
            _draw_lamp(canvas, pose, back_m, (side_m - 2 * _LAMP_M, side_m))

    @cached_property
    def _paper(self) -> Image.Image:
        """Draw the title and the legend, which are the same in all moments."""
        (image, draw), top = new_paper(self.title, self.colour), SIZE_PX[1] - 46
        first, second = self.layout.scene.population.profiles
        left = write_key(draw, (10, top), f"true trait: {first.name}", outline=_parts(first.colour))
        left = write_key(draw, (left, top), second.name, outline=_parts(second.colour))
        left = write_key(draw, (left, top), "brakes", outline=_LAMP, fill=_LAMP)
        left = write_key(draw, (left, top), "claimed lane", fill=_CLAIM_KEY)
        if self.has_attention:
            write_key(draw, (left, top), "attention", fill=_HALO_KEY)
        below = top + 22
        if self.reader is None:
            draw.text((10, below), "this policy has no traits of the others", font=_font(13), fill=_FAINT)
            self._add_hidden(draw, (280, below))
            return image
        left = write_key(draw, (10, below), f"inferred trait: {first.name}", fill=_parts(first.colour))
        left = write_key(draw, (left, below), second.name, fill=_parts(second.colour))
        left = write_key(draw, (left, below), "unsure", fill=_UNSURE)
        left = write_key(draw, (left, below), "nothing inferred", outline=_FAINT, fill=_WHITE)
        self._add_hidden(draw, (left, below))
        return image

    def _add_hidden(self, draw: ImageDraw.ImageDraw, at: tuple[int, int]) -> None:
        """Add vehicles that are not seen to the legend, if there can be any."""
        if self.sensor.hides:
            write_key(draw, at, "not seen", fill=pale(_parts(self.layout.scene.population.profiles[0].colour)))


def new_paper(title: str, colour: Colour) -> tuple[Image.Image, ImageDraw.ImageDraw]:
    """Return an empty frame with its title, and what draws on it."""
    image = Image.new("RGB", SIZE_PX, _PAPER)
    draw = ImageDraw.Draw(image)
    draw.rectangle((10, 8, 24, 22), fill=colour)
    draw.text((32, 6), title, font=_font(15), fill=_INK)
    return image, draw


def write_state(draw: ImageDraw.ImageDraw, moment: Moment, noticed: str) -> None:
    """Draw the time, what the policy wants, a line of what else there is to notice, and the outcome."""
    top = TITLE_HEIGHT_PX + SCENE_HEIGHT_PX + 8
    draw.text((10, top), f"{moment.time_s:4.1f} s", font=_font(24), fill=_INK)
    draw.text((110, top + 1), _wanted(moment), font=_font(15), fill=_INK)
    draw.text((110, top + 21), noticed, font=_font(15), fill=_INK)
    draw.text((630, top), moment.outcome, font=_font(24), fill=_OUTCOMES.get(moment.outcome, _INK), anchor="ra")


def _wanted(moment: Moment) -> str:
    """Draw the action and the value of the policy."""
    parts = [f"speed {moment.ego_mps:.1f} m/s"]
    if moment.desired_mps is not None:
        parts.append(f"action: wants {moment.desired_mps:.3g} m/s")
    if moment.value is not None:
        parts.append(f"value {moment.value:+.2f}")
    return "     ".join(parts)


def _noticed(layout: Layout, moment: Moment) -> str:
    """Draw the state of the ego's safety check and its claims."""
    claims = [route.name for route, claimed in zip(layout.scene.routes, moment.claimed, strict=True) if claimed]
    text = f"claims {' and '.join(claims)}" if claims else "claims no lane"
    return text + ("     held by the safety check" if moment.is_held else "")


def write_key(
    draw: ImageDraw.ImageDraw,
    at: tuple[int, int],
    text: str,
    *,
    outline: Colour | None = None,
    fill: Colour | None = None,
) -> int:
    """Draw an entry of the legend, and return where the next one begins."""
    left, top = at
    draw.rectangle((left, top + 2, left + 18, top + 13), outline=outline or fill, fill=fill, width=3)
    draw.text((left + 23, top), text, font=_font(13), fill=_INK)
    return left + 37 + round(_font(13).getlength(text))


def _draw_lamp(canvas: Canvas, pose: np.void, back_m: float, across_m: tuple[float, float]) -> None:
    """Draw the brake lights of a vehicle."""
    right_m, left_m = across_m
    canvas.draw.polygon(canvas.part(pose, (back_m - _LAMP_M - _EDGE_M, back_m + _EDGE_M), across_m), fill=_WHITE)
    inside_m = (right_m + _EDGE_M, left_m - _EDGE_M)
    canvas.draw.polygon(canvas.part(pose, (back_m - _LAMP_M, back_m), inside_m), fill=_LAMP)


def _draw_halo(canvas: Canvas, pose: np.void, weight: float) -> None:
    """Draw a disc whose area grows with the weight."""
    if weight < LEAST_WEIGHT:
        return
    ((across, down),) = canvas.pixels(np.array([[pose["x_m"], pose["y_m"]]]))
    least_m, most_m = HALO_M
    radius = (least_m + (most_m - least_m) * weight**0.5) * canvas.pixels_per_m
    canvas.draw.ellipse((across - radius, down - radius, across + radius, down + radius), fill=_HALO)


def _shade(p_conservative: float, conservative: Colour, aggressive: Colour) -> Colour:
    sureness = abs(2.0 * p_conservative - 1.0)
    likelier = conservative if p_conservative > 0.5 else aggressive
    return tuple(round(grey + (part - grey) * sureness) for grey, part in zip(_UNSURE, likelier, strict=True))


def _parts(colour: str) -> Colour:
    return tuple(int(part) for part in colour.split(","))


@cache
def _font(size_px: int) -> ImageFont.FreeTypeFont:
    font = ImageFont.load_default(size_px)
    assert isinstance(font, ImageFont.FreeTypeFont)
    return font


@cache
def _view(layout: Layout) -> View:
    """Return the scene's view, with more around it where a frame has room."""
    view = layout.scene.view
    width_m, height_m = view.right_m - view.left_m, view.top_m - view.bottom_m
    m_per_px = max(width_m / SIZE_PX[0], height_m / SCENE_HEIGHT_PX)
    half_width_m, half_height_m = SIZE_PX[0] * m_per_px / 2, SCENE_HEIGHT_PX * m_per_px / 2
    x_m, y_m = (view.left_m + view.right_m) / 2, (view.bottom_m + view.top_m) / 2
    return View(x_m - half_width_m, y_m - half_height_m, x_m + half_width_m, y_m + half_height_m)


@cache
def _roads(layout: Layout) -> Image.Image:
    """Return the empty roads with the ego's way; not to be drawn on."""
    roads = background(layout.roads, _view(layout), SIZE_PX[0], OVERSAMPLING).copy()
    canvas = Canvas(_view(layout), roads, width_px=SIZE_PX[0], oversampling=OVERSAMPLING)
    for building in layout.scene.buildings:
        canvas.fill(shapely.Polygon(building), BUILDING_COLOUR)
    task = layout.scene.ego
    way = _between(layout.ego.way, task.start_m, task.goal_m)
    canvas.draw.line(canvas.pixels(way), fill=_WAY, width=3 * OVERSAMPLING, joint="curve")
    return canvas.drawing


@cache
def _lanes(layout: Layout) -> tuple[shapely.Geometry, ...]:
    """Return the area of each route of the traffic."""
    half_m = layout.scene.network.lane_width_m / 2
    lines = [shapely.linestrings(_between(path.way, 0.0, path.length_m)) for path in layout.routes]
    return tuple(shapely.buffer(line, half_m, cap_style="flat") for line in lines)


def _between(way: Floats, from_m: float, to_m: float) -> Floats:
    """Return a tenth of the points of a part of a way."""
    part: Floats = way[round(from_m / SPACING_M) : round(to_m / SPACING_M) : 10]
    return part
