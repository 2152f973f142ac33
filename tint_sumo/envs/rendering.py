"""Top view of one intersection."""

import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageDraw

from tint_sumo.config import Street
from tint_sumo.errors import InputError
from tint_sumo.scenario.geometry import LANE_DIRECTION
from tint_sumo.simulation.intersections import Intersections

RENDER_FPS = 10
_PIXELS_PER_M = 16
_OVERSAMPLING = 3  # the image is drawn larger and scaled down, for smooth edges
_LEFT_M, _RIGHT_M, _BOTTOM_M, _TOP_M = -23.0, 23.0, -10.0, 10.0
_GRASS, _ROAD, _LINE, _EGO, _GLASS = "#e9efe3", "#8f959b", "#ffffff", (240, 180, 0), "#2b2f33"


def require_render_mode(render_mode: str | None) -> None:
    if render_mode not in (None, "rgb_array"):
        raise InputError(f"unknown render_mode {render_mode!r}; choose None or 'rgb_array'")


def render_intersection(simulation: Intersections, replica: int) -> NDArray[np.uint8]:
    """Draw one replica as an (H, W, 3) image."""
    canvas = _Canvas()
    _draw_street(canvas, simulation.scenario.street)
    shape = simulation.scenario.vehicle
    for slot in np.flatnonzero(simulation.present[replica]):
        profile = simulation.population[simulation.member[replica, slot]].profile
        direction = float(LANE_DIRECTION[simulation.lane[replica, slot]])
        colour = tuple(int(part) for part in profile.colour.split(","))
        centre = (simulation.x_m[replica, slot], simulation.y_m[replica, slot])
        canvas.vehicle(centre, (direction, 0.0), shape.length_m, shape.width_m, colour)
    pose = simulation.ego_pose[replica]
    heading = (pose["heading_x"], pose["heading_y"])
    canvas.vehicle((pose["x_m"], pose["y_m"]), heading, shape.length_m, shape.width_m, _EGO)
    return canvas.image()


def _draw_street(canvas: "_Canvas", street: Street) -> None:
    half = street.lane_width_m / 2
    middle = street.lower_y_m + half
    canvas.box(_LEFT_M, street.lower_y_m - half, _RIGHT_M, street.upper_y_m + half, _ROAD)
    canvas.box(-half, _BOTTOM_M, half, street.lower_y_m, _ROAD)
    for x_m in np.arange(_LEFT_M, _RIGHT_M, 2.0):
        canvas.box(x_m, middle - 0.06, x_m + 1.0, middle + 0.06, _LINE)


class _Canvas:
    def __init__(self) -> None:
        scale = _PIXELS_PER_M * _OVERSAMPLING
        size = (int((_RIGHT_M - _LEFT_M) * scale), int((_TOP_M - _BOTTOM_M) * scale))
        self._scale = scale
        self._image = Image.new("RGB", size, _GRASS)
        self._draw = ImageDraw.Draw(self._image)

    def _pixel(self, x_m: float, y_m: float) -> tuple[float, float]:
        return (x_m - _LEFT_M) * self._scale, (_TOP_M - y_m) * self._scale

    def box(self, left_m: float, bottom_m: float, right_m: float, top_m: float, colour: str) -> None:
        self._draw.rectangle((*self._pixel(left_m, top_m), *self._pixel(right_m, bottom_m)), fill=colour)

    def vehicle(
        self,
        centre_m: tuple[float, float],
        heading: tuple[float, float],
        length_m: float,
        width_m: float,
        colour: tuple[int, ...],
    ) -> None:
        """A box with its windscreen towards the front."""

        def polygon(back: float, front: float, half_width: float) -> list[tuple[float, float]]:
            corners = ((back, -half_width), (front, -half_width), (front, half_width), (back, half_width))
            return [
                self._pixel(
                    centre_m[0] + along * heading[0] - across * heading[1],
                    centre_m[1] + along * heading[1] + across * heading[0],
                )
                for along, across in corners
            ]

        half_length, half_width = length_m / 2, width_m / 2
        self._draw.polygon(polygon(-half_length, half_length, half_width), fill=colour)
        self._draw.polygon(polygon(0.16 * length_m, 0.3 * length_m, 0.8 * half_width), fill=_GLASS)

    def image(self) -> NDArray[np.uint8]:
        width, height = (side // _OVERSAMPLING for side in self._image.size)
        return np.asarray(self._image.resize((width, height), Image.Resampling.LANCZOS))
