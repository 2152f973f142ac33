"""The simulation of a SUMO configuration."""

import math
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import shapely
from shapely.affinity import rotate, translate

from tests.scenes.networks import USER_NETWORKS, UserNetwork, write_config
from tint_sumo.config import Backend, EgoController
from tint_sumo.core.errors import InputError
from tint_sumo.scenes import SumocfgScene
from tint_sumo.scenes.sumocfg import measure_route, read_net
from tint_sumo.simulation import SumocfgSimulation, make_simulation
from tint_sumo.simulation.ego_way import EGO

Make = Callable[[str], UserNetwork]


@contextmanager
def begun(scene: SumocfgScene, seed: int = 1, backend: Backend = "auto") -> Iterator[SumocfgSimulation]:
    simulation = SumocfgSimulation(1, scene, backend=backend)
    try:
        simulation.reset(0, seed)
        yield simulation
    finally:
        simulation.close()


def drive(simulation: SumocfgSimulation, steps: int, desired_mps: float | None = None) -> Iterator[int]:
    """Yield steps at the top speed, or another, until the ego has arrived or had a collision."""
    scene = simulation.scene
    desired = np.array([scene.controller.desired_speeds_mps[-1] if desired_mps is None else desired_mps])
    for step in range(steps):
        simulation.step(desired)
        yield step
        if simulation.egos.front_m[0] > scene.goal_m or simulation.egos.collided[0]:
            return


def test_the_ego_reaches_its_goal_in_every_network(user_network: Make) -> None:
    for name in USER_NETWORKS:
        scene = user_network(name).scene()
        front_m = []
        with begun(scene, seed=4) as simulation:
            egos = simulation.egos
            assert egos.front_m[0] == scene.start_m
            assert egos.speed_mps[0] == 0.0
            assert abs(egos.box["x_m"][0]) + abs(egos.box["y_m"][0]) < 1e-9
            for _ in drive(simulation, round(120.0 / scene.step_s)):
                front_m.append(egos.front_m[0])
            assert egos.collided[0] or egos.front_m[0] > scene.goal_m, name
            assert (np.diff(front_m) >= 0.0).all()
            assert np.hypot(egos.box["heading_x"], egos.box["heading_y"])[0] == pytest.approx(1.0)


@pytest.mark.parametrize("name", ["braunschweig", "merge"])
def test_slots_hold_the_nearest_vehicles_and_stay_empty_between_two(name: str, user_network: Make) -> None:
    sight_m = {"braunschweig": 60.0, "merge": 30.0}[name]
    scene = user_network(name).scene(max_vehicles=3, sight_m=sight_m)
    with begun(scene) as simulation:
        slots, vehicle = simulation.slots, simulation.connection.vehicle
        before = slots.vehicle_number[0].copy()
        crowds = 0
        for _ in drive(simulation, 400):
            ego_m = vehicle.getPosition(EGO)
            away_m = {one: math.dist(ego_m, vehicle.getPosition(one)) for one in vehicle.getIDList() if one != EGO}
            inside = sorted((one for one in away_m if away_m[one] <= sight_m), key=lambda one: away_m[one])
            crowds += len(inside) > 3
            assert set(simulation.slot) <= set(inside[:3])
            numbers = slots.vehicle_number[0].copy()
            changed = numbers != before
            assert ((before[changed] == -1) | (numbers[changed] == -1)).all()
            np.testing.assert_array_equal(slots.present[0], numbers >= 0)
            np.testing.assert_array_equal(slots.member[0] >= 0, slots.present[0])
            for one, slot in simulation.slot.items():
                assert scene.vtypes[slots.member[0, slot]] == vehicle.getTypeID(one)
                assert slots.width_m[0, slot] == vehicle.getWidth(one)
            before = numbers
        assert crowds > 10


def test_distances_are_those_of_boxes_of_each_vehicles_size(user_network: Make) -> None:
    scene = user_network("braunschweig").scene()
    with begun(scene) as simulation:
        slots, egos = simulation.slots, simulation.egos
        seen = set()
        for step in drive(simulation, 300):
            if step % 30 == 0:
                ego = _box(egos.box[0], 5.0, 2.0)
                for slot in np.flatnonzero(slots.present[0]).tolist():
                    size_m = float(slots.length_m[0, slot]), float(slots.width_m[0, slot])
                    seen.add(size_m)
                    other = _box(slots.box[0, slot], *size_m)
                    assert egos.distance_m[0, slot] == pytest.approx(ego.distance(other), abs=1e-6)
        assert len(seen) > 1


