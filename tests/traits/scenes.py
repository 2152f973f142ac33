"""Windows made by hand."""

import numpy as np
from numpy.typing import NDArray

from tint_sumo.dataset.windows import Windows


def two_populations(drivers: int, windows_each: int = 1, shortest: int = 20) -> tuple[Windows, NDArray[np.bool_]]:
    """Drivers at about 2.4 and 3.0 m/s behind leaders at any distance, and which windows are of the slow ones."""
    generator = np.random.default_rng(2)
    slow = generator.random(drivers) < 0.5
    speed_mps = np.where(slow, 2.4, 3.0) + generator.normal(scale=0.05, size=drivers)
    driver = np.repeat(np.arange(drivers), windows_each)
    offset = speed_mps[driver, None] * 0.1 * np.arange(20)
    gap = np.broadcast_to(generator.uniform(3.0, 12.0, size=(len(driver), 1)), offset.shape)
    windows = Windows(
        states=np.stack((offset, gap), axis=2).astype(np.float32),
        length=generator.integers(shortest, 21, len(driver)),
        driver=driver,
        episode=driver // 10,
        has_leader=np.ones(len(driver), dtype=bool),
    )
    return windows, slow[driver]
