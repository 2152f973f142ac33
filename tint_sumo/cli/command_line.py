"""The ``tint-sumo`` command. Each command is a dataclass whose fields are its flags."""

import io
import json
import sys
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager, redirect_stdout, suppress
from dataclasses import asdict, dataclass, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, ClassVar, Literal, get_args

import tyro
from tyro.conf import (
    FlagCreatePairsOff,
    OmitArgPrefixes,
    OmitSubcommandPrefixes,
    Positional,
    Suppress,
    arg,
    subcommand,
)

from tint_sumo import ENV_IDS
from tint_sumo.cli.configuration import (
    FromFile,
    commands_named,
    config_of,
    name_flag,
    one_of,
    read_command,
    write_command,
)
from tint_sumo.config import Decisions, Fraction, NoiseM, Seed, TauS, TrafficSeed, WindowCount
from tint_sumo.core.errors import BAD_PATHS, InputError, JobError, system_problem
from tint_sumo.core.files import PICTURE_SUFFIXES, require_output_file, require_output_folder
from tint_sumo.core.percentages import percent
from tint_sumo.core.processes import end_quickly, interrupt_on_sigterm
from tint_sumo.core.provenance import Origin, made_by, version_text
from tint_sumo.core.ranges import Processes, Range, require_ranges
from tint_sumo.core.redaction import redact
from tint_sumo.core.stores import name_in, working_folder
from tint_sumo.core.streams import READER_GONE, flushed_output, has_lost_reader, show_any_name
from tint_sumo.core.structures import Many, Where

if TYPE_CHECKING:
    from tint_sumo.config import Share
    from tint_sumo.jobs import Workers
    from tint_sumo.methods.loading import Contender
    from tint_sumo.study.report import StudyReport

# What a command needs is imported when it runs: --help shall not wait for torch and SUMO.
# ruff: noqa: PLC0415

Cases = Annotated[int, Range(1, 1_000_000)]
ShareFlag = Many[Fraction]  # one probability, or the two ends of a range
_SCENES = ", ".join(ENV_IDS)
Shell = Literal["bash", "zsh", "tcsh"]
_TYRO = (OmitArgPrefixes, OmitSubcommandPrefixes, FlagCreatePairsOff)
RESUMES = ", the same command goes on from here"


@dataclass(frozen=True)
class Outcome:
    """What a command prints: lines for people and, with --json, one object."""

    text: str
    content: dict[str, Any]


@dataclass(frozen=True, kw_only=True)
class Command:
    after_interrupt: ClassVar[str] = ", nothing was kept"

    json: bool = False
    """Print one JSON object as the last line of stdout."""
    config: Path | None = None
    """YAML file with values of these flags, named as here but with underscores; flags that are given here win. A scene,
    a budget or a population can be a mapping there: of its base, and the numbers that differ."""
    print_config: bool = False
    """Print all values as such a file, and do nothing else."""

    def run(self) -> Outcome:
        raise NotImplementedError


@dataclass(frozen=True, kw_only=True)
class SpreadCommand(Command):
    """A command whose work many machines can share."""

    executor: Literal["local", "ray"] = "local"
    """local: this machine; ray: a Ray cluster, with the same results (needs tint_sumo[ray])."""
    address: str = "auto"
    """Address of the Ray cluster, ray://HOST:10001; local: Ray on this machine alone; auto: the cluster that
    RAY_ADDRESS names or that runs on this machine or, if there is none, local."""

    @contextmanager
    def workers_of(self, workers: int, gpus_per_job: float = 0.0) -> "Iterator[Workers]":
        """In the block, what does the work: so many processes, or the cluster."""
        if self.executor == "local":
            for flag, value, default in (("address", self.address, "auto"), ("gpus-per-job", gpus_per_job, 0.0)):
                if value != default:
                    raise InputError(f"--{flag} goes with --executor ray; add that, or leave it out")
            yield workers
            return
        if workers != getattr(type(self), "workers", workers):  # a command without that flag uses no processes
            raise InputError("--workers goes with --executor local; a cluster does as many jobs as it has room for")
        try:
            from tint_sumo.jobs.cluster import ray_cluster
        except ModuleNotFoundError as error:
            if error.name != "ray":
                raise
            raise InputError('--executor ray needs Ray; install it: pip install "tint_sumo[ray]"') from None
        with ray_cluster(self.address, gpus_per_job) as found:
            if found.dashboard_url:
                print(f"Ray's dashboard: http://{found.dashboard_url}", file=sys.stderr)
            yield found


# What is a name among the flags can be defined in a configuration file.


def _read_scene(value: Any, where: Where = ()) -> Any:
    from tint_sumo.scenes import ALL_SCENES, read_scene

    return value if value in (None, ALL_SCENES) else read_scene(value, where)


def _scene_in_full(value: Any) -> Any:
    from tint_sumo.scenes import ALL_SCENES, scene_settings

    return value if value in (None, ALL_SCENES) else scene_settings(value)


