"""Says how well recorded tracks lie on the lanes of a network, in lines for people and in a picture."""

from pathlib import Path
from typing import Any

import numpy as np
import shapely
from matplotlib.collections import LineCollection
from matplotlib.figure import Figure

from tint_sumo.core.files import whole_file
from tint_sumo.core.percentages import percent
from tint_sumo.tracks.matching import REASONS, Matched

_COLOURS = {"": "#2a78b5", REASONS[0]: "#c0392b", REASONS[1]: "#e08a1e"}
_POINTS = 200_000  # that are drawn at most
_DOUBTFUL = 0.5  # a smaller share of placed rows is worth a warning


def summary(matched: Matched) -> dict[str, Any]:
    """Return all numbers, for JSON; distances are None if no row is placed."""
    table = matched.table
    placed = table[table["lane"].notna()]
    missing = table[table["lane"].isna()]
    offset_m, turn_rad = placed["offset_m"].abs(), placed["turn_rad"].abs()
    by_track = table["lane"].notna().groupby(matched.tracks.track_number).mean()
    return {
        "rows": len(table),
        "placed_rows": len(placed),
        "vehicles": len(by_track),
        "vehicles_placed_nowhere": int((by_track == 0.0).sum()),
        "vehicles_placed_in_part": int(((by_track > 0.0) & (by_track < 1.0)).sum()),
        "not_placed": {reason: int((missing["reason"] == reason).sum()) for reason in REASONS},
        "jumps": matched.jumps,
        "offset_median_m": float(offset_m.median()),
        "offset_95_m": float(offset_m.quantile(0.95)),
        "turn_median_deg": float(np.degrees(turn_rad.median())),
        "turn_95_deg": float(np.degrees(turn_rad.quantile(0.95))),
        "rows_with_leader": int(table["leader"].notna().sum()),
        "gap_median_m": None if table["gap_m"].isna().all() else float(table["gap_m"].median()),
    }


def report(matched: Matched) -> str:
    """Return the numbers as lines for people."""
    found = summary(matched)
    reasons = ", ".join(f"{count:,} {reason}" for reason, count in found["not_placed"].items() if count)
    share = percent(found["placed_rows"] / found["rows"])
    lines = [
        f"rows              {found['placed_rows']:,} of {found['rows']:,} placed ({share} %)"
        + (f"; {reasons}" if reasons else ""),
        f"vehicles          {found['vehicles']:,}: {found['vehicles_placed_in_part']:,} placed in part, "
        f"{found['vehicles_placed_nowhere']:,} nowhere",
        f"lateral offset    {found['offset_median_m']:.2f} m in the median, {found['offset_95_m']:.2f} m at 95 %",
        f"heading           {found['turn_median_deg']:.1f} degrees from the lane's in the median, "
        f"{found['turn_95_deg']:.1f} at 95 %",
        f"jumps             {found['jumps']:,} changes between lanes without a way between them",
        f"leaders           in {found['rows_with_leader']:,} rows"
        + (f", {found['gap_median_m']:.1f} m ahead in the median" if found["gap_median_m"] is not None else ""),
    ]
    if found["placed_rows"] < _DOUBTFUL * found["rows"]:
        lines.append("doubtful          is this the network of these tracks? `shift_m` moves them")
    return "\n".join(lines)


def plot(matched: Matched, file: Path) -> None:
    """Write a picture of the lanes, and of the tracks in colours that say whether they are placed."""
    figure = Figure(figsize=(10.0, 8.0), dpi=120, layout="constrained")
    axes = figure.subplots()
    lanes = matched.lanes
    for lines, colour in ((lanes.lines[~lanes.on_junction], "#555555"), (lanes.lines[lanes.on_junction], "#bbbbbb")):
        shapes = [shapely.get_coordinates(line) for line in lines]
        axes.add_collection(LineCollection(shapes, colors=colour, linewidths=0.6))
    every = -(-len(matched.table) // _POINTS)
    fronts, reason = matched.fronts_m[::every], matched.table["reason"].to_numpy()[::every]
    for name, colour in _COLOURS.items():
        found = fronts[reason == name]
        label = f"{name or 'placed'} ({len(found):,})"
        axes.scatter(found[:, 0], found[:, 1], s=2.0, color=colour, linewidths=0.0, label=label)
    axes.set(xlabel="x (m)", ylabel="y (m)", title=f"{matched.tracks.file.name} on {lanes.file.name}")
    axes.set_aspect("equal", adjustable="datalim")
    axes.legend(markerscale=4.0)
    with whole_file(file) as partial:
        figure.savefig(partial, format=file.suffix.lower().removeprefix("."))
