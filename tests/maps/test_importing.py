"""Maps of several formats as networks that SUMO drives in."""

import gzip
import re
import subprocess
from collections.abc import Iterator
from dataclasses import replace
from itertools import combinations, product
from pathlib import Path
from typing import Any
from xml.sax.saxutils import quoteattr

import numpy as np
import pytest
import shapely
import sumolib

from tests.maps.files import CROSSING, PRIORITY, STOP, YIELD, Drawn, commonroad, lanelet2, traffic_light
from tint_sumo.core.errors import InputError
from tint_sumo.core.files import write_text
from tint_sumo.maps import ImportedMap, import_map
from tint_sumo.maps.importing import report
from tint_sumo.scenes.network import sumo_program

REAL = Path(__file__).parents[3] / "shared" / "real" / "commonroad"


@pytest.fixture(scope="module")
def crossing(tmp_path_factory: pytest.TempPathFactory) -> ImportedMap:
    folder = tmp_path_factory.mktemp("crossing")
    return import_map(commonroad(folder / "crossing.xml"), folder / "net")


def network(found: ImportedMap) -> Any:
    return sumolib.net.readNet(str(found.net), withInternal=True, withPrograms=True)


def ways(net: Any) -> Iterator[tuple[Any, Any, int, shapely.LineString]]:
    """Junction, connection, its number there and its centre line, of every way over a junction."""
    for node in net.getNodes():
        for connection in node.getConnections():
            lane, points = connection.getViaLaneID(), []
            while lane:
                points += net.getLane(lane).getShape()
                last, lane = lane, net.getLane(lane).getOutgoing()[0].getViaLaneID()
            if points and not connection.getFrom().isSpecial():
                yield node, connection, node.getInternal().index(last), shapely.LineString(points)


def unknown_conflicts(net: Any) -> list[tuple[str, str]]:
    """Ways from different lanes on which two cars would touch, and neither yields."""
    found = []
    for (node, one, number, line), (other_node, other, other_number, other_line) in combinations(ways(net), 2):
        if node is other_node and one.getFromLane() is not other.getFromLane():
            shared = line.buffer(1.0, cap_style="flat").intersection(other_line.buffer(1.0, cap_style="flat"))
            if shared.area > 0.3 and not node.areFoes(number, other_number):
                found.append((str(one), str(other)))
    return found


def drive(found: ImportedMap, folder: Path) -> str:
    """Drive between all roads that begin and end at the border; return what SUMO warns of."""
    net = network(found)
    starts = [road for road in net.getEdges(withInternal=False) if not road.getIncoming()]
    ends = [road for road in net.getEdges(withInternal=False) if not road.getOutgoing()]
    routes = [net.getShortestPath(start, end)[0] for start, end in product(starts, ends)]
    flows = "".join(
        f'<flow id="{number}" begin="0" end="100" period="10" departLane="best"><route edges="{edges}"/></flow>'
        for number, edges in enumerate(" ".join(road.getID() for road in route) for route in routes if route)
    )
    assert flows
    write_text(folder / "flows.xml", f"<routes>{flows}</routes>")
    run = ["--net-file", found.net, "--route-files", folder / "flows.xml", "--step-length", "0.2", "--no-step-log"]
    strict = ["--collision.check-junctions", "--collision.action", "warn", "--time-to-teleport", "100"]
    command = [sumo_program("sumo"), *map(str, run), *strict, "--end", "400", "--duration-log.statistics"]
    result = subprocess.run(command, capture_output=True, text=True, check=True)
    assert "Running: 0" in result.stdout
    return result.stderr.strip()


def test_lanelets_become_roads_and_ways_over_a_junction(crossing: ImportedMap) -> None:
    net = network(crossing)
    roads = {road.getID(): road.getLaneNumber() for road in net.getEdges(withInternal=False)}
    assert roads == {"1": 2, "3": 1, "21": 2, "23": 1}  # 21 and 31 are one road
    found = {(one.getFromLane().getID(), one.getToLane().getID()) for _, one, *_ in ways(net)}
    assert found == {("1_0", "21_0"), ("1_1", "21_1"), ("3_0", "23_0"), ("3_0", "21_0")}
    assert net.getLane("21_1").getParam("lanelets") == "22 32"
    assert net.getLane("21_1").getSpeed() == 12.5
    assert net.getLane("21_1").getWidth() == pytest.approx(3.5, abs=1e-3)
    assert (crossing.roads, crossing.lanes, crossing.junctions, crossing.left_out) == (4, 6, 1, ())