def _read_population(value: Any, where: Where) -> Any:
    from tint_sumo.config import population_name, read_population

    if value is None:
        return None
    population = read_population(value, where)
    return population_name(population) or population


def _population_in_full(value: Any) -> Any:
    from tint_sumo.config import find_population

    return find_population(value) if isinstance(value, str) else value


_SCENE = FromFile(_read_scene, _scene_in_full)
_POPULATION = FromFile(_read_population, _population_in_full)
_BUDGET = one_of("tint_sumo.study.budgets", "BUDGETS", "quick")
_PPO_BUDGET = one_of("tint_sumo.config", "PPO_BUDGETS", "full")
_TRAIT_BUDGET = one_of("tint_sumo.config", "TRAIT_BUDGETS", "quick")
_TRAIT_STUDY = one_of("tint_sumo.comparisons.traits", "TRAIT_STUDIES", "full")
_SCENE_STUDY = one_of("tint_sumo.comparisons.scenes", "SCENE_STUDIES", "full")

# A path would lose a slash of a URL.
_PLACE = arg(metavar="FOLDER|URL")
FolderOrUrl = Annotated[str, _PLACE]

# Values are names, or what these make of a file.
SceneValue = Annotated[Any, name_flag(), _SCENE]
PopulationValue = Annotated[Any, name_flag("traits", "continuous"), _POPULATION]
BudgetValue = Annotated[Any, name_flag("quick", "full", "paper"), _BUDGET]
PpoBudgetValue = Annotated[Any, name_flag("quick", "full", "paper"), _PPO_BUDGET]
TraitBudgetValue = Annotated[Any, name_flag("quick", "full", "paper"), _TRAIT_BUDGET]
TraitStudyValue = Annotated[Any, name_flag("full"), _TRAIT_STUDY]
SceneStudyValue = Annotated[Any, name_flag("full"), _SCENE_STUDY]


@dataclass(frozen=True, kw_only=True)
class Net(Command):
    """Build a scene's road network, the drivers and plain SUMO's configuration with netconvert."""

    scene: Annotated[SceneValue, arg(help=f"Scene: {_SCENES}.")] = "t_intersection"
    replicas: Annotated[int, Range(1, 10_000)] = 1
    """Number of intersections in the network."""
    out: Path = Path("sumo_net")
    """Folder for the files; files of the same names are replaced if this command wrote them."""

    def run(self) -> Outcome:
        from tint_sumo.scenes import Scene, find_scene
        from tint_sumo.scenes.build import CONFIG_FILE, write_scene

        scene = find_scene(self.scene)
        if not isinstance(scene, Scene):
            raise InputError(f"scene {scene.name} has SUMO's files already")
        files = write_scene(self.out, scene, self.replicas)
        text = f"wrote {len(files)} files to {self.out}; run them with: sumo -c {self.out / CONFIG_FILE}"
        return Outcome(text, {"replicas": self.replicas, "files": [str(file) for file in files]})


@dataclass(frozen=True, kw_only=True)
class Record(SpreadCommand):
    """Record a dataset of traffic without the ego vehicle; the same command resumes an interrupted recording."""

    after_interrupt: ClassVar[str] = RESUMES

    out: FolderOrUrl
    """Folder for the dataset, or a URL such as s3://bucket/folder."""
    windows: WindowCount = 30_000
    """At least so many windows of up to 20 steps of 0.1 s."""
    p_conservative: ShareFlag = (0.5,)
    """Probability that a driver is conservative, 0 to 1; two numbers: each episode draws its own between them."""
    population: PopulationValue = None
    """traits: conservative and aggressive drivers; continuous: desired speeds and gaps without classes; the scene's
    drivers, traits in all that are built in, if not given."""
    seed: TrafficSeed = 0
    """Seed of the traffic."""
    scene: Annotated[SceneValue, arg(help=f"Scene: {_SCENES}.")] = "t_intersection"
    workers: Processes = 1
    """Processes of this machine that simulate; the dataset does not depend on their number."""
    format: Literal["parquet", "fcd"] = "parquet"
    """Parquet is always written; fcd: SUMO's floating-car data, too, also for a dataset that is there already."""
    sumocfg: Path | None = None
    """A SUMO configuration of your own in place of a scene: its network and demand, its vTypes as labels."""

    def run(self) -> Outcome:
        from tint_sumo.dataset.recorder import record
        from tint_sumo.dataset.sumocfg_recorder import record_sumocfg
        from tint_sumo.scenes import SumocfgScene

        sumocfg = self.scene.config.file if isinstance(self.scene, SumocfgScene) else self.sumocfg
        if sumocfg is not None:
            self._require_nothing_but_the_configuration()
            manifest = record_sumocfg(sumocfg, self.out, self.windows, seed=self.seed, workers=self.workers)
            return Outcome(f"{manifest['windows']} windows in {self.out}", manifest)
        with self.workers_of(self.workers) as workers:
            manifest = record(
                self.out,
                self.windows,
                p_conservative=_share(self.p_conservative),
                population=self.population,
                seed=self.seed,
                scene=self.scene,
                workers=workers,
                fcd=self.format == "fcd",
            )
        return Outcome(f"{manifest['windows']} windows in {self.out}", manifest)

    def _require_nothing_but_the_configuration(self) -> None:
        flags = ["p_conservative", "population", "format"]
        other = "the sumocfg of a scene"
        if self.executor != "local":
            raise InputError("a .sumocfg is on this machine alone; use --executor local")
        if self.sumocfg is not None:
            flags.append("scene")
            other = "--sumocfg"
        for flag in flags:
            if getattr(self, flag) != getattr(Record, flag):
                name = flag.replace("_", "-")
                raise InputError(f"--{name} does not go with {other}, which tells all of the traffic; leave it out")


