"""The page on a SUMO configuration: its numbers are those of files and of SUMO's run, and its flags can be copied."""

import json
import shlex
import subprocess
from collections.abc import Callable
from pathlib import Path

import matplotlib.image
import pytest

from tests.scenes.networks import UserNetwork, write_config
from tint_sumo.cli import main
from tint_sumo.scenes import from_sumocfg
from tint_sumo.scenes.network import sumo_program
from tint_sumo.simulation.sumocfg_check import Check, check_sumocfg, report
from tint_sumo.simulation.sumocfg_figure import plot_check

Make = Callable[[str], UserNetwork]


@pytest.fixture(scope="module")
def braunschweig(user_network: Make) -> Check:
    return check_sumocfg(user_network("braunschweig").sumocfg)


def test_the_network_is_measured(braunschweig: Check) -> None:
    network = braunschweig.network
    assert (network.version, network.is_lefthand, network.traffic_lights) == ("1.20", False, 1)
    assert (network.edges, network.lanes) == (33, 195)
    assert network.junctions == {"priority": 23, "traffic_light": 1}
    assert network.road_km == pytest.approx(1.352, abs=0.001)


def test_vtypes_have_sumos_numbers(braunschweig: Check) -> None:
    assert set(braunschweig.vtypes) == {f"veh_{kind}" for kind in ("car", "van", "truck", "bus", "motorbike")} | {
        "bike_bicycle"
    }
    bus = braunschweig.vtypes["veh_bus"]
    assert (bus.vehicle_class, bus.length_m, bus.car_following) == ("bus", 12.0, "Krauss")
    assert sum(braunschweig.traffic.vehicles.values()) > 50
    assert braunschweig.traffic.vehicles.keys() <= braunschweig.vtypes.keys()
    assert 10 < braunschweig.traffic.most_at_once < 68


def test_each_suggestion_is_a_scene_and_crosses_its_junction(user_network: Make) -> None:
    for name in ("braunschweig", "grid", "merge"):
        sumocfg = user_network(name).sumocfg
        found = check_sumocfg(sumocfg)
        junctions = [route.junction for route in found.routes]
        assert found.routes, name
        assert len(set(junctions)) == (3 if name == "grid" else 1)
        assert [route.vehicles for route in found.routes] == sorted((r.vehicles for r in found.routes), reverse=True)
        assert found.routes[0].vehicles > 5
        for route in found.routes:
            scene = from_sumocfg(sumocfg, route.edges, route.start_m, route.goal_m)
            assert 20.0 < scene.goal_m - scene.start_m < 120.0
        assert check_sumocfg(sumocfg, scene).passed[route.junction] == route.junction_type


def test_models_of_cars_and_left_hand_traffic_are_named(user_network: Make, tmp_path: Path) -> None:
    merge = user_network("merge").sumocfg
    found = check_sumocfg(merge)
    assert {vtype.car_following for vtype in found.vtypes.values()} == {"IDM"}
    net = found.config.net_file
    mirrored = net.read_text().replace("<net ", '<net lefthand="true" ', 1)
    (tmp_path / net.name).write_text(mirrored)
    for file in (merge, *found.config.demand_files):
        (tmp_path / file.name).write_bytes(file.read_bytes())
    assert "traffic on the left" in report(check_sumocfg(tmp_path / merge.name))


def test_persons_and_roads_without_conflicts_are_named(tmp_path: Path) -> None:
    nodes = "".join(f'<node id="{name}" x="{x}" y="0"/>' for name, x in (("a", 0), ("b", 90), ("c", 180)))
    (tmp_path / "r.nod.xml").write_text(f"<nodes>{nodes}</nodes>")
    (tmp_path / "r.edg.xml").write_text(
        '<edges><edge id="in" from="a" to="b"/><edge id="out" from="b" to="c"/></edges>'
    )
    command = [sumo_program("netconvert"), "-n", "r.nod.xml", "-e", "r.edg.xml", "-o", "r.net.xml"]
    subprocess.run(command, check=True, capture_output=True, cwd=tmp_path)
    (tmp_path / "r.rou.xml").write_text(
        '<routes><person id="p" depart="3"><walk edges="in out"/></person>'
        '<trip id="v" depart="5" from="in" to="out"/></routes>'
    )
    found = check_sumocfg(write_config(tmp_path / "r.sumocfg", "r.net.xml", "r.rou.xml"))
    assert (found.traffic.persons, found.traffic.vehicles, found.routes) == (1, {"DEFAULT_VEHTYPE": 1}, ())
    page = report(found)
    assert "limits            persons are not observed, but the ego can hit them" in page
    assert page.endswith("meets others at no junction; any edges that follow each other will do as its route")
    plot_check(found, tmp_path / "picture.svg")
    assert (tmp_path / "picture.svg").read_text().startswith("<?xml")


