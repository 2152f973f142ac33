"""Windows of up to 20 steps for learning traits, from a recorded dataset. Labels are loaded apart."""

import os
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, fields, replace
from pathlib import Path
from tempfile import TemporaryFile
from typing import Protocol, Self

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from tint_sumo.config import (
    MIN_WINDOW_STEPS,
    NO_LEADER_GAP_M,
    WINDOW_STEPS,
)
from tint_sumo.core.errors import InputError
from tint_sumo.dataset.schema import DRIVERS, MANIFEST, TRAJECTORIES, read_manifest, read_shards

_DRIVERS_PER_EPISODE = 100_000
PART = 10_000  # windows that are worked on at a time


@dataclass(frozen=True)
class Windows:
    """N windows of the states x of paper III-B, those of a driver in a row; nothing in them gives the label away.

    A state is the offset from the window's first position and the gap to the leader, in m; zero after ``length``.
    """

    states: NDArray[np.float32]  # (N, 20, 2)
    length: NDArray[np.int64]  # (N,): valid steps, 2 to 20
    driver: NDArray[np.int64]  # (N,): one number per driver, the same in all its windows
    episode: NDArray[np.int64]  # (N,)
    has_leader: NDArray[np.bool_]  # (N,): at every valid step

    def __len__(self) -> int:
        return len(self.length)

    def __getitem__(self, index: NDArray[np.integer] | NDArray[np.bool_] | slice) -> Self:
        """Return the windows at these indices."""
        return type(self)(**{field.name: getattr(self, field.name)[index] for field in fields(self)})

    def parts(self) -> Iterator[Self]:
        """Yield all windows in their order, some thousands at a time."""
        for start in range(0, len(self), PART):
            yield self[start : start + PART]


class HasDriver(Protocol):
    """N windows with the numbers of their drivers."""

    @property
    def driver(self) -> NDArray[np.int64]:
        """(N,) as in ``Windows``."""


def load_windows(folder: Path) -> Windows:
    """Return all windows of a dataset; its tracks are cut into windows of 20 steps, and a remainder of at least 2.

    Raises:
        InputError: no dataset there, an unfinished or damaged one, or one of another schema version.
    """
    count = read_manifest(folder).windows
    whole = Windows(**{name: np.empty(count, _RECORD[name]) for name in _RECORD.names or ()})
    done = 0
    for part in read_windows(folder):
        for field in fields(Windows):
            getattr(whole, field.name)[done : done + len(part)] = getattr(part, field.name)
        done += len(part)
    return whole


def read_windows(folder: Path) -> Iterator[Windows]:
    """Yield the windows of a dataset, shard after shard; all windows of an episode are in one shard.

    Raises:
        InputError: no dataset there, an unfinished or damaged one, or one of another schema version.
    """
    manifest = read_manifest(folder)
    missing = manifest.windows
    for rows in read_shards(folder, TRAJECTORIES, manifest, ["episode", "vehicle", "position_m", "gap_m"]):
        gap_m = rows["gap_m"].fillna(np.inf).to_numpy()  # in tables a missing leader is null
        windows = cut_windows(  # rows are sorted by episode, vehicle and time
            _driver_numbers(rows), rows["episode"].to_numpy(), rows["position_m"].to_numpy(), gap_m
        )
        missing -= len(windows)
        if missing < 0:
            break
        yield windows
    if missing != 0:
        raise InputError(f"{folder / TRAJECTORIES} and {folder / MANIFEST} do not agree; record the dataset anew")


def read_training_windows(folder: Path, test_fraction: float, seed: int) -> Iterator[Windows]:
    """Yield the training windows of ``split_by_episode``, shard after shard.

    Raises:
        InputError: as ``read_windows``.
    """
    episode = np.concatenate([np.unique(part.episode) for part in read_windows(folder)])
    test = episodes_to_test(episode, test_fraction, seed)
    for part in read_windows(folder):
        yield part[~np.isin(part.episode, test)]


