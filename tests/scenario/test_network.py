from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
import sumolib

from tint_sumo.config import Street, VehicleShape
from tint_sumo.scenario.build import NET_FILE, write_scenario
from tint_sumo.scenario.geometry import EgoPath, lane_length_m, lane_y_m, stage_start_m
from tint_sumo.scenario.network import EGO_ROUTE, LOWER_ROUTE, UPPER_ROUTE, lane_id, name, replica_origin

REPLICAS = 18  # more than one row


@pytest.fixture(scope="module")
def net(tmp_path_factory: pytest.TempPathFactory) -> sumolib.net.Net:
    folder: Path = tmp_path_factory.mktemp("net")
    write_scenario(folder, REPLICAS)
    return sumolib.net.readNet(str(folder / NET_FILE), withInternal=True)


def test_each_lane_crosses_its_own_priority_junction(net: sumolib.net.Net) -> None:
    for junction, edges in (("L", LOWER_ROUTE), ("U", UPPER_ROUTE)):
        node = net.getNode(name(junction, 3))
        assert node.getType() == "priority"
        assert net.getEdge(name(edges[0], 3)).getToNode() is node
        assert net.getEdge(name(edges[1], 3)).getFromNode() is node


@pytest.mark.parametrize("replica", [0, 7, REPLICAS - 1])
@pytest.mark.parametrize("lane", [0, 1])
def test_lanes_join_up_and_run_along_their_y(net: sumolib.net.Net, replica: int, lane: int) -> None:
    origin_x, origin_y = replica_origin(replica)
    lanes = [net.getLane(lane_id(lane, stage, replica)) for stage in range(3)]
    for before, after in pairwise(lanes):
        assert before.getShape()[-1] == after.getShape()[0]
    assert sum(one.getLength() for one in lanes) == lane_length_m(Street(), VehicleShape())
    assert {y - origin_y for one in lanes for _, y in one.getShape()} == {lane_y_m(Street())[lane]}
    start, end = lanes[0].getShape()[0][0] - origin_x, lanes[2].getShape()[-1][0] - origin_x
    assert (start, end) == ((22.5, -22.5) if lane == 0 else (-22.5, 22.5))
    starts_m = np.cumsum([0.0, *(one.getLength() for one in lanes[:2])])
    assert starts_m.tolist() == stage_start_m(Street(), VehicleShape())[lane].tolist()


def test_all_replicas_have_the_same_lane_lengths(net: sumolib.net.Net) -> None:
    for part in (*LOWER_ROUTE, *UPPER_ROUTE, *EGO_ROUTE):
        assert len({net.getLane(f"{name(part, replica)}_0").getLength() for replica in range(REPLICAS)}) == 1


def test_the_egos_lanes_follow_its_path(net: sumolib.net.Net) -> None:
    path = EgoPath.of(Street(), VehicleShape())
    lanes = ("stem.0_0", ":L.0_0_0", "mid.0_0", ":U.0_1_0")
    assert sum(net.getLane(one).getLength() for one in lanes) == pytest.approx(path.turn_end_m, abs=0.01)
