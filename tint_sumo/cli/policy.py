"""``tint-sumo policy``."""

from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, ClassVar

from tyro.conf import arg, subcommand

from tint_sumo.cli.command import RESUMES, Outcome, SpreadCommand, exporting_onnx, use_one_thread, wrote
from tint_sumo.cli.own_network import NetworkCommand
from tint_sumo.cli.values import (
    PPO_BUDGET,
    SCENES,
    Cases,
    FolderOrUrl,
    Gpus,
    MixFlag,
    OnnxFlag,
    PolicyName,
    PpoBudgetValue,
    Scene,
    SceneValue,
    SensorValue,
    TestMix,
    TestScene,
    TestSensor,
    TestTau,
    WorldName,
    optional,
)
from tint_sumo.config import PERFECT, SENSORS, Decisions, EpisodesSeed, Fraction, Mix, NoiseM, Seed, Sensor, network_ppo
from tint_sumo.core.errors import InputError
from tint_sumo.core.percentages import percent
from tint_sumo.core.ranges import Processes
from tint_sumo.core.stores import name_in, working_folder
from tint_sumo.core.structures import Many, plain
from tint_sumo.methods.registry import learned_methods

if TYPE_CHECKING:
    from tint_sumo.envs import TaskSettings
    from tint_sumo.methods.loading import Contender

_LEARNED = ", ".join(learned_methods())

_BUDGET = arg(
    help="Size of the network, settings of PPO and number of decisions; full takes 5 to 10 minutes on a free core. In "
    "a SUMO configuration full has 8 environments, each a process, and 200,000 decisions."
)
_TRAITS = optional(
    "MODEL",
    "Trait model of a method that infers traits: name of a shipped one, folder of a training, or path of a "
    ".safetensors file.",
    "the method's shipped one",
)
_MINARI = arg(metavar="NAME", help="Name of the dataset, such as tint_sumo/streaming-v0; needs tint_sumo[minari].")
_ROOT = optional("FOLDER", "Folder of all datasets.", "Minari's: MINARI_DATASETS_PATH, or ~/.minari/datasets")
_SENSOR = optional(
    "NAME", f"Sensor that the ego perceives the others with: {', '.join(SENSORS)}.", "perfect, or those of the world"
)
_SET = arg(
    metavar="NAME=VALUE,VALUE [NAME=VALUE,VALUE ...]",
    help="Values of PPO's settings, all behind one --set, such as learning_rate=0.001,0.003 n_epochs=2,4; names of the "
    "network's settings begin with policy, such as policy.hidden_size=32,64.",
)
_SWEEP_MIX = arg(
    help="Probability in training that a driver is conservative, 0 to 1; given two numbers, each episode draws it "
    "between them. Tests are at those of 0.25, 0.4 and 0.6 that this includes."
)


