"""``tint-sumo study``."""

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, ClassVar

from tyro.conf import Positional, arg, subcommand

from tint_sumo.cli.command import RESUMES, Command, Outcome, SpreadCommand, names_in, wrote
from tint_sumo.cli.values import (
    BUDGET,
    PLACE,
    SCENE_STUDY,
    SCENES,
    BudgetValue,
    FolderOrUrl,
    SceneStudyValue,
    SceneValue,
)
from tint_sumo.core.errors import InputError
from tint_sumo.core.ranges import Processes, Range
from tint_sumo.core.stores import working_folder

if TYPE_CHECKING:
    from tint_sumo.study.report import StudyReport


@dataclass(frozen=True, kw_only=True)
class RunStudy(SpreadCommand):
    """Record, learn traits, train and evaluate every method, report; the same command resumes an interrupted study."""

    after_interrupt: ClassVar[str] = RESUMES

    budget: BudgetValue = "quick"
    """quick: minutes, few decisions. full: all methods, four seeds, three hours. paper: all numbers as in the paper,
    days."""
    out: Annotated[str | None, PLACE] = None
    """Folder of the study, or a URL such as s3://bucket/folder; runs/<budget> if not given."""
    scene: Annotated[SceneValue, arg(help=f"Scene: {SCENES}.")] = "t_intersection"
    workers: Processes = 2
    """Processes of this machine at a time."""
    gpus_per_job: Annotated[float, Range(0.0, 64.0)] = 0.0
    """Share of a GPU for each training, with --executor ray and where the cluster has GPUs."""

    def run(self) -> Outcome:
        from tint_sumo.study.folders import DATASET
        from tint_sumo.study.plan import run_study

        place = self._place()
        with working_folder(place) as out:
            with self.workers_of(self.workers, self.gpus_per_job) as workers:
                report = run_study(BUDGET.full(self.budget), out, scene=self.scene, workers=workers)
            found = sorted(out.glob("traits/*/latent.png")) + sorted(out.glob("policies/*/policy.safetensors"))
            made = names_in(place, out, [out / DATASET, *found])
        outcome = _report_outcome(report, place, out)
        text = "\n".join([outcome.text, *wrote(made)])
        return Outcome(text, {**outcome.content, "made": made})

    def _place(self) -> str:
        if self.out is not None:
            return self.out
        if not isinstance(self.budget, str):
            raise InputError("a budget of your own needs a folder of its own; say --out FOLDER")
        return f"runs/{self.budget}"


@dataclass(frozen=True, kw_only=True)
class ReportStudy(Command):
    """Make a study's tables, figures and page again; the page's episodes are recorded if they are not there."""

    out: FolderOrUrl = "runs/quick"
    """Folder of the study, or its URL."""

    def run(self) -> Outcome:
        from tint_sumo.study.page import write_page
        from tint_sumo.study.report import write_report

        with working_folder(self.out) as out:
            report = write_page(write_report(out), out)
        return _report_outcome(report, self.out, out)


@dataclass(frozen=True, kw_only=True)
class ShowLog(Command):
    """Print what a job has written to its log, wherever it ran; a job that failed has its error there."""

    name: Positional[str]
    """Name of the job, as "train oracle-P0.4-seed0"."""
    out: FolderOrUrl = "runs/quick"
    """Folder of the study, the comparison or the sweep, or its URL."""

    def run(self) -> Outcome:
        from tint_sumo.jobs.process import read_log

        text = read_log(self.out, self.name)
        return Outcome(text.rstrip("\n"), {"name": self.name, "log": text})


@dataclass(frozen=True, kw_only=True)
class StudyScenes(Command):
    """Test trait models in scenes they were not trained in, half an hour's work; the same command resumes it."""

    after_interrupt: ClassVar[str] = RESUMES

    out: Path = Path("runs/scenes")
    """Folder of the comparison."""
    budget: SceneStudyValue = "full"
    """Sizes of all stages; others can be given in a configuration file."""
    workers: Processes = 2
    """Processes of this machine at a time."""

    def run(self) -> Outcome:
        from tint_sumo.comparisons.scenes import report_markdown, run_scene_study

        table = run_scene_study(SCENE_STUDY.full(self.budget), self.out, workers=self.workers)
        files = [str(self.out / "scenes.csv"), str(self.out / "scenes.md")]
        text = "\n".join([report_markdown(table), *wrote(files)])
        return Outcome(text, {"results": table.to_dict("records"), "files": files})


@dataclass(frozen=True)
class Study:
    """The study end to end."""

    command: (
        Annotated[RunStudy, subcommand("run")]
        | Annotated[ReportStudy, subcommand("report")]
        | Annotated[ShowLog, subcommand("log")]
        | Annotated[StudyScenes, subcommand("scenes")]
    )


def _report_outcome(report: "StudyReport", out: str, folder: Path) -> Outcome:
    """What a report says, of the study that the user calls ``out`` and that was written in ``folder``."""
    files = names_in(out, folder, (report.csv_file, report.markdown_file, *report.figure_files, report.page_file))
    text = "\n".join([report.markdown, *wrote(files)])
    return Outcome(text, {"results": [row.to_json() for row in report.rows], "files": files})
