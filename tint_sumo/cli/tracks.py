"""``tint-sumo tracks``."""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

from tyro.conf import Positional, Suppress, subcommand

from tint_sumo.cli.command import Command, Outcome, wrote
from tint_sumo.cli.values import optional
from tint_sumo.core.files import PICTURE_SUFFIXES, require_output_file
from tint_sumo.core.ranges import Range

_FORMAT = optional(
    "NAME",
    "Format: levelx, highd, interaction, ngsim, tgsim, leader_follower, commonroad, fcd, or fcd_geo for floating-car "
    "data with longitudes and latitudes.",
    "recognised by the file's beginning",
)
_FIGURE = optional("FILE", "Picture to write: .png, .jpg, .webp, .svg or .pdf.")
_TABLE = optional("FILE", "Table to write, a row for each of the tracks: .parquet or .csv.")
_TABLE_SUFFIXES = (".parquet", ".csv")
_Shift = Annotated[float, Range(-1e8, 1e8)]  # more than twice around the Earth
TrackFormatName = Annotated[str | None, _FORMAT]


@dataclass(frozen=True, kw_only=True)
class InspectTracks(Command):
    """Report what is in recorded tracks: vehicles, speeds, and values that are physically impossible."""

    file: Positional[Path]
    """levelX, INTERACTION, NGSIM, TGSIM or leader-follower CSV, CommonRoad XML, or SUMO's floating-car data."""
    format: TrackFormatName = None
    figure: Annotated[Path | None, _FIGURE] = None

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


@dataclass(frozen=True, kw_only=True)
class MatchTracks(Command):
    """Place recorded tracks on the lanes of a SUMO network, and find the leaders on the ways that vehicles take."""

    tracks: Positional[Path]
    """Recorded tracks, as tracks inspect reads them."""
    net: Positional[Path]
    """SUMO network (.net.xml), for example of net import."""
    out: Annotated[Path | None, _TABLE] = None
    figure: Annotated[Path | None, _FIGURE] = None
    format: TrackFormatName = None
    shift_m: tuple[_Shift, _Shift] = (0.0, 0.0)
    """Added to x and y of the tracks, m."""

    def run(self) -> Outcome:
        from tint_sumo.tracks import match, read_tracks
        from tint_sumo.tracks.match_report import plot, report, summary
        from tint_sumo.tracks.matching import write_table

        if self.out is not None:
            require_output_file(self.out, _TABLE_SUFFIXES, inputs=(self.tracks, self.net))
        if self.figure is not None:
            require_output_file(self.figure, PICTURE_SUFFIXES, "figure")
        matched = match(read_tracks(self.tracks, self.format), self.net, self.shift_m)
        if self.out is not None:
            write_table(matched, self.out)
        if self.figure is not None:
            plot(matched, self.figure)
        written = [str(file) for file in (self.out, self.figure) if file is not None]
        return Outcome("\n".join([report(matched), *wrote(written)]), {**summary(matched), "files": written})


# tyro makes subcommands of unions only, hence the None.
@dataclass(frozen=True)
class Tracks:
    """Recorded tracks of real or simulated traffic."""

    command: (
        Annotated[InspectTracks, subcommand("inspect")] | Annotated[MatchTracks, subcommand("match")] | Suppress[None]
    )