@dataclass(frozen=True, kw_only=True)
class InspectDataset(Command):
    """Tell what is in a dataset: counts, settings, and distributions of speed and gap per driver trait."""

    data: Positional[Path]
    """Folder of a dataset."""
    figure: Path | None = None
    """Where a picture of the distributions goes: .png, .jpg, .webp, .svg or .pdf."""
    verify: bool = False
    """Compare all files with the checksums of the manifest first."""

    def run(self) -> Outcome:
        from tint_sumo.dataset.inspection import inspect, plot, report
        from tint_sumo.dataset.schema import verify
        from tint_sumo.dataset.windows import read_manifest

        if self.figure is not None:
            require_output_file(self.figure, PICTURE_SUFFIXES, "--figure")
        verified = verify(self.data, read_manifest(self.data)) if self.verify else None
        found = inspect(self.data)
        text = report(found)
        if verified is not None:
            text += f"\nall {verified} files are as they were recorded"
        if self.figure is not None:
            plot(found, self.figure)
            text = "\n".join([text, *_wrote([str(self.figure)])])
        return Outcome(text, {"data": str(self.data), "verified_files": verified, **found.summary()})


@dataclass(frozen=True, kw_only=True)
class TrainTraits(Command):
    """Train a trait model on a dataset; the same command resumes an interrupted training."""

    after_interrupt: ClassVar[str] = RESUMES

    data: Path
    """Folder of a dataset."""
    out: Path
    """Folder for the model."""
    method: str = "vae"
    """vae (the paper's), cross_window and morton learn without labels, classifier with them."""
    budget: TraitBudgetValue = "quick"
    """quick: for about 30,000 windows; full: for some 700,000; paper: the paper's network and 1000 epochs."""
    noise: NoiseM | None = None
    """Standard deviation of the noise on every position in training, m; that of the budget, 0 in all that have names,
    if not given."""
    seed: Seed = 0
    """Seed of the training, and of the split into training and test episodes."""
    streaming: bool = False
    """Keep the windows in a file beside the model instead of in memory, for large datasets; the model is the same."""

    def run(self) -> Outcome:
        from tint_sumo.jobs.status import Title
        from tint_sumo.jobs.table import one_job
        from tint_sumo.traits.datasets import require_used, train_traits

        settings = _TRAIT_BUDGET.full(self.budget)
        if self.noise is not None:
            if settings.noise_m not in (0.0, self.noise):
                raise InputError(f"noise is {self.noise:g} m, and {settings.noise_m:g} m in the budget; give it once")
            settings = replace(settings, noise_m=self.noise)
        require_used(self.method, settings)
        with one_job(Title("traits", self.method, seed=self.seed)) as report:
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
class EvaluateTraits(Command):
    """Tell how well a linear classifier reads the drivers' traits from a model's latents, on unseen episodes."""

    data: Path
    """Folder of a dataset; the test episodes are those that training with the model's seed leaves out."""
    model: str
    """Name of a shipped model, folder of a training run, or path of a .safetensors file."""
    noise: NoiseM = 0.0
    """Standard deviation of the noise on every position, m."""
    other_scene: bool = False
    """Take a model that was trained in another scene, too."""

    def run(self) -> Outcome:
        from tint_sumo.traits.datasets import evaluate_traits

        _use_one_thread()
        found = evaluate_traits(self.data, self.model, noise_m=self.noise, other_scene=self.other_scene)
        parts = {**found["by_length"], **found["by_leader"]}
        lines = [
            f"linear SVC         {percent(found['accuracy'], 3):>7}% of {found['windows']} windows",
            f"majority share     {percent(found['majority_share'], 3):>7}% (of always taking the most frequent trait)",
            f"nearest neighbours {percent(found['knn_accuracy'], 3):>7}%",
            *(
                f"  {_part_name(name):16} {percent(part['accuracy'], 3):>7}%"
                for name, part in parts.items()
                if part["windows"]
            ),
        ]
        if found["error_m"] is not None:
            lines.append(f"position error     {found['error_m']:8.4f} m (root mean square)")
        return Outcome("\n".join(lines), found)


