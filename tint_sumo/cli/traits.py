"""``tint-sumo traits``."""

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, ClassVar

from tyro.conf import arg, subcommand

from tint_sumo.cli.command import (
    RESUMES,
    Command,
    Outcome,
    SpreadCommand,
    exporting_onnx,
    names_in,
    use_one_thread,
    wrote,
)
from tint_sumo.cli.tracks import TrackFormatName
from tint_sumo.cli.values import (
    SCENES,
    TRAIT_BUDGET,
    TRAIT_STUDY,
    FolderOrUrl,
    OnnxFlag,
    SceneValue,
    TestData,
    TraitBudgetValue,
    TraitModelName,
    TraitStudyValue,
    optional,
)
from tint_sumo.config import WORLDS, NoiseM, Seed
from tint_sumo.core.errors import InputError
from tint_sumo.core.files import require_output_file, require_output_folder, write_text
from tint_sumo.core.percentages import percent
from tint_sumo.core.ranges import Processes, Range
from tint_sumo.core.stores import working_folder
from tint_sumo.core.structures import plain
from tint_sumo.core.yaml_files import to_yaml

if TYPE_CHECKING:
    from tint_sumo.drivers.pairs import Pair
    from tint_sumo.traits.identification import ModelOf

_NOISE = optional(
    "FLOAT", "Standard deviation of the noise on every position in training, m.", "the budget's, 0 in named budgets"
)
_NET = optional("FILE", "Network of the scenario (.net.xml); without it no leader beyond the end of a lane is seen.")

_DATA = optional("FOLDER", "Dataset of windows and traits; give either this or --tracks.")
_TRACKS = optional("PATH", "Recorded tracks, a file or a folder of files, of any format that tracks inspect reads.")
_FIT = optional(
    "FOLDER",
    "Fit of the recorded drivers (tint-sumo drivers fit): the model learns from drivers that are drawn from it, behind "
    "the recorded leaders; with --tracks.",
    "the model learns from the recorded drivers themselves",
)
_UNSEEN = optional(
    "MODEL",
    "Trait model of method cross_window that has learnt from other drivers: its name, folder or .safetensors file.",
    "one is trained for each fifth of the drivers, from drivers like the others, in some minutes",
)
_FCD = optional(
    "PATH",
    "Floating-car data of SUMO (sumo --fcd-output: XML, CSV or Parquet), or a recorded dataset; give either this or "
    "--tracks.",
)
_MOST_CONFUSED = 10  # traits in the printed table
_VTYPES = optional(
    "FILE",
    "Route file, additional file or .sumocfg with the vehicles' vTypes, whose lengths are taken.",
    "--vehicle-length for all",
)


@dataclass(frozen=True, kw_only=True)
class TrainTraits(Command):
    """Train a trait model on a dataset or on recorded tracks; the same command resumes an interrupted training."""

    after_interrupt: ClassVar[str] = RESUMES

    data: Annotated[Path | None, _DATA] = None
    tracks: Annotated[Path | None, _TRACKS] = None
    fit: Annotated[Path | None, _FIT] = None
    format: TrackFormatName = None
    out: Path
    """Folder for the model."""
    method: str = "vae"
    """vae (the paper's), cross_window and morton learn without labels, classifier with them."""
    budget: TraitBudgetValue = "quick"
    """quick: for about 30,000 windows. full: for about 700,000. paper: the paper's network and 1000 epochs."""
    noise: Annotated[NoiseM | None, _NOISE] = None
    seed: Seed = 0
    """Seed of the training, and of the split into training and test episodes."""
    streaming: bool = False
    """Keep the windows in a file beside the model instead of in memory, for large datasets; the model is the same."""

    def run(self) -> Outcome:
        from tint_sumo.jobs.table import one_job
        from tint_sumo.traits.datasets import require_used, train_traits
        from tint_sumo.traits.recorded import train_on_tracks

        settings = TRAIT_BUDGET.full(self.budget)
        if self.noise is not None:
            if settings.noise_m not in (0.0, self.noise):
                raise InputError(f"noise is {self.noise:g} m, and {settings.noise_m:g} m in the budget; give it once")
            settings = replace(settings, noise_m=self.noise)
        require_used(self.method, settings)
        require_one(data=self.data, tracks=self.tracks)
        with one_job(f"traits {self.method}") as report:
            if self.tracks is not None:
                if self.streaming:
                    raise InputError("`streaming` is for datasets; leave it out with `tracks`")
                card = train_on_tracks(
                    self.tracks,
                    self.out,
                    method=self.method,
                    settings=settings,
                    seed=self.seed,
                    fit=self.fit,
                    format_name=self.format,
                    report=report,
                )
            else:
                assert self.data is not None
                if self.fit is not None or self.format is not None:
                    raise InputError("`fit` and `format` belong to tracks; give them with `tracks` in place of `data`")
                card = train_traits(
                    self.data,
                    self.out,
                    method=self.method,
                    settings=settings,
                    seed=self.seed,
                    streaming=self.streaming,
                    report=report,
                )
        return Outcome(
            f"trained {self.method} on {card['windows']} windows: {self.out}", {**card, "out": str(self.out)}
        )


