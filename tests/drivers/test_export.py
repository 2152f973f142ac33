"""Exported drivers drive in plain SUMO and in our scenes."""

import subprocess
from pathlib import Path
from xml.etree import ElementTree

import numpy as np
import pytest
from PIL import Image

from tests.cli.calls import run
from tests.drivers.conftest import KnownFit
from tint_sumo.config import FittedDriver, Population
from tint_sumo.core.files import write_text
from tint_sumo.core.yaml_files import read_yaml
from tint_sumo.drivers.export import export
from tint_sumo.drivers.models import MODELS
from tint_sumo.drivers.population import draws
from tint_sumo.scenes.drivers import read_population
from tint_sumo.scenes.network import sumo_program

SIZE = 20


@pytest.fixture(scope="module")
def files(known: KnownFit, tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    folder = tmp_path_factory.mktemp("exported")
    return {file.name: file for file in export(known.fitted, folder, SIZE, seed=1)}


def test_plain_sumo_draws_from_all_drivers(known: KnownFit, files: dict[str, Path], tmp_path: Path) -> None:
    write_text(tmp_path / "nodes.xml", '<nodes><node id="a" x="0" y="0"/><node id="b" x="3000" y="0"/></nodes>')
    write_text(tmp_path / "edges.xml", '<edges><edge id="ab" from="a" to="b" numLanes="2" speed="55"/></edges>')
    write_text(
        tmp_path / "flow.xml",
        '<routes><flow id="f" type="drivers" begin="0" end="150" period="1.5" from="ab" to="ab"/></routes>',
    )
    net = ["--node-files", "nodes.xml", "--edge-files", "edges.xml", "--output-file", "net.xml"]
    subprocess.run([sumo_program("netconvert"), *net], cwd=tmp_path, check=True, capture_output=True)
    options = ["--net-file", "net.xml", "--route-files", "flow.xml", "--step-length", "0.1"]
    out = ["--additional-files", str(files["drivers.add.xml"]), "--tripinfo-output", "trips.xml"]
    ended = subprocess.run(
        [sumo_program("sumo"), *options, *out], cwd=tmp_path, capture_output=True, text=True, check=True
    )
    assert "Warning" not in ended.stderr
    trips = ElementTree.parse(tmp_path / "trips.xml").getroot()
    assert len(trips) == 100
    assert len({trip.get("vType") for trip in trips}) > 15
    drawn = draws(known.fitted.car_following, known.fitted.population.population.any_pair, SIZE, seed=1)
    vtypes = list(ElementTree.parse(files["drivers.add.xml"]).getroot().iter("vType"))
    names = [parameter.attribute for parameter in known.fitted.car_following.parameters]
    found = [[float(vtype.attrib[name]) for name in names] for vtype in vtypes]
    np.testing.assert_allclose(found, np.exp(drawn), rtol=1e-5)
    assert {vtype.attrib["carFollowModel"] for vtype in vtypes} == {"IDM"}


def test_speeds_go_with_the_limit_where_it_is_known() -> None:
    model = MODELS["IDM"]
    attributes = model.vtype(model.usual, speed_limit_mps=25.0)
    assert float(attributes["speedFactor"]) == pytest.approx(33.3 / 25.0)
    assert model.vtype(model.usual)["speedFactor"] == "1"


def test_scenes_read_the_population_and_draw_from_it(
    known: KnownFit, files: dict[str, Path], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    population = read_population(read_yaml(files["population.yaml"]).content["population"])
    drawn = np.exp(draws(known.fitted.car_following, known.fitted.population.population.any_pair, SIZE, seed=1))
    assert population == Population(
        members=SIZE, fitted=tuple(FittedDriver(*map(float, row)) for row in drawn[:, 1:].round(4))
    )
    found = run(capsys, "record", "--config", files["population.yaml"], "--out", tmp_path / "data", "--windows", "50")
    assert found["windows"] >= 50


def test_the_picture_shows_every_parameter(files: dict[str, Path]) -> None:
    picture = np.asarray(Image.open(files["drivers.png"]).convert("RGB")).astype(int)
    red = (picture[..., 0] > 150) & (picture[..., 1] < 60) & (picture[..., 2] < 80)  # SUMO's defaults
    columns = np.flatnonzero(red.sum(axis=0) > 0.2 * picture.shape[0])
    assert len(np.flatnonzero(np.diff(columns) > 50)) + 1 == 5
