"""Scenes from SUMO configurations, as far as no simulation is needed."""

import pickle
import re
import shutil
import subprocess
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import pytest

from tests.scenes.networks import USER_NETWORKS, UserNetwork
from tint_sumo.core.errors import InputError
from tint_sumo.scenes import SumocfgScene
from tint_sumo.scenes.network import sumo_program
from tint_sumo.scenes.sumo_config import read_config
from tint_sumo.scenes.sumocfg import NET_VERSION, read_net

Make = Callable[[str], UserNetwork]


@pytest.fixture
def merge(user_network: Make, tmp_path: Path) -> UserNetwork:
    """A copy that may be damaged."""
    network = user_network("merge")
    folder = Path(shutil.copytree(network.sumocfg.parent, tmp_path / "merge"))
    return replace(network, sumocfg=folder / network.sumocfg.name)


@pytest.mark.parametrize("name", USER_NETWORKS)
def test_scenes_know_their_drivers_and_can_be_sent_to_other_processes(name: str, user_network: Make) -> None:
    scene = user_network(name).scene()
    vtypes = {
        "braunschweig": ("bike_bicycle", "veh_bus", "veh_car", "veh_motorbike", "veh_truck", "veh_van"),
        "grid": ("DEFAULT_VEHTYPE", "lorry"),
        "merge": ("calm", "hasty"),
    }
    assert scene.vtypes == vtypes.get(name, scene.vtypes)
    assert scene.step_s == {"braunschweig": 0.05, "autobahn": 0.5, "grid": 1.0, "merge": 0.1}[name]
    assert pickle.loads(pickle.dumps(scene)) == scene
    assert hash(scene) == hash(user_network(name).scene())


def test_the_ego_departs_where_it_starts_on_its_route(merge: UserNetwork) -> None:
    scene = merge.scene()
    assert scene.departure == (("ramp", "out"), 20.0)
    start_m = scene.route_edge_start_m[1]
    later = merge.scene(start_m=start_m + 5.0)
    assert later.departure[0] == ("out",)
    assert later.departure[1] == pytest.approx(5.0)


def test_defaults_follow_the_speeds_of_the_network(merge: UserNetwork) -> None:
    scene = merge.scene(controller=None)
    assert scene.controller.desired_speeds_mps == (0.0, 13.9 / 2, 13.9)
    assert scene.sight_m == pytest.approx(5.0 * 13.9)
    assert merge.scene().sight_m == 50.0  # at 3 m/s
    assert merge.scene(controller=None, sight_m=30.0).sight_m == 30.0


def test_all_that_is_in_sight_and_all_of_the_way_is_within_the_bounds_of_observations(merge: UserNetwork) -> None:
    scene = merge.scene(sight_m=120.0)
    assert scene.position_scale_m * 2.0 == 120.0
    assert scene.ego_scale_m * 2.0 == 130.0 - 20.0
    near = merge.scene(sight_m=20.0, goal_m=30.0)
    assert (near.position_scale_m, near.ego_scale_m) == (20.0, 20.0)  # as in the built-in scenes


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"ego_route": ("ramp", "nowhere")}, "no edge 'nowhere'"),
        ({"ego_route": ()}, "ego_route is empty"),
        ({"ego_route": ("out", "ramp")}, "no way for passenger cars leads from edge 'out' to edge 'ramp'"),
        ({"goal_m": 10.0}, "one behind the other"),
        ({"start_m": -1.0}, "one behind the other"),
        ({"goal_m": 1e4}, "one behind the other"),
        ({"max_vehicles": 0}, "max_vehicles must lie in 1 to 200"),
        ({"sight_m": float("nan")}, "sight_m must lie in 0 to 1000"),
        ({"warm_up_s": -1.0}, "warm_up_s must lie in"),
        ({"warm_up_spread_s": -1.0}, "warm_up_spread_s must lie in"),
        ({"warm_starts": -1}, "warm_starts must lie in 0 to 1,000"),
    ],
)
def test_bad_tasks_are_refused(changes: dict[str, object], message: str, merge: UserNetwork) -> None:
    with pytest.raises(InputError, match=message) as caught:
        merge.scene(**changes)
    assert "\n" not in str(caught.value)


def test_the_ego_may_not_start_on_a_junction(merge: UserNetwork) -> None:
    with pytest.raises(InputError, match=r"on a junction; its route's edges are at 0\.0 to"):
        merge.scene(start_m=merge.scene().route_edge_start_m[1] - 0.5)


def test_a_route_may_not_lead_over_a_way_for_others(user_network: Make) -> None:
    network = user_network("braunschweig")
    net = read_net(read_config(network.sumocfg).net_file)
    footway = next(edge.getID() for edge in net.getEdges() if not edge.allows("passenger"))
    with pytest.raises(InputError, match="closed to passenger cars"):
        network.scene(ego_route=(footway,))


@pytest.mark.parametrize("missing", ["merge.net.xml", "merge.rou.xml", "merge.sumocfg"])
def test_missing_files_are_named(missing: str, merge: UserNetwork) -> None:
    (merge.sumocfg.parent / missing).unlink()
    with pytest.raises(InputError, match=missing):
        merge.scene()


@pytest.mark.parametrize("damaged", ["merge.net.xml", "merge.rou.xml", "merge.sumocfg"])
def test_damaged_files_are_named(damaged: str, merge: UserNetwork) -> None:
    file = merge.sumocfg.parent / damaged
    file.write_text(file.read_text()[:-30])
    with pytest.raises(InputError, match=damaged) as caught:
        merge.scene()
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("version", "message"),
    [('version="1.99"', "of a newer SUMO"), ("", "is not a SUMO network"), ('version="2.0"', "newer")],
)
def test_networks_of_a_newer_sumo_are_refused(version: str, message: str, merge: UserNetwork) -> None:
    file = merge.sumocfg.parent / "merge.net.xml"
    file.write_text(re.sub(r'<net version="[0-9.]*"', f"<net {version}", file.read_text()))
    with pytest.raises(InputError, match=message):
        merge.scene()


def test_the_known_version_is_that_of_this_sumo(tmp_path: Path) -> None:
    file = tmp_path / "net.xml"
    subprocess.run([sumo_program("netgenerate"), "--grid", "-o", str(file)], check=True, capture_output=True)
    assert tuple(map(int, read_net(file).getVersion())) == NET_VERSION


def test_defaults_are_those_of_the_built_in_scenes() -> None:
    assert (SumocfgScene.max_vehicles, SumocfgScene.time_limit_s) == (12, 50.0)
