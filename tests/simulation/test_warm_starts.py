"""The traffic with which the episodes of a SUMO configuration begin."""

import subprocess
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path

import numpy as np
import psutil
import pytest

from tests.scenes.networks import UserNetwork, write_config
from tint_sumo.config import Backend
from tint_sumo.core.errors import InputError
from tint_sumo.scenes import SumocfgScene
from tint_sumo.scenes.network import sumo_program
from tint_sumo.simulation import SumocfgSimulation
from tint_sumo.simulation.warm_starts import _LOADING

Make = Callable[[str], UserNetwork]

CROSSINGS = "--grid --grid.number 2 --grid.length 100 --grid.attach-length 80 -L 2"
LIGHTS = "--default-junction-type traffic_light --tls.default-type actuated --sidewalks.guess --crossings.guess"
MIXED_ROUTES = """<routes>
    <vType id="car" speedDev="0.1"/>
    <vType id="idmm" carFollowModel="IDMM"/>
    <vType id="lorry" vClass="truck"/>
    <flow id="west" type="car" from="left0A0" to="B0right0" begin="0" end="900" period="exp(0.3)" departLane="best"/>
    <flow id="east" type="idmm" from="right1B1" to="A1left1" begin="0" end="900" period="exp(0.3)"/>
    <flow id="south" type="lorry" from="top0A1" to="A0bottom0" begin="0" end="900" probability="0.1"/>
    <flow id="parking" type="car" from="left1A1" to="B1right1" begin="0" end="900" period="4">
        <stop parkingArea="area" duration="9"/>
    </flow>
    <flow id="stopping" type="lorry" from="left1A1" to="B1right1" begin="0" end="900" period="9">
        <stop lane="A1B1_1" endPos="60" duration="5"/>
    </flow>
    <personFlow id="walker" begin="0" end="900" period="exp(0.3)"><walk from="A0B0" to="B0B1"/></personFlow>
</routes>
"""
DRIVERS_TO_COME = """<routes>
    <personFlow id="driver" begin="0" end="900" period="8">
        <personTrip from="left1A1" to="B0B1" modes="car"/>
    </personFlow>
</routes>
"""
TIMETABLE = """<routes>
    <vType id="exact" sigma="0" speedDev="0"/>
    <flow id="through" type="exact" from="in" to="out" begin="0" end="900" period="5"/>
    <vehicle id="passed" type="exact" depart="20"><route edges="in out"/></vehicle>
    <vehicle id="late" type="exact" depart="55"><route edges="in out"/></vehicle>
</routes>
"""
MIXED_MORE = """<additional>
    <parkingArea id="area" lane="A1B1_1" startPos="10" endPos="50" roadsideCapacity="3"/>
    <rerouter id="elsewhere" edges="A1left1">
        <interval begin="0" end="900"><parkingAreaReroute id="area"/></interval>
    </rerouter>
    <route id="counted" edges="A0B0 B0right0"/>
    <calibrator id="more" edge="A0B0" pos="5" period="10" output="NUL">
        <flow begin="0" end="900" vehsPerHour="1200" speed="9" route="counted"/>
    </calibrator>
    <inductionLoop id="loop" lane="A0B0_1" pos="50" period="60" file="NUL"/>
</additional>
"""


@pytest.fixture(scope="module")
def mixed(tmp_path_factory: pytest.TempPathFactory) -> UserNetwork:
    """Actuated lights, persons on foot, parking, stops, a calibrator, and cars that choose their routes."""
    folder = tmp_path_factory.mktemp("mixed")
    command = [sumo_program("netgenerate"), *CROSSINGS.split(), *LIGHTS.split(), "-o", str(folder / "mixed.net.xml")]
    subprocess.run(command, check=True, capture_output=True)
    (folder / "mixed.rou.xml").write_text(MIXED_ROUTES)
    (folder / "mixed.add.xml").write_text(MIXED_MORE.replace("NUL", str(folder / "counts.xml")))
    more = (
        '<input><additional-files value="mixed.add.xml"/></input><step-length value="0.1"/>'
        '<device.rerouting.probability value="0.5"/><device.rerouting.period value="10"/>'
    )
    sumocfg = write_config(folder / "mixed.sumocfg", "mixed.net.xml", "mixed.rou.xml", more)
    return UserNetwork(sumocfg, ("bottom1B0", "B0B1", "B1A1"), 10.0, 150.0)


