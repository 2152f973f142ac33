"""``tint-sumo drivers``."""

import json
from pathlib import Path

import pytest

from tests.cli.calls import refuse
from tests.drivers.recordings import population, simulated_pair, write_pair
from tint_sumo.cli import main
from tint_sumo.core.files import write_text


@pytest.fixture(scope="module")
def fit(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Folder of a fit, with the recording beside it."""
    folder = tmp_path_factory.mktemp("command")
    for number, truth in enumerate(population(2, 0)):
        pair = simulated_pair(truth, number, 200, follower=str(number))
        write_pair(folder / "recording" / f"{number}.csv", pair)
    assert main(["drivers", "fit", str(folder / "recording"), "--out", str(folder / "fit")]) == 0
    return folder / "fit"


def test_fit_reports_the_population_and_writes_it(fit: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["drivers", "fit", str(fit.parent / "recording"), "--out", str(fit), "--json"]) == 0  # is done already
    text, _, last = capsys.readouterr().out.rstrip("\n").rpartition("\n")
    assert "IDM: 2 pairs of 2 drivers" in text
    assert f"wrote {fit / 'fitted.json'}" in text
    assert json.loads(last) == json.loads((fit / "fitted.json").read_text())


def test_bad_recordings_get_one_line(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    for name, text, message in (
        ("empty.csv", "", "is empty"),
        (
            "short.csv",
            "run_no,leader_id,follower_id,xLeaderReal,xFollowerReal\n1,2,3,4,5\n",
            "lacks the column timestamp",
        ),
    ):
        write_text(tmp_path / name, text)
        assert message in refuse(capsys, "drivers", "fit", tmp_path / name, "--out", tmp_path / "fit")
    assert not (tmp_path / "fit").exists()
    assert "shorter than 60 s" in refuse(
        capsys,
        *("drivers", "fit", write_pair(tmp_path / "pair.csv", simulated_pair(population(1, 0)[0]))),
        *("--min-duration", "60", "--out", tmp_path / "fit"),
    )


def test_export_writes_vtypes_population_and_picture(fit: Path, tmp_path: Path) -> None:
    assert main(["drivers", "export", str(fit), "--out", str(tmp_path), "--size", "3", "--speed-limit", "30"]) == 0
    assert sorted(file.name for file in tmp_path.iterdir()) == ["drivers.add.xml", "drivers.png", "population.yaml"]
    assert (tmp_path / "drivers.add.xml").read_text().count("<vType ") == 3


def test_export_replaces_its_own_files_alone(fit: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    words = ["drivers", "export", str(fit), "--out", str(tmp_path), "--size", "2"]
    assert main(words) == main(words) == 0
    capsys.readouterr()
    for name in ("drivers.add.xml", "population.yaml"):
        own = (tmp_path / name).read_text()
        write_text(tmp_path / name, "precious")
        assert f"{name} that tint-sumo did not write; choose another --out" in refuse(capsys, *words)
        assert (tmp_path / name).read_text() == "precious"
        write_text(tmp_path / name, own)


def test_check_prints_the_distances(fit: Path, capsys: pytest.CaptureFixture[str]) -> None:
    words = ["drivers", "check", str(fit), "--recording", str(fit.parent / "recording"), "--repeats", "1", "--json"]
    assert main(words) == 0
    text, _, last = capsys.readouterr().out.rstrip("\n").rpartition("\n")
    assert "createVehTypeDistribution.py" in text
    assert json.loads(last)["repeats"] == 1


def test_what_is_no_fit_is_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    for words in (["export", tmp_path, "--out", tmp_path / "out"], ["check", tmp_path, "--recording", tmp_path]):
        assert "has no fitted.json; fit drivers first" in refuse(capsys, "drivers", *words)
    assert not (tmp_path / "out").exists()
