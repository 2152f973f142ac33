"""A roundabout of one lane in right-hand traffic: enter from the south, leave to the north.

Traffic from west to east passes the ego's entry; traffic from east to west enters where the ego passes, and passes its
exit. The two flows share no part of the ring.
"""

import math

from tint_sumo.config import Claim
from tint_sumo.scenes.network import Connection, Edge, Network, Node, Point
from tint_sumo.scenes.parts import AHEAD_ONLY, OVERHANG_M, arc, quarter_turns
from tint_sumo.scenes.registry import register
from tint_sumo.scenes.scene import EgoTask, Route, Scene, View

_RING_RADIUS_M = 11.0
_ENTRY_RADIUS_M = 8.0
_HALF_LANE_M = 2.0
_ARM_END_M, _EGO_ARM_END_M = 17.5 + OVERHANG_M, 22.5
_TRAFFIC, _EGO = 3, 1  # priorities

# An entry is a right-hand arc from its arm's lane to the ring, tangent to both; exits mirror entries.
_ENTRY_X_M = math.sqrt((_RING_RADIUS_M + _ENTRY_RADIUS_M) ** 2 - (_ENTRY_RADIUS_M + _HALF_LANE_M) ** 2)
_ENTRY_DEG = math.degrees(math.asin((_ENTRY_RADIUS_M + _HALF_LANE_M) / (_RING_RADIUS_M + _ENTRY_RADIUS_M)))
_ENTRY_CENTRE = (-_ENTRY_X_M, -_HALF_LANE_M - _ENTRY_RADIUS_M)

# All for the west arm; the others' are quarter turns of these.
_LANE_IN = ((-_ARM_END_M, -_HALF_LANE_M), (-_ENTRY_X_M, -_HALF_LANE_M))
_LANE_OUT = ((-_ENTRY_X_M, _HALF_LANE_M), (-_ARM_END_M, _HALF_LANE_M))
_ENTRY = arc(_ENTRY_CENTRE, _ENTRY_RADIUS_M, 90.0, _ENTRY_DEG)
_EXIT = tuple((x_m, -y_m) for x_m, y_m in reversed(_ENTRY))
_PASSING = arc((0.0, 0.0), _RING_RADIUS_M, 180.0 - _ENTRY_DEG, 180.0 + _ENTRY_DEG)
_BETWEEN = arc((0.0, 0.0), _RING_RADIUS_M, 180.0 + _ENTRY_DEG, 270.0 - _ENTRY_DEG)
_KERB = arc(_ENTRY_CENTRE, _ENTRY_RADIUS_M - _HALF_LANE_M, 90.0, _ENTRY_DEG)
_ISLAND = arc((0.0, 0.0), _RING_RADIUS_M - _HALF_LANE_M, 180.0 + _ENTRY_DEG, 180.0 - _ENTRY_DEG)
_JUNCTION = (*((x_m, -y_m) for x_m, y_m in reversed(_KERB)), *_KERB, *_ISLAND)

_SOUTH, _EAST, _NORTH = 1, 2, 3  # quarter turns from the west arm


def _junction(name: str, turn: int) -> Node:
    ((x_m, y_m),) = quarter_turns(((-_RING_RADIUS_M, 0.0),), turn)
    return Node(name, x_m, y_m, quarter_turns(_JUNCTION, turn))


def _end(name: str, point: Point) -> Node:
    return Node(name, *point, type="dead_end")


def _network() -> Network:
    """Return roads with junctions where the ego's way and the traffic's part or meet; no ways meet at the west arm."""
    west_in = (*_LANE_IN, *_ENTRY, *_BETWEEN)
    west_out = (*quarter_turns(_BETWEEN, _NORTH), *_EXIT, *_LANE_OUT)
    east_in, east_out = quarter_turns(_LANE_IN, _EAST), quarter_turns(_LANE_OUT, _EAST)
    south_in = quarter_turns(((-_EGO_ARM_END_M, -_HALF_LANE_M), _LANE_IN[1]), _SOUTH)
    north_out = quarter_turns((_LANE_OUT[0], (-_EGO_ARM_END_M, _HALF_LANE_M)), _NORTH)
    return Network(
        nodes=(
            _junction("south", _SOUTH),
            _junction("east", _EAST),
            _junction("north", _NORTH),
            _end("west_start", west_in[0]),
            _end("south_start", south_in[0]),
            _end("east_start", east_in[0]),
            _end("west_end", west_out[-1]),
            _end("east_end", east_out[-1]),
            _end("north_end", north_out[-1]),
        ),
        edges=(
            Edge("west_in", "west_start", "south", _TRAFFIC, west_in),
            Edge("south_in", "south_start", "south", _EGO, south_in),
            # The ring gives way to the east arm, so that no driver from there waits for an ego it does not react to.
            Edge("ring_south_east", "south", "east", _EGO, quarter_turns(_BETWEEN, _SOUTH)),
            Edge("east_in", "east_start", "east", _TRAFFIC, east_in),
            Edge("east_out", "east", "east_end", _TRAFFIC, east_out),
            Edge("ring_east_north", "east", "north", _TRAFFIC, quarter_turns(_BETWEEN, _EAST)),
            Edge("north_out", "north", "north_end", _EGO, north_out),
            Edge("west_out", "north", "west_end", _TRAFFIC, west_out),
        ),
        connections=(
            Connection("west_in", "ring_south_east", quarter_turns(_PASSING, _SOUTH)),
            Connection("south_in", "ring_south_east", quarter_turns(_ENTRY, _SOUTH)),
            Connection("ring_south_east", "east_out", quarter_turns(_EXIT, _EAST)),
            Connection("ring_south_east", "ring_east_north", quarter_turns(_PASSING, _EAST)),
            Connection("east_in", "ring_east_north", quarter_turns(_ENTRY, _EAST)),
            Connection("ring_east_north", "west_out", quarter_turns(_PASSING, _NORTH)),
            Connection("ring_east_north", "north_out", quarter_turns(_EXIT, _NORTH)),
        ),
        left_hand=False,
    )


@register
def roundabout() -> Scene:
    return Scene(
        name="roundabout",
        title="enter a roundabout and leave it at the second exit (right-hand traffic)",
        network=_network(),
        routes=(
            Route("west_east", ("west_in", "ring_south_east", "east_out")),
            Route("east_west", ("east_in", "ring_east_north", "west_out")),
        ),
        ego=EgoTask(
            edges=("south_in", "ring_south_east", "ring_east_north", "north_out"),
            start_m=6.0,
            goal_m=47.0,
            controller=AHEAD_ONLY,
        ),
        view=View(-20.5, -23.0, 20.5, 23.0),
        claim=Claim(by="box"),
    )
