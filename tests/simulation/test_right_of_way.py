"""Right of way: whether the ego must yield at its next junction, and which vehicles have priority over it."""

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import cache
from pathlib import Path

import numpy as np
import pytest

from tests.scenes.networks import netconvert, write_config
from tests.simulation.test_sumocfg import begun
from tint_sumo.config import EgoController
from tint_sumo.scenes import SumocfgScene, from_sumocfg
from tint_sumo.simulation import SumocfgSimulation
from tint_sumo.simulation.ego_way import EGO

_AT = {"w": (-100, 0), "e": (100, 0), "s": (0, -100), "n": (0, 100)}
_WAYS = {"from_west": "wc ce", "from_east": "ec cw", "turns_right": "nc cw", "from_north": "nc cs", "leaves": "wc cs"}
_FROM_M = {"leaves": 25}  # behind another one

Make = Callable[..., SumocfgScene]


@pytest.fixture(scope="module")
def crossing(tmp_path_factory: pytest.TempPathFactory) -> Make:
    """Return a function that makes a crossing of a main road, from west to east, with a minor one."""

    @cache
    def make(kind: str, *ego_route: str) -> SumocfgScene:
        folder: Path = tmp_path_factory.mktemp(kind)
        nodes = "".join(f'<node id="{name}" x="{x}" y="{y}"/>' for name, (x, y) in _AT.items())
        edges = "".join(
            f'<edge id="{start}{end}" from="{start}" to="{end}" priority="{5 if name in "we" else 1}" speed="13.9"/>'
            for name in _AT
            for start, end in ((name, "c"), ("c", name))
        )
        net = netconvert(folder, f'<node id="c" x="0" y="0" type="{kind}"/>{nodes}', edges)
        vehicles = "".join(
            f'<vehicle id="{name}" depart="0" departPos="{_FROM_M.get(name, 40)}" departSpeed="5">'
            f'<route edges="{way}"/></vehicle>'
            for name, way in _WAYS.items()
            if not way.startswith(ego_route[0])
        )
        (folder / "x.rou.xml").write_text(f"<routes>{vehicles}</routes>")
        sumocfg = write_config(folder / "x.sumocfg", net.name, "x.rou.xml", '<step-length value="0.5"/>')
        return from_sumocfg(
            sumocfg,
            ego_route,
            60.0,
            150.0,
            sight_m=200.0,
            warm_up_s=0.0,
            controller=EgoController((0.0, 5.0)),
            perceives=("right_of_way",),
        )

    return make


@contextmanager
def driven(scene: SumocfgScene) -> Iterator[tuple[SumocfgSimulation, Callable[[float], set[str]]]]:
    """Yield a simulation and a function that takes a step and returns who has priority over the ego then."""
    with begun(scene) as simulation:

        def step(desired_mps: float) -> set[str]:
            simulation.step(np.array([desired_mps]))
            first = simulation.perception.right_of_way.has_priority
            return {name for name, slot in simulation.slot.items() if first[slot]}

        yield simulation, step


def test_an_ego_from_a_minor_road_yields_to_those_on_the_main_road_whose_ways_meet_its(crossing: Make) -> None:
    with driven(crossing("priority", "sc", "cn")) as (simulation, step):
        right_of_way, vehicle = simulation.perception.right_of_way, simulation.connection.vehicle
        seen: list[set[str]] = []
        for _ in range(40):
            seen.append(step(0.0))
            assert right_of_way.must_yield and right_of_way.crossing is not None
            left_m = simulation.connection.lane.getLength("sc_0") - vehicle.getLanePosition(EGO)
            assert right_of_way.crossing.line_m - simulation.egos.front_m[0] == pytest.approx(left_m)
        assert seen[0] == {"from_west", "from_east"}, "neither who turns away nor who comes from the other minor road"
        passed = [name for name in ("from_west", "from_east") if name not in seen[-1]]
        assert passed == ["from_west", "from_east"]


def test_an_ego_on_the_main_road_yields_to_nobody(crossing: Make) -> None:
    with driven(crossing("priority", "wc", "ce")) as (simulation, step):
        right_of_way = simulation.perception.right_of_way
        for _ in range(8):
            assert step(5.0) == set()
            assert not right_of_way.must_yield
        assert right_of_way.crossing is not None
        while simulation.connection.vehicle.getRoadID(EGO) != "ce":
            step(5.0)
        assert right_of_way.crossing is None, "there is no junction to come"
        assert not right_of_way.must_yield


def test_where_roads_are_equal_those_from_the_right_have_priority(crossing: Make) -> None:
    with driven(crossing("right_before_left", "sc", "cn")) as (simulation, step):
        assert step(0.0) == {"from_east"}
        assert simulation.perception.right_of_way.must_yield


def test_on_the_junction_it_stays_that_junction_s_and_who_crosses_the_ego_s_way_counts(crossing: Make) -> None:
    with driven(crossing("priority", "sc", "cn")) as (simulation, step):
        right_of_way, vehicle = simulation.perception.right_of_way, simulation.connection.vehicle
        across = set()
        while not vehicle.getRoadID(EGO).startswith(":"):
            first = step(5.0)
            across |= {name for name in first if vehicle.getRoadID(name).startswith(":")}
        assert across == {"from_west", "from_east"}
        assert right_of_way.crossing is not None and right_of_way.crossing.line_m < simulation.egos.front_m[0]
        assert right_of_way.must_yield


def test_those_at_a_red_light_have_no_priority(crossing: Make) -> None:
    with driven(crossing("traffic_light", "sc", "cn")) as (simulation, step):
        signals, right_of_way = simulation.connection.trafficlight, simulation.perception.right_of_way
        links = signals.getControlledLinks("c")
        for main, first, must_yield in (("G", {"from_west", "from_east"}, True), ("r", set(), False)):
            states = [main if start[0] in "we" else {"G": "r", "r": "G"}[main] for ((start, *_), *_) in links]
            signals.setRedYellowGreenState("c", "".join(states))
            assert step(0.0) == first
            assert right_of_way.must_yield is must_yield


def test_libsumo_and_traci_agree(crossing: Make) -> None:
    scene, found = crossing("priority", "sc", "cn"), []
    for backend in ("libsumo", "traci"):
        with begun(scene, backend=backend) as simulation:
            steps = []
            for _ in range(15):
                simulation.step(np.array([5.0]))
                right_of_way = simulation.perception.right_of_way
                steps.append((right_of_way.crossing, right_of_way.must_yield, right_of_way.has_priority.tolist()))
            found.append(steps)
    assert found[0] == found[1]
