"""Manifests and tables that are not as they were recorded."""

import json
import shutil
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest

from tint_sumo.core.errors import InputError
from tint_sumo.dataset.schema import MANIFEST, TRAJECTORIES, read_manifest, read_shard, verify
from tint_sumo.dataset.windows import load_windows


def test_a_missing_dataset(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"dataset: no file .*manifest\.json; check the path"):
        load_windows(tmp_path)


def test_another_schema_version(dataset: Path, tmp_path: Path) -> None:
    shutil.copytree(dataset, tmp_path / "d")
    manifest = json.loads((tmp_path / "d" / MANIFEST).read_text())
    (tmp_path / "d" / MANIFEST).write_text(json.dumps(manifest | {"schema_version": 0}))
    with pytest.raises(InputError, match="schema version 0, this tint_sumo reads 2; record it anew"):
        load_windows(tmp_path / "d")


@pytest.mark.parametrize("keep", [0, 100, 5000])
def test_a_damaged_shard(dataset: Path, tmp_path: Path, keep: int) -> None:
    shutil.copytree(dataset, tmp_path / "d")
    file = next((tmp_path / "d" / TRAJECTORIES).iterdir())
    file.write_bytes(file.read_bytes()[:keep])
    with pytest.raises(InputError, match=r"shard-00000.parquet is damaged .*; remove it and repeat the command"):
        load_windows(tmp_path / "d")


def test_rows_that_are_missing(dataset: Path, tmp_path: Path) -> None:
    shutil.copytree(dataset, tmp_path / "d")
    file = next((tmp_path / "d" / TRAJECTORIES).iterdir())
    pd.read_parquet(file).iloc[1:].to_parquet(file)
    with pytest.raises(InputError, match=r"trajectories has \d+ of \d+ rows; repeat the command"):
        load_windows(tmp_path / "d")


@pytest.mark.parametrize("key", ["rows", "seed"])
def test_a_manifest_that_lacks_something(dataset: Path, tmp_path: Path, key: str) -> None:
    shutil.copytree(dataset, tmp_path / "d")
    manifest = json.loads((tmp_path / "d" / MANIFEST).read_text())
    del manifest[key]
    (tmp_path / "d" / MANIFEST).write_text(json.dumps(manifest))
    with pytest.raises(InputError, match=f"damaged \\({key} must be given\\); record the dataset anew"):
        load_windows(tmp_path / "d")


@pytest.mark.parametrize(
    ("wrong", "message"),
    [
        ({"shards": 10**30}, "shards: must lie in 0 to 1,000,000, not 1000000"),
        ({"shards": "two"}, "shards: must be a whole number from 0 to 1,000,000, not 'two'"),
        ({"rows": -1}, "rows: must lie in 0 to"),
        ({"scene": ["a"]}, "scene: must be text"),
        ({"p_conservative": 7}, r"p_conservative: P\(conservative\) must be a probability"),
        ({"sha256": {"a": 1}}, "sha256"),
    ],
)
def test_a_manifest_with_wrong_values(dataset: Path, tmp_path: Path, wrong: dict[str, Any], message: str) -> None:
    manifest = json.loads((dataset / MANIFEST).read_text())
    (tmp_path / MANIFEST).write_text(json.dumps(manifest | wrong))
    with pytest.raises(InputError, match=r"manifest\.json is damaged \(.*" + message):
        load_windows(tmp_path)


@pytest.mark.parametrize(
    ("column", "value", "message"),
    [
        ("position_m", np.nan, "has values in position_m that are not finite"),
        ("speed_mps", np.inf, "has values in speed_mps that are not finite"),
        ("gap_m", -np.inf, "has values in gap_m that are not finite"),
        ("position_m", "far", "has other values than numbers in position_m"),
        ("position_m", True, "has other values than numbers in position_m"),
    ],
)
def test_tables_with_other_values_than_finite_numbers(
    dataset: Path, tmp_path: Path, column: str, value: Any, message: str
) -> None:
    file = shutil.copytree(dataset, tmp_path / "d") / TRAJECTORIES / "shard-00000.parquet"
    rows = pd.read_parquet(file)
    rows[column] = value if isinstance(value, str | bool) else rows[column].where(rows.index != 5, value)
    rows.to_parquet(file)
    with pytest.raises(InputError, match=message):
        read_shard(file)
    with pytest.raises(InputError, match=r"shard-00000\.parquet is not as it was recorded"):
        verify(tmp_path / "d", read_manifest(tmp_path / "d"))


def test_files_are_verified(dataset: Path, tmp_path: Path) -> None:
    manifest = read_manifest(dataset)
    assert verify(dataset, manifest) == 2 * manifest.shards
    with pytest.raises(InputError, match="has no checksums"):
        verify(dataset, replace(manifest, sha256=None))