def _part_name(name: str) -> str:
    return name.replace("_", " ") if name[0].isalpha() else f"{name} steps"


@dataclass(frozen=True, kw_only=True)
class PlotTraits(Command):
    """Draw a model's latent space beside the trajectories of some windows, and reconstructions if it makes them."""

    data: Path
    """Folder of a dataset; the test episodes are those that training with the model's seed leaves out."""
    model: str
    """Name of a shipped model, folder of a training run, or path of a .safetensors file."""
    out: Path
    """Folder for the PNG files."""
    noise: NoiseM = 0.0
    """Standard deviation of the noise on every position, m."""
    other_scene: bool = False
    """Take a model that was trained in another scene, too."""

    def run(self) -> Outcome:
        from tint_sumo.traits.datasets import plot_traits

        require_output_folder(self.out)
        _use_one_thread()
        files = plot_traits(self.data, self.model, self.out, noise_m=self.noise, other_scene=self.other_scene)
        names = [str(file) for file in files]
        return Outcome("\n".join(_wrote(names)), {"files": names})


@dataclass(frozen=True, kw_only=True)
class InferTraits(Command):
    """Infer the traits of the vehicles in any SUMO run: a table of latents per vehicle and window of 2 s."""

    fcd: Path
    """What sumo --fcd-output wrote (XML, CSV, Parquet), or a recorded dataset."""
    model: str
    """Name of a shipped model, folder of a training run, or path of a .safetensors file."""
    out: Path
    """The table, .csv or .parquet."""
    net: Path | None = None
    """The scenario's .net.xml; without it nobody sees a leader beyond the end of a lane."""
    vehicle_length: Annotated[float, Range(0.5, 30.0)] = 5.0
    """Length of the vehicles in floating-car data, m."""

    def run(self) -> Outcome:
        from tint_sumo.traits.inference import OUTSIDE, SUFFIXES, infer_traits, write_table

        if self.out.exists() and self.fcd.exists() and self.out.samefile(self.fcd):
            raise InputError(f"{self.out} holds the data themselves; choose another --out")
        require_output_file(self.out, SUFFIXES)
        _use_one_thread()
        table = infer_traits(self.fcd, self.model, net_file=self.net, vehicle_length_m=self.vehicle_length)
        write_table(table, self.out)
        outside = float(table[OUTSIDE].mean()) if OUTSIDE in table else None
        content = {"out": str(self.out), "windows": len(table), "vehicles": int(table["vehicle"].nunique())}
        reach = "how many are outside is not known, since the model's card does not tell what it was trained on"
        if outside is not None:
            reach = f"{percent(outside)}% of the windows lie outside what the model was trained on"
        text = f"{content['windows']} windows of {content['vehicles']} vehicles: {self.out}\n{reach}"
        return Outcome(text, {**content, "outside": outside, "columns": list(table)})


@dataclass(frozen=True, kw_only=True)
class StudyTraits(SpreadCommand):
    """Compare all trait methods at every position noise, an hour's work; the same command resumes it."""

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
            report = run_trait_study(_TRAIT_STUDY.full(self.budget), out, workers=workers)
        files = _names(self.out, out, (report.csv_file, report.markdown_file, report.figure_file))
        text = "\n".join([report.markdown, *_wrote(files)])
        return Outcome(text, {"results": report.table.to_dict("records"), "files": files})


@dataclass(frozen=True, kw_only=True)
class TrainPolicy(Command):
    """Train a navigation policy with PPO; the same command resumes an interrupted training."""

    after_interrupt: ClassVar[str] = RESUMES

    method: str
    """Learned method: no_labels, morton, vae, no_attention, cross_window, streaming, streaming_critic, ma or oracle."""
    out: Path
    """Folder for the policy, its card, the training's curve and the TensorBoard log."""
    p_conservative: ShareFlag = (0.1, 0.9)
    """Probability that a driver is conservative, 0 to 1; two numbers: each episode draws its own between them."""
    steps: Decisions | None = None
    """Decisions of the policy; those of the budget if not given."""
    seed: Seed = 0
    """Seed of the training, 0 to 1000."""
    budget: PpoBudgetValue = "full"
    """Sizes of the network, settings of PPO and number of decisions. full takes 5 to 8 minutes on a free core."""
    scene: Annotated[SceneValue, arg(help=f"Scene: {_SCENES}, or all of them at once: all.")] = "t_intersection"
    traits: str | None = None
    """Trait model of methods that infer traits: shipped name, folder of a training run, or .safetensors file; the
    shipped one of the method if not given."""
    other_scene: bool = False
    """Take a trait model that was trained in another scene, too."""
    zip: bool = False
    """Write the policy as Stable-Baselines3's policy.zip, too. That is a pickle: others must trust you to read it."""

    def run(self) -> Outcome:
        from tint_sumo.config import share_words
        from tint_sumo.films.training_films import film_policy
        from tint_sumo.jobs.status import Title
        from tint_sumo.jobs.table import one_job
        from tint_sumo.methods.training import train_policy
        from tint_sumo.scenes import SumocfgScene

        _use_one_thread()
        is_sumocfg = isinstance(self.scene, SumocfgScene) and self.p_conservative == TrainPolicy.p_conservative
        settings = _PPO_BUDGET.full(self.budget)
        steps = settings.total_steps if self.steps is None else self.steps
        share = None if is_sumocfg else _share(self.p_conservative)
        mix = "" if share is None else share_words(share)
        with one_job(Title("train", self.method, mix, self.seed)) as report:
            policy = train_policy(
                self.method,
                share,
                steps,
                self.seed,
                self.out,
                settings=settings,
                scene=self.scene,
                traits=self.traits,
                other_scene=self.other_scene,
                with_zip=self.zip,
                film=film_policy,
                report=report,
            )
        content = {"model": str(policy), "method": self.method, "p_conservative": self.p_conservative}
        return Outcome(f"trained {self.method}: {policy}", {**content, "steps": steps, "seed": self.seed})


