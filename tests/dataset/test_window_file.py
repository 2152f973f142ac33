"""Windows in a file, against the same ones in memory."""

import resource
from collections.abc import Iterator
from dataclasses import fields
from pathlib import Path

import numpy as np
import pytest

from tint_sumo.core.errors import InputError
from tint_sumo.dataset import window_file as module
from tint_sumo.dataset.window_file import WindowFile, window_file
from tint_sumo.dataset.windows import Windows, load_labels, load_windows, read_windows


@pytest.fixture
def stored(two_shards: Path, tmp_path: Path) -> Iterator[WindowFile]:
    with window_file(read_windows(two_shards), tmp_path) as windows:
        yield windows


def assert_same(one: Windows, other: Windows) -> None:
    for field in fields(Windows):
        here, there = getattr(one, field.name), getattr(other, field.name)
        np.testing.assert_array_equal(here, there)
        assert here.dtype == there.dtype
        assert here.flags.writeable  # what torch asks for


def test_chosen_windows_come_in_the_order_asked_for(stored: WindowFile, two_shards: Path) -> None:
    windows = load_windows(two_shards)
    assert len(stored) == len(windows)
    for size in (1, 500):
        index = np.random.default_rng(0).integers(len(windows), size=size)
        assert_same(stored[index], windows[index])


def test_parts_hold_every_window_once(stored: WindowFile, two_shards: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(module, "PART", 1000)
    windows, parts = load_windows(two_shards), list(stored.parts())
    assert [len(part) for part in parts[:-1]] == [1000] * (len(windows) // 1000)
    for number, part in enumerate(parts):
        assert_same(part, windows[1000 * number : 1000 * (number + 1)])


def test_labels_are_those_of_the_windows_in_memory(stored: WindowFile, two_shards: Path) -> None:
    np.testing.assert_array_equal(load_labels(two_shards, stored), load_labels(two_shards, load_windows(two_shards)))


def test_the_file_leaves_no_trace_in_a_folder_that_may_not_be_there_yet(dataset: Path, tmp_path: Path) -> None:
    with window_file(read_windows(dataset), tmp_path / "runs" / "model") as windows:
        assert list(tmp_path.iterdir()) == []
        assert len(windows) > 0
    with window_file([], tmp_path) as nothing:
        assert len(nothing) == 0
        assert list(nothing.parts()) == []


def test_a_disk_without_room(dataset: Path, tmp_path: Path) -> None:
    limits = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (100_000, limits[1]))
    try:
        with (
            pytest.raises(InputError, match=r"has no room for the windows \(File too large\); free some"),
            window_file(read_windows(dataset), tmp_path),
        ):
            pass
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)
    assert list(tmp_path.iterdir()) == []
