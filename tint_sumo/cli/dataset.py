"""``tint-sumo record`` and ``tint-sumo dataset``."""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, ClassVar, Literal

from tyro.conf import Positional, Suppress, subcommand

from tint_sumo.cli.command import RESUMES, Command, Outcome, SpreadCommand, flag_of, wrote
from tint_sumo.cli.values import FolderOrUrl, MixFlag, PopulationValue, Scene, optional
from tint_sumo.config import POPULATIONS, Mix, TrafficSeed, WindowCount
from tint_sumo.core.errors import InputError
from tint_sumo.core.files import PICTURE_SUFFIXES, require_output_file
from tint_sumo.core.ranges import Processes

_SUMOCFG = optional("FILE", "SUMO configuration in place of a scene: its network and demand, its vTypes as labels.")
_POPULATION = optional(
    f"{{{','.join(POPULATIONS)}}}",
    "traits: conservative and aggressive drivers. continuous: desired speeds and gaps of all kinds, without classes. "
    "same_speed, same_gap: traits that do not differ in it. towns, held_out_towns: each episode in a town. "
    "willing, gentle, inattentive, polite: states of drivers decide whether they yield. "
    "street: 30 to 50 km/h.",
    "the scene's, traits in built-in scenes",
)


@dataclass(frozen=True, kw_only=True)
class Record(SpreadCommand):
    """Record a dataset of traffic without the ego vehicle; the same command resumes an interrupted recording."""

    after_interrupt: ClassVar[str] = RESUMES

    out: FolderOrUrl
    """Folder for the dataset, or a URL such as s3://bucket/folder."""
    windows: WindowCount = 30_000
    """Least number of windows; a window is up to 20 steps of 0.1 s of a vehicle and its leader."""
    p_conservative: MixFlag = (0.5,)
    """Probability that a driver is conservative, 0 to 1; given two numbers, each episode draws it between them."""
    population: Annotated[PopulationValue, _POPULATION] = None
    seed: TrafficSeed = 0
    """Seed of the traffic."""
    scene: Scene = "t_intersection"
    workers: Processes = 1
    """Processes of this machine that simulate; the dataset does not depend on their number."""
    format: Literal["parquet", "fcd"] = "parquet"
    """parquet: tables. fcd: also SUMO's floating-car data, which a dataset that is there already can be given."""
    sumocfg: Annotated[Path | None, _SUMOCFG] = None

    def run(self) -> Outcome:
        from tint_sumo.dataset.recorder import record
        from tint_sumo.dataset.sumocfg_recorder import record_sumocfg
        from tint_sumo.scenes import find_scene

        sumocfg = find_scene(self.scene).sumocfg or self.sumocfg
        if sumocfg is not None:
            self._require_nothing_but_the_configuration()
            manifest = record_sumocfg(sumocfg, self.out, self.windows, seed=self.seed, workers=self.workers)
            return Outcome(f"{manifest.windows} windows in {self.out}", manifest.content())
        with self.workers_of(self.workers) as workers:
            manifest = record(
                self.out,
                self.windows,
                p_conservative=Mix.parse(self.p_conservative),
                population=self.population,
                seed=self.seed,
                scene=self.scene,
                workers=workers,
                fcd=self.format == "fcd",
            )
        return Outcome(f"{manifest.windows} windows in {self.out}", manifest.content())

    def _require_nothing_but_the_configuration(self) -> None:
        names = ["p_conservative", "population", "format"]
        other = "the sumocfg of a scene"
        if self.executor != "local":
            raise InputError("a .sumocfg is on this machine alone; use --executor local")
        if self.sumocfg is not None:
            names.append("scene")
            other = "--sumocfg"
        for name in names:
            if getattr(self, name) != getattr(Record, name):
                raise InputError(
                    f"{flag_of(name)} does not go with {other}, which defines all of the traffic; leave it out"
                )


@dataclass(frozen=True, kw_only=True)
class InspectDataset(Command):
    """Report what is in a dataset: counts, settings, and distributions of speed and gap per driver trait."""

    data: Positional[Path]
    """Folder of a dataset."""
    figure: Annotated[Path | None, optional("FILE", "Picture to write: .png, .jpg, .webp, .svg or .pdf.")] = None
    verify: bool = False
    """Compare all files with the checksums of the manifest first."""

    def run(self) -> Outcome:
        from tint_sumo.dataset.inspection import inspect, plot, report
        from tint_sumo.dataset.schema import read_manifest, verify

        if self.figure is not None:
            require_output_file(self.figure, PICTURE_SUFFIXES, "figure")
        verified = verify(self.data, read_manifest(self.data)) if self.verify else None
        found = inspect(self.data)
        text = report(found)
        if verified is not None:
            text += f"\nall {verified} files are as they were recorded"
        if self.figure is not None:
            plot(found, self.figure)
            text = "\n".join([text, *wrote([str(self.figure)])])
        return Outcome(text, {"data": str(self.data), "verified_files": verified, **found.summary()})


# tyro makes subcommands of unions only, hence the None.
@dataclass(frozen=True)
class Dataset:
    """Recorded datasets."""

    command: Annotated[InspectDataset, subcommand("inspect")] | Suppress[None]
