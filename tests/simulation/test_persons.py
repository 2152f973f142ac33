"""Persons on foot around the ego in a SUMO configuration."""

import math
import subprocess
from collections.abc import Iterator
from contextlib import closing, contextmanager
from pathlib import Path

import numpy as np
import pytest
from PIL import ImageColor

from tests.scenes.networks import write_config
from tint_sumo.config import Backend, EgoController
from tint_sumo.envs import TaskSettings
from tint_sumo.envs.rendering import _PERSON
from tint_sumo.envs.scene_env import SceneEnv
from tint_sumo.scenes import SumocfgScene, from_sumocfg
from tint_sumo.scenes.geometry import clearance_m
from tint_sumo.scenes.network import sumo_program
from tint_sumo.scenes.sumocfg import network_roads
from tint_sumo.simulation import SumocfgSimulation
from tint_sumo.simulation.bodies import Bodies
from tint_sumo.simulation.ego_way import EGO

_NODES = '<nodes><node id="w" x="0" y="0"/><node id="x" x="80" y="0"/><node id="e" x="200" y="0"/></nodes>'
_EDGES = (
    "<edges>"
    + "".join(
        f'<edge id="{start}{end}" from="{start}" to="{end}" speed="13"/>' for start, end in ("wx", "xw", "xe", "ex")
    )
    + "</edges>"
)
_CROSSING = '<connections><crossing node="x" edges="wx xw" priority="true"/></connections>'
_WALKERS = """<routes>
    <personFlow id="p" begin="0" end="600" period="{period}" departPos="60">
        <walk from="wx" to="xw" arrivalPos="20"/>
    </personFlow>
    <vehicle id="p.0" depart="0" departPos="110"><route edges="ex"/><stop lane="ex_1" endPos="115" duration="900"/>
    </vehicle>
</routes>"""


