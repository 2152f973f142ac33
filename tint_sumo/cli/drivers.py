"""``tint-sumo drivers``."""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, ClassVar, Literal

from tyro.conf import Positional, Suppress, subcommand

from tint_sumo.cli.command import RESUMES, Command, Outcome, wrote
from tint_sumo.cli.tracks import TrackFormatName
from tint_sumo.config import STEP_S, StepS
from tint_sumo.core.ranges import Range

_Duration = Annotated[float, Range(0.2, 3600.0)]


@dataclass(frozen=True, kw_only=True)
class FitDrivers(Command):
    """Fit a car-following model of SUMO to recorded drivers, and to all of them as a population."""

    after_interrupt: ClassVar[str] = RESUMES

    recording: Positional[Path]
    """File of tracks, or folder with such files: leader-follower CSV, or any other format that tracks inspect reads."""
    out: Path
    """Folder for the fit."""
    model: Literal["IDM", "Krauss"] = "IDM"
    """SUMO's car-following model; Krauss without its random dawdling."""
    format: TrackFormatName = None
    min_duration: _Duration = 1.0
    """Pairs of a leader and a follower that last less long are left out, s."""
    step: StepS = STEP_S
    """SUMO's step length, s; recordings are interpolated to it."""

    def run(self) -> Outcome:
        from tint_sumo.core.structures import plain
        from tint_sumo.drivers.fitted import FITTED_FILE, TABLE_FILE, fit_drivers, report_text
        from tint_sumo.drivers.models import MODELS
        from tint_sumo.drivers.pairs import left_out_text, read_pairs
        from tint_sumo.jobs.table import one_job

        found = read_pairs(self.recording, self.format, self.step, self.min_duration)
        with one_job("fit") as report:
            fitted = fit_drivers(found.pairs, MODELS[self.model], self.out, report)
        files = [str(self.out / name) for name in (FITTED_FILE, TABLE_FILE)]
        return Outcome("\n".join([*left_out_text(found), report_text(fitted), *wrote(files)]), plain(fitted))


# tyro makes subcommands of unions only, hence the None.
@dataclass(frozen=True)
class Drivers:
    """Drivers of SUMO's car-following models, fitted to recorded traffic."""

    command: Annotated[FitDrivers, subcommand("fit")] | Suppress[None]
