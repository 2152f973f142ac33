"""Runs of SUMO configurations: nothing of the user's is touched, and what crashes SUMO is found before."""

import re
import shutil
import subprocess
from collections.abc import Callable
from contextlib import closing
from pathlib import Path

import pytest

from tests.scenes.networks import UserNetwork, write_config
from tint_sumo.core.errors import InputError
from tint_sumo.scenes import from_sumocfg
from tint_sumo.scenes.network import sumo_program
from tint_sumo.scenes.sumo_config import read_config
from tint_sumo.scenes.sumo_run import SumocfgRun, require_loads

Make = Callable[[str], UserNetwork]
WRITING = """<additional>
    <vType id="car"/>
    <inductionLoop id="e1" lane="in_0" pos="50" period="10" file="e1.xml"/>
    <instantInductionLoop id="i1" lane="in_0" pos="55" file="sub/i1.xml"/>
    <laneAreaDetector id="e2" lane="in_1" pos="50" endPos="90" period="10" file="e2.csv"/>
    <edgeData id="edges" file="edges.xml.gz" period="10"/>
    <laneData id="lanes" file="{elsewhere}/lanes.xml" period="10"/>
    <routeProbe id="probe" edge="in" period="10" file="probe.xml"/>
    <vTypeProbe id="types" type="calm" period="5" file="types.xml"/>
</additional>
"""
DEVICES = """<routes>
    <vType id="calm"><param key="has.ssm.device" value="true"/></vType>
    <vehicle id="first" type="calm" depart="0"><route edges="in out"/></vehicle>
    <vehicle id="second" type="calm" depart="2">
        <route edges="in out"/><param key="device.ssm.file" value="own.xml"/>
    </vehicle>
</routes>
"""
OPTIONS = """
    <tripinfo value="trips.xml"/><vehroutes value="v.xml"/><vtk-output value="vtk"/><save-state.times value="5"/>
    <log value="log.txt"/><error-log value="errors.txt"/><output-prefix value="run_"/>
    <device.ssm.probability value="1"/>
"""


@pytest.fixture
def folder(user_network: Make, tmp_path: Path) -> Path:
    """A folder with the configuration ``merge.sumocfg`` and its files, which may be changed."""
    return Path(shutil.copytree(user_network("merge").sumocfg.parent, tmp_path / "merge"))


def contents(*folders: Path) -> dict[Path, bytes]:
    return {file: file.read_bytes() for folder in folders for file in folder.rglob("*") if file.is_file()}


@pytest.mark.parametrize("name", ["merge", "a, b"])
def test_a_run_writes_nothing_into_folders_of_the_user(name: str, folder: Path, tmp_path: Path) -> None:
    """Neither output options, nor detectors, nor devices, with relative or absolute paths."""
    elsewhere, work = tmp_path / "elsewhere", tmp_path / "work"
    for made in (elsewhere, work, folder / "sub"):
        made.mkdir()
    folder = folder.rename(tmp_path / name)
    (folder / "a.add.xml").write_text(WRITING.format(elsewhere=elsewhere))
    (folder / "d.rou.xml").write_text(DEVICES)
    more = f'<additional-files value="a.add.xml"/>{OPTIONS}'
    config = read_config(write_config(folder / "w.sumocfg", "merge.net.xml", "d.rou.xml", more))
    before = contents(folder, elsewhere, work)
    with closing(SumocfgRun(config)) as run:
        options = run.options(seed=1, more={"end": "20"})
        subprocess.run([sumo_program("sumo"), *options], cwd=work, check=True, capture_output=True)
        written = {file.name for file in run.output.iterdir()}
    assert written >= {"e1.xml", "i1.xml", "e2.csv", "edges.xml.gz", "lanes.xml", "probe.xml", "types.xml"}
    assert written >= {"ssm_first.xml", "own.xml"}
    assert contents(folder, elsewhere, work) == before
    assert not run.output.exists()


@pytest.mark.parametrize(
    "damage",
    [
        lambda net: re.sub(r'length="[0-9.]+"', 'length="nan"', net, count=1),
        lambda net: re.sub(r'length="[0-9.]+"', 'length="-3"', net, count=1),
        lambda net: re.sub(r'(<lane [^>]*)shape="[^"]*"', r'\1shape=""', net, count=1),
        lambda net: re.sub(r'(<lane [^>]*)shape="([^ "]*) [^"]*"', r'\1shape="\2"', net, count=1),
        lambda net: re.sub(r'(<lane [^>]*)shape="[^"]*"', r'\1shape="nan,nan 1,1"', net, count=1),
        lambda net: re.sub(r'speed="[0-9.]+"', 'speed="inf"', net, count=1),
    ],
)
def test_damaged_networks_are_refused_before_sumo_loads_them(damage: Callable[[str], str], folder: Path) -> None:
    file = folder / "merge.net.xml"
    file.write_text(damage(file.read_text()))
    with pytest.raises(InputError, match=r"merge\.net\.xml is damaged: lane ") as caught:
        from_sumocfg(folder / "merge.sumocfg", ["ramp", "out"], start_m=20.0, goal_m=130.0)
    assert "\n" not in str(caught.value)


def test_demand_that_crashes_sumo_is_an_error(folder: Path) -> None:
    (folder / "merge.rou.xml").write_text('<routes><include href="merge.rou.xml"/></routes>')
    with pytest.raises(InputError, match=r"SUMO does not run .*merge\.sumocfg \(it ends with code -"):
        require_loads(read_config(folder / "merge.sumocfg"))


def test_the_first_of_sumos_errors_is_named(folder: Path) -> None:
    text = (folder / "merge.rou.xml").read_text().replace('from="ramp"', 'from="nowhere"')
    (folder / "merge.rou.xml").write_text(text)
    with pytest.raises(InputError, match=r"\(.*'nowhere'.*\); try it with: sumo -c ") as caught:
        require_loads(read_config(folder / "merge.sumocfg"))
    assert "\n" not in str(caught.value)
    assert "Quitting" not in str(caught.value)


def test_a_forgotten_run_leaves_no_folder(folder: Path) -> None:
    run = SumocfgRun(read_config(folder / "merge.sumocfg"))
    output = run.output
    assert output.is_dir()
    del run
    assert not output.exists()
