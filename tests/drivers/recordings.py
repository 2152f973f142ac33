"""Simulated recordings with known parameters: followers of SUMO's models behind a leader that stops and goes."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from scipy.signal import lfilter

from tint_sumo.core.files import write_text
from tint_sumo.drivers.models import MODELS, Floats
from tint_sumo.drivers.pairs import Pair

STEP_S = 0.1
HEADER = "run_no,timestamp,leader_id,follower_id,xLeaderReal,vLeaderReal,aLeaderReal,xFollowerReal,vFollowerReal"


def leader_speeds_mps(rows: int, seed: int, mean_mps: float = 20.0) -> Floats:
    """Speeds that rise and fall in waves of 7 to 40 s, and reach 0 once."""
    rng = np.random.default_rng(seed)
    time_s = STEP_S * np.arange(rows)
    waves = sum(
        rng.uniform(1.0, 3.0) * np.sin(2.0 * np.pi * time_s / period_s + rng.uniform(0.0, 6.28))
        for period_s in (40.0, 17.0, 7.0)
    )
    stop = 1.0 - np.exp(-(((time_s - 0.6 * time_s[-1]) / 6.0) ** 2)) * 1.2
    return np.maximum((mean_mps + waves) * stop, 0.0)


def wandering(rows: int, deviation_m: float, seed: int, time_s: float = 5.0) -> Floats:
    """Errors of a recorded position that come and go in some seconds: an AR(1) process that begins at 0."""
    rng = np.random.default_rng((seed, 1))
    keeps = np.exp(-STEP_S / time_s)
    innovations = rng.normal(0.0, deviation_m * np.sqrt(1.0 - keeps**2), rows)
    innovations[0] = 0.0
    return np.asarray(lfilter([1.0], [1.0, -keeps], innovations))


def simulated_pair(
    log_parameters: Floats,
    seed: int = 0,
    rows: int = 600,
    model: str = "IDM",
    follower: str = "1",
    noise_m: float = 0.0,
    start_s: float = 0.0,
    mean_mps: float = 20.0,
) -> Pair:
    """A follower with these parameters; its positions err by ``noise_m``, see ``wandering``."""
    leader_speed_mps = leader_speeds_mps(rows, seed, mean_mps)
    leader_rear_m = 60.0 + np.cumsum(leader_speed_mps) * STEP_S
    front_m, speed_mps = MODELS[model].follow(
        leader_rear_m, leader_speed_mps, 20.0, leader_speed_mps[0], log_parameters, STEP_S
    )
    wander_m = wandering(rows, noise_m, seed)
    return Pair(
        "1", follower, f"leader{seed}", start_s, STEP_S, leader_rear_m, leader_speed_mps, front_m + wander_m, speed_mps
    )


def population(drivers: int, seed: int, spread: float = 0.25) -> list[Floats]:
    """Logarithms of the parameters of some drivers of IDM."""
    rng = np.random.default_rng(seed)
    mean = np.log([30.0, 1.3, 2.5, 1.4, 1.8])
    return [mean + spread * rng.standard_normal(5) * [0.4, 1.0, 1.0, 1.0, 1.0] for _ in range(drivers)]


def write_pair(file: Path, pair: Pair, length_m: float = 5.0) -> Path:
    """Write a pair as a leader-follower file, whose positions are those of the centres."""
    lines = [
        f"{pair.recording},{pair.start_s + STEP_S * row:.1f},{pair.leader},{pair.follower},"
        f"{pair.leader_rear_m[row] + length_m / 2:.6f},{pair.leader_speed_mps[row]:.6f},0,"
        f"{pair.front_m[row] - length_m / 2:.6f},{pair.speed_mps[row]:.6f}"
        for row in range(pair.rows)
    ]
    write_text(file, "\n".join([HEADER, *lines]) + "\n")
    return file


def write_pairs(folder: Path, pairs: Sequence[Pair]) -> Path:
    for number, pair in enumerate(pairs):
        write_pair(folder / f"pair-{number:03}.csv", pair)
    return folder
