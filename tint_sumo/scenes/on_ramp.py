"""Merging from an acceleration lane into the lane beside it, in right-hand traffic."""

from tint_sumo.config import Claim
from tint_sumo.scenes.network import Connection, Edge, Network, Node, Point
from tint_sumo.scenes.parts import AHEAD_ONLY, OVERHANG_M
from tint_sumo.scenes.registry import register
from tint_sumo.scenes.scene import EgoTask, Route, Scene, View

_END_M = 20.0 + OVERHANG_M
_TAPER_START_M, _TAPER_END_M, _RAMP_Y_M = -8.0, 10.0, -4.0
_TAPER_POINTS = 25
_HALF_LANE_M = 2.0
_MAIN, _RAMP = 3, 1  # priorities


def _taper(part: float) -> Point:
    """Return a point of the quintic that starts and ends straight and uncurved."""
    x_m = _TAPER_START_M + (_TAPER_END_M - _TAPER_START_M) * part
    return x_m, _RAMP_Y_M * (1.0 - part**3 * (10.0 - 15.0 * part + 6.0 * part**2))


def _network() -> Network:
    taper = tuple(_taper(point / (_TAPER_POINTS - 1)) for point in range(_TAPER_POINTS))
    south = tuple((x_m, y_m - _HALF_LANE_M) for x_m, y_m in taper)
    return Network(
        nodes=(
            Node("WI", -_END_M, 0.0, type="dead_end"),
            Node("RI", -_END_M, _RAMP_Y_M, type="dead_end"),
            Node("EO", _END_M, 0.0, type="dead_end"),
            Node("M", 0.0, 0.0, (*south, (_TAPER_END_M, _HALF_LANE_M), (_TAPER_START_M, _HALF_LANE_M))),
        ),
        edges=(
            Edge("main_in", "WI", "M", _MAIN, ((-_END_M, 0.0), (_TAPER_START_M, 0.0))),
            Edge("main_out", "M", "EO", _MAIN, ((_TAPER_END_M, 0.0), (_END_M, 0.0))),
            Edge("ramp", "RI", "M", _RAMP, ((-_END_M, _RAMP_Y_M), (_TAPER_START_M, _RAMP_Y_M))),
        ),
        connections=(Connection("main_in", "main_out"), Connection("ramp", "main_out", taper)),
        left_hand=False,
    )


@register
def on_ramp() -> Scene:
    return Scene(
        name="on_ramp",
        title="merge from an acceleration lane (right-hand traffic)",
        network=_network(),
        routes=(Route("main", ("main_in", "main_out")),),
        ego=EgoTask(edges=("ramp", "main_out"), start_m=14.0, goal_m=40.0, controller=AHEAD_ONLY),
        view=View(-23.0, -10.0, 23.0, 6.0),
        claim=Claim(by="box"),
    )
