"""Types of flags. A scene, a population or a budget is a name, or is defined in a configuration file."""

from typing import Annotated, Any

from tyro.conf import arg

from tint_sumo import ENV_IDS
from tint_sumo.cli.configuration import FromFile, name_flag, one_of
from tint_sumo.config import Fraction
from tint_sumo.core.ranges import Range
from tint_sumo.core.structures import Many, Where

Cases = Annotated[int, Range(1, 1_000_000)]
MixFlag = Many[Fraction]  # one probability, or the two ends of a range
SCENES = ", ".join(ENV_IDS)


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


SCENE = FromFile(_read_scene, _scene_in_full)
POPULATION = FromFile(_read_population, _population_in_full)
BUDGET = one_of("tint_sumo.study.budgets", "BUDGETS", "quick")
PPO_BUDGET = one_of("tint_sumo.config", "PPO_BUDGETS", "full")
TRAIT_BUDGET = one_of("tint_sumo.config", "TRAIT_BUDGETS", "quick")
TRAIT_STUDY = one_of("tint_sumo.comparisons.traits", "TRAIT_STUDIES", "full")
SCENE_STUDY = one_of("tint_sumo.comparisons.scenes", "SCENE_STUDIES", "full")

# A path would lose a slash of a URL.
PLACE = arg(metavar="FOLDER|URL")
FolderOrUrl = Annotated[str, PLACE]

# Values are names, or what these make of a file.
SceneValue = Annotated[Any, name_flag(), SCENE]
PopulationValue = Annotated[Any, name_flag("traits", "continuous"), POPULATION]
BudgetValue = Annotated[Any, name_flag("quick", "full", "paper"), BUDGET]
PpoBudgetValue = Annotated[Any, name_flag("quick", "full", "paper"), PPO_BUDGET]
TraitBudgetValue = Annotated[Any, name_flag("quick", "full", "paper"), TRAIT_BUDGET]
TraitStudyValue = Annotated[Any, name_flag("full"), TRAIT_STUDY]
SceneStudyValue = Annotated[Any, name_flag("full"), SCENE_STUDY]