@dataclass(frozen=True, kw_only=True)
class FitRelative(Command):
    """Fit relative traits to simulated traffic, without labels, and measure how well they tell who yields."""

    out: Path
    """YAML file for them, for `tint-sumo policy train --method relative --config FILE`."""
    world: Annotated[str, arg(help=f"World to fit to: {', '.join(WORLDS)}.")] = "strangers"
    test: Annotated[tuple[str, ...], arg(metavar="WORLD [WORLD ...]")] = ("old", "towns")
    """Worlds to measure in, in other traffic."""
    scene: Annotated[SceneValue, arg(help=f"Scene: {SCENES}.")] = "t_intersection"
    seed: Annotated[int, Range(0, 1_000_000)] = 0
    """Seed of the traffic."""

    def run(self) -> Outcome:
        from tint_sumo.envs.worlds import find_world
        from tint_sumo.traits.relative_fit import fit_relative, traffic_in
        from tint_sumo.traits.relative_reading import beliefs

        require_output_file(self.out, (".yaml", ".yml"))
        for name in self.test:
            find_world(name)
        use_one_thread()
        settings = fit_relative(traffic_in(self.world, self.scene, 2 * self.seed))
        found = {name: beliefs(settings, traffic_in(name, self.scene, 2 * self.seed + 1)) for name in self.test}
        scores = {
            name: {"accuracy": one.accuracy, "brier": one.brier, "calibration_error": one.calibration_error}
            for name, one in found.items()
        }
        values = {"budget": {"base": "strangers", "relative": plain(settings)}}
        write_text(self.out, to_yaml(values, {"budget": f"Relative traits, fitted to the world {self.world}."}))
        lines = [
            f"{name:16} {percent(one['accuracy'], 3):>7}% right, Brier score {one['brier']:.3f}, "
            f"calibration error {percent(one['calibration_error'], 3)}%"
            for name, one in scores.items()
        ]
        content = {"out": str(self.out), "world": self.world, "seed": self.seed}
        text = "\n".join([*lines, *wrote([str(self.out)])])
        return Outcome(text, {**content, "settings": plain(settings), "worlds": scores})


@dataclass(frozen=True, kw_only=True)
class EvaluateTraits(Command):
    """Measure how well a linear classifier reads the drivers' traits from a model's latents, on unseen episodes."""

    data: TestData
    model: TraitModelName
    noise: NoiseM = 0.0
    """Standard deviation of the noise on every position, m."""
    other_scene: bool = False
    """Accept a model that was trained in another scene."""

    def run(self) -> Outcome:
        from tint_sumo.traits.datasets import evaluate_traits

        use_one_thread()
        found = evaluate_traits(self.data, self.model, noise_m=self.noise, other_scene=self.other_scene)
        parts = {**found["by_length"], **found["by_leader"]}
        lines = [
            f"linear SVC         {percent(found['accuracy'], 3):>7}% of {found['windows']} windows",
            f"majority share     {percent(found['majority_share'], 3):>7}% (of always taking the most frequent trait)",
            f"mean of traits     {percent(found['balanced_accuracy'], 3):>7}% (each trait counts the same)",
            f"nearest neighbours {percent(found['knn_accuracy'], 3):>7}%",
            *(
                f"  {_part_name(name):16} {percent(part['accuracy'], 3):>7}%"
                for name, part in parts.items()
                if part["windows"]
            ),
        ]
        if found["error_m"] is not None:
            lines.append(f"position error     {found['error_m']:8.4f} m (root mean square)")
        lines += _confusion_lines(found["confusion"])
        return Outcome("\n".join(lines), found)


