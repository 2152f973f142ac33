"""A crossing of four roads in right-hand traffic: straight across the main road, or left across its oncoming lane."""

from dataclasses import replace

from tint_sumo.config import Claim
from tint_sumo.scenes.network import Connection, Edge, Network, Node
from tint_sumo.scenes.parts import AHEAD_ONLY, OVERHANG_M, arc
from tint_sumo.scenes.registry import register
from tint_sumo.scenes.scene import EgoTask, Route, Scene, View

_END_M, _MINOR_END_M = 20.0 + OVERHANG_M, 25.0
_WEST_M, _EAST_M, _SOUTH_M, _NORTH_M = -4.0, 8.0, -4.0, 4.0  # borders of the junction
_EASTBOUND_Y_M, _WESTBOUND_Y_M, _NORTHBOUND_X_M = -2.0, 2.0, 2.0
_MAIN, _MINOR = 3, 1  # priorities
_TURN_RADIUS_M = 6.0


def _network(eastbound_priority: int, *connections: Connection) -> Network:
    """Return roads on which the ego's lane has less priority than the traffic's; westbound traffic goes straight on."""
    return Network(
        nodes=(
            Node("WI", -_END_M, _EASTBOUND_Y_M, type="dead_end"),
            Node("EO", _END_M, _EASTBOUND_Y_M, type="dead_end"),
            Node("EI", _END_M, _WESTBOUND_Y_M, type="dead_end"),
            Node("WO", -_END_M, _WESTBOUND_Y_M, type="dead_end"),
            Node("S", _NORTHBOUND_X_M, -_MINOR_END_M, type="dead_end"),
            Node("N", _NORTHBOUND_X_M, _MINOR_END_M, type="dead_end"),
            Node(
                "C",
                _NORTHBOUND_X_M,
                0.0,
                ((_WEST_M, _SOUTH_M), (_EAST_M, _SOUTH_M), (_EAST_M, _NORTH_M), (_WEST_M, _NORTH_M)),
            ),
        ),
        edges=(
            Edge("west_in", "WI", "C", eastbound_priority, ((-_END_M, _EASTBOUND_Y_M), (_WEST_M, _EASTBOUND_Y_M))),
            Edge("east_out", "C", "EO", _MAIN, ((_EAST_M, _EASTBOUND_Y_M), (_END_M, _EASTBOUND_Y_M))),
            Edge("east_in", "EI", "C", _MAIN, ((_END_M, _WESTBOUND_Y_M), (_EAST_M, _WESTBOUND_Y_M))),
            Edge("west_out", "C", "WO", _MAIN, ((_WEST_M, _WESTBOUND_Y_M), (-_END_M, _WESTBOUND_Y_M))),
            Edge("south_in", "S", "C", _MINOR, ((_NORTHBOUND_X_M, -_MINOR_END_M), (_NORTHBOUND_X_M, _SOUTH_M))),
            Edge("north_out", "C", "N", _MINOR, ((_NORTHBOUND_X_M, _NORTH_M), (_NORTHBOUND_X_M, _MINOR_END_M))),
        ),
        # No road is left without a connection: netconvert would guess some.
        connections=(
            Connection("east_in", "west_out"),
            Connection("west_in", "east_out"),
            Connection("south_in", "north_out"),
            *connections,
        ),
        left_hand=False,
    )


@register
def four_way() -> Scene:
    return Scene(
        name="four_way",
        title="straight on across the two lanes of a main road (right-hand traffic)",
        network=_network(_MAIN),
        routes=(Route("eastbound", ("west_in", "east_out")), Route("westbound", ("east_in", "west_out"))),
        ego=EgoTask(edges=("south_in", "north_out"), start_m=18.5, goal_m=34.0, controller=AHEAD_ONLY),
        view=View(-23.0, -15.0, 23.0, 15.0),
        claim=Claim(by="box"),
    )


@register
def four_way_turn() -> Scene:
    turn = Connection("west_in", "north_out", arc((_WEST_M, _NORTH_M), _TURN_RADIUS_M, -90.0, 0.0))
    return replace(
        four_way(),
        name="four_way_turn",
        title="left across the oncoming lane of a main road (right-hand traffic)",
        network=_network(_MINOR, turn),
        routes=(Route("westbound", ("east_in", "west_out")),),
        ego=EgoTask(edges=("west_in", "north_out"), start_m=18.0, goal_m=33.0, controller=AHEAD_ONLY),
    )
