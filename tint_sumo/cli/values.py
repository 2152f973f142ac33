"""Types of flags with their help. A scene, a population or a budget is a name, or defined in a configuration file."""

from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Any, get_args

from tyro.conf import arg

from tint_sumo import ENV_IDS
from tint_sumo.cli.configuration import FromFile, name_flag, one_of
from tint_sumo.config import POPULATIONS, SENSORS, WORLDS, Fraction, Perceivable, TauS
from tint_sumo.core.ranges import Range
from tint_sumo.core.structures import Many, Where, choose


def optional(metavar: str, text: str, default: str = "none") -> Any:
    """Return the form of a flag that need not be given: its value, its help, and what holds if it is not given."""
    return arg(metavar=metavar, help=text, help_behavior_hint=f"(default: {default})")


Cases = Annotated[int, Range(1, 1_000_000)]
MixFlag = Many[Fraction]  # one probability, or the two ends of a range
SCENES = ", ".join(ENV_IDS)


EGO_ROUTE_HELP = 'Edges that the ego drives along, one after the other (with a minus: --ego-route="-E1 -E2")'


PERCEIVES = optional(
    "KEY [KEY ...]",
    f"Further perceptions of the ego: {', '.join(get_args(Perceivable))}; with --ego-route.",
)
RED_LIGHT = optional(
    "ignore|cost|end",
    "Consequence of driving over a stop line at red: none, a cost (1 is taken from the reward), or the episode's end "
    "with the reward of a collision; with --ego-route.",
    "ignore",
)


def edges_of(words: Sequence[str]) -> list[str]:
    """Return the edges of a route: a word each, or several in a word, as names with a minus in front must be given."""
    return [edge for word in words for edge in word.split()]


def _read_scene(value: Any, where: Where = ()) -> Any:
    from tint_sumo.scenes import ALL_SCENES, SCENES, read_scene

    if value in (None, ALL_SCENES):
        return value
    scene = read_scene(value, where)
    return scene.name if scene in [make() for make in SCENES.values()] else scene


def _scene_in_full(value: Any) -> Any:
    from tint_sumo.scenes import ALL_SCENES, find_scene, scene_settings

    return value if value in (None, ALL_SCENES) else scene_settings(find_scene(value))


def _read_population(value: Any, where: Where) -> Any:
    from tint_sumo.scenes.drivers import population_name, read_population

    if value is None:
        return None
    population = read_population(value, where)
    return population_name(population) or population


def _population_in_full(value: Any) -> Any:
    from tint_sumo.scenes.drivers import find_population

    return find_population(value) if isinstance(value, str) else value


def _read_sensor(value: Any, where: Where) -> Any:
    return None if value is None else choose(value, SENSORS, "perfect", where)


def _sensor_in_full(value: Any) -> Any:
    return SENSORS[value] if isinstance(value, str) else value


SCENE = FromFile(_read_scene, _scene_in_full)
SENSOR = FromFile(_read_sensor, _sensor_in_full)
POPULATION = FromFile(_read_population, _population_in_full)
BUDGET = one_of("tint_sumo.study.budgets", "BUDGETS", "quick")
PPO_BUDGET = one_of("tint_sumo.config", "PPO_BUDGETS", "full")
TRAIT_BUDGET = one_of("tint_sumo.config", "TRAIT_BUDGETS", "quick")
TRAIT_STUDY = one_of("tint_sumo.comparisons.traits", "TRAIT_STUDIES", "full")
SCENE_STUDY = one_of("tint_sumo.comparisons.scenes", "SCENE_STUDIES", "full")

FolderOrUrl = Annotated[str, arg(metavar="FOLDER|URL")]  # a path would lose a slash of a URL

# Values are names, or what these make of a file.
SceneValue = Annotated[Any, name_flag(), SCENE]
SensorValue = Annotated[Any, name_flag(*SENSORS), SENSOR]
PopulationValue = Annotated[Any, name_flag(*POPULATIONS), POPULATION]
BudgetValue = Annotated[Any, name_flag("quick", "full", "strangers", "paper"), BUDGET]
PpoBudgetValue = Annotated[Any, name_flag("quick", "full", "strangers", "paper"), PPO_BUDGET]
TraitBudgetValue = Annotated[Any, name_flag("quick", "full", "paper"), TRAIT_BUDGET]
TraitStudyValue = Annotated[Any, name_flag("full"), TRAIT_STUDY]
SceneStudyValue = Annotated[Any, name_flag("full"), SCENE_STUDY]

# Flags of several commands.
Scene = Annotated[SceneValue, arg(help=f"Scene: {SCENES}.")]
Gpus = Annotated[float, Range(0.0, 64.0), arg(help="Share of a GPU for each training, with --executor ray.")]
TraitModelName = Annotated[
    str, arg(help="Trait model: name of a shipped one, folder of a training, or path of a .safetensors file.")
]
OnnxFlag = Annotated[
    bool, arg(help="Write ONNX files, too, which run without Python and this package; needs tint_sumo[onnx].")
]
TestData = Annotated[
    Path, arg(help="Folder of a dataset; its test episodes are those that training with the model's seed leaves out.")
]
PolicyName = Annotated[
    str,
    arg(
        help="Policy: a shipped one by its method (streaming, oracle, ...), a rule (always_go, ttc; in a SUMO "
        "configuration also sumo, its own driver), the folder of a training, the path of a .safetensors file, or with "
        "--allow-pickle of a .zip file."
    ),
]
TestMix = Annotated[
    MixFlag | None,
    optional(
        "FLOAT [FLOAT]",
        "Probability that a driver is conservative, 0 to 1; given two numbers, each case draws it between them.",
        "as in the policy's training",
    ),
]
TestScene = Annotated[
    SceneValue, optional("NAME", f"Scene: {SCENES}.", "the policy's; t_intersection for always_go and ttc")
]
TestSensor = Annotated[
    SensorValue,
    optional("NAME", f"Sensor that the ego perceives the others with: {', '.join(SENSORS)}.", "as in its training"),
]
WorldName = Annotated[
    str | None,
    optional(
        "NAME",
        f"World, which is a population of drivers and a sensor: {', '.join(WORLDS)}.",
        "the scene's drivers, and the sensor",
    ),
]
TestTau = Annotated[
    TauS | None, optional("FLOAT", "Time headway of the other drivers, s.", "the scene's, 1 s in built-in scenes")
]
