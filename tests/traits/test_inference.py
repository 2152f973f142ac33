from pathlib import Path

import numpy as np
import pandas as pd
import pytest
import torch

from tint_sumo.config import TraitSettings
from tint_sumo.core.errors import InputError
from tint_sumo.core.files import shipped
from tint_sumo.dataset.recorder import record
from tint_sumo.dataset.schema import TRAJECTORIES
from tint_sumo.dataset.windows import load_windows
from tint_sumo.traits import TRAIT_METHODS, load
from tint_sumo.traits.evaluation import encode_windows
from tint_sumo.traits.inference import infer_traits, outside_lines, write_table
from tint_sumo.traits.storage import save
from tint_sumo.traits.streaming import evidence, posterior

NET = shipped("sumo_net") / "tint.net.xml"
KEYS = ["vehicle", "window", "start_s", "end_s", "steps", "has_leader"]
OUTSIDE_COLUMNS = ["outside", "outside_input", "outside_step", "outside_m", "trained_low_m", "trained_high_m"]
LATENTS, STDS = ["latent_1", "latent_2"], ["std_1", "std_2"]


@pytest.fixture(scope="module")
def dataset(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("data") / "dataset"
    record(folder, 100, seed=5, workers=2, fcd=True, progress=False)  # this process's libsumo stays free
    return folder


@pytest.fixture(scope="module")
def cross_window(tmp_path_factory: pytest.TempPathFactory, small: TraitSettings) -> Path:
    """A model nobody trained, of some uncertainty."""
    with torch.random.fork_rng():
        torch.manual_seed(0)
        model = TRAIT_METHODS["cross_window"](small)
    stem = tmp_path_factory.mktemp("model") / "model"
    save(model, stem, {"seed": 0})
    return stem.parent


def test_a_dataset_gives_the_latents_of_its_windows(dataset: Path) -> None:
    table = infer_traits(dataset, "vae")
    windows = load_windows(dataset)
    expected = encode_windows(load("vae"), windows)
    np.testing.assert_allclose(table[LATENTS], expected.mean, atol=1e-5)
    np.testing.assert_allclose(table[STDS], expected.std, rtol=1e-4)
    assert list(table) == [*KEYS, *LATENTS, *STDS, *OUTSIDE_COLUMNS]
    assert table["outside"].mean() < 0.01
    np.testing.assert_array_equal(table["steps"], windows.length)
    np.testing.assert_allclose(table["end_s"] - table["start_s"], 0.1 * (table["steps"] - 1), atol=1e-3)
    assert table.groupby("vehicle", observed=True)["window"].apply(lambda part: list(part) == [*range(len(part))]).all()
    near = windows.has_leader & (windows.states[:, :, 1] < 20.0).all(axis=1)  # zero after the window's length
    np.testing.assert_array_equal(table["has_leader"], near)


def test_floating_car_data_give_nearly_the_same(dataset: Path) -> None:
    """Two decimals of the speeds are left of the displacements."""
    exact = infer_traits(dataset, "vae")
    rounded = infer_traits(dataset / "fcd" / "shard-00000.xml.gz", "vae", net_file=NET)
    both = exact.merge(rounded, on=KEYS, suffixes=("", "_fcd"))
    assert len(both) > 0.99 * len(exact) == 0.99 * len(rounded)
    error = np.abs(both[LATENTS].to_numpy() - both[[f"{name}_fcd" for name in LATENTS]].to_numpy())
    assert np.median(error) < 0.01
    assert error.max() < 0.2
    assert exact[LATENTS].std().min() > 1.0


def test_running_fusion_is_the_fusion_of_the_windows_so_far(dataset: Path, cross_window: Path) -> None:
    table = infer_traits(dataset / TRAJECTORIES, cross_window)
    assert list(table)[-4:] == ["fused_latent_1", "fused_latent_2", "fused_std_1", "fused_std_2"]
    longest = table["vehicle"].value_counts().index[:3]
    for _, part in table[table["vehicle"].isin(longest)].groupby("vehicle", observed=True):
        assert len(part) > 3
        for windows in range(1, len(part) + 1):
            mean, std = (torch.tensor(part[columns].to_numpy()[:windows]) for columns in (LATENTS, STDS))
            fused, fused_std = posterior(evidence(mean, 2 * std.log()).sum(dim=1))
            now = part.iloc[windows - 1]
            np.testing.assert_allclose(now[["fused_latent_1", "fused_latent_2"]].astype(float), fused, rtol=1e-4)
            np.testing.assert_allclose(now[["fused_std_1", "fused_std_2"]].astype(float), fused_std, rtol=1e-4)


def test_a_vehicle_that_comes_back_goes_on_counting(tmp_path: Path, cross_window: Path) -> None:
    steps = "".join(
        f'<timestep time="{time:.1f}"><vehicle id="a" lane="e_0" pos="{time:.2f}" speed="1.00"/></timestep>'
        for time in [*np.arange(0.0, 2.25, 0.1), *np.arange(5.0, 5.65, 0.1), 9.0]
    )
    (tmp_path / "fcd.xml").write_text(f"<fcd-export>{steps}</fcd-export>")
    table = infer_traits(tmp_path / "fcd.xml", cross_window)
    assert table[["window", "start_s", "end_s", "steps"]].to_numpy().tolist() == [
        [0.0, 0.0, 1.9, 20.0],
        [1.0, 2.0, 2.2, 3.0],
        [2.0, 5.0, 5.6, 7.0],
    ]
    assert table["fused_std_1"].is_monotonic_decreasing


def test_no_window_is_no_table(tmp_path: Path) -> None:
    steps = "".join(
        f'<timestep time="{time:.2f}"><vehicle id="a" lane="e_0" pos="1" speed="1"/></timestep>' for time in (0.0, 0.05)
    )
    (tmp_path / "fcd.xml").write_text(f"<fcd-export>{steps}</fcd-export>")
    with pytest.raises(InputError, match="2 steps"):
        infer_traits(tmp_path / "fcd.xml", "vae")


@pytest.mark.parametrize("suffix", ["csv", "parquet"])
def test_tables_come_back_as_they_were(tmp_path: Path, dataset: Path, suffix: str) -> None:
    table, file = infer_traits(dataset, "vae"), tmp_path / f"table.{suffix}"
    write_table(table, file)
    found = pd.read_csv(file, dtype={"vehicle": str}) if suffix == "csv" else pd.read_parquet(file)
    assert found["vehicle"].astype(str).tolist() == table["vehicle"].astype(str).tolist()
    pd.testing.assert_frame_equal(
        found.drop(columns="vehicle"), table.drop(columns="vehicle"), check_dtype=False, rtol=1e-6
    )
    assert [path.name for path in tmp_path.iterdir()] == [file.name]


def test_inputs_that_the_training_had_not_are_named(tmp_path: Path) -> None:
    steps = "".join(
        f'<timestep time="{time:.1f}"><vehicle id="a" lane="e_0" pos="{30 * time:.2f}" speed="30.00"/></timestep>'
        for time in np.arange(0.0, 1.95, 0.1)
    )
    (tmp_path / "fcd.xml").write_text(f"<fcd-export>{steps}</fcd-export>")
    table = infer_traits(tmp_path / "fcd.xml", "vae")
    (row,) = table[OUTSIDE_COLUMNS].to_dict("records")
    assert (row["outside"], row["outside_input"], row["outside_step"]) == (True, "offset", 20)
    assert row["outside_m"] == pytest.approx(0.1 * 30.0 * 19, abs=0.1)
    assert 0.0 <= row["trained_low_m"] < row["trained_high_m"] < 10.0
    (line,) = outside_lines(table)
    assert line.startswith("  offset: 100.0% of the windows, such as 57.0 m at step 20 of vehicle a's window at 0.0 s;")
    assert line.endswith(" m there")