def cut_windows(
    driver: NDArray[np.int64],
    episode: NDArray[np.integer],
    position_m: NDArray[np.floating],
    gap_m: NDArray[np.floating],
    no_leader_gap_m: float = NO_LEADER_GAP_M,
) -> Windows:
    """Return the windows of rows (M,) that are sorted by driver and time.

    ``gap_m`` is infinite without a leader; in the states it is ``no_leader_gap_m`` at most, which stands for none.
    """
    first, length = window_rows(driver)
    valid = valid_steps(length)
    row = np.where(valid, first[:, None] + np.arange(WINDOW_STEPS), first[:, None])
    states = np.zeros((*valid.shape, 2), np.float32)
    states[..., 0] = position_m[row] - position_m[first, None]
    states[..., 1] = np.where(valid, capped(gap_m, no_leader_gap_m)[row], 0.0)
    has_leader = np.isfinite(gap_m)[row].all(axis=1)
    return Windows(states, length, driver[first], episode[first].astype(np.int64), has_leader)


def window_rows(driver: NDArray[np.int64]) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Return each window's first row (N,) and its number of steps (N,), in rows (M,) sorted by driver and time.

    A driver's windows of 20 steps follow each other; what is left is a window if it has at least 2.
    """
    row = np.arange(len(driver))
    begins = np.r_[True, driver[1:] != driver[:-1]][: len(driver)]
    first = np.flatnonzero((row - np.maximum.accumulate(np.where(begins, row, 0))) % WINDOW_STEPS == 0)
    length = np.diff(first, append=len(driver))
    whole = length >= MIN_WINDOW_STEPS
    return first[whole], length[whole]


def count_windows(trajectories: pd.DataFrame) -> int:
    """Return the number of windows in rows of trajectories, sorted by episode, vehicle and time."""
    return len(window_rows(_driver_numbers(trajectories))[0])


def valid_steps(length: NDArray[np.int64]) -> NDArray[np.bool_]:
    """Return which of 20 steps windows of these lengths (N,) have, (N, 20)."""
    return np.asarray(np.arange(WINDOW_STEPS) < length[:, None])


def capped(gap_m: NDArray[np.floating], no_leader_gap_m: float) -> NDArray[np.floating]:
    """Return gaps to leaders, infinite without one, as trait models read them: ``no_leader_gap_m`` at most."""
    return np.asarray(np.minimum(gap_m, no_leader_gap_m))


def joined(parts: Sequence[Windows]) -> Windows:
    """Return all windows of several datasets, with different numbers for their drivers and episodes."""
    first = np.cumsum([0, *(part.episode.max(initial=0) + 1 for part in parts)])
    moved = [
        replace(part, driver=part.driver + start * _DRIVERS_PER_EPISODE, episode=part.episode + start)
        for part, start in zip(parts, first.tolist(), strict=False)
    ]
    columns = {field.name: np.concatenate([getattr(part, field.name) for part in moved]) for field in fields(Windows)}
    return Windows(**columns)


def load_labels(folder: Path, windows: HasDriver) -> NDArray[np.int64]:
    """Return the number of each window's trait in ``Manifest.traits``, (N,).

    Methods without labels never see it.

    Raises:
        InputError: the labels are missing or do not belong to these windows.
    """
    traits = read_manifest(folder).traits
    drivers, row = _drivers(folder, windows, ["trait"])
    return pd.Index(traits).get_indexer(pd.Index(drivers["trait"].astype(str))).astype(np.int64)[row]


def load_drivers(folder: Path, windows: HasDriver, columns: Sequence[str]) -> pd.DataFrame:
    """Return columns of the label file, such as ``desired_speed_mps``, with a row for each window's driver.

    Raises:
        InputError: the labels are missing or do not belong to these windows.
    """
    drivers, row = _drivers(folder, windows, columns)
    return drivers.iloc[row].reset_index(drop=True)


def _drivers(folder: Path, windows: HasDriver, columns: Sequence[str]) -> tuple[pd.DataFrame, NDArray[np.intp]]:
    """Return columns of the label file, with a row for each driver, and the row of each window's driver."""
    rows = pd.concat(read_shards(folder, DRIVERS, read_manifest(folder), ["episode", "vehicle", *columns]))
    row = pd.Index(_driver_numbers(rows)).get_indexer(pd.Index(windows.driver))
    if (row < 0).any():
        raise InputError(f"{folder / DRIVERS} lacks drivers of these windows; record the dataset anew")
    return rows[list(columns)], row


