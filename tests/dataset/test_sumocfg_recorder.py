"""Recording a SUMO configuration, and learning from that."""

import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from tests.dataset.test_recorder import contents
from tests.scenes.networks import USER_NETWORKS, UserNetwork, write_config
from tint_sumo.cli import main
from tint_sumo.config import TraitSettings
from tint_sumo.core.errors import InputError
from tint_sumo.dataset.inspection import Distribution, Inspection, TraitStatistics, _boxes, inspect, plot
from tint_sumo.dataset.schema import DRIVERS, MANIFEST, TRAJECTORIES, read_manifest, shard_file
from tint_sumo.dataset.shards import EPISODE_STEPS
from tint_sumo.dataset.sumocfg_recorder import EPISODES_PER_SHARD, record_sumocfg
from tint_sumo.dataset.windows import load_labels, load_windows
from tint_sumo.traits.datasets import evaluate_traits, plot_traits, train_traits

Make = Callable[[str], UserNetwork]
TWO_SHARDS = 2000
TINY = TraitSettings((8,), 8, 8, 8, epochs=1)


@pytest.fixture(scope="module")
def merge_data(user_network: Make, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two shards."""
    folder = tmp_path_factory.mktemp("merge_data")
    record_sumocfg(user_network("merge").sumocfg, folder, TWO_SHARDS, progress=False)
    return folder


@pytest.mark.parametrize("name", USER_NETWORKS)
def test_every_network_is_recorded_in_steps_of_windows(name: str, user_network: Make, tmp_path: Path) -> None:
    network = user_network(name)
    manifest = record_sumocfg(network.sumocfg, tmp_path / "d", 100, progress=False)
    rows = pd.read_parquet(tmp_path / "d" / TRAJECTORIES)
    drivers = pd.read_parquet(tmp_path / "d" / DRIVERS)
    assert manifest.traits == network.scene().vtypes
    assert manifest.scene == network.sumocfg.stem
    assert (manifest.episodes, manifest.rows, manifest.drivers) == (
        EPISODES_PER_SHARD,
        len(rows),
        len(drivers),
    )
    assert rows["time_s"].max() == pytest.approx(EPISODE_STEPS * 0.1)
    keys = ["episode", "vehicle"]
    assert rows.set_index([*keys, "time_s"]).index.is_monotonic_increasing
    tracks = rows.groupby(keys)
    np.testing.assert_allclose(tracks["time_s"].diff().dropna(), 0.1, atol=1e-4)
    moved_m = tracks["position_m"].diff()
    seen = moved_m.notna()
    np.testing.assert_allclose(moved_m[seen], 0.1 * rows["speed_mps"][seen], atol=1e-3)
    assert rows["acceleration_mps2"].notna().equals(seen)
    assert rows["leader"].isna().equals(rows["gap_m"].isna())
    assert set(rows["route"]) == {""}
    assert not drivers.duplicated(keys).any()
    assert set(map(tuple, drivers[keys].to_numpy())) == set(map(tuple, rows[keys].drop_duplicates().to_numpy()))
    assert set(drivers["trait"]) <= set(manifest.traits)


def test_drivers_have_what_their_vtype_says(merge_data: Path) -> None:
    drivers = pd.read_parquet(merge_data / DRIVERS)
    for vtype, gap_m, tau_s, speed_mps in (("calm", 3.0, 1.5, 7.0), ("hasty", 1.0, 0.8, 11.0)):
        mine = drivers[drivers["vtype"] == vtype]
        assert len(mine) > 20
        assert (mine["trait"] == vtype).all()
        assert mine["min_gap_m"].unique() == pytest.approx([gap_m])
        assert mine["tau_s"].unique() == pytest.approx([tau_s])
        assert mine["desired_speed_mps"].mean() == pytest.approx(speed_mps, rel=0.1)  # times factors around 1


def test_leaders_drive_ahead_by_the_gap(merge_data: Path) -> None:
    rows = pd.read_parquet(merge_data / TRAJECTORIES)
    keys = ["episode", "time_s"]
    leaders = rows[[*keys, "vehicle", "position_m"]].rename(columns={"vehicle": "leader", "position_m": "ahead_m"})
    both = (
        rows.dropna(subset=["leader"])
        .astype({"leader": int})
        .merge(leaders.astype({"leader": int}), on=[*keys, "leader"])
    )
    assert len(both) == rows["leader"].notna().sum() > 1000
    close = both["gap_m"] < 5.0
    same_start = (both["ahead_m"] - both["position_m"] - 5.0 - both["gap_m"]).abs() < 1e-3
    assert same_start[close].mean() > 0.5  # the others have started on the other road


def test_the_dataset_is_the_same_with_workers_and_after_an_interruption(
    merge_data: Path, user_network: Make, tmp_path: Path
) -> None:
    sumocfg = user_network("merge").sumocfg
    record_sumocfg(sumocfg, tmp_path / "workers", TWO_SHARDS, workers=2, progress=False)
    assert contents(tmp_path / "workers") == contents(merge_data)
    interrupted = Path(shutil.copytree(merge_data, tmp_path / "interrupted"))
    (interrupted / MANIFEST).unlink()
    shard_file(interrupted, TRAJECTORIES, 1).unlink()
    manifest = record_sumocfg(sumocfg, interrupted, TWO_SHARDS, progress=False)
    assert contents(interrupted) == contents(merge_data)
    assert manifest == read_manifest(merge_data)
    assert manifest.shards == 2


def test_a_vehicle_that_sumo_teleports_appears_anew(user_network: Make, tmp_path: Path) -> None:
    merge = user_network("merge")
    (merge.sumocfg.parent / "jam.rou.xml").write_text(
        '<routes><vehicle id="first" depart="0" departPos="90"><route edges="ramp out"/>'
        '<stop lane="ramp_0" endPos="90" duration="1000"/></vehicle>'
        '<vehicle id="second" depart="0" departPos="60"><route edges="ramp out"/></vehicle></routes>'
    )
    config = merge.sumocfg.with_name("jam.sumocfg")
    write_config(config, "merge.net.xml", "jam.rou.xml", '<time-to-teleport value="5"/>')
    record_sumocfg(config, tmp_path / "d", 10, progress=False)
    rows = pd.read_parquet(tmp_path / "d" / TRAJECTORIES)
    first = rows[rows["episode"] == 0]
    assert sorted(first["vehicle"].unique()) == [0, 1, 2]
    assert first.groupby("vehicle")["position_m"].diff().max() < 2.0


def test_a_vehicle_is_not_recorded_while_it_parks_beside_the_road(user_network: Make, tmp_path: Path) -> None:
    net = str(user_network("merge").sumocfg.with_name("merge.net.xml"))
    (tmp_path / "park.rou.xml").write_text(
        '<routes><vehicle id="parks" depart="0"><route edges="ramp out"/>'
        '<stop lane="ramp_0" endPos="50" duration="20" parking="true"/></vehicle>'
        '<vehicle id="passes" depart="12"><route edges="ramp out"/></vehicle></routes>'
    )
    record_sumocfg(write_config(tmp_path / "park.sumocfg", net, "park.rou.xml"), tmp_path / "d", 10, progress=False)
    rows = pd.read_parquet(tmp_path / "d" / TRAJECTORIES)
    before, passes, after = (rows[(rows["episode"] == 0) & (rows["vehicle"] == number)] for number in range(3))
    assert before["time_s"].max() + 20.0 == pytest.approx(after["time_s"].min(), abs=0.2)
    assert before["position_m"].max() == pytest.approx(after["position_m"].min(), abs=0.2)
    assert passes["position_m"].iloc[-1] > 100.0
    alone = passes["time_s"] < after["time_s"].min()
    assert alone.any()
    assert passes["leader"][alone].isna().all()


def test_a_folder_is_of_one_configuration_and_seed(merge_data: Path, user_network: Make, tmp_path: Path) -> None:
    network = user_network("merge")
    with pytest.raises(InputError, match="different: seed"):
        record_sumocfg(network.sumocfg, merge_data, TWO_SHARDS, seed=1, progress=False)
    folder = Path(shutil.copytree(network.sumocfg.parent, tmp_path / "merge"))
    routes = folder / "merge.rou.xml"
    routes.write_text(routes.read_text().replace('tau="0.8"', 'tau="0.9"'))
    with pytest.raises(InputError, match="different: scene_digest"):
        record_sumocfg(folder / network.sumocfg.name, merge_data, TWO_SHARDS, progress=False)


def test_a_trait_model_learns_from_it(merge_data: Path, tmp_path: Path) -> None:
    windows = load_windows(merge_data)
    labels = load_labels(merge_data, windows)
    assert labels.dtype == np.int64
    assert set(labels.tolist()) == {0, 1}
    for method in ("vae", "classifier"):
        train_traits(merge_data, tmp_path / method, method=method, settings=TINY)
        assert 0.0 < evaluate_traits(merge_data, tmp_path / method)["accuracy"] <= 1.0
        assert plot_traits(merge_data, tmp_path / method, tmp_path / "pictures")


def test_the_classifier_needs_two_vtypes(user_network: Make, tmp_path: Path) -> None:
    record_sumocfg(user_network("braunschweig").sumocfg, tmp_path / "d", 100, progress=False)
    with pytest.raises(InputError, match="exactly two kinds of drivers, and the dataset has 3; choose"):
        train_traits(tmp_path / "d", tmp_path / "c", method="classifier", settings=TINY)
    assert not (tmp_path / "c").exists()


def test_the_dataset_can_be_inspected(merge_data: Path, tmp_path: Path) -> None:
    found = inspect(merge_data, progress=False)
    assert set(found.traits) == {"calm", "hasty"}
    assert found.traits["calm"].speed_mps.quantile(1.0) < found.traits["hasty"].speed_mps.quantile(1.0)
    plot(found, tmp_path / "found.png")
    assert (tmp_path / "found.png").stat().st_size > 10_000


def test_the_figure_of_many_vtypes_names_those_that_drive_and_has_room_for_them(merge_data: Path) -> None:
    values = Distribution.of(pd.Series([0.0, 2.0, 400.0]))
    traits = {f"vtype_{one}": TraitStatistics(one, one, values, values, values) for one in range(40)}
    figure = _boxes(Inspection(replace(read_manifest(merge_data), windows=7), traits, values, values))
    speed, *_ = figure.axes
    names = [label.get_text() for label in speed.get_yticklabels()]
    assert names == [f"vtype_{one} ({one} drivers)" for one in range(39, 15, -1)]
    assert len(speed.patches) == len(names) and figure.get_figheight() > 10
    assert speed.get_xlim()[1] >= 400.0
    assert "16 vTypes with fewer drivers or none are left out" in figure.get_suptitle()


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--sumocfg", "nowhere.sumocfg"], "no file"),
        (["--sumocfg", "{merge}", "--windows", "0"], "windows must lie in 1 to 100,000,000"),
        (["--sumocfg", "{merge}", "--p-conservative", "0.3"], "--p-conservative does not go with --sumocfg"),
        (["--sumocfg", "{merge}", "--format", "fcd"], "--format does not go with --sumocfg"),
        (["--sumocfg", "{empty}"], "no vehicle drives in the first 50 s"),
        (["--sumocfg", "{wrong}"], "SUMO does not run"),
    ],
)
def test_bad_input_is_refused_in_one_line(
    arguments: list[str], message: str, user_network: Make, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    merge = user_network("merge")
    others = {"merge": merge.sumocfg}
    for name, routes in (("empty", ""), ("wrong", '<vehicle id="a" depart="9"><route edges="nowhere"/></vehicle>')):
        (merge.sumocfg.parent / f"{name}.rou.xml").write_text(f"<routes>{routes}</routes>")
        config = merge.sumocfg.with_name(f"{name}.sumocfg")
        others[name] = write_config(config, "merge.net.xml", f"{name}.rou.xml")
    given = [argument.format(**others) for argument in arguments]
    assert main(["record", "--out", str(tmp_path / "d"), *given]) == 2
    lines = capsys.readouterr().err.strip().splitlines()
    assert message in lines[-1]
    assert lines[-1].startswith("tint-sumo: error: ")