@dataclass(frozen=True, kw_only=True)
class EvaluatePolicy(SpreadCommand):
    """Evaluate a policy on unseen cases, which are the same for every policy; rates are fractions of episodes."""

    model: str
    """A shipped policy by its method's name (streaming, oracle, ...), always_go, ttc, the folder of a training run, a
    .safetensors file, or with --allow-pickle a .zip file."""
    p_conservative: ShareFlag | None = None
    """Probability that a driver is conservative, 0 to 1, or two numbers between which each case draws its own; those
    of the policy's training if not given."""
    scene: SceneValue = None
    """Scene; the one the policy was trained in if not given, for always_go and ttc t_intersection."""
    noise: NoiseM = 0.0
    """Standard deviation of the noise on the others' positions, m."""
    tau: TauS | None = None
    """Time headway of the other drivers, s; the scene's if not given, 1 s in all that are built in."""
    episodes: Cases = 500
    """Number of cases."""
    seed: Seed = 0
    """Which set of cases, 0 to 1000."""
    allow_pickle: bool = False
    """Read .zip files, which can run any code: only for files you trust."""

    def run(self) -> Outcome:
        from tint_sumo.core.progress import progress_bar
        from tint_sumo.envs.rows import OUTCOMES
        from tint_sumo.methods.evaluation import evaluate
        from tint_sumo.methods.evaluation_jobs import evaluate_on
        from tint_sumo.methods.loading import load_policy

        _use_one_thread()
        given = {"scene": self.scene, "allow_pickle": self.allow_pickle}
        contender = load_policy(self.model, **given)
        world = _world(contender, self.p_conservative, self.noise, self.tau)
        with self.workers_of(1) as workers:
            if isinstance(workers, int):
                with progress_bar(self.model) as report:
                    evaluation = evaluate(
                        contender.policy,
                        lambda num_envs: contender.make_venv(num_envs, **world),
                        self.episodes,
                        self.seed,
                        report=report,
                    )
            else:
                evaluation = evaluate_on(workers, self.model, contender, world, self.episodes, self.seed, **given)
        rates = {outcome: evaluation.rate(outcome) for outcome in OUTCOMES}
        lines = [
            f"{outcome:9} {percent(rate.value):>5}%  (95 % interval {low}% to {high}%)"
            for outcome, rate in rates.items()
            for low, high in (map(percent, rate.interval),)
        ]
        time_s = evaluation.navigation_time_s
        lines.append("no success" if time_s is None else f"navigation time {time_s:.1f} s")
        place = {"model": self.model, "scene": contender.scene_name, **world}
        return Outcome("\n".join(lines), {**place, "seed": self.seed, **evaluation.summary()})


