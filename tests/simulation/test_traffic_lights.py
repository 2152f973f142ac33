"""Traffic lights on the ego's route: their states as SUMO has them, and stop lines driven over at red."""

from collections.abc import Callable, Iterator
from contextlib import closing, contextmanager
from dataclasses import replace
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest

from tests.scenes.networks import UserNetwork, lights, netconvert, write_config
from tint_sumo.config import Backend, EgoController
from tint_sumo.scenes import SumocfgScene, from_sumocfg
from tint_sumo.simulation import SumocfgSimulation
from tint_sumo.simulation.ego_way import EGO

FAST = 10.0
ROUTE = ("left0A0", "A0B0", "B0right0")
CROSSINGS = ("A0", "B0")
SIGNALS = 20  # of a crossing


@pytest.fixture(scope="module")
def scene_of(tmp_path_factory: pytest.TempPathFactory) -> Callable[[float], SumocfgScene]:
    """Return a function that makes the scene with lights in steps of this length, once."""
    folder, made = tmp_path_factory.mktemp("lights"), dict[float, SumocfgScene]()

    def make(step_s: float) -> SumocfgScene:
        if step_s not in made:
            network: UserNetwork = lights(folder, step_s)
            made[step_s] = network.scene(perceives=("traffic_light",), red_light="cost", warm_up_s=0.0)
        return made[step_s]

    return make


@contextmanager
def begun(scene: SumocfgScene, seed: int = 1, backend: Backend = "auto") -> Iterator[SumocfgSimulation]:
    with closing(SumocfgSimulation(1, scene, backend=backend)) as simulation:
        simulation.reset(0, seed)
        yield simulation


def set_all(simulation: SumocfgSimulation, state: str) -> None:
    """Give all signals of all lights this state."""
    signals = simulation.connection.trafficlight
    for name in signals.getIDList():
        signals.setRedYellowGreenState(name, state * len(signals.getRedYellowGreenState(name)))


def index_of(simulation: SumocfgSimulation, crossing: str, lane: str) -> int:
    """Return the number of the signal of a lane's link straight on along the route."""
    after = ROUTE[ROUTE.index(lane[:-2]) + 1]
    links = simulation.connection.trafficlight.getControlledLinks(crossing)
    return next(i for i, ((start, end, _), *_) in enumerate(links) if start == lane and end.startswith(after))


def drive_through(
    simulation: SumocfgSimulation, on_step: Callable[[int], None] = lambda _: None
) -> list[tuple[str, int]]:
    """Drive to the goal; return state and count at each stop line, which is passed when SUMO has the ego beyond it."""
    vehicle, found = simulation.connection.vehicle, []
    for step in range(1000):
        on_step(step)
        lane = vehicle.getLaneID(EGO)
        simulation.step(np.array([FAST]))
        passed = simulation.perception.lights.passed_red
        if lane[:-2] in ROUTE[:2] and vehicle.getRoadID(EGO) != lane[:-2]:
            crossing = CROSSINGS[ROUTE.index(lane[:-2])]
            states = simulation.connection.trafficlight.getRedYellowGreenState(crossing)
            found.append((states[index_of(simulation, crossing, lane)], passed))
        else:
            assert passed == 0, "no stop line was driven over"
        if simulation.egos.front_m[0] > simulation.scene.goal_m:
            break
    return found


@pytest.mark.parametrize("step_s", [0.1, 0.5, 1.0])
def test_stop_lines_driven_over_are_counted_by_the_state_of_their_signal(
    scene_of: Callable[[float], SumocfgScene], step_s: float
) -> None:
    with begun(scene_of(step_s)) as simulation:
        for state, count in (("r", 1), ("u", 1), ("y", 0), ("g", 0), ("G", 0), ("s", 0), ("o", 0), ("O", 0)):
            simulation.reset(0, 1)
            simulation.egos.rules = simulation.egos.rules._replace(unsafe_distance_m=-1.0, closing_distance_m=-1.0)
            set_all(simulation, state)
            assert drive_through(simulation) == [(state, count)] * 2
            assert not simulation.egos.ran_red[0], "that is a cost here, and no end"


