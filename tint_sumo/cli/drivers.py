"""``tint-sumo drivers``."""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, ClassVar, Literal

from tyro.conf import Positional, subcommand

from tint_sumo.cli.command import RESUMES, Command, Outcome, wrote
from tint_sumo.cli.tracks import TrackFormatName
from tint_sumo.cli.values import optional
from tint_sumo.config import STEP_S, StepS, TrafficSeed
from tint_sumo.core.ranges import Range

_SPEED_LIMIT = optional(
    "FLOAT",
    "Speed limit of the recorded road, m/s: desired speeds then rise and fall with the limits of other roads.",
    "desired speeds are the same on all roads that allow them",
)
_RECORDED_LIMIT = optional(
    "FLOAT",
    "Speed limit of the recorded road, m/s, which SUMO's own drivers keep to.",
    "the speed that 5 % of the recorded moments exceed",
)
SpeedLimitMps = Annotated[float, Range(1.0, 100.0)]
_Duration = Annotated[float, Range(0.2, 3600.0)]


@dataclass(frozen=True, kw_only=True)
class FitDrivers(Command):
    """Fit a car-following model of SUMO to recorded drivers, and to all of them as a population."""

    after_interrupt: ClassVar[str] = RESUMES

    recording: Positional[Path]
    """File of tracks, or folder with such files: leader-follower CSV, or any other format that tracks inspect reads."""
    out: Path
    """Folder for the fit."""
    model: Literal["IDM", "EIDM", "Krauss"] = "IDM"
    """SUMO's car-following model; Krauss without its random dawdling, EIDM without its random errors."""
    format: TrackFormatName = None
    min_duration: _Duration = 1.0
    """Pairs of a leader and a follower that last less long are left out, s."""
    step: StepS = STEP_S
    """SUMO's step length, s; recordings are interpolated to it."""

    def run(self) -> Outcome:
        from tint_sumo.core.structures import plain
        from tint_sumo.drivers.fitted import FITTED_FILE, TABLES, fit_drivers, report_text
        from tint_sumo.drivers.models import MODELS
        from tint_sumo.drivers.pairs import left_out_text, read_pairs
        from tint_sumo.jobs.table import one_job

        found = read_pairs(self.recording, self.format, self.step, self.min_duration)
        with one_job("fit") as report:
            fitted = fit_drivers(found.pairs, MODELS[self.model], self.out, report)
        files = [str(self.out / name) for name in (FITTED_FILE, *TABLES)]
        return Outcome("\n".join([*left_out_text(found), report_text(fitted), *wrote(files)]), plain(fitted))


@dataclass(frozen=True, kw_only=True)
class ExportDrivers(Command):
    """Write drivers drawn from a fitted population: vTypes for plain SUMO, a population for scenes, and a picture."""

    fitted: Positional[Path]
    """Folder of a fit."""
    out: Path
    """Folder for the files."""
    size: Annotated[int, Range(1, 1000)] = 100
    """Number of drivers."""
    seed: TrafficSeed = 0
    """Seed of the draws."""
    speed_limit: Annotated[SpeedLimitMps | None, _SPEED_LIMIT] = None

    def run(self) -> Outcome:
        from tint_sumo.drivers.export import export
        from tint_sumo.drivers.fitted import read_fitted

        files = export(read_fitted(self.fitted), self.out, self.size, self.seed, self.speed_limit)
        names = list(map(str, files))
        return Outcome("\n".join(wrote(names)), {"files": names})


@dataclass(frozen=True, kw_only=True)
class CheckDrivers(Command):
    """Compare traffic of fitted drivers with recorded traffic, in SUMO, beside SUMO's own drivers."""

    fitted: Positional[Path]
    """Folder of a fit."""
    recording: Path
    """File or folder of tracks: the recording that was fitted, or another one."""
    format: TrackFormatName = None
    min_duration: _Duration = 1.0
    """Pairs of a leader and a follower that last less long are left out, s."""
    repeats: Annotated[int, Range(1, 100)] = 5
    """Drivers of each kind that drive in place of a recorded follower, one after the other."""
    seed: Annotated[int, Range(0, 1_000_000)] = 0
    """Seed of the drivers and of SUMO's randomness."""
    speed_limit: Annotated[SpeedLimitMps | None, _RECORDED_LIMIT] = None

    def run(self) -> Outcome:
        from tint_sumo.drivers.check import check, report_text
        from tint_sumo.drivers.fitted import read_fitted
        from tint_sumo.drivers.pairs import left_out_text, read_pairs
        from tint_sumo.jobs.table import one_job

        fitted = read_fitted(self.fitted)
        recorded = read_pairs(self.recording, self.format, fitted.step_s, self.min_duration)
        with one_job("check") as report:
            found = check(fitted, recorded.pairs, self.repeats, self.seed, self.speed_limit, report)
        return Outcome("\n".join([*left_out_text(recorded), report_text(found)]), found.summary())


@dataclass(frozen=True)
class Drivers:
    """Drivers of SUMO's car-following models, fitted to recorded traffic."""

    command: (
        Annotated[FitDrivers, subcommand("fit")]
        | Annotated[ExportDrivers, subcommand("export")]
        | Annotated[CheckDrivers, subcommand("check")]
    )