def test_lanes_lie_on_the_lanelets(crossing: ImportedMap) -> None:
    net = network(crossing)
    lines = [net.getLane(lane).getShape() for lane in ("1_0", "1_1", "3_0", "21_0", "23_0")]
    lines += [list(line.coords) for *_, line in ways(net)]
    drawn = shapely.union_all([shapely.LineString(one.points) for one in CROSSING.values()])
    for line in lines:
        assert max(drawn.distance(shapely.Point(point)) for point in line) < 0.02
    lengths = [net.getLane(lane).getLength() for lane in ("1_0", "3_0", "21_0")]
    np.testing.assert_allclose(lengths, 50.0, atol=0.1)


def test_conflicts_are_known(crossing: ImportedMap) -> None:
    net = network(crossing)
    assert crossing.conflicts == 4  # 13 crosses 11 and 12, 14 merges with 11, and netconvert adds 14 and 12
    assert not unknown_conflicts(net)
    assert {node.getType() for node in net.getNodes() if node.getOutgoing() and node.getIncoming()} == {"priority"}


def test_vehicles_drive_through(crossing: ImportedMap, tmp_path: Path) -> None:
    assert not drive(crossing, tmp_path)


@pytest.mark.parametrize(
    ("south", "west", "states"), [(YIELD, None, "mM"), (None, YIELD, "Mm"), (PRIORITY, None, "Mm")]
)
def test_signs_say_who_yields(tmp_path: Path, south: str | None, west: str | None, states: str) -> None:
    signed = {**CROSSING, 3: replace(CROSSING[3], sign=south), 1: replace(CROSSING[1], sign=west)}
    net = network(import_map(commonroad(tmp_path / "map.xml", signed), tmp_path / "net"))
    found = {one.getFromLane().getID(): one.getState() for _, one, *_ in ways(net) if one.getToLane().getID() != "21_0"}
    assert found["3_0"] + found["1_1"] == states


def test_a_sign_on_a_way_over_the_junction_holds_for_the_road_before_it(tmp_path: Path) -> None:
    signed = {**CROSSING, 11: replace(CROSSING[11], sign=YIELD), 12: replace(CROSSING[12], sign=YIELD)}
    net = network(import_map(commonroad(tmp_path / "map.xml", signed), tmp_path / "net"))
    found = {one.getFromLane().getID(): one.getState() for _, one, *_ in ways(net) if one.getToLane().getID() != "21_0"}
    assert (found["3_0"], found["1_1"]) == ("M", "m")


def test_stop_signs_and_lights(tmp_path: Path) -> None:
    stop = {**CROSSING, 3: replace(CROSSING[3], sign=STOP)}
    net = network(import_map(commonroad(tmp_path / "stop.xml", stop), tmp_path / "net"))
    assert {one.getState() for _, one, *_ in ways(net) if one.getFromLane().getID() == "3_0"} == {"s"}
    light = {**CROSSING, 3: replace(CROSSING[3], light=7)}
    net = network(import_map(commonroad(tmp_path / "light.xml", light), tmp_path / "net"))
    assert {node.getType() for node in net.getNodes() if node.getOutgoing() and node.getIncoming()} == {"traffic_light"}
    assert len(net.getTrafficLights()) == 1


LIGHTS = {**CROSSING, **{name: replace(CROSSING[name], light=light) for name, light in ((1, 7), (2, 7), (3, 8))}}


def test_lights_switch_as_the_map_says(tmp_path: Path) -> None:
    east = traffic_light(7, [(200, "green"), (30, "yellow"), (270, "red")], 20)  # from 2 s on
    south = traffic_light(8, [(250, "red"), (20, "redYellow"), (200, "green"), (30, "yellow")], 0)
    net = network(import_map(commonroad(tmp_path / "map.xml", LIGHTS, east + south), tmp_path / "net"))
    (light,) = net.getTrafficLights()
    index = {one[0].getID(): one[2] for one in light.getConnections()}
    (program,) = light.getPrograms().values()
    times = np.cumsum([0.0, *(phase.duration for phase in program.getPhases())])
    states = {
        lane: [phase.state[number] for phase in program.getPhases()] for lane, number in index.items() if lane != "1_1"
    }
    assert times.tolist() == [0.0, 2.0, 22.0, 25.0, 27.0, 47.0, 50.0]
    assert "".join(states["1_0"]) == "rgyrrr"
    assert "".join(states["3_0"]) == "rrrugy"


