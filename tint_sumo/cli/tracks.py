"""``tint-sumo tracks``."""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

from tyro.conf import Positional, Suppress, subcommand

from tint_sumo.cli.command import Command, Outcome, wrote
from tint_sumo.cli.values import optional
from tint_sumo.core.files import PICTURE_SUFFIXES, require_output_file

_FORMAT = optional(
    "NAME",
    "Format: levelx, highd, interaction, ngsim, tgsim, leader_follower, commonroad, fcd, or fcd_geo for floating-car "
    "data with longitudes and latitudes.",
    "recognised by the file's beginning",
)
TrackFormatName = Annotated[str | None, _FORMAT]


@dataclass(frozen=True, kw_only=True)
class InspectTracks(Command):
    """Report what is in recorded tracks: vehicles, speeds, and values that are physically impossible."""

    file: Positional[Path]
    """levelX, INTERACTION, NGSIM, TGSIM or leader-follower CSV, CommonRoad XML, or SUMO's floating-car data."""
    format: TrackFormatName = None
    figure: Annotated[Path | None, optional("FILE", "Picture to write: .png, .jpg, .webp, .svg or .pdf.")] = None

    def run(self) -> Outcome:
        from tint_sumo.tracks import read_tracks
        from tint_sumo.tracks.inspection import inspect, plot, report

        if self.figure is not None:
            require_output_file(self.figure, PICTURE_SUFFIXES, "figure")
        found = inspect(read_tracks(self.file, self.format))
        text = report(found)
        if self.figure is not None:
            plot(found, self.figure)
            text = "\n".join([text, *wrote([str(self.figure)])])
        return Outcome(text, {"file": str(self.file), **found.summary()})


# tyro makes subcommands of unions only, hence the None.
@dataclass(frozen=True)
class Tracks:
    """Recorded tracks of real or simulated traffic."""

    command: Annotated[InspectTracks, subcommand("inspect")] | Suppress[None]
