"""Traits of the drivers in any SUMO scenario or recording: a table of latents. No label is needed."""

from pathlib import Path

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from tint_sumo.config import MIN_WINDOW_STEPS, STEP_S, WINDOW_STEPS, VehicleShape
from tint_sumo.core.errors import InputError
from tint_sumo.core.files import require_output_file, write_frame
from tint_sumo.core.percentages import percent
from tint_sumo.dataset.tracks import read_tracks
from tint_sumo.dataset.windows import Windows, cut_windows, window_rows
from tint_sumo.drivers.pairs import read_pairs
from tint_sumo.traits.cross_window import CrossWindow
from tint_sumo.traits.evaluation import Latents, encode_windows
from tint_sumo.traits.input_range import InputRange
from tint_sumo.traits.model import TraitModel
from tint_sumo.traits.recorded import windows_of
from tint_sumo.traits.storage import load, read_card
from tint_sumo.traits.streaming import fuse_so_far

SUFFIXES = (".csv", ".parquet")
OUTSIDE = "outside"  # the column
_MOST_OUTSIDE = 0.9  # share of recorded windows; a model says nothing about more


def infer_traits(
    source: Path,
    model: str | Path,
    *,
    net_file: Path | None = None,
    vehicle_length_m: float = VehicleShape().length_m,
    vtypes_file: Path | None = None,
) -> pd.DataFrame:
    """Return latents of all vehicles, a row for each window of 2 to 20 steps of 0.1 s, by vehicle and time.

    Args:
        source: floating-car data, or trajectories of a dataset, as in ``tint_sumo.dataset.tracks.read_tracks``.
        model: name of a shipped model, folder of a training run, or path of a .safetensors file.
        net_file: SUMO network of floating-car data; with it leaders are seen beyond the end of a lane.
        vehicle_length_m: of the vehicles in floating-car data, if no file of vTypes says it.
        vtypes_file: route file, additional file or .sumocfg with the vTypes of floating-car data.

    Returns:
        vehicle (id), window (0, 1, ... of the vehicle), start_s, end_s, steps, has_leader (at every step, and nearer
        than the gap that stands for none, which is 20 m in scenes), latent_1, ... and std_1, ... (mean and standard
        deviation of the window's posterior). Of ``cross_window``, also fused_latent_1, ... and fused_std_1, ...: what
        the vehicle's windows say together, up to this one. If the model's card knows the range of its training's
        inputs, also outside (whether the window has a step whose offset or gap no training window had), and
        outside_input, outside_step, outside_m, trained_low_m and trained_high_m, which say what is the farthest beyond
        (``tint_sumo.traits.input_range.InputRange.farthest_outside``).

    Raises:
        InputError: unusable data, network, length or model.
    """
    trained = load(model)
    limit_m = trained.no_leader_gap_m
    rows = read_tracks(
        source, net_file=net_file, vehicle_length_m=vehicle_length_m, vtypes_file=vtypes_file, reach_m=limit_m
    )
    track = rows["track"].to_numpy()
    gap_m = rows["gap_m"].where(rows["gap_m"] < limit_m, np.inf).to_numpy()
    windows = cut_windows(track, np.zeros_like(track), rows["position_m"].to_numpy(), gap_m, limit_m)
    if len(windows) == 0:
        raise InputError(f"{source} has no vehicle for {MIN_WINDOW_STEPS} steps of {STEP_S} s; write a longer run")
    first, _ = window_rows(track)
    return _table(
        trained,
        read_card(model).input_range,
        rows["vehicle"].iloc[first].array,
        rows["time_s"].to_numpy()[first],
        windows,
    )


def infer_recorded(source: Path, model: str | Path, format_name: str | None = None) -> pd.DataFrame:
    """Return latents of all recorded vehicles, by vehicle and time.

    Args:
        source: file of tracks in any format of ``tint_sumo.tracks``, or folder of such files.
        model: as in ``infer_traits``.
        format_name: format of the tracks; recognised if not given.

    Returns:
        the columns of ``infer_traits``; vehicle is RECORDING/VEHICLE. A window ends where a vehicle's leader changes.

    Raises:
        InputError: unusable tracks or model, or nearly all windows are outside what the model was trained on.
    """
    trained, reach = load(model), read_card(model).input_range
    pairs = read_pairs(source, format_name, with_free=True).pairs
    windows, number = windows_of(pairs, trained.no_leader_gap_m)
    in_pair = pd.Series(number).groupby(number).cumcount().to_numpy()
    start_s = np.array([pair.start_s for pair in pairs])[number] + in_pair * WINDOW_STEPS * STEP_S
    vehicle = pd.Categorical([pairs[one].driver for one in number.tolist()])
    table = _table(trained, reach, vehicle, start_s, windows)
    if OUTSIDE in table and table[OUTSIDE].mean() > _MOST_OUTSIDE:
        (farthest, *_) = outside_lines(table)
        raise InputError(
            f"{percent(float(table[OUTSIDE].mean()))}% of the windows of {source} lie outside what {model} was trained "
            f"on ({farthest.strip()}); train a model on such `tracks` with tint-sumo traits train"
        )
    return table


def _table(
    trained: TraitModel,
    reach: InputRange | None,
    vehicle: pd.Categorical,
    start_s: NDArray[np.float64],
    windows: Windows,
) -> pd.DataFrame:
    """Return the table of windows that are sorted by vehicle and time."""
    number = np.asarray(pd.Series(vehicle.codes).groupby(vehicle.codes).cumcount(), np.int64)
    latents = encode_windows(trained, windows)
    return pd.DataFrame(
        {
            "vehicle": vehicle,
            "window": number,
            "start_s": start_s.round(3),
            "end_s": (start_s + (windows.length - 1) * STEP_S).round(3),
            "steps": windows.length,
            "has_leader": windows.has_leader,
            **_columns("", latents),
            **(_columns("fused_", fuse_so_far(latents, vehicle.codes)) if isinstance(trained, CrossWindow) else {}),
            **({} if reach is None else dict(reach.farthest_outside(windows))),
        }
    )


def outside_lines(table: pd.DataFrame) -> list[str]:
    """Return a line for each input that is the farthest outside in some windows, with the farthest of its values."""
    lines = []
    for name, part in table[table[OUTSIDE]].groupby("outside_input"):
        low_m, high_m, found_m = (part[key].to_numpy() for key in ("trained_low_m", "trained_high_m", "outside_m"))
        beyond_m = np.nan_to_num(np.maximum(low_m - found_m, found_m - high_m), nan=np.inf)
        worst = part.iloc[int(beyond_m.argmax())]
        trained = f"the training had {worst['trained_low_m']:.1f} to {worst['trained_high_m']:.1f} m there"
        if np.isnan(worst["trained_low_m"]):
            trained = "no window of the training is so long"
        lines.append(
            f"  {name}: {percent(len(part) / len(table))}% of the windows, such as {worst['outside_m']:.1f} m at step "
            f"{worst['outside_step']} of vehicle {worst['vehicle']}'s window at {worst['start_s']:.1f} s; {trained}"
        )
    return lines


def write_table(table: pd.DataFrame, out: Path) -> None:
    """Write CSV or Parquet, by the suffix of ``out``.

    Raises:
        InputError: ``out`` cannot be such a file, or lies in the folder of a run.
    """
    require_output_file(out, SUFFIXES)
    write_frame(table, out)


def _columns(prefix: str, latents: Latents) -> dict[str, NDArray[np.float32]]:
    return {
        f"{prefix}{name}_{index + 1}": values[:, index]
        for name, values in (("latent", latents.mean), ("std", latents.std))
        for index in range(values.shape[1])
    }