def _box(pose: np.void, length_m: float, width_m: float) -> shapely.Polygon:
    box = shapely.box(-length_m / 2, -width_m / 2, length_m / 2, width_m / 2)
    angle_rad = math.atan2(pose["heading_y"], pose["heading_x"])
    return translate(rotate(box, angle_rad, origin=(0, 0), use_radians=True), pose["x_m"], pose["y_m"])


def test_touching_a_vehicle_is_a_collision_with_its_vtype(user_network: Make) -> None:
    blind = EgoController(unsafe_distance_m=0.0, closing_distance_m=0.0)
    scene = _with_standing_vehicle(user_network("merge"), 50.0).scene(controller=blind)
    with begun(scene) as simulation:
        for _ in drive(simulation, 200):
            pass
        collision, egos = simulation.egos.collision[0], simulation.egos
        assert collision is not None
        assert (scene.vtypes[collision.trait], collision.route) == ("van", "ramp")
        assert egos.distance_m[0, collision.slot] == 0.0
        assert 50.0 - 7.0 < egos.front_m[0] < 50.0 - 7.0 + 0.3 + 1e-6  # the van's back is at 43 m


def test_the_safety_check_holds_the_ego_behind_a_standing_vehicle(user_network: Make) -> None:
    scene = _with_standing_vehicle(user_network("merge"), 50.0).scene()
    with begun(scene) as simulation:
        for _ in drive(simulation, 200):
            pass
        assert 42.0 < simulation.egos.front_m[0] < 43.0
        assert not simulation.egos.collided[0]


def _with_standing_vehicle(network: UserNetwork, front_m: float) -> UserNetwork:
    """Return the network without other traffic, and with a van on the ramp."""
    folder = network.sumocfg.parent
    (folder / "standing.rou.xml").write_text(
        '<routes><vType id="van" length="7"/>'
        f'<vehicle id="standing" type="van" depart="0" departPos="{front_m}"><route edges="ramp out"/>'
        f'<stop lane="ramp_0" endPos="{front_m}" duration="1000"/></vehicle></routes>'
    )
    step = '<step-length value="0.1"/>'
    return replace(
        network, sumocfg=write_config(folder / "standing.sumocfg", "merge.net.xml", "standing.rou.xml", step)
    )


def test_an_episode_depends_on_its_seed_alone_whatever_the_backend(user_network: Make) -> None:
    scene = user_network("merge").scene()

    def lived(simulation: SumocfgSimulation, seed: int) -> list[bytes]:
        simulation.reset(0, seed)
        slots, egos = simulation.slots, simulation.egos
        return [
            slots.box[slots.present].tobytes() + egos.box.tobytes() + simulation.leaders()[1].tobytes()
            for _ in drive(simulation, 150)
        ]

    first, second = SumocfgSimulation(1, scene), SumocfgSimulation(1, scene)
    try:
        assert (first.backend, second.backend) == ("libsumo", "traci")
        once = lived(first, 1)
        assert lived(first, 2) != once
        assert lived(first, 1) == once
        assert lived(second, 1) == once
    finally:
        first.close()
        second.close()


def test_leaders_are_seen_with_gaps_from_bumper_to_bumper(user_network: Make) -> None:
    scene = user_network("merge").scene(sight_m=100.0)
    seen = 0
    with begun(scene) as simulation:
        slots = simulation.slots
        for _ in drive(simulation, 200, desired_mps=0.0):
            leader, gap_m = simulation.leaders()
            for slot in np.flatnonzero(leader[0] >= 0).tolist():
                own, ahead = slots.box[0, slot], slots.box[0, leader[0, slot]]
                straight = own["heading_x"] > 0.999 and ahead["heading_x"] > 0.999
                if straight and abs(own["y_m"] - ahead["y_m"]) < 0.1:
                    assert gap_m[0, slot] == pytest.approx(ahead["x_m"] - own["x_m"] - 5.0, abs=0.2)
                    seen += 1
    assert seen > 20