@contextmanager
def simulating(scene: SumocfgScene, backend: Backend = "auto") -> Iterator[SumocfgSimulation]:
    simulation = SumocfgSimulation(1, scene, backend=backend)
    try:
        yield simulation
    finally:
        simulation.close()


def seen(simulation: SumocfgSimulation) -> dict[str, tuple[float, ...]]:
    """Return the positions of all vehicles and persons."""
    vehicle, person = simulation.connection.vehicle, simulation.connection.person
    return {name: domain.getPosition(name) for domain in (vehicle, person) for name in domain.getIDList()}


def lived(simulation: SumocfgSimulation, seed: int, steps: int = 50) -> list[dict[str, tuple[float, ...]]]:
    """Return the traffic of an episode, step by step."""
    simulation.reset(0, seed)
    found = [seen(simulation)]
    for _ in range(steps):
        simulation.step(np.array([1.0]))
        found.append(seen(simulation))
    return found


def test_an_episode_depends_on_its_seed_alone_whatever_ran_before(mixed: UserNetwork) -> None:
    scene = mixed.scene(warm_starts=2)
    with simulating(scene) as first:
        episodes = {seed: lived(first, seed) for seed in range(6)}
        assert len(first.warm_starts.states) == 2
    with simulating(scene) as second:
        assert lived(second, 5) == episodes[5]
        assert lived(second, 2) == episodes[2]
    with simulating(scene, backend="traci") as third:
        for seed in (4, 1, 4):
            assert lived(third, seed, steps=10) == episodes[seed][:11]


def test_episodes_begin_with_the_same_traffic_and_go_on_differently(user_network: Make) -> None:
    with simulating(user_network("merge").scene(warm_starts=1)) as simulation:
        first, second = lived(simulation, 1, steps=200), lived(simulation, 2, steps=200)
    assert first[0] == second[0]
    assert first[-1] != second[-1]
    with simulating(user_network("merge").scene()) as simulation:
        assert lived(simulation, 1)[0] != lived(simulation, 2)[0]


@pytest.mark.parametrize("warm_starts", [0, 3])
def test_warm_ups_of_episodes_can_differ_in_length(warm_starts: int, user_network: Make) -> None:
    scene = user_network("merge").scene(warm_up_spread_s=30.0, warm_starts=warm_starts)
    times_s: dict[int, float] = {}
    with simulating(scene) as simulation:
        for seed in (0, 1, 2, 3, 4, 5):
            simulation.reset(0, seed)
            times_s[seed] = simulation.connection.simulation.getTime()
        assert len(set(times_s.values())) == (warm_starts or 6)
        assert all(20.0 < time_s < 20.0 + 30.0 + 5.0 for time_s in times_s.values())  # and until the ego has entered
    with simulating(scene) as simulation:
        simulation.reset(0, 3)
        assert simulation.connection.simulation.getTime() == times_s[3]


def test_loaded_traffic_is_that_which_was_saved(mixed: UserNetwork) -> None:
    with simulating(mixed.scene(warm_starts=3)) as simulation:
        for seed in range(6):
            simulation.reset(0, seed)
            assert simulation.connection.person.getIDCount() > 0
        assert len(simulation.warm_starts.states) > 1
        assert None not in simulation.warm_starts.states.values()


def test_states_lie_in_a_folder_that_is_removed(
    user_network: Make, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path))
    with simulating(user_network("merge").scene(warm_starts=3)) as simulation:
        for seed in range(20):
            simulation.reset(0, seed)
        assert len(list(tmp_path.rglob("*.xml"))) == 3
    assert not list(tmp_path.iterdir())
    with simulating(user_network("merge").scene()) as simulation:
        simulation.reset(0, 1)
        assert not list(tmp_path.rglob("*.xml"))


def test_a_state_that_sumo_does_not_load_as_it_was_saved_is_not_used(mixed: UserNetwork) -> None:
    """SUMO 1.28 forgets cars that wait at the start of their way for room on the road, with their driver in them."""
    folder = mixed.sumocfg.parent
    (folder / "drivers.rou.xml").write_text(DRIVERS_TO_COME)
    text = mixed.sumocfg.read_text().replace("mixed.rou.xml", "mixed.rou.xml,drivers.rou.xml")
    (folder / "drivers.sumocfg").write_text(text)
    scene = replace(mixed, sumocfg=folder / "drivers.sumocfg").scene()
    with simulating(scene) as simulation:
        usual = lived(simulation, 1, steps=10)
    with simulating(replace(scene, warm_starts=1)) as simulation:
        assert lived(simulation, 1, steps=10) == usual
        assert simulation.warm_starts.states == {0: None}


