"""Top view of one replica of a scene."""

from collections.abc import Sequence
from functools import cache
from pathlib import Path

import numpy as np
import shapely
from numpy.typing import NDArray
from PIL import Image, ImageDraw

from tint_sumo.core.errors import InputError
from tint_sumo.scenes import View
from tint_sumo.scenes.geometry import SPACING_M, Floats
from tint_sumo.scenes.layout import Layout
from tint_sumo.scenes.sumocfg import read_net
from tint_sumo.simulation.simulation import Simulation
from tint_sumo.simulation.sumocfg import SumocfgSimulation

RENDER_FPS = 10
_WIDTH = 736  # pixels
_OVERSAMPLING = 3  # the image is drawn larger and scaled down, for smooth edges
_DASH_M, _LINE_M = 1.0, 0.12
_GRASS, _ROAD, _LINE, _EGO, _GLASS = "#e9efe3", "#8f959b", "#ffffff", (240, 180, 0), "#2b2f33"
_AROUND_M = (30.0, 20.0)  # what is shown of a user's network, to each side of the ego
_SEAM_M = 0.06  # half of the line between two lanes
# Of vTypes, by their numbers; those that follow begin again.
_VTYPES = ((40, 90, 200), (200, 40, 40), (30, 140, 70), (130, 60, 170), (220, 110, 20), (20, 150, 170), (90, 90, 90))


def render_fps(decision_s: float | None) -> float:
    """Return the images per second that show episodes in real time, one for each step of the environment."""
    return RENDER_FPS if decision_s is None else 1.0 / decision_s


def require_render_mode(render_mode: str | None, choices: Sequence[str]) -> None:
    if render_mode is not None and render_mode not in choices:
        raise InputError(f"unknown render_mode {render_mode!r}; choose one of None, {', '.join(map(repr, choices))}")


def render_scene(simulation: Simulation | SumocfgSimulation, replica: int) -> NDArray[np.uint8]:
    """Draw one replica as an (H, W, 3) image."""
    if isinstance(simulation, SumocfgSimulation):
        return _render_surroundings(simulation)
    view = simulation.scene.view
    canvas = Canvas(view, background(simulation.layout, view).copy())
    slots, shape = simulation.slots, simulation.scene.vehicle
    for slot in np.flatnonzero(slots.present[replica]).tolist():
        profile = simulation.population[slots.member[replica, slot]].profile
        colour = tuple(int(part) for part in profile.colour.split(","))
        canvas.vehicle(slots.pose[replica, slot], shape.length_m, shape.width_m, colour)
    canvas.vehicle(simulation.egos.pose[replica], shape.length_m, shape.width_m, _EGO)
    return canvas.image()


def _render_surroundings(simulation: SumocfgSimulation) -> NDArray[np.uint8]:
    """The surroundings of the ego in a user's network."""
    ego, slots = simulation.egos.pose[0], simulation.slots
    x_m, y_m, across_m, up_m = float(ego["x_m"]), float(ego["y_m"]), *_AROUND_M
    view = View(x_m - across_m, y_m - up_m, x_m + across_m, y_m + up_m)
    canvas = Canvas(view)
    roads = _network_roads(simulation.scene.config.net_file)
    corners_m = np.array([[view.left_m, view.bottom_m], [view.right_m, view.top_m]]) + simulation.origin_m
    for road in roads.geometries[roads.query(shapely.box(*corners_m.reshape(-1)))]:
        canvas.fill(shapely.transform(road, lambda points_m: points_m - simulation.origin_m), _ROAD)
    for slot in np.flatnonzero(slots.present[0]).tolist():
        colour = _VTYPES[slots.member[0, slot] % len(_VTYPES)]
        canvas.vehicle(slots.pose[0, slot], slots.length_m[0, slot], slots.width_m[0, slot], colour)
    canvas.vehicle(ego, simulation.scene.vehicle.length_m, simulation.scene.vehicle.width_m, _EGO)
    return canvas.image()


@cache
def _network_roads(net_file: Path) -> shapely.STRtree:
    """The areas of all lanes and junctions."""
    net = read_net(net_file, with_internal=False)
    lanes = [lane for edge in net.getEdges(withInternal=False) for lane in edge.getLanes()]
    paved = [
        shapely.LineString(lane.getShape()).buffer(max(lane.getWidth() / 2 - _SEAM_M, _SEAM_M), cap_style="flat")
        for lane in lanes
    ]
    outlines = [node.getShape() for node in net.getNodes() if len(node.getShape()) > 2]
    return shapely.STRtree([*paved, *(shapely.Polygon(outline).buffer(_SEAM_M) for outline in outlines)])


@cache
def background(layout: Layout, view: View, width_px: int = _WIDTH, oversampling: int = _OVERSAMPLING) -> Image.Image:
    """The empty roads, as a canvas of the same arguments has them; not to be drawn on."""
    canvas = Canvas(view, width_px=width_px, oversampling=oversampling)
    canvas.fill(layout.roads, _ROAD)
    half_m, dash = layout.scene.network.lane_width_m / 2, round(_DASH_M / SPACING_M)
    for route in layout.routes:
        middle = route.way[: round(route.length_m / SPACING_M)]
        step = np.gradient(middle, axis=0)
        across = np.stack([-step[:, 1], step[:, 0]], axis=-1) / np.hypot(*step.T)[:, None] * half_m
        for border in (middle + across, middle - across):
            for start in range(0, len(border) - dash, 2 * dash):
                line = shapely.linestrings(border[start : start + dash + 1 : 10])
                canvas.fill(shapely.buffer(line, _LINE_M / 2, cap_style="flat"), _LINE)
    return canvas.drawing


class Canvas:
    """A top view in metres, drawn ``oversampling`` times as large as it is wanted; colours may have an opacity."""

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

    def vehicle(self, pose: np.void, length_m: float, width_m: float, colour: tuple[int, ...]) -> None:
        """A box with its windscreen towards the front."""
        half_length_m, half_width_m = length_m / 2, width_m / 2
        self.draw.polygon(self.box(pose, (-half_length_m, half_length_m), (-half_width_m, half_width_m)), fill=colour)
        half_glass_m = 0.8 * half_width_m
        self.draw.polygon(self.box(pose, (0.16 * length_m, 0.3 * length_m), (-half_glass_m, half_glass_m)), fill=_GLASS)

    def box(
        self, pose: np.void, along_m: tuple[float, float], across_m: tuple[float, float]
    ) -> list[tuple[float, float]]:
        """Corners of a part of a vehicle: from and to, ahead of its centre and to its left."""
        centre = np.array([pose["x_m"], pose["y_m"]])
        ahead = np.array([pose["heading_x"], pose["heading_y"]])
        abreast = np.array([-ahead[1], ahead[0]])
        (back_m, front_m), (right_m, left_m) = along_m, across_m
        corners = np.array([(back_m, right_m), (front_m, right_m), (front_m, left_m), (back_m, left_m)])
        return self.pixels(centre + corners @ np.stack([ahead, abreast]))

    def image(self) -> NDArray[np.uint8]:
        return np.asarray(self.drawing.reduce(self._oversampling))
