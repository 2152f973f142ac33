"""Vehicles on bridges, with long bodies, and parked, and an ego that keeps its route."""

import math
import subprocess
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from tests.scenes.networks import write_config
from tint_sumo.config import Backend, EgoController
from tint_sumo.core.errors import InputError
from tint_sumo.envs import SceneEnv, TaskSettings
from tint_sumo.envs.rendering import render_scene
from tint_sumo.scenes import SumocfgScene, from_sumocfg
from tint_sumo.scenes.geometry import clearance_m
from tint_sumo.scenes.network import sumo_program
from tint_sumo.simulation import SumocfgSimulation
from tint_sumo.simulation.bodies import Bodies, cut
from tint_sumo.simulation.sumocfg import EGO

ROUTE = ("wm", "me")
# A street from west to east that crosses rails at x = 100 and passes under a bridge at x = 160; a way around, too.
NODES = """<nodes>
    <node id="w" x="0" y="0" z="0"/><node id="m" x="100" y="0" z="0" type="rail_crossing"/>
    <node id="e" x="300" y="0" z="0"/><node id="far" x="400" y="0" z="0"/>
    <node id="s" x="100" y="-300" z="0"/><node id="n" x="100" y="100" z="0"/><node id="nw" x="0" y="200" z="0"/>
    <node id="bs" x="160" y="-100" z="7"/><node id="bn" x="160" y="100" z="7"/>
    <node id="out" x="300" y="-100" z="0"/>
</nodes>
"""
EDGES = """<edges>
    <edge id="wm" from="w" to="m" numLanes="1" speed="14"/><edge id="me" from="m" to="e" numLanes="1" speed="14"/>
    <edge id="on" from="e" to="far" numLanes="1" speed="14"/><edge id="off" from="e" to="out" numLanes="1" speed="14"/>
    <edge id="sm" from="s" to="m" numLanes="1" speed="14" allow="rail tram"/>
    <edge id="mn" from="m" to="n" numLanes="1" speed="14" allow="rail tram"/>
    <edge id="curve" from="n" to="nw" numLanes="1" speed="14" allow="rail tram" shape="100,100 60,180 0,200"/>
    <edge id="bridge" from="bs" to="bn" numLanes="1" speed="14"/>
</edges>
"""
TRAIN = """<vType id="train" vClass="rail" length="150" maxSpeed="10"/>
    <vehicle id="t" type="train" depart="0" departPos="{}" departSpeed="10"><route edges="sm mn curve"/></vehicle>
"""
TO_THE_EXIT = """<route id="other" edges="wm me off"/>
    <rerouter id="r" edges="wm me"><interval begin="0" end="999"><routeProbReroute id="other"/></interval></rerouter>
"""