def test_the_command_prints_a_page_whose_flags_can_be_copied(
    user_network: Make, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    sumocfg, picture = str(user_network("braunschweig").sumocfg), tmp_path / "picture.png"
    assert main(["scene", "check", sumocfg, "--figure", str(picture)]) == 0
    page = capsys.readouterr().out
    assert len(page.splitlines()) < 40
    assert "traffic lights    1\n" in page
    assert "limits            traffic lights are not observed" in page
    assert "limits            the ego may drive through red" in page
    flags = [line.strip()[1:] for line in page.splitlines() if "--ego-route=" in line]
    assert len(flags) == 3
    assert main(["scene", "check", sumocfg, *shlex.split(flags[0])]) == 0
    assert "ego               starts at" in capsys.readouterr().out
    watchful = ("--perceives", "traffic_light", "--red-light", "cost")
    assert main(["scene", "check", sumocfg, *shlex.split(flags[0]), *watchful]) == 0
    assert "limits" not in capsys.readouterr().out
    assert main(["scene", "check", sumocfg, *watchful]) == 2
    assert "--perceives and --red-light are the ego's; add its --ego-route" in capsys.readouterr().err
    assert main(["scene", "check", sumocfg, *shlex.split(flags[1]), "--json"]) == 0
    assert "38" in json.loads(capsys.readouterr().out.splitlines()[-1])["passed"]
    image = matplotlib.image.imread(picture)
    assert image.shape[:2] == (840, 1680)
    assert image[..., :3].std() > 0.05


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["nowhere.sumocfg"], "no file"),
        (["{sumocfg}", "--ego-route", "in", "nowhere", "--goal-m", "9"], "the network has no edge 'nowhere'"),
        (["{sumocfg}", "--ego-route=in out"], "--ego-route needs --goal-m"),
        (["{sumocfg}", "--goal-m", "9"], "--start-m and --goal-m are positions on --ego-route"),
        (["{sumocfg}", "--figure", "{sumocfg}"], "must end in"),
    ],
)
def test_words_that_are_refused_end_in_one_line(
    user_network: Make, capfd: pytest.CaptureFixture[str], words: list[str], message: str
) -> None:
    sumocfg = user_network("merge").sumocfg
    assert main(["scene", "check", *(word.format(sumocfg=sumocfg) for word in words)]) == 2
    (error,) = capfd.readouterr().err.splitlines()
    assert error.startswith("tint-sumo: error: ")
    assert message in error


@pytest.mark.parametrize(
    "demand",
    [
        '<flow id="f" from="in" to="nowhere" end="9"/>',
        '<vType accel="2"/>',
        '<vType id="car" accel="abc"/>',
        '<vType id="car" length="-1"/>',
    ],
)
def test_configurations_that_sumo_refuses_end_in_one_line(
    user_network: Make, tmp_path: Path, capfd: pytest.CaptureFixture[str], demand: str
) -> None:
    (tmp_path / "broken.rou.xml").write_text(f"<routes>{demand}</routes>")
    net = str(user_network("merge").sumocfg.with_name("merge.net.xml"))
    broken = write_config(tmp_path / "broken.sumocfg", net, "broken.rou.xml")
    assert main(["scene", "check", str(broken)]) == 2
    (error,) = capfd.readouterr().err.splitlines()
    assert error.startswith("tint-sumo: error: SUMO does not run")
