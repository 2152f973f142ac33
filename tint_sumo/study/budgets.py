"""Budgets of studies: everything that sets their cost and their quality, in one place."""

from dataclasses import dataclass, field, replace
from typing import Annotated

from tint_sumo.config import (
    ALL_MIXES,
    HELD_OUT_WORLDS,
    P_CONSERVATIVE,
    PERFECT,
    PPO_BUDGETS,
    SNAPSHOTS_PERCENT,
    TRAIT_BUDGETS,
    Fraction,
    Mix,
    NoiseM,
    PpoSettings,
    Seed,
    Sensor,
    TauS,
    TraitSettings,
)
from tint_sumo.core.errors import InputError
from tint_sumo.core.ranges import Range, require_distinct, require_ranges, set_floats
from tint_sumo.core.structures import Many
from tint_sumo.envs import TaskSettings
from tint_sumo.envs.worlds import find_world, scene_in, task_in
from tint_sumo.methods.registry import built_in_methods
from tint_sumo.scenes import AnyScene, Scene, paper_scene

STRANGERS_TESTS = ("old", "towns", *HELD_OUT_WORLDS)  # worlds in which policies that drive among strangers are tested


@dataclass(frozen=True)
class Conditions:
    """The conditions in which a policy is tested, and after which part of its training."""

    p_conservative: Mix
    position_noise_m: NoiseM = 0.0
    tau_s: TauS | None = None  # time headway of the other drivers; None: the scene's
    percent: int = 100  # part of the training after which the policy is tested
    world: str | None = None  # name of a world; None: the drivers of the training, and a perfect sensor

    def __post_init__(self) -> None:
        require_ranges(self)
        set_floats(self, "position_noise_m", "tau_s")
        if self.world is not None:
            _ = self.task(paper_scene())  # there is such a world, and it is one for tests
            if self.position_noise_m or self.tau_s is not None:
                raise InputError("a world has a sensor and a headway; leave position_noise_m and tau_s out beside it")
        if self.percent not in (*SNAPSHOTS_PERCENT, 100):
            kept = ", ".join(map(str, (*SNAPSHOTS_PERCENT, 100)))
            raise InputError(f"percent must be one of {kept}, when policies are kept, not {self.percent}")

    @property
    def is_single_mix(self) -> bool:
        """Whether all cases have one P(conservative), and nothing else differs from the conditions of the training."""
        return self.p_conservative.is_single and self == Conditions(self.p_conservative)

    def task(self, scene: AnyScene) -> TaskSettings:
        """Return the settings of environments in a scene, or in its world."""
        if self.world is not None:
            return task_in(find_world(self.world), TaskSettings(scene, self.p_conservative))
        return TaskSettings(scene, self.p_conservative, sensor=Sensor(noise_m=self.position_noise_m), tau_s=self.tau_s)

    def resolved(self, scene_tau_s: float) -> "Conditions":
        """Return these conditions with the headway of the scene's drivers where neither it nor a world is given."""
        is_given = self.tau_s is not None or self.world is not None
        return self if is_given else replace(self, tau_s=scene_tau_s)

    def relative_to(self, scene_tau_s: float) -> "Conditions":
        """Return these conditions with None for a headway that is the scene's: the form in which they are compared."""
        return replace(self, tau_s=None) if self.tau_s == scene_tau_s else self

    @property
    def label(self) -> str:
        """The values that differ from the conditions of the training, for tables and figures."""
        parts = [
            "" if self.world is None else find_world(self.world).title,
            f"noise {self.position_noise_m:g} m" if self.position_noise_m else "",
            f"headway {self.tau_s:g} s" if self.tau_s is not None else "",
            f"{self.percent} % of training" if self.percent != 100 else "",
        ]
        return ", ".join(part for part in parts if part) or "as trained"