@pytest.fixture(scope="module")
def net(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return the folder of a street with pavements and a crossing at x = 80 m."""
    folder = tmp_path_factory.mktemp("crossing")
    for name, text in (("nod", _NODES), ("edg", _EDGES), ("con", _CROSSING)):
        (folder / f"{name}.xml").write_text(text)
    files = [part for flag, name in (("-n", "nod"), ("-e", "edg"), ("-x", "con")) for part in (flag, f"{name}.xml")]
    command = [sumo_program("netconvert"), *files, "--sidewalks.guess", "-o", "x.net.xml"]
    subprocess.run(command, check=True, capture_output=True, cwd=folder)
    return folder


def street(
    net: Path, *, period_s: float = 1.0, step_s: float = 0.1, speeds_mps: tuple[float, ...] = (0.0, 3.0, 8.0)
) -> SumocfgScene:
    """Return a scene in which persons walk over the crossing; a vehicle has the id of the first of them."""
    (net / "x.rou.xml").write_text(_WALKERS.format(period=period_s))
    sumocfg = write_config(net / "x.sumocfg", "x.net.xml", "x.rou.xml", f'<step-length value="{step_s}"/>')
    return from_sumocfg(
        sumocfg, ["wx", "xe"], 30.0, 150.0, warm_up_s=20.0, time_limit_s=60.0, controller=EgoController(speeds_mps)
    )


def steps_of(simulation: SumocfgSimulation, desired_mps: float, steps: int) -> Iterator[int]:
    for step in range(steps):
        simulation.step(np.array([desired_mps]))
        yield step
        if simulation.egos.collided[0] or simulation.egos.front_m[0] > simulation.scene.goal_m:
            return


@contextmanager
def begun(scene: SumocfgScene, backend: Backend = "auto") -> Iterator[SumocfgSimulation]:
    with closing(SumocfgSimulation(1, scene, backend=backend)) as simulation:
        simulation.reset(0, 1)
        yield simulation


@pytest.mark.parametrize("backend", ["libsumo", "traci"])
def test_persons_are_where_sumo_has_them_even_with_the_id_of_a_vehicle(net: Path, backend: Backend) -> None:
    with begun(street(net, period_s=4.0), backend) as simulation:
        person, vehicle, mixed = simulation.connection.person, simulation.connection.vehicle, 0
        for _ in steps_of(simulation, 8.0, 60):
            left_m, low_m = simulation.origin_m
            ids = simulation.persons.ids
            assert set(ids) >= {
                name
                for name in person.getIDList()
                if math.dist(person.getPosition(name), vehicle.getPosition(EGO)) < 40.0
            }
            for name, box in zip(ids, simulation.pedestrians, strict=True):
                x_m, y_m = person.getPosition(name)
                assert math.dist((box["x_m"] + left_m, box["y_m"] + low_m), (x_m, y_m)) < 0.2
                assert (box["length_m"], box["width_m"]) == (person.getLength(name), person.getWidth(name))
            mixed += "p.0" in simulation.slot and "p.0" in ids
            for name, slot in simulation.slot.items():
                box = simulation.slots.box[0, slot]
                x_m, y_m = vehicle.getPosition(name)
                assert math.dist((box["x_m"] + left_m, box["y_m"] + low_m), (x_m, y_m)) < 3.0
            assert len(simulation.slot) <= 1  # no person has a slot
        assert mixed > 0


def test_the_way_of_a_long_vehicle_is_found_beside_pavements(net: Path) -> None:
    with begun(street(net)) as simulation:
        behind = Bodies(simulation.connection)._lane_behind(("wx", "xe"), 1, "xe_1")
        assert behind is not None
        assert simulation.connection.lane.getLinks(behind)[0][0] == "xe_1"


@pytest.mark.parametrize("step_s", [0.1, 1.0])
def test_an_ego_that_touches_a_person_has_a_collision(net: Path, step_s: float) -> None:
    with closing(SceneEnv(TaskSettings(street(net, step_s=step_s, speeds_mps=(0.0, 12.0, 13.0))))) as env:
        env.reset(seed=1)
        ended = False
        while not ended:
            _, reward, ended, truncated, info = env.step(2)
            assert not truncated
        assert info["outcome"] == "collision"
        assert reward == -2.0
        assert info["collision"]["trait"] == "pedestrian"
        assert info["collision"]["route"].startswith(":x_c")
        env.reset(seed=2)
        assert not env.simulation.egos.collided[0]


def test_the_safety_check_counts_persons_on_the_carriageway_alone(net: Path) -> None:
    held, near = set(), set()
    with begun(street(net)) as simulation:
        egos, persons = simulation.egos, simulation.persons
        for _ in steps_of(simulation, 2.0, 300):
            roads = [simulation.connection.person.getLaneID(name) for name in persons.ids]
            distances_m = [clearance_m(egos.box[0], box) for box in persons.boxes]
            close = {road for road, distance_m in zip(roads, distances_m, strict=True) if distance_m < 0.8}
            near |= close
            held |= close if egos.unsafe[0] else set()
            assert egos.unsafe[0] >= any(road.startswith(":x_c") for road in close)
            assert egos.unsafe[0] <= any(
                road.startswith(":x_c") for road, m in zip(roads, distances_m, strict=True) if m < 1.0 or m == 0.0
            )
    assert any(road.startswith(":x_c") for road in held)


def test_pictures_show_persons_and_crossings(net: Path) -> None:
    with closing(SceneEnv(TaskSettings(street(net)), render_mode="rgb_array")) as env:
        env.reset(seed=1)
        for _ in range(35):
            env.step(2)
        simulation, image = env.simulation, env.render()
        view, pixels_per_m = simulation.view(0), image.shape[1] / 60.0
        shown = 0
        for box in simulation.pedestrians:
            across, down = (box["x_m"] - view.left_m) * pixels_per_m, (view.top_m - box["y_m"]) * pixels_per_m
            if 0 <= across < image.shape[1] and 0 <= down < image.shape[0]:
                assert tuple(image[int(down), int(across)]) == ImageColor.getrgb(_PERSON)
                shown += 1
        assert shown > 3
    stripes = network_roads(net / "x.net.xml").marks.geometries
    assert len(stripes) == 7
    assert all(stripe.area == pytest.approx(0.5 * 4.0) for stripe in stripes[:-1])


def test_scenes_without_persons_have_none() -> None:
    with closing(SceneEnv()) as env:
        env.reset(seed=1)
        assert len(env.simulation.pedestrians) == 0