def test_a_cleared_simulation_stands_still(user_network: Make) -> None:
    with begun(user_network("merge").scene()) as simulation:
        simulation.clear(0)
        time_s = simulation.connection.simulation.getTime()
        simulation.step(np.array([3.0]))
        assert simulation.connection.simulation.getTime() == time_s
        assert not simulation.slots.present.any()


def test_polygons_of_the_type_building_are_walls_around_the_ego(user_network: Make) -> None:
    network = user_network("merge")
    folder = network.sumocfg.parent
    (folder / "shapes.add.xml").write_text(
        '<additional><poly id="house" type="building.yes" shape="100,10 120,10 120,30"/>'
        '<poly id="pond" type="water" shape="0,10 20,10 20,30"/></additional>'
    )
    more = '<additional-files value="shapes.add.xml"/><step-length value="0.1"/>'
    sumocfg = write_config(folder / "built.sumocfg", "merge.net.xml", "merge.rou.xml", more)
    with begun(replace(network, sumocfg=sumocfg).scene(warm_up_s=1.0)) as simulation:
        walls = simulation.walls + np.tile(simulation.origin_m, 2)
    assert walls[:3].tolist() == [[100.0, 10.0, 120.0, 10.0], [120.0, 10.0, 120.0, 30.0], [120.0, 30.0, 100.0, 10.0]]
    assert np.unique(walls, axis=0).shape == (3, 4)


def test_a_hidden_leader_is_none_and_the_next_one_ahead_is_it(user_network: Make) -> None:
    found = 0
    with begun(user_network("autobahn").scene()) as simulation:
        for _ in drive(simulation, 60):
            leader, gap_m = simulation.leaders()
            for slot in np.flatnonzero(leader[0] >= 0).tolist():
                ahead = int(leader[0, slot])
                seen = simulation.slots.present.copy()
                seen[0, ahead] = False
                now, now_m = simulation.leaders(seen=seen)
                further, length_m = int(leader[0, ahead]), simulation.slots.length_m[0, ahead]
                if gap_m[0, slot] + length_m < 15.0:
                    assert now[0, slot] == further
                    assert now_m[0, slot] == pytest.approx(gap_m[0, slot] + length_m + gap_m[0, ahead])
                    found += further >= 0
    assert found > 10


def test_the_end_of_the_route_is_past_the_goal(user_network: Make) -> None:
    network = user_network("merge")
    end_m = network.scene().route_edge_start_m[1] + 145.0
    scene = network.scene(start_m=end_m - 20.0, goal_m=end_m - 0.01)
    with begun(scene) as simulation:
        for _ in drive(simulation, 200):
            pass
        assert simulation.egos.collided[0] or simulation.egos.front_m[0] > scene.goal_m


def test_vehicles_at_the_start_of_the_ego_are_an_error(user_network: Make) -> None:
    scene = _with_standing_vehicle(user_network("merge"), 22.0).scene()
    with pytest.raises(InputError, match=r"no room at its start \(20 m\)"), begun(scene):
        pass


