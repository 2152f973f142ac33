from pathlib import Path

import numpy as np
import pytest
import sumolib

from tint_sumo.core.errors import InputError
from tint_sumo.scenes import SCENES, T_INTERSECTION, find_scene
from tint_sumo.scenes.build import NET_FILE, write_scene
from tint_sumo.scenes.layout import layout
from tint_sumo.scenes.network import build_network, name, plain_xml, replica_origin
from tint_sumo.scenes.sumo_config import read_config
from tint_sumo.simulation.vtypes import read_vtype_table

REPLICAS = 18  # more than one row


@pytest.fixture(scope="module")
def net(tmp_path_factory: pytest.TempPathFactory) -> sumolib.net.Net:
    folder: Path = tmp_path_factory.mktemp("net")
    write_scene(folder, find_scene(T_INTERSECTION), REPLICAS)
    return sumolib.net.readNet(str(folder / NET_FILE), withInternal=True)


def test_each_lane_of_the_t_intersection_crosses_its_own_priority_junction(net: sumolib.net.Net) -> None:
    for junction, route in zip("LU", find_scene(T_INTERSECTION).routes, strict=True):
        node = net.getNode(name(junction, 3))
        assert node.getType() == "priority"
        assert net.getEdge(name(route.edges[0], 3)).getToNode() is node
        assert net.getEdge(name(route.edges[1], 3)).getFromNode() is node


@pytest.mark.parametrize("work", ["network", "configuration", "vTypes"])
def test_a_temporary_folder_that_sumo_cannot_name_is_refused(
    work: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    file = tmp_path / ("own.sumocfg" if work == "configuration" else "own.add.xml")
    file.write_text("<sumoConfiguration/>" if work == "configuration" else "<additional/>", encoding="utf-8")
    folder = tmp_path / "a, b"
    folder.mkdir()
    monkeypatch.setattr("tempfile.tempdir", str(folder))
    build_network.cache_clear()
    with pytest.raises(InputError, match="a, b, for it splits paths at commas; set TMPDIR"):
        if work == "network":
            build_network(plain_xml(find_scene(T_INTERSECTION).network, 1))
        elif work == "configuration":
            read_config(file)
        else:
            read_vtype_table(file)


@pytest.mark.parametrize("replica", [0, 7, REPLICAS - 1])
def test_replicas_are_copies_at_their_origins(net: sumolib.net.Net, replica: int) -> None:
    origin_x, origin_y = replica_origin(replica)
    found = layout(find_scene(T_INTERSECTION))
    for path in (*found.routes, found.ego):
        first, copy = ([net.getLane(lane.format(replica=number)) for lane in path.lanes] for number in (0, replica))
        for one, other in zip(first, copy, strict=True):
            assert other.getLength() == one.getLength()
            moved = np.subtract(other.getShape(), (origin_x, origin_y))
            np.testing.assert_allclose(moved, one.getShape(), atol=1e-9)


@pytest.mark.parametrize("scene", SCENES)
def test_drivers_give_way_to_the_ego_alone(scene: str, tmp_path: Path) -> None:
    """The traffic's lanes have priority on every junction, so that its routes never hold each other."""
    write_scene(tmp_path, find_scene(scene), replicas=1)
    network = sumolib.net.readNet(str(tmp_path / NET_FILE), withInternal=True)
    for path in layout(find_scene(scene)).routes:
        for lane in path.lanes:
            for connection in network.getLane(lane.format(replica=0)).getOutgoing():
                via = connection.getViaLaneID()
                if via in [one.format(replica=0) for one in path.lanes]:
                    assert connection.getState() == "M"
