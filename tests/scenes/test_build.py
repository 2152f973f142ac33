import subprocess
from dataclasses import replace
from pathlib import Path
from xml.etree import ElementTree

import pytest
from sumolib.shapes import polygon

from tint_sumo.config import POPULATIONS, Towns
from tint_sumo.core.errors import InputError
from tint_sumo.core.files import shipped
from tint_sumo.scenes import SCENES, T_INTERSECTION, find_scene
from tint_sumo.scenes.build import BUILDINGS_FILE, CONFIG_FILE, NET_FILE, scene_files, write_scene
from tint_sumo.scenes.buildings import corner_buildings
from tint_sumo.scenes.network import sumo_program

T = find_scene(T_INTERSECTION)


def test_the_committed_network_is_what_the_sources_build() -> None:
    built = scene_files(T, replicas=1)
    committed = {path.name: path.read_text(encoding="utf-8") for path in shipped("sumo_net").iterdir()}
    assert committed == built


@pytest.mark.parametrize("routes", ["saturated.rou.xml", "poisson.rou.xml"])
@pytest.mark.parametrize("name", SCENES)
def test_plain_sumo_runs_every_scene(name: str, routes: str, tmp_path: Path) -> None:
    write_scene(tmp_path, find_scene(name), replicas=2)
    command = [sumo_program("sumo"), "-c", str(tmp_path / CONFIG_FILE), "-r", str(tmp_path / routes)]
    result = subprocess.run([*command, "--end", "60"], capture_output=True, text=True, check=True)
    inserted = next(line for line in result.stdout.splitlines() if "Inserted:" in line)
    assert int(inserted.split()[1]) > 10
    assert "collision" not in result.stderr.lower()


def test_plain_sumo_runs_a_town(tmp_path: Path) -> None:
    drivers = replace(POPULATIONS["towns"], towns=Towns(only=5))
    write_scene(tmp_path, replace(T, population=drivers), replicas=1)
    command = [sumo_program("sumo"), "-c", str(tmp_path / CONFIG_FILE), "--end", "100"]
    result = subprocess.run(
        [*command, "--vehroute-output", "driven.xml"], cwd=tmp_path, capture_output=True, text=True, check=True
    )
    assert "collision" not in result.stderr.lower()
    driven = {entry.attrib["type"] for entry in ElementTree.parse(tmp_path / "driven.xml").iter("vehicle")}
    assert len(driven) > 5 and {name.split(".")[1] for name in driven} == {"5"}


def test_buildings_are_polygons_that_sumo_reads(tmp_path: Path) -> None:
    scene = replace(T, buildings=corner_buildings(T, 1.5))
    write_scene(tmp_path, scene, replicas=2)
    polygons = [(one.id, one.type, one.shape) for one in polygon.read(str(tmp_path / BUILDINGS_FILE))]
    assert [(name, kind) for name, kind, _ in polygons] == [
        (f"building{number}.{replica}", "building") for replica in (0, 1) for number in (0, 1)
    ]
    assert [tuple(shape) for _, _, shape in polygons[:2]] == list(scene.buildings)
    assert [(x_m - 128.0, y_m) for x_m, y_m in polygons[2][2]] == list(scene.buildings[0])
    command = [sumo_program("sumo"), "-c", str(tmp_path / CONFIG_FILE), "--end", "1"]
    subprocess.run(command, capture_output=True, check=True)
    assert BUILDINGS_FILE not in scene_files(T, replicas=1)


def test_rebuilding_replaces_written_files_and_no_others(tmp_path: Path) -> None:
    write_scene(tmp_path, T, replicas=2)
    write_scene(tmp_path, T, replicas=1)
    assert 'id="L.1"' not in (tmp_path / NET_FILE).read_text()
    (tmp_path / NET_FILE).write_text("<net/>")
    with pytest.raises(InputError, match=r"tint\.net\.xml that tint-sumo did not write"):
        write_scene(tmp_path, T, replicas=1)
    assert (tmp_path / NET_FILE).read_text() == "<net/>"


def test_at_least_one_replica(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="replicas must be at least 1"):
        write_scene(tmp_path / "net", T, replicas=0)
    assert not (tmp_path / "net").exists()