@dataclass(frozen=True, kw_only=True)
class SweepPolicy(SpreadCommand):
    """Train and test methods with other settings of PPO, all combinations; the same command resumes it. Tests are on
    cases that are reported nowhere (set 1000), so that settings can be chosen by them."""

    after_interrupt: ClassVar[str] = RESUMES

    set: Annotated[Many[str], arg(metavar="NAME=VALUE,VALUE [NAME=VALUE,VALUE ...]")]
    """Values of PPO's settings, all behind one --set, such as learning_rate=0.001,0.003 n_epochs=2,4; names of the
    network's settings begin with policy, such as policy.hidden_size=32,64."""
    out: FolderOrUrl
    """Folder of the sweep, or a URL such as s3://bucket/folder."""
    methods: Many[str] = ("oracle",)
    """Learned methods: no_labels, morton, vae, no_attention, cross_window, streaming, streaming_critic, ma, oracle."""
    seeds: Many[Seed] = (0,)
    """Seeds of the trainings, 0 to 1000."""
    p_conservative: ShareFlag = (0.1, 0.9)
    """Probability in training that a driver is conservative, 0 to 1; two numbers: each episode draws its own between
    them. Tests are at those of 0.25, 0.4 and 0.6 that this includes."""
    budget: PpoBudgetValue = "full"
    """Sizes of the network, settings of PPO and number of decisions, where --set does not say others."""
    scene: Annotated[SceneValue, arg(help=f"Scene: {_SCENES}.")] = "t_intersection"
    episodes: Cases = 500
    """Number of cases of each test."""
    workers: Processes = 2
    """Processes of this machine at a time."""
    gpus_per_job: Annotated[float, Range(0.0, 64.0)] = 0.0
    """Share of a GPU for each training, with --executor ray and where the cluster has GPUs."""

    def run(self) -> Outcome:
        from tint_sumo.comparisons.sweep import Sweep, read_varied, report_markdown, run_sweep

        sweep = Sweep(
            _PPO_BUDGET.full(self.budget),
            read_varied(self.set),
            methods=self.methods,
            seeds=self.seeds,
            p_conservative=_share(self.p_conservative),
            scene=self.scene,
            episodes=self.episodes,
        )
        with working_folder(self.out) as out, self.workers_of(self.workers, self.gpus_per_job) as workers:
            table = run_sweep(sweep, out, workers=workers)
        files = [name_in(self.out, name) for name in ("sweep.csv", "sweep.md")]
        text = "\n".join([report_markdown(table, self.episodes), *_wrote(files)])
        rows = table.astype(object).where(table.notna(), None).to_dict("records")
        return Outcome(text, {"results": rows, "files": files})


@dataclass(frozen=True, kw_only=True)
class RunStudy(SpreadCommand):
    """Record, learn traits, train and evaluate every method, report; the same command resumes an interrupted study."""

    after_interrupt: ClassVar[str] = RESUMES

    budget: BudgetValue = "quick"
    """quick: minutes, few decisions. full: all methods, four seeds, three hours. paper: all numbers as in the paper,
    days."""
    out: Annotated[str | None, _PLACE] = None
    """Folder of the study, or a URL such as s3://bucket/folder; runs/<budget> if not given."""
    scene: Annotated[SceneValue, arg(help=f"Scene: {_SCENES}.")] = "t_intersection"
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
                report = run_study(_BUDGET.full(self.budget), out, scene=self.scene, workers=workers)
            found = sorted(out.glob("traits/*/latent.png")) + sorted(out.glob("policies/*/policy.safetensors"))
            made = _names(place, out, [out / DATASET, *found])
        outcome = _report_outcome(report, place, out)
        text = "\n".join([outcome.text, *_wrote(made)])
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

        table = run_scene_study(_SCENE_STUDY.full(self.budget), self.out, workers=self.workers)
        files = [str(self.out / "scenes.csv"), str(self.out / "scenes.md")]
        text = "\n".join([report_markdown(table), *_wrote(files)])
        return Outcome(text, {"results": table.to_dict("records"), "files": files})


@dataclass(frozen=True, kw_only=True)
class Render(Command):
    """Film one unseen case: who drives how, what the policy takes them for, where it looks, what it does."""

    model: str
    """A shipped policy by its method's name (streaming, oracle, ...), always_go, ttc, the folder of a training run, a
    .safetensors file, or with --allow-pickle a .zip file."""
    out: Path
    """The film, .mp4 (needs tint_sumo[video]) or .gif, or a strip of eight moments, .png."""
    p_conservative: ShareFlag | None = None
    """Probability that a driver is conservative, 0 to 1, or two numbers between which the case draws its own; those
    of the policy's training if not given."""
    case: Annotated[int, Range(0, 999_999)] = 0
    """Number of the case; the same cases as in policy evaluate."""
    seed: Seed = 0
    """Which set of cases, 0 to 1000."""
    scene: SceneValue = None
    """Scene; the one the policy was trained in if not given, for always_go and ttc t_intersection."""
    noise: NoiseM = 0.0
    """Standard deviation of the noise on the others' positions, m; the film shows where they are."""
    tau: TauS | None = None
    """Time headway of the other drivers, s; the scene's if not given, 1 s in all that are built in."""
    allow_pickle: bool = False
    """Read .zip files, which can run any code: only for files you trust."""

    def run(self) -> Outcome:
        from tint_sumo.core.progress import progress_bar
        from tint_sumo.films.film import render_case, require_film_file
        from tint_sumo.methods.loading import load_policy

        require_film_file(self.out)
        _use_one_thread()
        contender = load_policy(self.model, scene=self.scene, allow_pickle=self.allow_pickle)
        world = _world(contender, self.p_conservative, self.noise, self.tau)
        with progress_bar(str(self.out)) as report:
            film = render_case(contender, self.case, self.out, seed=self.seed, report=report, **world)
        text = f"{film.outcome} after {film.time_s:.1f} s, {film.frames} frames: {self.out}"
        content = {"model": self.model, "scene": contender.scene_name, **world, "case": self.case, "seed": self.seed}
        return Outcome(text, {**content, "out": str(self.out), **asdict(film)})