def test_options_of_the_user_for_states_do_not_change_them(user_network: Make, tmp_path: Path) -> None:
    network = user_network("merge")
    names = [str(network.sumocfg.parent / name) for name in ("merge.net.xml", "merge.rou.xml")]
    more = (
        '<step-length value="0.1"/><save-state.rng value="true"/><save-state.precision value="1"/>'
        '<load-state.offset value="5"/><load-state.remove-vehicles value="through.0 through.1 through.2 through.3"/>'
    )
    other = replace(network, sumocfg=write_config(tmp_path / "other.sumocfg", *names, more))
    with simulating(network.scene(warm_starts=2)) as simulation:
        expected = [lived(simulation, seed) for seed in range(2)]
    with simulating(other.scene(warm_starts=2)) as simulation:
        assert [lived(simulation, seed) for seed in range(2)] == expected


def timetable(network: UserNetwork, folder: Path, begin: str) -> SumocfgScene:
    """Traffic without random numbers, which begins when its configuration says."""
    routes = folder / "timetable.rou.xml"
    routes.write_text(TIMETABLE)
    more = f'<step-length value="0.5"/>{begin}'
    sumocfg = write_config(
        folder / "timetable.sumocfg", str(network.sumocfg.parent / "merge.net.xml"), str(routes), more
    )
    return replace(network, sumocfg=sumocfg).scene(warm_up_s=20.0)


@pytest.mark.parametrize(
    ("begin", "begin_s"), [("", 0.0), ('<begin value="0"/>', 0.0), ('<begin value="0:0:30"/>', 30.0)]
)
@pytest.mark.parametrize("backend", ["libsumo", "traci"])
def test_a_warm_start_goes_on_like_the_warm_up_whenever_the_traffic_begins(
    begin: str, begin_s: float, backend: Backend, user_network: Make, tmp_path: Path
) -> None:
    scene = timetable(user_network("merge"), tmp_path, begin)
    with simulating(scene, backend) as simulation:
        expected = lived(simulation, 1, steps=100)
    with simulating(replace(scene, warm_starts=1), backend) as simulation:
        simulation.reset(0, 1)
        assert simulation.connection.simulation.getTime() == begin_s + 20.0 + scene.step_s  # in which the ego enters
        assert lived(simulation, 1, steps=100) == expected
        assert None not in simulation.warm_starts.states.values()
    assert any("late" in positions for positions in expected)
    assert any("passed" in positions for positions in expected) == (begin_s == 0.0)


def test_a_state_that_sumo_loads_at_another_time_is_not_used(
    user_network: Make, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    scene = timetable(user_network("merge"), tmp_path, "")
    with simulating(scene) as simulation:
        usual = lived(simulation, 1)
    monkeypatch.setitem(_LOADING, "begin", "3")
    with simulating(replace(scene, warm_starts=1)) as simulation:
        assert lived(simulation, 1) == usual
        assert simulation.warm_starts.states == {0: None}


def test_a_state_that_sumo_refuses_is_an_error_with_a_way_out(user_network: Make) -> None:
    with simulating(user_network("merge").scene(warm_starts=1)) as simulation:
        simulation.reset(0, 1)
        (file,) = simulation.warm_starts.states.values()
        assert file is not None
        file.write_text(file.read_text().replace('lane id="in_0"', 'lane id="nowhere"'))
        with pytest.raises(
            InputError, match=r"a state of .* that it has saved itself .*; set warm_starts to 0"
        ) as caught:
            simulation.reset(0, 2)
        assert "\n" not in str(caught.value)


@pytest.mark.long
def test_memory_does_not_grow_over_many_resets(mixed: UserNetwork) -> None:
    process = psutil.Process()
    with simulating(mixed.scene(warm_starts=4)) as simulation:
        sizes = []
        for seed in range(500):
            simulation.reset(0, seed)
            sizes.append(process.memory_info().rss / 2**20)
    assert max(sizes[450:]) < max(sizes[50:100]) + 5.0
