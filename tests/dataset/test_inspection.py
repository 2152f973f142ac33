"""Inspection of a dataset, against pandas on all of it at once."""

import json
import shutil
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from hypothesis import given
from hypothesis import strategies as st
from PIL import Image

from tint_sumo.config import AGGRESSIVE, CONSERVATIVE
from tint_sumo.core.errors import InputError
from tint_sumo.dataset.inspection import QUANTILES, Distribution, Inspection, TraitStatistics, inspect, plot, report
from tint_sumo.dataset.schema import DRIVERS, MANIFEST, TRAJECTORIES, read_manifest

CENTS = st.lists(st.integers(0, 400), min_size=1, max_size=50).map(lambda cents: np.array(cents) / 100)


@given(CENTS, CENTS)
def test_parts_add_up(first: np.ndarray, second: np.ndarray) -> None:
    both = np.r_[first, second]
    added = Distribution.of(pd.Series(first)) + Distribution.of(pd.Series(second))
    assert np.repeat(added.value, added.count) == pytest.approx(np.sort(both))
    summary = added.summary()
    assert summary["count"] == len(both)
    assert summary["mean"] == pytest.approx(both.mean(), abs=1e-4)
    assert summary["sd"] == pytest.approx(both.std(), abs=1e-4)
    assert (summary["min"], summary["max"]) == (both.min(), both.max())
    for fraction in QUANTILES:
        assert added.quantile(fraction) == pytest.approx(np.quantile(both, fraction, method="inverted_cdf"))


def test_nulls_do_not_count() -> None:
    assert Distribution.of(pd.Series([np.nan, 2.0, np.nan])).summary()["count"] == 1
    assert Distribution.of(pd.Series([np.nan])).summary() == {"count": 0}


def test_summaries_are_those_of_the_tables(two_shards: Path) -> None:
    found = inspect(two_shards, progress=False)
    rows, drivers = (pd.read_parquet(two_shards / part) for part in (TRAJECTORIES, DRIVERS))
    rows = rows.merge(drivers, on=["episode", "vehicle"])
    for trait, one in found.summary()["traits"].items():
        mine = rows[rows["trait"] == trait]
        assert one["rows"] == len(mine) > 1000
        assert one["drivers"] == (drivers["trait"] == trait).sum()
        for column in ("speed_mps", "gap_m"):
            summary = one[column]
            assert summary["count"] == mine[column].count()
            assert summary["mean"] == pytest.approx(mine[column].mean(), abs=0.005)
            assert summary["sd"] == pytest.approx(mine[column].std(), abs=0.005)
            for fraction in QUANTILES:
                assert summary[f"q{100 * fraction:g}"] == pytest.approx(mine[column].quantile(fraction), abs=0.011)
        times = mine.groupby(["episode", "vehicle"])["time_s"]
        assert one["track_s"]["mean"] == pytest.approx((times.max() - times.min()).mean(), abs=0.005)
    assert found.episode_s.summary()["count"] == rows["episode"].nunique() == 32
    assert found.episode_s.value == pytest.approx([50.0])
    assert found.drivers_per_episode.summary()["mean"] == pytest.approx(len(drivers) / 32, abs=1e-4)
    json.dumps(found.summary())


def test_the_report_shows_the_manifest_and_every_distribution(dataset: Path) -> None:
    text = report(inspect(dataset, progress=False))
    for key, value in json.loads((dataset / MANIFEST).read_text()).items():
        assert f"{key} " in text
        assert isinstance(value, dict) or str(value) in text
    for trait in ("conservative", "aggressive"):
        assert f"{trait}, speed (m/s) " in text


def test_the_figure(dataset: Path, tmp_path: Path) -> None:
    plot(inspect(dataset, progress=False), tmp_path / "figure.png")
    with Image.open(tmp_path / "figure.png") as image:
        colours = {colour[:3] for _, colour in image.convert("RGB").getcolors(2**24)}
    for profile in (CONSERVATIVE, AGGRESSIVE):
        assert tuple(map(int, profile.colour.split(","))) in colours


def test_a_trait_that_no_driver_has(dataset: Path, tmp_path: Path) -> None:
    some = Distribution.of(pd.Series([2.4]))
    lonely = Inspection(
        read_manifest(dataset),
        {"conservative": TraitStatistics(1, 1, some, some, some), "aggressive": TraitStatistics()},
        some,
        some,
    )
    plot(lonely, tmp_path / "figure.png")
    assert "no drivers: aggressive" in report(lonely)


@pytest.mark.parametrize("part", [TRAJECTORIES, DRIVERS])
def test_missing_and_damaged_files(part: str, dataset: Path, tmp_path: Path) -> None:
    copy = tmp_path / "copy"
    shutil.copytree(dataset, copy)
    file = next((copy / part).iterdir())
    file.write_bytes(file.read_bytes()[:100])
    with pytest.raises(InputError, match=f"{file.name} is damaged"):
        inspect(copy, progress=False)
    file.unlink()
    with pytest.raises(InputError, match=f"{file.name} is missing; repeat the command"):
        inspect(copy, progress=False)


def test_rows_without_a_driver(dataset: Path, tmp_path: Path) -> None:
    copy = tmp_path / "copy"
    shutil.copytree(dataset, copy)
    file = next((copy / DRIVERS).iterdir())
    drivers = pd.read_parquet(file)
    drivers.loc[0, "vehicle"] = 9999
    drivers.to_parquet(file)
    with pytest.raises(InputError, match=r"has \d+ of \d+ rows with their drivers"):
        inspect(copy, progress=False)
