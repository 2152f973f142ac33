"""The paper's T-intersection: turn right across one lane and merge into the other, in left-hand traffic.

Each lane crosses its own priority junction, L on the lower lane and U on the upper one, joined by a very short edge on
the ego's arc: a driver then reacts to the ego only once it enters the junction of the driver's own lane. One junction
for both lanes would make upper-lane drivers brake for an ego that still stands in the lower lane.
"""

import math
from dataclasses import dataclass, replace

import numpy as np

from tint_sumo.config import VehicleShape
from tint_sumo.scenes.network import Connection, Edge, Network, Node, Point
from tint_sumo.scenes.parts import mirrored_x
from tint_sumo.scenes.registry import register
from tint_sumo.scenes.scene import EgoTask, Route, Scene, View

_LENGTH_M = VehicleShape().length_m
_HALF_LENGTH_M = 20.0  # the street's: vehicle centres lie in [-20, 20] (code)
_LANE_WIDTH_M = 4.0  # code
_LOWER_Y_M, _BORDER_Y_M, _UPPER_Y_M = 2.0, 4.0, 6.0  # westbound lane, border, eastbound lane; y = 0 is the stem's end
_JUNCTION_HALF_LENGTH_M = 6.0
STEM_LENGTH_M = 20.0
_TURN_RADIUS_M = 6.0  # the ego's centre follows a quarter circle from (0, 0) to (6, 6) (code)
_START_Y_M = -5.0  # the ego's centre starts there, at x = 0 (code)
_GOAL_X_M = 8.0  # the ego's centre reaches its goal there, on the upper lane (code)
_HALF_LINK_M = 0.06
_TURN_POINTS = 16
_WAY_POINTS = 1024  # points along the arc

START_M = STEM_LENGTH_M + _START_Y_M + _LENGTH_M / 2  # start of the ego's front on its way
EGO_EDGES = ("stem", "mid", "upper_out")
ROUTES = (Route("lower", ("lower_in", "lower_out")), Route("upper", ("upper_in", "upper_out")))


@dataclass(frozen=True)
class Turn:
    """The ego's way by the length its front bumper has driven from the stem's start.

    The ego's centre drives up x = 0, and from (0, 0) on a quarter circle to the upper lane's middle (code); with a
    larger radius the circle begins earlier. SUMO leads
    the front along a lane's shape and the back along the same shape one vehicle length behind it, so the shape is the
    front's trace: straight on for half a vehicle more, then a quarter of the slightly larger circle around the same
    centre. The ego's centre then stays within 0.3 m of its path.
    """

    centre_radius_m: float = _TURN_RADIUS_M
    goal_x_m: float = _GOAL_X_M

    @property
    def radius_m(self) -> float:
        """Radius of the arc that the front follows."""
        return math.hypot(self.centre_radius_m, _LENGTH_M / 2)

    @property
    def start_y_m(self) -> float:
        """The centre's y where the turn starts, which is also that of the arc's centre."""
        return _UPPER_Y_M - self.centre_radius_m

    @property
    def start_m(self) -> float:
        return STEM_LENGTH_M + self.start_y_m + _LENGTH_M / 2

    @property
    def start_rad(self) -> float:
        """Angle of the front on its arc where the turn starts; 0 is west of the arc's centre, pi/2 north of it."""
        return math.asin(_LENGTH_M / 2 / self.radius_m)

    @property
    def end_m(self) -> float:
        return self.start_m + math.pi / 2 * self.radius_m

    def crossing_m(self, y_m: float) -> float:
        """Return the arc length at which the front reaches ``y_m`` on the first half of its turn."""
        return self.start_m + self.radius_m * (math.asin((y_m - self.start_y_m) / self.radius_m) - self.start_rad)

    def point(self, along_m: float) -> Point:
        on_turn_m = min(max(along_m, self.start_m), self.end_m)
        angle_rad = self.start_rad + (on_turn_m - self.start_m) / self.radius_m
        x_m = self.centre_radius_m - self.radius_m * math.cos(angle_rad) + max(along_m - self.end_m, 0.0)
        y_m = self.start_y_m + self.radius_m * math.sin(angle_rad) + min(along_m - self.start_m, 0.0)
        return x_m, y_m

    def points(self, start_m: float, end_m: float, count: int) -> tuple[Point, ...]:
        return tuple(self.point(along_m) for along_m in np.linspace(start_m, end_m, count).tolist())

    def goal_m(self) -> float:
        """Return the arc length at which the ego's centre reaches the goal; its back is still on the arc then."""
        low_m, high_m = self.end_m, self.end_m + _LENGTH_M
        for _ in range(60):
            middle_m = (low_m + high_m) / 2
            front_x_m, front_y_m = self.point(middle_m)
            back_x_m, back_y_m = self.point(middle_m - _LENGTH_M)
            heading_x = (front_x_m - back_x_m) / math.hypot(front_x_m - back_x_m, front_y_m - back_y_m)
            reached = front_x_m - _LENGTH_M / 2 * heading_x > self.goal_x_m
            low_m, high_m = (low_m, middle_m) if reached else (middle_m, high_m)
        return high_m

    def way(self, beyond_m: float) -> tuple[Point, ...]:
        """Return the front's way from the stem's start to this distance beyond the turn."""
        return (
            (0.0, -STEM_LENGTH_M),
            *self.points(self.start_m, self.end_m, _WAY_POINTS),
            self.point(self.end_m + beyond_m),
        )