@dataclass(frozen=True)
class Trials:
    """Some conditions, each with so many cases, which are the same for all policies."""

    conditions: Many[Conditions]
    episodes: Annotated[int, Range(1, 1_000_000)]

    def __post_init__(self) -> None:
        if not self.conditions:
            raise InputError("conditions must be one or more")
        require_ranges(self)

    def relative_to(self, scene_tau_s: float) -> "Trials":
        """Return these trials with None for headways that are the scene's."""
        return replace(self, conditions=tuple(conditions.relative_to(scene_tau_s) for conditions in self.conditions))


@dataclass(frozen=True)
class Budget:
    """Sizes of all stages of a study."""

    traits: TraitSettings | None  # settings of the trait models that it learns; None: it takes the shipped ones
    windows: Annotated[int, Range(0, 100_000_000)] = 0  # windows to record for them
    record_p_conservative: Fraction = 0.5  # share of conservative drivers in the dataset
    ppo: PpoSettings = field(default_factory=PpoSettings)  # settings of PPO, and the steps of every policy
    world: str | None = None  # name of the world of the trainings; None: the scene's drivers, and a perfect sensor
    methods: Many[str] = ("always_go", "ttc", "no_labels", "vae", "oracle")
    mixes: Many[Mix] = (ALL_MIXES,)  # P(conservative) in training: a policy for each
    seeds: Many[Seed] = (0, 1, 2)
    trials: Many[Trials] = field(kw_only=True)
    with_shipped: bool = False  # test the shipped policies, too

    def __post_init__(self) -> None:
        require_distinct(self, "methods", "mixes", "seeds", "trials")
        require_ranges(self)
        if self.world is not None:
            find_world(self.world)
        if self.traits is not None and self.windows == 0:
            raise InputError("windows must be at least 1, not 0")
        if self.traits is None and (self.windows, self.record_p_conservative) != (0, Budget.record_p_conservative):
            raise InputError(
                "windows are recorded to learn traits from; give traits, or windows: 0 and "
                f"record_p_conservative: {Budget.record_p_conservative:g}"
            )

    def trained_in(self, scene: Scene) -> Scene:
        """Return a scene with the drivers of the trainings."""
        return scene if self.world is None else scene_in(find_world(self.world), scene)

    @property
    def sensors(self) -> tuple[Sensor, ...]:
        """Sensors of the trainings."""
        return (PERFECT,) if self.world is None else find_world(self.world).sensors


BUDGETS = {
    "quick": Budget(
        windows=30_000,
        traits=TRAIT_BUDGETS["quick"],
        ppo=PPO_BUDGETS["quick"],
        seeds=(0,),
        trials=(Trials(tuple(Conditions(Mix(p)) for p in P_CONSERVATIVE), 200),),
        with_shipped=True,
    ),
    "full": Budget(
        traits=None,
        ppo=PPO_BUDGETS["full"],
        methods=built_in_methods(),
        seeds=(0, 1, 2, 3),
        trials=(
            Trials(tuple(Conditions(Mix(p)) for p in (0.1, 0.25, 0.4, 0.6, 0.9)), 1000),
            Trials(
                (
                    Conditions(ALL_MIXES),
                    *(Conditions(ALL_MIXES, position_noise_m=noise_m) for noise_m in (0.05, 0.1, 0.2)),
                    *(Conditions(ALL_MIXES, tau_s=tau_s) for tau_s in (0.7, 1.5)),
                    *(Conditions(ALL_MIXES, percent=percent) for percent in (25, 50)),
                ),
                300,
            ),
        ),
    ),
    "strangers": Budget(
        traits=TRAIT_BUDGETS["full"],
        windows=696_000,
        ppo=PPO_BUDGETS["strangers"],
        world="strangers",
        methods=(*built_in_methods(), "relative"),
        seeds=(0, 1, 2, 3, 4),
        trials=(Trials(tuple(Conditions(ALL_MIXES, world=name) for name in STRANGERS_TESTS), 300),),
    ),
    "paper": Budget(
        traits=TRAIT_BUDGETS["paper"],
        windows=696_000,  # the number of the paper's trajectories
        mixes=tuple(map(Mix, P_CONSERVATIVE)),
        trials=(Trials(tuple(Conditions(Mix(p)) for p in P_CONSERVATIVE), 500),),  # paper IV-C
    ),
}