def test_demand_that_sumo_refuses_is_an_error_in_one_line(user_network: Make) -> None:
    network = user_network("merge")
    folder = network.sumocfg.parent
    (folder / "wrong.rou.xml").write_text(
        '<routes><vehicle id="wrong" depart="0"><route edges="nowhere"/></vehicle></routes>'
    )
    sumocfg = write_config(folder / "wrong.sumocfg", "merge.net.xml", "wrong.rou.xml")
    with pytest.raises(InputError, match=r"SUMO does not run .*wrong\.sumocfg \(The edge 'nowhere' within") as caught:
        UserNetwork(sumocfg, network.ego_route, 20.0, 100.0).scene()
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("backend", ["libsumo", "traci"])
def test_demand_that_sumo_refuses_in_an_episode_is_an_error_in_one_line(backend: Backend, user_network: Make) -> None:
    network = user_network("merge")
    folder = network.sumocfg.parent
    (folder / "later.rou.xml").write_text(
        '<routes><vehicle id="early" depart="0"><route edges="in out"/></vehicle>'
        '<trip id="wrong" depart="25" from="out" to="ramp"/></routes>'
    )
    more = '<step-length value="0.1"/><route-steps value="5"/>'
    sumocfg = write_config(folder / "later.sumocfg", "merge.net.xml", "later.rou.xml", more)
    with (
        begun(UserNetwork(sumocfg, network.ego_route, 20.0, 100.0).scene(), backend=backend) as simulation,
        pytest.raises(
            InputError, match=r"SUMO does not run .*later\.sumocfg \((.*'wrong'|Connection closed)"
        ) as caught,
    ):
        for _ in drive(simulation, 100, desired_mps=0.0):
            pass
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("backend", ["libsumo", "traci"])
def test_a_fault_that_sumo_finds_while_it_runs_is_an_error_in_one_line(backend: Backend, user_network: Make) -> None:
    network = user_network("merge")
    text = network.sumocfg.read_text().replace("</configuration>", '<lateral-resolution value="0.8"/></configuration>')
    (network.sumocfg.parent / "sublane.sumocfg").write_text(text)
    routes = (network.sumocfg.parent / "merge.rou.xml").read_text()
    (network.sumocfg.parent / "sublane.rou.xml").write_text(
        routes.replace('id="calm"', 'id="calm" laneChangeModel="LC2013"')
    )
    sumocfg = network.sumocfg.parent / "sublane.sumocfg"
    sumocfg.write_text(sumocfg.read_text().replace("merge.rou.xml", "sublane.rou.xml"))
    scene = replace(network, sumocfg=sumocfg).scene()
    with pytest.raises(InputError, match=r"SUMO does not run .*sublane\.sumocfg") as caught, begun(scene, 1, backend):
        pass
    assert "\n" not in str(caught.value)


def test_output_files_of_the_configuration_are_not_written(user_network: Make) -> None:
    network = user_network("merge")
    folder = network.sumocfg.parent
    more = '<output><tripinfo-output value="trips.xml"/><fcd-output value="fcd.xml"/></output>'
    sumocfg = write_config(folder / "writing.sumocfg", "merge.net.xml", "merge.rou.xml", more)
    with begun(UserNetwork(sumocfg, network.ego_route, 20.0, 100.0).scene()) as simulation:
        simulation.step(np.array([3.0]))
    assert not (folder / "trips.xml").exists()
    assert not (folder / "fcd.xml").exists()


def test_there_is_one_simulation_per_process(user_network: Make) -> None:
    with pytest.raises(InputError, match="set workers to num_envs"):
        make_simulation(2, user_network("merge").scene())


def _with(network: UserNetwork, processing: str = "", additional: str = "") -> UserNetwork:
    """Return the network with more elements in its configuration, and with an additional file."""
    folder = network.sumocfg.parent
    (folder / "more.add.xml").write_text(f"<additional>{additional}</additional>")
    more = f'<additional-files value="more.add.xml"/>{processing}</configuration>'
    sumocfg = folder / "more.sumocfg"
    sumocfg.write_text(network.sumocfg.read_text().replace("</configuration>", more))
    return replace(network, sumocfg=sumocfg)


@pytest.mark.parametrize("backend", ["libsumo", "traci"])
@pytest.mark.parametrize("more", ["", '<time-to-teleport.remove value="true"/>'])
def test_an_ego_that_sumo_teleports_or_removes_is_lost(backend: Backend, more: str, user_network: Make) -> None:
    network = _with(_with_standing_vehicle(user_network("merge"), 90.0), f'<time-to-teleport value="5"/>{more}')
    with begun(network.scene(), backend=backend) as simulation:
        for _ in drive(simulation, 100, desired_mps=0.0):
            if simulation.egos.lost[0]:
                break
        assert simulation.egos.lost[0]
        assert simulation.egos.front_m[0] < simulation.scene.goal_m
        simulation.step(np.zeros(1))  # does nothing
        simulation.reset(0, 2)
        assert not simulation.egos.lost[0]