@pytest.mark.parametrize(
    "lights",
    [
        traffic_light(7, [(200, "green"), (300, "red")], 0) + traffic_light(8, [(200, "green"), (200, "red")], 0),
        traffic_light(7, [], 0) + traffic_light(8, [], 0),
        traffic_light(7, [(200, "green"), (300, "red")], 0, active=False) + traffic_light(8, [(500, "red")], 0),
        traffic_light(7, [(0, "green"), (500, "red")], 0) + traffic_light(8, [(500, "red")], 0),
    ],
    ids=["other periods", "no cycles", "inactive", "no time"],
)
def test_other_lights_have_programs_of_netconvert(tmp_path: Path, lights: str) -> None:
    found = import_map(commonroad(tmp_path / "map.xml", LIGHTS, lights), tmp_path / "net")
    assert len(network(found).getTrafficLights()) == 1
    assert not any(".tll." in path.name for path in found.files)
    assert not drive(found, tmp_path)


def test_long_lanelets_that_cross_are_cut(tmp_path: Path) -> None:
    lanelets = {1: Drawn([(-100, 0), (100, 0)]), 2: Drawn([(-20, -100), (20, 100)])}
    found = import_map(commonroad(tmp_path / "cross.xml", lanelets), tmp_path / "net")
    net = network(found)
    assert {road.getID() for road in net.getEdges(withInternal=False)} == {"1", "1.1", "2", "2.1"}
    assert (found.junctions, found.conflicts) == (1, 1)
    assert max(line.length for *_, line in ways(net)) < 12.0
    assert not drive(found, tmp_path)


def test_lanelets_that_end_within_a_junction_are_left_out(tmp_path: Path) -> None:
    stub = {**CROSSING, 3: replace(CROSSING[3], successors=[13, 14, 15]), 15: Drawn([(0, -10), (-1, 2)])}
    found = import_map(commonroad(tmp_path / "stub.xml", stub), tmp_path / "net")
    assert found.left_out == ("15",)
    assert "left out" in report(found)
    assert found.junctions == 1


def test_one_strip_for_both_directions_is_no_junction(tmp_path: Path) -> None:
    both = {1: Drawn([(0, 0), (50, 0)]), 2: Drawn([(50, 0), (0, 0)])}
    found = import_map(commonroad(tmp_path / "both.xml", both), tmp_path)
    assert (found.roads, found.junctions, found.left_out) == (2, 0, ())


def test_left_hand_traffic(tmp_path: Path) -> None:
    def mirrored(one: Drawn) -> Drawn:
        points = [(x, -y) for x, y in one.points]
        return replace(one, points=points, left=one.right, right=one.left)

    lanelets = {name: mirrored(one) for name, one in CROSSING.items()}
    found = import_map(commonroad(tmp_path / "left.xml", lanelets), tmp_path / "net", left_hand=True)
    net = network(found)
    assert net.getLane("1_0").getShape()[0][1] == pytest.approx(1.75)  # the lane at the left side
    assert (found.left_hand, found.conflicts) == (True, 4)
    assert not unknown_conflicts(net)
    assert not drive(found, tmp_path)


@pytest.mark.parametrize(("y", "is_left"), [(3.5, False), (-3.5, True)])
def test_the_side_of_traffic_is_that_of_opposite_lanelets(tmp_path: Path, y: float, is_left: bool) -> None:
    side = "adjacentRight" if is_left else "adjacentLeft"
    lanelets = {
        1: Drawn([(0, 0), (50, 0)], opposite={side: 2}),
        2: Drawn([(50, y), (0, y)], opposite={side: 1}),
    }
    for file in (commonroad(tmp_path / "map.xml", lanelets), lanelet2(tmp_path / "map.osm", lanelets)):
        found = import_map(file, tmp_path / "net", overwrite=True)
        assert (found.left_hand, found.roads) == (is_left, 2)