@dataclass(frozen=True, kw_only=True)
class Bench(Command):
    """Measure how fast the environments and the recorder are on this machine, against SUMO's own speed."""

    quick: bool = False
    """Measure less, for a first look; 2 to 4 minutes on a free machine otherwise."""

    def run(self) -> Outcome:
        from tint_sumo.bench import QUICK, Sizes, run_benchmark

        found = run_benchmark(QUICK if self.quick else Sizes())
        return Outcome(found.table(), found.to_json())


@dataclass(frozen=True, kw_only=True)
class Models(Command):
    """List the trained models that are shipped: kind, method, scene, training and main result; or show one's card."""

    name: Positional[str | None] = None
    """Name of a shipped model, whose card is shown; a trait model and a policy may share it."""

    def run(self) -> Outcome:
        from tint_sumo.methods.shipped import card_text, models_named, models_table, shipped_models

        if self.name is None:
            models = shipped_models()
            return Outcome(models_table(models), {"models": [model.summary() for model in models]})
        models = models_named(self.name)
        content = [{**model.summary(), "card": model.card} for model in models]
        return Outcome("\n\n".join(map(card_text, models)), {"models": content})


# tyro makes subcommands of unions only, hence the None.
@dataclass(frozen=True)
class Dataset:
    """Recorded datasets."""

    command: Annotated[InspectDataset, subcommand("inspect")] | Suppress[None]


@dataclass(frozen=True)
class Traits:
    """Driver traits learnt from trajectories."""

    command: (
        Annotated[TrainTraits, subcommand("train")]
        | Annotated[EvaluateTraits, subcommand("evaluate")]
        | Annotated[PlotTraits, subcommand("plot")]
        | Annotated[InferTraits, subcommand("infer")]
        | Annotated[StudyTraits, subcommand("study")]
    )


@dataclass(frozen=True)
class Policy:
    """Navigation policies."""

    command: (
        Annotated[TrainPolicy, subcommand("train")]
        | Annotated[EvaluatePolicy, subcommand("evaluate")]
        | Annotated[SweepPolicy, subcommand("sweep")]
    )


@dataclass(frozen=True)
class Study:
    """The study end to end."""

    command: (
        Annotated[RunStudy, subcommand("run")]
        | Annotated[ReportStudy, subcommand("report")]
        | Annotated[ShowLog, subcommand("log")]
        | Annotated[StudyScenes, subcommand("scenes")]
    )


@dataclass(frozen=True, kw_only=True)
class TintSumo:
    """Driving among strangers: driver-trait inference and intersection navigation on Eclipse SUMO."""

    version: bool = False
    """Print the version, and those of SUMO, torch, gymnasium and Python, and do nothing else."""
    print_completion: Shell | None = None
    """Print a script that completes commands and flags in that shell, and do nothing else. For bash, put this line into
    ~/.bashrc: eval "$(tint-sumo --print-completion bash)"."""

    command: (
        Annotated[Net, subcommand("net")]
        | Annotated[Record, subcommand("record")]
        | Annotated[Dataset, subcommand("dataset")]
        | Annotated[Traits, subcommand("traits")]
        | Annotated[Policy, subcommand("policy")]
        | Annotated[Study, subcommand("study")]
        | Annotated[Render, subcommand("render")]
        | Annotated[Bench, subcommand("bench")]
        | Annotated[Models, subcommand("models")]
    )


def main(argv: Sequence[str] | None = None) -> int:
    """Run one command and return its exit code.

    It is 0; 1 if jobs failed or the system refused something, such as room on a full disk; 2 after bad input; 130 after
    Ctrl-C or SIGTERM; or 141 if nobody reads any more what it prints.
    """
    end_quickly()
    interrupt_on_sigterm()
    show_any_name()
    try:
        with flushed_output():
            return _run(list(sys.argv[1:] if argv is None else argv))
    except OSError as error:
        if has_lost_reader():
            return READER_GONE
        return _refuse(system_problem(error), 2 if isinstance(error, BAD_PATHS) else 1)
    except UnicodeEncodeError as error:
        return _refuse(f"a name holds {error.object[error.start]!r}, which is no text; use another name", 1)


