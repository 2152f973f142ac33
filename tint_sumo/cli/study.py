"""``tint-sumo study``."""

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, ClassVar

from tyro.conf import Positional, arg, subcommand

from tint_sumo.cli.command import RESUMES, Command, Outcome, SpreadCommand, names_in, wrote
from tint_sumo.cli.values import BUDGET, SCENE_STUDY, BudgetValue, FolderOrUrl, Gpus, Scene, SceneStudyValue, optional
from tint_sumo.core.errors import InputError
from tint_sumo.core.ranges import Processes
from tint_sumo.core.stores import working_folder

if TYPE_CHECKING:
    from tint_sumo.study.report import StudyReport

_BUDGET = arg(
    help="quick: few decisions, minutes. full: all methods, four seeds, three hours. strangers: trained in 128 towns "
    "with nine sensors, tested in held-out worlds, two days. paper: the paper's numbers, days."
)
_OUT = optional("FOLDER|URL", "Folder of the study, or a URL such as s3://bucket/folder.", "runs/BUDGET")


@dataclass(frozen=True, kw_only=True)
class RunStudy(SpreadCommand):
    """Record, learn traits, train and test every method, and report; the same command resumes an interrupted study."""

    after_interrupt: ClassVar[str] = RESUMES

    budget: Annotated[BudgetValue, _BUDGET] = "quick"
    out: Annotated[str | None, _OUT] = None
    scene: Scene = "t_intersection"
    workers: Processes = 2
    """Processes of this machine at a time."""
    gpus_per_job: Gpus = 0.0

    def run(self) -> Outcome:
        from tint_sumo.study.folders import DATASET
        from tint_sumo.study.plan import run_study

        out_name = self._out_name()
        with working_folder(out_name) as out:
            with self.workers_of(self.workers, self.gpus_per_job) as workers:
                report = run_study(BUDGET.full(self.budget), out, scene=self.scene, workers=workers)
            found = sorted(out.glob("traits/*/latent.png")) + sorted(out.glob("policies/*/policy.safetensors"))
            data = [out / DATASET] if (out / DATASET).exists() else []  # none where the shipped trait models are taken
            made = names_in(out_name, out, [*data, *found])
        outcome = _report_outcome(report, out_name, out)
        text = "\n".join([outcome.text, *wrote(made)])
        return Outcome(text, {**outcome.content, "made": made})

    def _out_name(self) -> str:
        if self.out is not None:
            return self.out
        if not isinstance(self.budget, str):
            raise InputError("a budget without a name needs a folder; give it with --out")
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
    """Print the log of a job, wherever it ran; a job that failed has its error there."""

    name: Positional[str]
    """Name of the job, such as "train oracle-P0.4-seed0"."""
    out: FolderOrUrl = "runs/quick"
    """Folder of the study, the comparison or the sweep, or its URL."""

    def run(self) -> Outcome:
        from tint_sumo.jobs.process import read_log

        text = read_log(self.out, self.name)
        return Outcome(text.rstrip("\n"), {"name": self.name, "log": text})


@dataclass(frozen=True, kw_only=True)
class StudyScenes(Command):
    """Test trait models in scenes where they were not trained, in half an hour; the same command resumes it."""

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
    """Return the outcome for a report that was written in ``folder``, which stands for the user's ``out``."""
    files = names_in(out, folder, (report.csv_file, report.markdown_file, *report.figure_files, report.page_file))
    text = "\n".join([report.markdown, *wrote(files)])
    return Outcome(text, {"results": [row.to_json() for row in report.rows], "files": files})