@dataclass(frozen=True, kw_only=True)
class PlotTraits(Command):
    """Draw a model's latent space beside the trajectories of some windows, and reconstructions if it makes them."""

    data: TestData
    model: TraitModelName
    out: Path
    """Folder for the PNG files."""
    noise: NoiseM = 0.0
    """Standard deviation of the noise on every position, m."""
    other_scene: bool = False
    """Accept a model that was trained in another scene."""

    def run(self) -> Outcome:
        from tint_sumo.traits.datasets import plot_traits

        require_output_folder(self.out)
        use_one_thread()
        files = plot_traits(self.data, self.model, self.out, noise_m=self.noise, other_scene=self.other_scene)
        names = [str(file) for file in files]
        return Outcome("\n".join(wrote(names)), {"files": names})


@dataclass(frozen=True, kw_only=True)
class InferTraits(Command):
    """Infer the traits of the vehicles in any SUMO run or recording: a table of latents per vehicle and 2 s."""

    fcd: Annotated[Path | None, _FCD] = None
    tracks: Annotated[Path | None, _TRACKS] = None
    format: TrackFormatName = None
    model: TraitModelName
    out: Path
    """Table to write, .csv or .parquet."""
    net: Annotated[Path | None, _NET] = None
    vehicle_length: Annotated[float, Range(0.5, 30.0)] = 5.0
    """Length of all vehicles in floating-car data, m."""
    vtypes: Annotated[Path | None, _VTYPES] = None

    def run(self) -> Outcome:
        from tint_sumo.traits.inference import (
            OUTSIDE,
            SUFFIXES,
            infer_recorded,
            infer_traits,
            outside_lines,
            write_table,
        )

        source = require_one(fcd=self.fcd, tracks=self.tracks)
        require_output_file(self.out, SUFFIXES, inputs=(source,))
        use_one_thread()
        if self.tracks is not None:
            if self.net is not None or self.vtypes is not None:
                raise InputError("`net` and `vtypes` belong to floating-car data; leave them out with `tracks`")
            table = infer_recorded(source, self.model, self.format)
        else:
            if self.format is not None:
                raise InputError("`format` is that of tracks; give it with `tracks` in place of `fcd`")
            table = infer_traits(
                source, self.model, net_file=self.net, vehicle_length_m=self.vehicle_length, vtypes_file=self.vtypes
            )
        write_table(table, self.out)
        outside = float(table[OUTSIDE].mean()) if OUTSIDE in table else None
        content = {"out": str(self.out), "windows": len(table), "vehicles": int(table["vehicle"].nunique())}
        reach = "how many are outside is not known, since the model's card does not say what it was trained on"
        if outside is not None:
            reach = "\n".join(
                [f"{percent(outside)}% of the windows lie outside what the model was trained on", *outside_lines(table)]
            )
        text = f"{content['windows']} windows of {content['vehicles']} vehicles: {self.out}\n{reach}"
        return Outcome(text, {**content, "outside": outside, "columns": list(table)})


@dataclass(frozen=True, kw_only=True)
class ExportTraits(Command):
    """Write a folder with all that belongs to one trait model, to share it or to run it without Python."""

    model: TraitModelName
    out: Path
    """Folder to write, which has no files yet; it is a trait model for all commands."""
    onnx: OnnxFlag = False

    def run(self) -> Outcome:
        from tint_sumo.methods.exporting import export_traits

        use_one_thread()
        with exporting_onnx():
            files = [str(file) for file in export_traits(self.model, self.out, with_onnx=self.onnx)]
        return Outcome("\n".join(wrote(files)), {"model": self.model, "files": files})


