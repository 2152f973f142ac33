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
        ("empty.csv", "", "known format"),
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