@dataclass(frozen=True, kw_only=True)
class TrainPolicy(NetworkCommand):
    """Train a navigation policy with PPO; the same command resumes an interrupted training."""

    after_interrupt: ClassVar[str] = RESUMES

    method: Annotated[str, arg(help=f"Learned method: {_LEARNED}.")]
    out: Path
    """Folder for the policy, its card, the training's curve and the TensorBoard log."""
    p_conservative: MixFlag = (0.1, 0.9)
    """Probability that a driver is conservative, 0 to 1; given two numbers, each episode draws it between them."""
    steps: Annotated[Decisions | None, optional("INT", "Decisions of the policy.", "the budget's")] = None
    seed: Seed = 0
    """Seed of the training, 0 to 1000."""
    budget: Annotated[PpoBudgetValue, _BUDGET] = "full"
    world: WorldName = None
    sensor: Annotated[SensorValue, _SENSOR] = None
    scene: Annotated[SceneValue, arg(help=f"Scene: {SCENES}, or all but t_intersection_street at once: all.")] = (
        "t_intersection"
    )
    traits: Annotated[str | None, _TRAITS] = None
    other_scene: bool = False
    """Accept a trait model that was trained in another scene."""
    zip: bool = False
    """Also write Stable-Baselines3's policy.zip, a pickle: whoever reads it must trust you."""

    def run(self) -> Outcome:
        from tint_sumo.envs.episodes import find_sensor
        from tint_sumo.envs.worlds import find_world, scene_in
        from tint_sumo.films.training_films import film_policy
        from tint_sumo.jobs.table import one_job
        from tint_sumo.methods.training import train_policy
        from tint_sumo.scenes import ALL_SCENES, find_scene, find_scenes

        use_one_thread()
        scene, sensors = self.scene_of(self.scene), [PERFECT if self.sensor is None else find_sensor(self.sensor)]
        if self.world is not None:
            require_one_sensor(self.sensor)
            if scene == ALL_SCENES:
                raise InputError(f"a world is of one scene; give `world`, or `scene` {ALL_SCENES}")
            world = find_world(self.world)
            scene, sensors = scene_in(world, find_scene(scene)), list(world.sensors)
        is_given = self.p_conservative != TrainPolicy.p_conservative
        first = find_scenes(scene)[0]
        has_mix = is_given or first.sumocfg is None
        is_default = self.budget == TrainPolicy.budget
        settings = network_ppo(first.step_s) if first.sumocfg and is_default else PPO_BUDGET.full(self.budget)
        steps = settings.total_steps if self.steps is None else self.steps
        mix = Mix.parse(self.p_conservative) if has_mix else None
        with one_job(f"train {self.method}") as report:
            policy = train_policy(
                self.method,
                mix,
                steps,
                self.seed,
                self.out,
                settings=settings,
                scene=scene,
                sensors=sensors,
                traits=self.traits,
                other_scene=self.other_scene,
                with_zip=self.zip,
                film=film_policy,
                report=report,
            )
        content = {
            "model": str(policy),
            "method": self.method,
            "scene": ALL_SCENES if scene == ALL_SCENES else first.name,
            "world": self.world,
            "sensors": [sensor_name(sensor) for sensor in sensors],
            "p_conservative": self.p_conservative if has_mix else None,
        }
        return Outcome(f"trained {self.method}: {policy}", {**content, "steps": steps, "seed": self.seed})


@dataclass(frozen=True, kw_only=True)
class PolicyCommand(NetworkCommand):
    """Base class of commands that let a policy drive among drivers and with a sensor that the user chooses."""

    model: PolicyName
    p_conservative: TestMix = None
    world: WorldName = None
    scene: TestScene = None
    sensor: TestSensor = None
    noise: NoiseM = 0.0
    """Standard deviation of the noise on the others' positions, m, with a sensor that has none."""
    tau: TestTau = None
    allow_pickle: bool = False
    """Read .zip files, which can run any code: for files that you trust alone."""

    def load(self) -> "tuple[Contender, TaskSettings]":
        """Return the policy, and the settings of its environments; what is not given is as in its training."""
        from tint_sumo.methods.loading import load_policy

        contender = load_policy(self.model, scene=self.scene_of(self.scene), allow_pickle=self.allow_pickle)
        return contender, self._task(contender)

    def content_of(self, task: "TaskSettings") -> dict[str, Any]:
        """Return what --json prints of the policy and of settings of its environments."""
        return {
            "model": self.model,
            "scene": task.scene.name,
            "world": self.world,
            "p_conservative": plain(task.p_conservative),
            "sensor": sensor_name(task.sensor),
            "position_noise_m": task.sensor.noise_m,
            "tau_s": task.played.tau_s,
        }

    def _task(self, contender: "Contender") -> "TaskSettings":
        """Raise InputError if there are two noises, two sensors or two headways."""
        from tint_sumo.envs.episodes import find_sensor
        from tint_sumo.envs.worlds import find_world, task_in

        mix = contender.p_conservative if self.p_conservative is None else Mix.parse(self.p_conservative)
        task = replace(contender.task, p_conservative=mix, tau_s=self.tau)
        if self.world is not None:
            require_one_sensor(self.sensor)
            if self.tau is not None:
                raise InputError("a world has the headways of its drivers; give `world` or `tau`")
            task = task_in(find_world(self.world), task)
        if self.sensor is not None:
            task = replace(task, sensor=find_sensor(self.sensor))
        if self.noise == 0.0:
            return task
        if task.sensor.noise_m not in (0.0, self.noise):
            raise InputError(f"`noise` is {self.noise:g} m, and {task.sensor.noise_m:g} m in the sensor; give it once")
        return replace(task, sensor=replace(task.sensor, noise_m=self.noise))