def test_a_network_is_the_same_each_time_and_replaces_nothing(tmp_path: Path) -> None:
    file = commonroad(tmp_path / "map.xml")
    packed = tmp_path / "map.xml.gz"
    packed.write_bytes(gzip.compress(file.read_bytes()))
    first = import_map(file, tmp_path / "net")
    texts = [path.read_text() for path in first.files]
    assert all(str(tmp_path) not in text and "<!--" not in text for text in texts)
    with pytest.raises(InputError, match=r"holds map.net.xml already; choose another `out`, or allow to `overwrite`"):
        import_map(packed, tmp_path / "net")
    again = import_map(packed, tmp_path / "net", overwrite=True)
    assert [path.read_text() for path in again.files] == texts
    assert {path.name for path in (tmp_path / "net").iterdir()} == {path.name for path in first.files}


def test_the_plain_files_give_the_network_again(crossing: ImportedMap, tmp_path: Path) -> None:
    kinds = [("--node-files", "nod"), ("--edge-files", "edg"), ("--connection-files", "con")]
    sources = [word for flag, kind in kinds for word in (flag, str(crossing.net).replace(".net.", f".{kind}."))]
    options = ["--junctions.endpoint-shape", "--offset.disable-normalization", "--no-turnarounds", "--precision", "3"]
    command = [sumo_program("netconvert"), *sources, *options, "--output-file", str(tmp_path / "again.net.xml")]
    subprocess.run(command, capture_output=True, check=True)
    assert (tmp_path / "again.net.xml").read_text().endswith(crossing.net.read_text().partition("<net ")[2])


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ("", "is empty"),
        ("a,b\n1,2\n", "is no map of a known format; give one of these: CommonRoad XML"),
        ("<net></net>", "is a network of SUMO already"),
        ("<commonRoad></commonRoad>", "has no lanelets"),
        ("<commonRoad><lanelet>", "is not whole XML"),
        ('<commonRoad><lanelet id="1"><leftBound/><rightBound/></lanelet></commonRoad>', "fewer than two points"),
        ("<OpenDRIVE></OpenDRIVE>", "has no roads|netconvert says"),
        ("<osm></osm>", "has no roads|netconvert says"),
        ("<osm", "netconvert says"),
        ('<!DOCTYPE x [<!ENTITY a SYSTEM "a.xml">]><OpenDRIVE>&a;</OpenDRIVE>', "has XML entities"),
        ('<osm><relation id="1"><tag k="type" v="lanelet"/></relation></osm>', "lanelet 1 has no left or no right"),
    ],
)
def test_one_line_says_what_is_wrong(tmp_path: Path, content: str, message: str) -> None:
    write_text(tmp_path / "map.xml", content)
    with pytest.raises(InputError, match=message) as refused:
        import_map(tmp_path / "map.xml", tmp_path / "net")
    assert "\n" not in str(refused.value)
    assert not (tmp_path / "net").exists()


def lanes_of(found: ImportedMap) -> dict[str, list[tuple[float, float]]]:
    net = network(found)
    return {lane.getID(): lane.getShape() for edge in net.getEdges() for lane in edge.getLanes()}


def test_lanelet2_gives_the_same_network(crossing: ImportedMap, tmp_path: Path) -> None:
    found = import_map(lanelet2(tmp_path / "crossing.osm"), tmp_path)
    assert (found.format, found.junctions, found.conflicts, found.left_hand) == ("lanelet2", 1, 4, False)
    lanes = lanes_of(found)
    expected = lanes_of(crossing)
    assert lanes.keys() == expected.keys()
    for name, line in expected.items():
        assert shapely.hausdorff_distance(shapely.LineString(line), shapely.LineString(lanes[name])) < 0.05
    assert network(found).getLane("1_0").getSpeed() == pytest.approx(12.5)
    assert not network(found).hasGeoProj()
    assert not drive(found, tmp_path)


def test_lanelets_of_others_than_vehicles_are_left_out(tmp_path: Path) -> None:
    file = lanelet2(tmp_path / "map.osm")
    text = file.read_text().replace('<relation id="3">', '<relation id="3"><tag k="participant:pedestrian" v="yes"/>')
    write_text(file, text.replace('<relation id="1">', '<relation id="1"><tag k="participant:vehicle:car" v="yes"/>'))
    lanes = lanes_of(import_map(file, tmp_path))
    assert "1_0" in lanes
    assert "3_0" not in lanes