def t_network(turn: Turn, half_length_m: float, speed_limit_mps: float = Network.speed_limit_mps) -> Network:
    """Return the roads of a street of twice this length."""
    half_width_m = _LANE_WIDTH_M / 2
    # Lanes reach half a vehicle past the street, so that a vehicle enters with departPos="base" and arrives at its
    # lane's end just when its centre crosses the border.
    end_m = half_length_m + _LENGTH_M / 2
    low_m, high_m, stem_m = _LOWER_Y_M - half_width_m, _UPPER_Y_M + half_width_m, half_width_m
    east_m, west_m, upper_east_m = (
        _JUNCTION_HALF_LENGTH_M,
        -_JUNCTION_HALF_LENGTH_M,
        turn.centre_radius_m + _LENGTH_M / 2,
    )
    lower = (
        (-stem_m, low_m),
        (stem_m, low_m),
        (east_m, low_m),
        (east_m, _BORDER_Y_M),
        (west_m, _BORDER_Y_M),
        (west_m, low_m),
    )
    upper = ((west_m, _BORDER_Y_M), (upper_east_m, _BORDER_Y_M), (upper_east_m, high_m), (west_m, high_m))
    border_m = turn.crossing_m(_BORDER_Y_M)
    link_start_m, link_end_m = border_m - _HALF_LINK_M, border_m + _HALF_LINK_M
    stem: tuple[Point, ...] = ((0.0, -STEM_LENGTH_M), (0.0, 0.0))
    across = ((0.0, 0.0), *turn.points(turn.start_m, link_start_m, _TURN_POINTS))
    link = turn.points(link_start_m, link_end_m, 2)
    if turn.start_m < STEM_LENGTH_M:  # the front turns before it reaches the street
        entry_m, (border_x_m, _) = turn.crossing_m(0.0), turn.point(border_m)
        stem = (stem[0], *turn.points(turn.start_m, entry_m, _TURN_POINTS))
        across = turn.points(entry_m, link_start_m, _TURN_POINTS)
        # Along the flatter arc, netconvert would take it for the lower lane's way back, and move that lane.
        x_m, y_m = 0.6 * _HALF_LINK_M, 0.8 * _HALF_LINK_M
        link = ((border_x_m - x_m, _BORDER_Y_M - y_m), (border_x_m + x_m, _BORDER_Y_M + y_m))
    return Network(
        nodes=(
            Node("S", 0.0, -STEM_LENGTH_M, type="dead_end"),
            Node("WL", -end_m, _LOWER_Y_M, type="dead_end"),
            Node("EL", end_m, _LOWER_Y_M, type="dead_end"),
            Node("WU", -end_m, _UPPER_Y_M, type="dead_end"),
            Node("EU", end_m, _UPPER_Y_M, type="dead_end"),
            Node("L", 0.0, _LOWER_Y_M, lower),
            Node("U", 0.0, _UPPER_Y_M, upper),
        ),
        edges=(
            Edge("lower_in", "EL", "L", 3),
            Edge("lower_out", "L", "WL", 3),
            Edge("upper_in", "WU", "U", 3),
            Edge("upper_out", "U", "EU", 3),
            Edge("stem", "S", "L", 1, stem),
            Edge("mid", "L", "U", 1, link),
        ),
        connections=(
            Connection("lower_in", "lower_out"),
            Connection("upper_in", "upper_out"),
            Connection("stem", "mid", across),
            Connection("mid", "upper_out", turn.points(link_end_m, turn.end_m, _TURN_POINTS)),
        ),
        left_hand=True,
        speed_limit_mps=speed_limit_mps,
    )


@register
def t_intersection() -> Scene:
    turn = Turn()
    return Scene(
        name="t_intersection",
        title="turn right across one lane and merge into the other (left-hand traffic)",
        network=t_network(turn, _HALF_LENGTH_M),
        routes=ROUTES,
        ego=EgoTask(edges=EGO_EDGES, start_m=START_M, goal_m=turn.goal_m(), way=turn.way(_HALF_LENGTH_M)),
        view=View(-23.0, -10.0, 23.0, 10.0),
    )


@register
def t_intersection_right() -> Scene:
    """The mirror image: turn left across one lane and merge into the other, in right-hand traffic."""
    scene = t_intersection()
    network, ego = scene.network, scene.ego
    return replace(
        scene,
        name="t_intersection_right",
        title="turn left across one lane and merge into the other (right-hand traffic)",
        network=replace(
            network,
            nodes=tuple(replace(node, x_m=-node.x_m, shape=mirrored_x(node.shape)) for node in network.nodes),
            edges=tuple(replace(edge, shape=mirrored_x(edge.shape)) for edge in network.edges),
            connections=tuple(
                replace(connection, shape=mirrored_x(connection.shape)) for connection in network.connections
            ),
            left_hand=False,
        ),
        ego=replace(ego, way=mirrored_x(ego.way)),
    )