def split_by_episode(windows: Windows, test_fraction: float, seed: int) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Return indices of training and test windows; no episode, hence no driver, is in both."""
    in_test = np.isin(windows.episode, episodes_to_test(windows.episode, test_fraction, seed))
    return np.flatnonzero(~in_test), np.flatnonzero(in_test)


def episodes_to_test(episode: NDArray[np.int64], test_fraction: float, seed: int) -> NDArray[np.int64]:
    """Return the episodes for tests among these, each named once or more often."""
    episodes = np.unique(episode)
    return np.random.default_rng(seed).permutation(episodes)[: round(test_fraction * len(episodes))]


def _driver_numbers(rows: pd.DataFrame) -> NDArray[np.int64]:
    episode, vehicle = (rows[key].to_numpy(np.int64) for key in ("episode", "vehicle"))
    return np.asarray(episode * _DRIVERS_PER_EPISODE + vehicle)


_RECORD = np.dtype(
    [
        ("states", np.float32, (WINDOW_STEPS, 2)),
        ("length", np.int64),
        ("driver", np.int64),
        ("episode", np.int64),
        ("has_leader", np.bool_),
    ]
)


class WindowFile:
    """N windows in an open file, one record after the other; use ``window_file`` to make one.

    Windows are read, not mapped: the kernel maps up to 2 MiB around every byte that is touched, so that a batch from
    all over the file would bring all of it into the process's memory. Reading is no slower.
    """

    def __init__(self, descriptor: int) -> None:
        self._descriptor = descriptor
        self._count = os.fstat(descriptor).st_size // _RECORD.itemsize

    def __len__(self) -> int:
        return self._count

    def __getitem__(self, index: NDArray[np.integer]) -> Windows:
        """Return the windows at these indices."""
        return _windows(b"".join([self._read(number, 1) for number in index.tolist()]))

    def parts(self) -> Iterator[Windows]:
        """Yield all windows in their order, some thousands at a time."""
        for start in range(0, len(self), PART):
            yield _windows(self._read(start, PART))

    @property
    def driver(self) -> NDArray[np.int64]:
        """(N,) as in ``Windows``."""
        return np.concatenate([part.driver for part in self.parts()])

    def _read(self, first: int, count: int) -> bytes:
        return os.pread(self._descriptor, count * _RECORD.itemsize, first * _RECORD.itemsize)


@contextmanager
def window_file(parts: Iterable[Windows], folder: Path) -> Iterator[WindowFile]:
    """Write all windows of ``parts`` to a file without a name, which is gone after the block or when the process ends.

    Args:
        parts: windows, which are written in their order.
        folder: where the file lies; if it is not there yet, in the nearest folder above it.

    Raises:
        InputError: there is not enough room.
    """
    home = next(nearest for nearest in (folder, *folder.absolute().parents) if nearest.is_dir())
    with TemporaryFile(dir=home, buffering=0) as file:
        for part in parts:
            left = memoryview(_content(part))
            try:
                while left:
                    left = left[file.write(left) :]
            except OSError as error:
                raise InputError(
                    f"{home} has no room for the windows ({error.strerror}); free some or choose another `out`"
                ) from None
        yield WindowFile(file.fileno())


def _content(windows: Windows) -> bytes:
    records = np.empty(len(windows), _RECORD)
    for field in fields(Windows):
        records[field.name] = getattr(windows, field.name)
    return records.tobytes()


def _windows(content: bytes) -> Windows:
    records = np.frombuffer(content, _RECORD)
    return Windows(**{field.name: records[field.name].copy() for field in fields(Windows)})