def test_right_of_way_of_lanelet2(tmp_path: Path) -> None:
    signed = {**CROSSING, 1: replace(CROSSING[1], sign=YIELD), 3: replace(CROSSING[3], sign=PRIORITY)}
    net = network(import_map(lanelet2(tmp_path / "map.osm", signed), tmp_path))
    found = {one.getFromLane().getID(): one.getState() for _, one, *_ in ways(net) if one.getToLane().getID() != "21_0"}
    assert (found["3_0"], found["1_1"]) == ("M", "m")


def test_lanelet2_on_earth_has_a_projection_and_may_have_an_origin(tmp_path: Path) -> None:
    file = lanelet2(tmp_path / "map.osm", shift_deg=(48.1, 1.5))
    net = network(import_map(file, tmp_path / "utm"))
    longitude, latitude = net.convertXY2LonLat(*net.getLane("3_0").getShape()[-1])
    assert (latitude, longitude) == pytest.approx((48.1, 1.5), abs=1e-3)
    net = network(import_map(file, tmp_path / "local", origin=(48.1, 1.5)))
    assert net.getLane("3_0").getShape()[0] == pytest.approx((0.0, -60.0), abs=0.02)
    assert net.convertXY2LonLat(0.0, 0.0) == pytest.approx((1.5, 48.1), abs=1e-6)
    with pytest.raises(InputError, match="leave the `origin` out"):
        import_map(commonroad(tmp_path / "map.xml"), tmp_path / "other", origin=(48.1, 1.5))


def test_opendrive(crossing: ImportedMap, tmp_path: Path) -> None:
    command = [sumo_program("netconvert"), "--sumo-net-file", crossing.net, "--opendrive-output", tmp_path / "map.xodr"]
    subprocess.run(list(map(str, command)), capture_output=True, check=True)
    found = import_map(tmp_path / "map.xodr", tmp_path / "right")
    assert (found.format, found.roads, found.lanes, found.left_hand) == ("opendrive", 4, 6, False)
    lines = [shapely.LineString(line) for line in lanes_of(found).values()]
    for name in ("1_0", "1_1", "3_0", "21_0", "21_1", "23_0"):  # where they were
        there = shapely.LineString(lanes_of(crossing)[name])
        assert min(shapely.hausdorff_distance(there, line) for line in lines) < 0.5
    text = (tmp_path / "map.xodr").read_text().replace("<road ", '<road rule="LHT" ')
    packed = tmp_path / "map.xml.gz"
    packed.write_bytes(gzip.compress(text.encode()))
    left = import_map(packed, tmp_path / "left")
    assert (left.format, left.left_hand, left.net.name) == ("opendrive", True, "map.net.xml")


def osm(file: Path) -> Path:
    """A street with a light where another crosses it, and a footway."""
    places = [
        (48.1020, 11.5000),
        (48.1020, 11.5030),
        (48.1020, 11.5060),
        (48.1, 11.503),
        (48.104, 11.503),
        (48.105, 11.5),
    ]
    light = '<tag k="highway" v="traffic_signals"/>'
    nodes = "".join(
        f'<node id="{number}" lat="{latitude}" lon="{longitude}">{light if number == 2 else ""}</node>'
        for number, (latitude, longitude) in enumerate(places, 1)
    )
    ways = "".join(
        f'<way id="{number}">{"".join(f"<nd ref={chr(34)}{node}{chr(34)}/>" for node in along)}'
        f'<tag k="highway" v="{kind}"/><tag k="lanes" v="2"/></way>'
        for number, kind, along in ((10, "primary", (1, 2, 3)), (11, "residential", (4, 2, 5)), (12, "footway", (5, 6)))
    )
    write_text(file, f'<?xml version="1.0"?><osm version="0.6">{nodes}{ways}</osm>')
    return file