@pytest.fixture(scope="module")
def net_file(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("geometry")
    (folder / "n.nod.xml").write_text(NODES)
    (folder / "n.edg.xml").write_text(EDGES)
    files = ("-n", str(folder / "n.nod.xml"), "-e", str(folder / "n.edg.xml"), "-o", str(folder / "n.net.xml"))
    subprocess.run([sumo_program("netconvert"), *files], check=True, capture_output=True)
    return folder / "n.net.xml"


Make = Callable[..., SumocfgScene]


@pytest.fixture
def make(net_file: Path, tmp_path: Path) -> Make:
    def scene(demand: str, more: str = "", additional: str = "", step_s: float = 0.1, **task: Any) -> SumocfgScene:
        (tmp_path / "d.rou.xml").write_text(f"<routes>{demand}</routes>")
        (tmp_path / "a.add.xml").write_text(f"<additional>{additional}</additional>")
        options = f'<additional-files value="a.add.xml"/><step-length value="{step_s}"/>{more}'
        sumocfg = write_config(tmp_path / "s.sumocfg", str(net_file), "d.rou.xml", options)
        usual: dict[str, Any] = {"start_m": 20.0, "goal_m": 250.0, "warm_up_s": 5.0, "ego_route": ROUTE}
        controller = EgoController((0.0, 3.0, 10.0))
        return from_sumocfg(sumocfg, **(usual | {"controller": controller, "time_limit_s": 100.0} | task))

    return scene


@contextmanager
def begun(scene: SumocfgScene, backend: Backend = "auto") -> Iterator[SumocfgSimulation]:
    simulation = SumocfgSimulation(1, scene, backend=backend)
    try:
        simulation.reset(0, 1)
        yield simulation
    finally:
        simulation.close()


def drive(simulation: SumocfgSimulation, desired_mps: float, steps: int) -> Iterator[int]:
    """Yield steps until the ego has arrived or had a collision."""
    for step in range(steps):
        simulation.step(np.array([desired_mps]))
        yield step
        if simulation.egos.front_m[0] > simulation.scene.goal_m or simulation.egos.collided[0]:
            return


def outcome(scene: SumocfgScene, action: int = 2) -> tuple[str, float, bool, bool]:
    """Return the outcome of an episode, its last reward, and whether it has terminated or was truncated."""
    env = SceneEnv(TaskSettings(scene))
    try:
        env.reset(seed=0)
        while True:
            _, reward, terminated, truncated, info = env.step(action)
            if terminated or truncated:
                return info["outcome"], reward, terminated, truncated
    finally:
        env.close()


@pytest.mark.parametrize("backend", ["libsumo", "traci"])
def test_the_ego_keeps_its_route_whoever_reroutes(backend: Backend, make: Make) -> None:
    more = '<device.rerouting.probability value="1"/>'
    scene = make("", more, TO_THE_EXIT, ego_route=("wm", "me", "on"), goal_m=350.0)
    with begun(scene, backend) as simulation:
        roads = set()
        for step in drive(simulation, 10.0, 600):
            if step % 20 == 0:
                roads.add(simulation.connection.vehicle.getRoadID(EGO))
        assert simulation.egos.front_m[0] > 350.0
        assert not simulation.egos.lost[0]
        assert "off" not in roads
        assert "on" in roads


@pytest.mark.parametrize(
    ("remover", "message"),
    [
        ('<vaporizer id="wm" begin="0" end="999"/>', "or a vaporizer lets none in"),
        (
            '<calibrator id="c" edge="wm" pos="20.1" period="9"><flow begin="0" end="9" vehsPerHour="0"/></calibrator>',
            "SUMO takes the ego off the road where it starts",
        ),
    ],
)
def test_an_ego_that_is_removed_where_it_starts_is_refused(remover: str, message: str, make: Make) -> None:
    with pytest.raises(InputError, match=message), begun(make("", additional=remover)):
        pass


def test_the_end_of_the_route_can_be_the_goal(make: Make) -> None:
    assert outcome(make("", goal_m=292.79))[0] == "success"  # the route has 292.8 m


def test_vehicles_on_a_bridge_are_neither_hit_nor_waited_for(make: Make) -> None:
    cars = '<flow id="c" begin="0" end="99" period="1.5" departSpeed="max"><route edges="bridge"/></flow>'
    near_m: list[float] = []
    with begun(make(cars)) as simulation:
        for _ in drive(simulation, 10.0, 600):
            near_m += [float(distance_m) for distance_m in simulation.egos.distance_m[0] if distance_m < 25.0]
        assert not near_m
        assert not simulation.egos.collided[0]
        assert simulation.egos.front_m[0] > 250.0


def test_a_long_vehicle_on_a_bridge_is_as_high_where_it_is_nearest(make: Make) -> None:
    demand = """<vType id="long" length="120"/><vehicle id="b" type="long" depart="0" departPos="180">
        <route edges="bridge"/><stop lane="bridge_0" endPos="185" duration="999"/></vehicle>"""
    with begun(make(demand)) as simulation:
        for _ in drive(simulation, 10.0, 600):
            assert not simulation.egos.unsafe[0]
        assert simulation.egos.front_m[0] > 250.0


def test_only_vtypes_that_vehicles_have_widen_the_look(make: Make) -> None:
    car = '<vehicle id="c" depart="0" departPos="70"><route edges="wm me"/></vehicle>'
    with begun(make(car, warm_up_s=1.0)) as simulation:
        assert not simulation._any_long
    with begun(make(TRAIN.format(0))) as simulation:
        assert simulation._any_long


def test_pictures_show_the_whole_body(make: Make) -> None:
    with begun(make(TRAIN.format(250), start_m=85.0)) as simulation:
        for _ in drive(simulation, 0.0, 30):
            pass
        (slot,) = simulation.slot.values()
        pieces = simulation.bodies[slot]
        assert len(pieces) == 15
        ego = simulation.egos.box[0]
        nearest = min(pieces, key=lambda piece: clearance_m(ego, piece))
        assert nearest == simulation.slots.box[0, slot]
        image = render_scene(simulation, 0)
        colour = simulation.scene.trait_colours[simulation.slots.member[0, slot]]
        assert (image == colour).all(axis=-1).sum() > 2.5 * 36.0 * 12.0**2  # 12 pixels per metre, 40 m up and down


def test_a_train_is_seen_and_waited_for_until_its_end_has_passed(make: Make) -> None:
    with begun(make(TRAIN.format(250), start_m=85.0)) as simulation:
        vehicle = simulation.connection.vehicle
        waited = 0
        for _ in drive(simulation, 3.0, 800):
            if (
                "t" in vehicle.getIDList() and vehicle.getDistance("t") < 190.0
            ):  # its end is 200 m from its start's front
                assert simulation.egos.front_m[0] < 101.0
                waited += simulation.egos.speed_mps[0] < 0.1
                assert "t" in simulation.slot
        assert waited > 50
        assert not simulation.egos.collided[0]
        assert simulation.egos.front_m[0] > 250.0


def test_the_ego_hits_the_middle_of_a_train(make: Make) -> None:
    blind = EgoController((0.0, 3.0, 10.0), unsafe_distance_m=0.0, closing_distance_m=0.0)
    with begun(make(TRAIN.format(250), controller=blind)) as simulation:
        for _ in drive(simulation, 10.0, 600):
            pass
        collision = simulation.egos.collision[0]
        assert collision is not None
        assert simulation.connection.vehicle.getDistance("t") > 50.0 + 30.0  # its front has passed long before


def test_a_long_body_bends_along_its_lanes(make: Make) -> None:
    with begun(make(TRAIN.format("last"), warm_up_s=18.0)) as simulation:
        bodies, vehicle = Bodies(simulation.connection), simulation.connection.vehicle
        assert vehicle.getRoadID("t") == "curve"
        front = vehicle.getPosition("t")
        pieces = cut(list(bodies._trace("t", 150.0)), (150.0, 2.8))
        assert len(pieces) == 15
        assert sum(piece[4] for piece in pieces) == pytest.approx(150.0, abs=1.5)
        assert math.dist(pieces[0][:2], front) == pytest.approx(5.0, abs=0.2)
        straight = [piece for piece in pieces if piece[1] < 395.0]  # the network's origin is 300 m south of the street
        assert all(abs(piece[0] - straight[0][0]) < 0.1 and piece[3] == pytest.approx(1.0) for piece in straight)
        assert len(straight) > 3
        assert pieces[0][2] < -0.3  # the front heads to the north-west


def test_vehicles_parked_beside_the_lane_are_passed_and_those_that_stand_on_it_are_not(make: Make) -> None:
    car = '<vehicle id="p" depart="0" departPos="60" departSpeed="0"><route edges="wm me"/><stop {}/></vehicle>'
    area = '<parkingArea id="pa" lane="wm_0" startPos="60" endPos="80" roadsideCapacity="2"/>'
    parked = car.format('parkingArea="pa" duration="999"')
    assert outcome(make(parked, additional=area))[0] == "success"
    beside = car.format('lane="wm_0" endPos="70" duration="999" parking="true"')
    assert outcome(make(beside))[0] == "success"
    standing = car.format('lane="wm_0" endPos="70" duration="999"')
    assert outcome(make(standing, time_limit_s=20.0), action=1)[0] == "timeout"