@dataclass(frozen=True, kw_only=True)
class IdentifyTraits(Command):
    """Measure on recorded drivers, without labels, how far traits predict, identify drivers and stay the same."""

    tracks: Path
    """Recorded tracks, a file or a folder of files, of any format that tracks inspect reads."""
    model: Annotated[str | None, _UNSEEN] = None
    format: TrackFormatName = None

    def run(self) -> Outcome:
        from tint_sumo.drivers.pairs import read_pairs
        from tint_sumo.jobs.table import one_job
        from tint_sumo.traits.identification import identify, report_text, train_on_others

        use_one_thread()
        pairs = read_pairs(self.tracks, self.format).pairs
        model_of = train_on_others if self.model is None else self._trained(self.model, pairs)
        with one_job("identify") as report:
            measures = identify(pairs, model_of, report)
        return Outcome(report_text(measures), {"measures": [asdict(one) for one in measures]})

    def _trained(self, model: str, pairs: "Sequence[Pair]") -> "ModelOf":
        """Return the given model for all folds.

        Raises:
            InputError: it does not predict, knows other scales, or has learnt from these drivers.
        """
        from tint_sumo.traits import load
        from tint_sumo.traits.cross_window import CrossWindow
        from tint_sumo.traits.inference import infer_recorded
        from tint_sumo.traits.recorded import require_unseen

        trained = load(model)
        if not isinstance(trained, CrossWindow):
            raise InputError(f"{model} predicts nothing; give a model of method cross_window")
        infer_recorded(self.tracks, model, self.format)  # refuses tracks of other scales
        require_unseen(model, pairs)
        return lambda *_: trained


@dataclass(frozen=True, kw_only=True)
class StudyTraits(SpreadCommand):
    """Compare all trait methods with more and less noise on positions, in an hour; the same command resumes it."""

    after_interrupt: ClassVar[str] = RESUMES

    out: FolderOrUrl = "runs/traits"
    """Folder of the comparison, or a URL such as s3://bucket/folder."""
    budget: TraitStudyValue = "full"
    """Sizes of all stages; others can be given in a configuration file."""
    workers: Processes = 2
    """Processes of this machine at a time."""

    def run(self) -> Outcome:
        from tint_sumo.comparisons.traits import run_trait_study

        with working_folder(self.out) as out, self.workers_of(self.workers) as workers:
            report = run_trait_study(TRAIT_STUDY.full(self.budget), out, workers=workers)
        files = names_in(self.out, out, (report.csv_file, report.markdown_file, report.figure_file))
        text = "\n".join([report.markdown, *wrote(files)])
        return Outcome(text, {"results": report.table.to_dict("records"), "files": files})


@dataclass(frozen=True)
class Traits:
    """Driver traits learnt from trajectories."""

    command: (
        Annotated[TrainTraits, subcommand("train")]
        | Annotated[FitRelative, subcommand("relative")]
        | Annotated[EvaluateTraits, subcommand("evaluate")]
        | Annotated[PlotTraits, subcommand("plot")]
        | Annotated[InferTraits, subcommand("infer")]
        | Annotated[ExportTraits, subcommand("export")]
        | Annotated[IdentifyTraits, subcommand("identify")]
        | Annotated[StudyTraits, subcommand("study")]
    )


def require_one(**given: Path | None) -> Path:
    """Return the only path among some that are given by their flags.

    Raises:
        InputError: there is none, or more than one.
    """
    paths = [path for path in given.values() if path is not None]
    if len(paths) != 1:
        raise InputError(f"give either {' or '.join(f'`{name}`' for name in given)}")
    return paths[0]


def _part_name(name: str) -> str:
    return name.replace("_", " ") if name[0].isalpha() else f"{name} steps"


def _confusion_lines(confusion: Mapping[str, Mapping[str, int]]) -> list[str]:
    """Return a table of windows: a row for each trait, and the linear classifier's answers in columns."""
    sizes = {name: sum(answers.values()) for name, answers in confusion.items()}
    shown = sorted(sizes, key=lambda name: -sizes[name])[:_MOST_CONFUSED]
    rows = [["", *shown, "right"]]
    for name in shown:
        right = percent(confusion[name][name] / sizes[name], 1) + "%" if sizes[name] else "-"
        rows.append([name, *(f"{confusion[name][answer]:,}" for answer in shown), right])
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    lines = ["", "windows of each trait (rows), and what the linear SVC takes them for (columns)"]
    for first, *others in rows:
        cells = (cell.rjust(width) for cell, width in zip(others, widths[1:], strict=True))
        lines.append("  ".join([first.ljust(widths[0]), *cells]).rstrip())
    if len(sizes) > len(shown):
        lines.append(f"{len(sizes) - len(shown)} rarer traits are in --json alone")
    return lines
