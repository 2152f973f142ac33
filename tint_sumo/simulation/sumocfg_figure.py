"""Draws a SUMO network with its traffic lights and the ways of the ego."""

from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import shapely
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection, PolyCollection
from matplotlib.figure import Figure
from numpy.typing import NDArray
from sumolib.geomhelper import positionAtShapeOffset

from tint_sumo.core.files import whole_file
from tint_sumo.scenes.sumocfg import EGO_CLASS, measure_route, network_roads, read_net
from tint_sumo.simulation.sumocfg_check import Check

_WAYS = ("#c83232", "#2860c8", "#1e8c46")
_AROUND_M = 25.0  # shown around the ego's way

Way = tuple[tuple[str, ...], float, float]  # edges, start and goal


def plot_check(found: Check, file: Path) -> None:
    """Write a picture: the whole network, and what surrounds the first way of the ego, as .png, .svg or the like."""
    net = read_net(found.config.net_file)
    if found.scene is not None:
        ways: list[Way] = [(found.scene.ego_route, found.scene.start_m, found.scene.goal_m)]
    else:
        ways = [(route.edges, route.start_m, route.goal_m) for route in found.routes]
    figure = Figure(figsize=(14.0, 7.0), dpi=120, layout="constrained")
    whole, near = figure.subplots(1, 2)
    _draw_lanes(net, whole)
    roads = shapely.get_parts(network_roads(found.config.net_file).paved.geometries)
    near.add_collection(PolyCollection([np.asarray(road.exterior.coords) for road in roads], facecolors="#b4b4b4"))
    for axes in (whole, near):
        lights = np.array([node.getCoord() for node in net.getNodes() if node.getType().startswith("traffic_light")])
        if len(lights):
            axes.plot(*lights.T, "D", color="#e0a000", markersize=5, label="traffic light")
        for number, way in enumerate(ways):
            points_m, start_m, goal_m = _way_m(net, way)
            colour = _WAYS[number % len(_WAYS)]
            axes.plot(*points_m.T, color=colour, linewidth=2.5, label="ego" if len(ways) == 1 else f"ego, {number + 1}")
            axes.plot(*start_m, "o", color=colour)
            axes.plot(*goal_m, "*", color=colour, markersize=12)
        axes.set(xlabel="x (m)", ylabel="y (m)")
        axes.set_aspect("equal")
    if ways:
        points_m = _way_m(net, ways[0])[0]
        (left_m, bottom_m), (right_m, top_m) = points_m.min(axis=0) - _AROUND_M, points_m.max(axis=0) + _AROUND_M
        near.set(xlim=(left_m, right_m), ylim=(bottom_m, top_m))
    else:
        near.autoscale()
    if whole.get_legend_handles_labels()[0]:
        whole.legend(loc="upper left")
    figure.suptitle(f"{found.config.name}: {found.network.edges:,} edges, {len(found.vtypes):,} vTypes")
    with whole_file(file) as partial:
        figure.savefig(partial, format=file.suffix.lower().removeprefix("."))


def _draw_lanes(net: Any, axes: Axes) -> None:
    """Draw the middle of each lane, those that the ego may take darker."""
    lanes = [lane for edge in net.getEdges() for lane in edge.getLanes()]
    colours = ["#606060" if lane.allows(EGO_CLASS) else "#d0d0d0" for lane in lanes]
    axes.add_collection(LineCollection([lane.getShape() for lane in lanes], colors=colours, linewidths=0.8))
    axes.autoscale()


def _way_m(net: Any, way: Way) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
    """Return points of a way along the lanes, (N, 2), and those of its start and goal, in m."""
    edges, start_m, goal_m = way
    starts_m, _, _ = measure_route(net, edges)
    shapes = {edge: _shape(net.getEdge(edge)) for edge in edges}
    points = list(shapes[edges[0]])
    for edge, after in pairwise(edges):
        connections = net.getEdge(edge).getOutgoing()[net.getEdge(after)]
        for inside in net.getInternalPath(connections)[0] or ():
            points += _shape(inside)
        points += shapes[after]
    ends = []
    for position_m in (start_m, goal_m):
        number = max(index for index, edge_m in enumerate(starts_m) if edge_m <= position_m)
        shape = shapes[edges[number]]
        ends.append(np.array(positionAtShapeOffset(shape, min(position_m - starts_m[number], _length_m(shape)))))
    return np.array(points), ends[0], ends[1]


def _shape(edge: Any) -> list[tuple[float, float]]:
    """Return the middle of an edge's first lane for the ego."""
    lane = next((lane for lane in edge.getLanes() if lane.allows(EGO_CLASS)), edge.getLanes()[0])
    return [(x_m, y_m) for x_m, y_m, *_ in lane.getShape()]


def _length_m(shape: list[tuple[float, float]]) -> float:
    return float(np.hypot(*np.diff(np.array(shape), axis=0).T).sum())