def test_an_ego_that_a_calibrator_removes_is_lost(user_network: Make) -> None:
    calibrator = (
        '<calibrator id="c" edge="out" pos="60" period="10"><flow begin="0" end="3600" vehsPerHour="0"/></calibrator>'
    )
    with begun(_with(user_network("merge"), additional=calibrator).scene()) as simulation:
        for _ in drive(simulation, 800):
            if simulation.egos.lost[0]:
                break
        assert simulation.egos.lost[0]


@pytest.mark.parametrize("start_m", [25.0, 25.5, 26.0])
@pytest.mark.parametrize("ballistic", [False, True])
def test_an_ego_that_brakes_at_its_routes_end_arrives_however_sumo_moves_it(
    ballistic: bool, start_m: float, user_network: Make, tmp_path: Path
) -> None:
    net = user_network("merge").sumocfg.with_name("merge.net.xml")
    (tmp_path / "empty.rou.xml").write_text("<routes/>")
    method = f'<step-length value="1"/><step-method.ballistic value="{ballistic}"/>'
    sumocfg = write_config(tmp_path / "method.sumocfg", str(net), "empty.rou.xml", method)
    *_, end_m = measure_route(read_net(net), ("ramp", "out"))
    network = UserNetwork(sumocfg, ("ramp", "out"), start_m, end_m - 0.01, (0.0, 5.0, 10.0))
    with begun(network.scene(warm_up_s=1.0)) as simulation:
        egos = simulation.egos
        for _ in drive(simulation, 60):
            if egos.front_m[0] > end_m - 10.0:
                break
        for _ in drive(simulation, 2, desired_mps=0.0):
            assert not egos.lost[0]
        assert egos.front_m[0] > network.goal_m


_ROUTERS = {
    "device": ('<device.rerouting.probability value="1"/><device.rerouting.period value="5"/>', ""),
    "rerouter": (
        "",
        '<rerouter id="r" edges="bottom2C0 C0C1"><interval begin="0" end="3600">'
        '<destProbReroute id="right1C1" probability="0"/><destProbReroute id="C0right0" probability="1"/>'
        "</interval></rerouter>",
    ),
    "routes": (
        "",
        '<route id="other" edges="bottom2C0 C0right0"/><rerouter id="r" edges="bottom2C0"><interval begin="0" '
        'end="3600"><routeProbReroute id="other"/></interval></rerouter>',
    ),
}


@pytest.mark.parametrize("router", ["device", "rerouter", "routes"])
def test_the_ego_keeps_its_route(router: str, user_network: Make) -> None:
    processing, additional = _ROUTERS[router]
    grid = user_network("grid")
    scene = _with(grid, processing, additional).scene(goal_m=90.0, warm_up_s=1.0)
    roads = set()
    with begun(scene) as simulation:
        for _ in drive(simulation, 60):
            if simulation.egos.lost[0]:
                break
            if simulation.egos.front_m[0] < scene.goal_m:
                roads.add(simulation.connection.vehicle.getRoadID(EGO))
        assert not simulation.egos.lost[0]
        assert {road for road in roads if not road.startswith(":")} <= set(grid.ego_route)
        assert simulation.egos.collided[0] or simulation.egos.front_m[0] > scene.goal_m


def test_a_route_that_is_closed_when_the_ego_appears_is_refused(user_network: Make) -> None:
    closed = (
        '<rerouter id="r" edges="C0C1"><interval begin="0" end="3600"><closingReroute id="C1B1" disallow="all"/>'
        "</interval></rerouter>"
    )
    with (
        pytest.raises(InputError, match="no valid route"),
        begun(_with(user_network("grid"), additional=closed).scene(warm_up_s=1.0)),
    ):
        pass


def test_an_ego_whose_route_is_changed_to_one_that_leads_elsewhere_is_lost(user_network: Make) -> None:
    with begun(user_network("grid").scene(warm_up_s=1.0)) as simulation:
        vehicle = simulation.connection.vehicle
        vehicle.setRoute(EGO, ("bottom2C0", "C0right0"))
        for _ in drive(simulation, 5):
            assert vehicle.getRoute(EGO) == ("bottom2C0", "C0C1", "C1B1", "B1A1")
        vehicle.setRoute(EGO, ("bottom2C0", "C0right0"))
        vehicle.moveTo(EGO, "C0right0_0", 5.0)
        simulation.step(np.zeros(1))
        assert simulation.egos.lost[0]