def _run(words: list[str]) -> int:
    """Run the command that the words of a command line say, and print what comes out."""
    after_interrupt = Command.after_interrupt
    if words[:1] == ["--print-completion"] and words[1:] in ([shell] for shell in get_args(Shell)):
        print(_completion_script(words[1]), end="")
        return 0
    if words == ["--version"]:
        print(version_text())
        return 0
    try:
        command = parse(words)
        after_interrupt = command.after_interrupt
        if command.print_config:
            print(write_command(command), end="")
            return 0
        with made_by(Origin(tuple(words), partial(write_command, command))):
            outcome = command.run()
    except (InputError, JobError) as error:
        return _refuse(str(error), 2 if isinstance(error, InputError) else 1)
    except KeyboardInterrupt:
        print("\ntint-sumo: interrupted; all files are whole" + after_interrupt, file=sys.stderr)
        return 130
    print(redact(outcome.text))
    if command.json:
        print(redact(json.dumps(outcome.content)))
    return 0


def _refuse(message: str, exit_code: int) -> int:
    print(f"tint-sumo: error: {redact(message)}", file=sys.stderr)
    return exit_code


def parse(words: list[str]) -> Command:
    """The command that the words of a command line say, with what its configuration file says.

    Raises:
        InputError: the file is not there, a value in it does not fit, a flag comes twice, or a path is a URL.
    """
    _require_each_once(words)
    file = config_of(words)
    *groups, kind = commands_named(TintSumo, words)
    if file is None or not issubclass(kind, Command):
        parsed: Any = tyro.cli(TintSumo, prog="tint-sumo", args=words, config=_TYRO)
    else:
        default: Any = read_command(kind, file)
        for group in reversed(groups):
            default = group(command=default)
        with_pairs = [one for one in _TYRO if one is not FlagCreatePairsOff]  # --no-json where the file has json: true
        parsed = tyro.cli(TintSumo, prog="tint-sumo", args=words, default=default, config=with_pairs)
    while not isinstance(parsed, Command):
        parsed = parsed.command
    _require_paths(parsed)
    require_ranges(parsed)
    return parsed


def _require_each_once(words: Sequence[str]) -> None:
    """Raise InputError if a flag comes twice: what stands behind the first would be forgotten in silence."""
    flags = [word.partition("=")[0] for word in words if word.startswith("--")]
    for flag in flags:
        if flags.count(flag) > 1:
            raise InputError(f"{flag} is given twice; give it once, with all of its values behind it")


def _require_paths(command: Command) -> None:
    """Raise InputError if a URL is given where a path belongs: it would become a folder with a strange name."""
    for name, value in vars(command).items():
        if isinstance(value, Path) and value.parts and value.parts[0].endswith(":"):
            raise InputError(
                f"--{name.replace('_', '-')} of this command is a path on this machine, not a URL; only record, traits "
                "study, study run and policy sweep write to URLs"
            )


def _completion_script(shell: str) -> str:
    """A script that a shell reads; it holds all commands and flags, and does not need this package."""
    script = io.StringIO()
    with redirect_stdout(script), suppress(SystemExit):
        tyro.cli(TintSumo, prog="tint-sumo", args=["--tyro-print-completion", shell], config=_TYRO)
    # The script offers each line of a help text as a word of its own.
    lines = script.getvalue().splitlines(keepends=True)
    return "".join(one.replace("\\n", " ") if one.startswith("COMPLETION_SPEC") else one for one in lines)


def _world(
    contender: "Contender", p_conservative: ShareFlag | None, noise_m: float, tau_s: float | None
) -> dict[str, Any]:
    """Where a policy is evaluated: what is not given is that of its training."""
    return {
        "p_conservative": contender.p_conservative if p_conservative is None else _share(p_conservative),
        "position_noise_m": noise_m,
        "tau_s": contender.tau_s if tau_s is None else tau_s,
    }


def _share(numbers: ShareFlag) -> "Share":
    """What one or two numbers after --p-conservative mean."""
    if len(numbers) not in (1, 2):
        raise InputError(f"p_conservative is one probability or two, from low to high, not {len(numbers)} numbers")
    return numbers[0] if len(numbers) == 1 else (numbers[0], numbers[1])


def _use_one_thread() -> None:
    """The networks are small: more threads gain little, and cost a multiple as soon as other work needs the cores."""
    import torch

    torch.set_num_threads(1)


def _report_outcome(report: "StudyReport", out: str, folder: Path) -> Outcome:
    """What a report says, of the study that the user calls ``out`` and that was written in ``folder``."""
    files = _names(out, folder, (report.csv_file, report.markdown_file, *report.figure_files, report.page_file))
    text = "\n".join([report.markdown, *_wrote(files)])
    return Outcome(text, {"results": [row.to_json() for row in report.rows], "files": files})


def _names(out: str, folder: Path, files: Iterable[Path | None]) -> list[str]:
    """What the user calls files of a folder that stands for the output folder ``out``."""
    return [name_in(out, file.relative_to(folder)) for file in files if file is not None]


def _wrote(files: Iterable[str]) -> Iterator[str]:
    """Lines that tell of the files that were written."""
    return (f"wrote {file}" for file in files)