@pytest.mark.parametrize("step_s", [0.1, 1.0])
def test_the_state_counts_that_the_signal_has_while_the_front_moves_over_the_line(
    scene_of: Callable[[float], SumocfgScene], step_s: float
) -> None:
    """Signals switch back and forth, so that red begins and ends just before, at and after the line."""
    seen = set()
    with begun(scene_of(step_s)) as simulation:
        for first in range(6):
            simulation.reset(0, 1)

            def switch(step: int, first: int = first) -> None:
                set_all(simulation, "Gr"[(step + first) // 3 % 2])

            found = drive_through(simulation, on_step=switch)
            assert found and all(count == (state == "r") for state, count in found)
            seen |= set(found)
    assert seen == {("G", 0), ("r", 1)}


def test_an_ego_that_stands_at_the_line_or_starts_beyond_it_drives_over_none(
    scene_of: Callable[[float], SumocfgScene],
) -> None:
    scene = scene_of(0.1)
    with begun(replace(scene, start_m=scene.route_edge_start_m[2] + 0.1)) as simulation:
        set_all(simulation, "r")
        assert simulation.perception.traffic_light is None
        assert drive_through(simulation) == []
    with begun(scene) as simulation:
        line_m = scene.start_m + simulation.connection.vehicle.getNextTLS(EGO)[0][2]
    with begun(replace(scene, start_m=line_m)) as simulation:
        set_all(simulation, "r")
        for _ in range(3):
            simulation.step(np.array([0.0]))
            assert simulation.perception.lights.passed_red == 0
        assert drive_through(simulation) == [("r", 1)] * 2


def test_an_ego_that_waits_on_the_junction_until_its_light_is_red_has_not_driven_over_red(tmp_path: Path) -> None:
    """A left turn has a second stop on the junction, where the ego gives way to oncoming traffic."""
    turn = replace(lights(tmp_path, 0.5), ego_route=("left0A0", "A0A1", "A1top0"), start_m=40.0, goal_m=120.0)
    with begun(turn.scene(perceives=("traffic_light",), red_light="cost", warm_up_s=0.0)) as simulation:
        vehicle, counted = simulation.connection.vehicle, 0
        set_all(simulation, "g")
        while vehicle.getRoadID(EGO) == "left0A0":
            simulation.step(np.array([5.0]))
            counted += simulation.perception.lights.passed_red
        assert vehicle.getRoadID(EGO).startswith(":")
        set_all(simulation, "r")
        for speed_mps in (0.0, 0.0, 0.0, *[5.0] * 20):
            simulation.step(np.array([speed_mps]))
            counted += simulation.perception.lights.passed_red
        assert vehicle.getRoadID(EGO) == "A0A1"
        assert counted == 0


def test_a_red_light_counts_in_the_step_in_which_the_ego_arrives_and_in_no_step_after(tmp_path: Path) -> None:
    """The edge behind the light is so short that the ego drives over both ends of the junction in a step."""
    at = {"w": (-500, 0), "e": (25, 0), "s": (0, -90), "n": (0, 90)}
    nodes = '<node id="c" x="0" y="0" type="traffic_light"/>' + "".join(
        f'<node id="{name}" x="{x}" y="{y}"/>' for name, (x, y) in at.items()
    )
    edges = "".join(f'<edge id="{a}{b}" from="{a}" to="{b}" speed="50"/>' for a, b in ("wc", "ce", "sc", "cn"))
    net = netconvert(tmp_path, nodes, edges)
    (tmp_path / "x.rou.xml").write_text('<routes><vType id="car"/></routes>')
    sumocfg = write_config(tmp_path / "x.sumocfg", net.name, "x.rou.xml")
    controller = EgoController((0.0, 50.0), accel_limit_mps2=50.0)
    scene = from_sumocfg(sumocfg, ["wc", "ce"], 5.0, 500.0, warm_up_s=0.0, controller=controller, red_light="cost")
    at_once = 0
    for start_m in range(5, 55, 10):
        with begun(replace(scene, start_m=float(start_m))) as simulation:
            set_all(simulation, "r")
            counts = []
            for _ in range(16):
                simulation.step(np.array([50.0]))
                counts.append(simulation.perception.lights.passed_red)
                at_once += counts[-1] == 1 and not np.isfinite(simulation.egos.front_m[0])
            assert sum(counts) == 1
    assert at_once > 0


def test_the_next_light_is_as_sumo_has_it(scene_of: Callable[[float], SumocfgScene]) -> None:
    scene = replace(scene_of(0.5), warm_up_s=30.0)
    with begun(scene) as simulation:
        vehicle = simulation.connection.vehicle
        for step in range(200):
            light, listed = simulation.perception.traffic_light, vehicle.getNextTLS(EGO)
            if not listed:
                assert light is None
                break
            assert light is not None
            name, index, distance_m, state = listed[0]
            assert (light.name, light.index, light.state) == (name, index, state)
            assert light.line_m - simulation.egos.front_m[0] == pytest.approx(distance_m)
            simulation.step(np.array([5.0 if step % 20 < 15 else 0.0]))
        else:
            pytest.fail("the ego has not passed its lights")


def program(kind: str, *phases: tuple[float, str]) -> str:
    """Return a program of crossing A0 whose signals all have the same state."""
    listed = "".join(
        f'<phase duration="{duration_s}" minDur="2" maxDur="{duration_s}" state="{letter * SIGNALS}"/>'
        for duration_s, letter in phases
    )
    return f'<tlLogic id="A0" programID="test" type="{kind}" offset="7">{listed}</tlLogic>'


PHASES = ((9.0, "r"), (8.0, "r"), (3.0, "y"), (20.0, "g"), (5.0, "G"))


def ages(scene: SumocfgScene, steps: int) -> dict[float, tuple[str, float]]:
    """Return state and time in state of the first light by the time of the simulation, while the ego stands."""
    found = {}
    with begun(scene) as simulation:
        for _ in range(steps):
            light = simulation.perception.traffic_light
            assert light is not None
            time_s = simulation.perception.lights.time_s
            found[time_s] = (light.state, round(time_s - light.since_s, 6))
            simulation.step(np.array([0.0]))
    return found


def test_time_in_state_goes_on_over_phases_with_the_same_state(tmp_path: Path) -> None:
    scene = lights(tmp_path, 0.5, program("static", *PHASES)).scene(perceives=("traffic_light",), warm_up_s=0.0)
    found = ages(scene, 200)
    longest = {letter: max(age_s for state, age_s in found.values() if state == letter) for letter in "rygG"}
    assert longest == {"r": 17.0, "y": 3.0, "g": 20.0, "G": 5.0}
    # Later begins are in the middle of a state, whose time so far its program tells.
    for warm_up_s, warm_starts in ((50.0, 0), (62.5, 1), (70.0, 0), (77.5, 1)):
        later = ages(replace(scene, warm_up_s=warm_up_s, warm_starts=warm_starts), 40)
        assert later == {time_s: found[time_s] for time_s in later}


def test_lights_that_are_actuated_or_off_or_change_their_program(tmp_path: Path) -> None:
    network = lights(tmp_path, 0.5, program("actuated", *PHASES))
    scene = network.scene(perceives=("traffic_light",), warm_up_s=0.0)
    states = ages(scene, 150)
    later = ages(replace(scene, warm_up_s=50.0), 5)  # the red phase before was as short as it may be
    assert later == {time_s: states[time_s] for time_s in later}
    for (before, _), (state, age_s) in pairwise(states.values()):
        assert age_s == 0.5 if state != before else age_s > 0.5
    assert {state for state, _ in states.values()} == set("rygG")
    with begun(network.scene(perceives=("traffic_light",), red_light="cost", warm_up_s=5.0)) as simulation:
        signals, lit = simulation.connection.trafficlight, simulation.perception
        signals.setProgram("A0", "off")
        simulation.step(np.array([0.0]))
        assert lit.traffic_light is not None
        assert lit.traffic_light.state in "oO"
        assert lit.lights.time_s - lit.traffic_light.since_s == 0.5
        signals.setProgram("A0", "0")
        simulation.step(np.array([0.0]))
        assert lit.traffic_light.state == signals.getRedYellowGreenState("A0")[lit.traffic_light.index]