@dataclass(frozen=True, kw_only=True)
class EvaluatePolicy(PolicyCommand, SpreadCommand):
    """Evaluate a policy on unseen test episodes (cases), which are the same for every policy."""

    episodes: Cases = 500
    """Number of cases."""
    seed: Seed = 0
    """Number of the case set, 0 to 1000."""

    def run(self) -> Outcome:
        from tint_sumo.jobs.table import one_job
        from tint_sumo.methods.evaluation import evaluate
        from tint_sumo.methods.evaluation_jobs import evaluate_on

        use_one_thread()
        contender, task = self.load()
        with self.workers_of(1) as workers:
            if isinstance(workers, int):
                with one_job(f"evaluate {self.model}") as report:
                    evaluation = evaluate(
                        contender.policy,
                        lambda num_envs: contender.make_venv(num_envs, task),
                        self.episodes,
                        self.seed,
                        report=report,
                    )
            else:
                evaluation = evaluate_on(
                    workers, self.model, task, self.episodes, self.seed, allow_pickle=self.allow_pickle
                )
        rates = {outcome: evaluation.rate(outcome) for outcome in evaluation.outcomes}
        lines = [
            f"{outcome:9} {percent(rate.value):>5}%  (95 % interval {low}% to {high}%)"
            for outcome, rate in rates.items()
            for low, high in (map(percent, rate.interval),)
        ]
        time_s = evaluation.navigation_time_s
        lines.append("no success" if time_s is None else f"navigation time {time_s:.1f} s")
        if evaluation.cost is not None:
            lines.append(f"driven over at red {evaluation.cost:.2f} stop lines per case")
        content = {**self.content_of(task), "seed": self.seed, **evaluation.summary()}
        return Outcome("\n".join(lines), content)


@dataclass(frozen=True, kw_only=True)
class RecordPolicy(PolicyCommand):
    """Record episodes of a policy as a Minari dataset for offline learning; none of them is a test case."""

    minari: Annotated[str, _MINARI]
    out: Annotated[Path | None, _ROOT] = None
    episodes: Cases = 500
    """Number of episodes."""
    random_actions: Fraction = 0.0
    """Share of the decisions whose action is drawn at random, for data that cover more than the policy does, 0 to 1."""
    seed: EpisodesSeed = 0
    """Number of the set of episodes, 0 to 999; no two sets share any."""
    workers: Processes = 1
    """Processes of this machine; the dataset does not depend on their number."""
    author: Annotated[str | None, optional("NAME", "Author of the dataset.")] = None
    author_email: Annotated[str | None, optional("ADDRESS", "The author's address.")] = None
    code_permalink: Annotated[str | None, optional("URL", "Code with which the dataset was made.")] = None
    description: Annotated[str | None, optional("TEXT", "Description.", "policy, scene and outcomes")] = None

    def run(self) -> Outcome:
        from tint_sumo.jobs.table import one_job

        try:
            from tint_sumo.methods.minari_dataset import Credits, PolicyEpisodes, record_minari
        except ModuleNotFoundError as error:
            if error.name not in ("minari", "h5py"):
                raise
            raise InputError('--minari needs Minari; install it: pip install "tint_sumo[minari]"') from None
        use_one_thread()
        _, task = self.load()
        episodes = PolicyEpisodes(
            self.model, task, self.episodes, self.seed, self.random_actions, allow_pickle=self.allow_pickle
        )
        credits = Credits(self.author, self.author_email, self.code_permalink, self.description)
        with one_job(f"record {self.model}") as report:
            found = record_minari(
                self.minari, episodes, root=self.out, credits=credits, workers=self.workers, report=report
            )
        lines = [f"{outcome:9} {count}" for outcome, count in found.outcomes.items()]
        text = "\n".join([*lines, f"{found.steps} decisions", *wrote([str(found.folder)])])
        content = {**self.content_of(task), "seed": self.seed, "random_actions": self.random_actions}
        shown = {"episodes": self.episodes, "decisions": found.steps, "outcomes": found.outcomes}
        return Outcome(text, {**content, **shown, "minari": self.minari, "folder": str(found.folder)})