def test_openstreetmap(tmp_path: Path) -> None:
    found = import_map(osm(tmp_path / "map.osm.xml"), tmp_path)
    net = network(found)
    assert (found.format, found.roads, found.junctions > 0, found.left_hand) == ("osm", 8, True, False)
    assert len(net.getTrafficLights()) == 1
    assert net.convertXY2LonLat(*net.getNode("2").getCoord()) == pytest.approx((11.503, 48.102), abs=1e-6)
    assert net.getNode("2").getCoord()[0] > 1e5  # in UTM, not moved to the corner
    assert "tll" in {path.name.split(".")[-2] for path in found.files}
    assert not drive(found, tmp_path)
    assert import_map(tmp_path / "map.osm.xml", tmp_path / "left", left_hand=True).left_hand


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("<x>[^<]*<", "<x>nan<", "x of lanelet 1 is 'nan', not a number"),
        ("<x>[^<]*<", "<x>1e300<", "a bound of lanelet 1 lies more than"),
        ("<y>[^<]*</y>", "", "y of lanelet 1 is None, not a number"),
        ('id="2"', 'id="1"', "has lanelet 1 twice"),
        ("<rightBound>.*?</rightBound>", "<rightBound>LEFT</rightBound>", "lanelet 1 is 0.00 m wide"),
        ("<speedLimit>12.5", "<speedLimit>fast", "a speed limit is 'fast'"),
    ],
)
def test_one_line_says_which_lanelet_is_wrong(tmp_path: Path, old: str, new: str, message: str) -> None:
    text = commonroad(tmp_path / "map.xml").read_text()
    first = re.search("<leftBound>(.*?)</leftBound>", text)
    assert first is not None
    write_text(tmp_path / "map.xml", re.sub(old, new.replace("LEFT", first[1]), text, count=1))
    with pytest.raises(InputError, match=message):
        import_map(tmp_path / "map.xml", tmp_path / "net")


def test_places_that_are_none_are_refused(tmp_path: Path) -> None:
    file = lanelet2(tmp_path / "map.osm")
    with pytest.raises(InputError, match=r"`origin` .* is no latitude and longitude"):
        import_map(file, tmp_path / "net", origin=(100.0, 0.0))
    text = file.read_text()
    write_text(file, re.sub('lat="[^"]*"', 'lat="95"', text, count=1))
    with pytest.raises(InputError, match="has nodes whose latitude or longitude is none"):
        import_map(file, tmp_path / "net")
    write_text(file, re.sub('<node id="-3"[^>]*>', "", text))
    with pytest.raises(InputError, match="has ways with nodes that it lacks"):
        import_map(file, tmp_path / "net")


def test_a_map_of_nothing_but_a_junction_is_refused(tmp_path: Path) -> None:
    lanelets = {1: Drawn([(0, 0), (5, 0)]), 2: Drawn([(2, -2), (2, 2)])}
    with pytest.raises(InputError, match="all of its lanelets lie in a junction"):
        import_map(commonroad(tmp_path / "map.xml", lanelets), tmp_path / "net")


@pytest.mark.parametrize("name", ["7 8", 'a"b', "", "<x>"])
def test_ids_that_sumo_does_not_take_are_refused(tmp_path: Path, name: str) -> None:
    text = commonroad(tmp_path / "map.xml").read_text().replace('id="3"', f"id={quoteattr(name)}")
    write_text(tmp_path / "map.xml", text)
    with pytest.raises(InputError, match="is no id"):
        import_map(tmp_path / "map.xml", tmp_path / "net")


def test_neighbours_in_a_ring_and_lanelets_that_follow_themselves_are_roads(tmp_path: Path) -> None:
    odd = {
        1: Drawn([(0, 0), (60, 0)], [1], left=2, right=2),
        2: Drawn([(0, 3.5), (60, 3.5)], [9], left=1, right=1),
        3: Drawn([(0, 50), (60, 50)], [3, 3], left=3),
    }
    found = import_map(commonroad(tmp_path / "odd.xml", odd), tmp_path)
    assert {name.split("_")[0] for name in lanes_of(found)} >= {"2"}
    assert found.lanes + len(found.left_out) == 3


@pytest.mark.skipif(not REAL.is_dir(), reason="the recorded traffic is not there")
@pytest.mark.parametrize(("name", "conflicts"), [("USA_Lanker-1_1_T-1", 81), ("USA_Peach-4_8_T-1", 53)])
def test_real_scenes(tmp_path: Path, name: str, conflicts: int) -> None:
    found = import_map(REAL / f"{name}.xml", tmp_path / "net")
    assert (found.junctions, found.conflicts, found.warnings) == (3, conflicts, 0)
    assert not unknown_conflicts(network(found))
    assert not drive(found, tmp_path)