@dataclass(frozen=True, kw_only=True)
class ExportPolicy(NetworkCommand):
    """Write a folder with all that belongs to one learned policy, to share it or to run it without Python."""

    model: PolicyName
    out: Path
    """Folder to write, which has no files yet; it is a model for all commands."""
    scene: TestScene = None
    onnx: OnnxFlag = False

    def run(self) -> Outcome:
        from tint_sumo.methods.exporting import export_policy
        from tint_sumo.methods.loading import load_policy

        use_one_thread()
        if self.model.endswith(".zip"):
            raise InputError(f"{self.model} is a pickle and is not exported; give the .safetensors file beside it")
        contender = load_policy(self.model, scene=self.scene_of(self.scene))
        with exporting_onnx():
            files = [str(file) for file in export_policy(contender, self.out, with_onnx=self.onnx)]
        return Outcome("\n".join(wrote(files)), {"model": self.model, "files": files})


@dataclass(frozen=True, kw_only=True)
class SweepPolicy(SpreadCommand):
    """Train and test methods with all combinations of some settings of PPO; the same command resumes it."""

    after_interrupt: ClassVar[str] = RESUMES

    set: Annotated[Many[str], _SET]
    out: FolderOrUrl
    """Folder of the sweep, or a URL such as s3://bucket/folder."""
    methods: Annotated[Many[str], arg(help=f"Learned methods: {_LEARNED}.")] = ("oracle",)
    seeds: Many[Seed] = (0,)
    """Seeds of the trainings, 0 to 1000."""
    p_conservative: Annotated[MixFlag, _SWEEP_MIX] = (0.1, 0.9)
    budget: PpoBudgetValue = "full"
    """Size of the network, settings of PPO and number of decisions, as far as --set gives no others."""
    scene: Scene = "t_intersection"
    episodes: Cases = 500
    """Number of cases of each test; no study reports cases of their set (1000), so settings can be chosen by them."""
    workers: Processes = 2
    """Processes of this machine at a time."""
    gpus_per_job: Gpus = 0.0

    def run(self) -> Outcome:
        from tint_sumo.comparisons.sweep import Sweep, read_varied, report_markdown, run_sweep
        from tint_sumo.scenes import find_scene

        sweep = Sweep(
            PPO_BUDGET.full(self.budget),
            read_varied(self.set),
            methods=self.methods,
            seeds=self.seeds,
            p_conservative=Mix.parse(self.p_conservative),
            scene=find_scene(self.scene),
            episodes=self.episodes,
        )
        with working_folder(self.out) as out, self.workers_of(self.workers, self.gpus_per_job) as workers:
            table = run_sweep(sweep, out, workers=workers)
        files = [name_in(self.out, name) for name in ("sweep.csv", "sweep.md")]
        text = "\n".join([report_markdown(table, self.episodes), *wrote(files)])
        return Outcome(text, {"results": table.to_dict("records"), "files": files})


@dataclass(frozen=True)
class Policy:
    """Navigation policies."""

    command: (
        Annotated[TrainPolicy, subcommand("train")]
        | Annotated[EvaluatePolicy, subcommand("evaluate")]
        | Annotated[RecordPolicy, subcommand("record")]
        | Annotated[ExportPolicy, subcommand("export")]
        | Annotated[SweepPolicy, subcommand("sweep")]
    )


def sensor_name(sensor: Sensor) -> Any:
    """Return the name of a sensor, or its values if it has none."""
    return next((name for name, known in SENSORS.items() if known == sensor), plain(sensor))


def require_one_sensor(sensor: "str | Sensor | None") -> None:
    """Raise InputError if a sensor is given beside a world, which has one."""
    if sensor is not None:
        raise InputError("a world has a sensor; give `world` or `sensor`")
