"""Every number of the study once, with its unit and its source.

Sources: "paper" is Liu et al., Learning to Navigate Intersections with Unsupervised Driver Trait Inference, ICRA 2022;
"code" is the authors' published code, used where the paper gives no value; "SUMO" is Eclipse SUMO's default.
"""

import re
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Annotated, Any, Literal

from tint_sumo.errors import InputError, find_named
from tint_sumo.structures import FieldError, Many, ReadBy, Where, build, choose

NO_LEADER_GAP_M = 20.0  # stands for the gap of every driver without a leader, whatever its trait, and caps all gaps
MIN_WINDOW_STEPS = 2  # shortest window; a single step has no motion
STEP_S = 0.1  # step of simulations, and time between the states of a window (code)
WINDOW_STEPS = 20  # steps from which a trait is inferred, and between two inferences (paper III-C, code)
LATENT_SIZE = 2  # numbers that represent a trait (paper III-B)
P_CONSERVATIVE = (0.25, 0.4, 0.6)  # driver mixes of the paper's experiments (paper Fig. 4)

MOST_PROFILES = 127  # labels are numbers of one byte

POSITION_SCALE_M = 20.0  # positions are observed divided by this (code)
SPEED_SCALE_MPS = 3.0  # velocities are observed divided by this: the ego's top desired speed

Backend = Literal["auto", "libsumo", "traci"]
Share = float | tuple[float, float]  # a probability, or the range it is drawn from


def require_positive(owner: object, *names: str) -> None:
    """Raise InputError unless these fields are above 0."""
    for name in names:
        if not getattr(owner, name) > 0:
            raise InputError(f"{name} must be above 0, not {getattr(owner, name)}")


def require_at_least(owner: object, lowest: float, *names: str) -> None:
    """Raise InputError unless these fields, or all items of those that are tuples, are not below ``lowest``."""
    for name in names:
        value = getattr(owner, name)
        if not all(one >= lowest for one in (value if isinstance(value, tuple) else (value,))):
            raise InputError(f"{name} must be at least {lowest:g}, not {value}")


def set_floats(owner: object, *names: str) -> None:
    """Make floats of the numbers in these fields of a frozen dataclass, so that 1 and 1.0 are one value; None stays."""
    for name in names:
        value = getattr(owner, name)
        if value is not None:
            number = tuple(map(float, value)) if isinstance(value, Sequence) else float(value)
            object.__setattr__(owner, name, number)


def require_fraction(owner: object, *names: str) -> None:
    """Raise InputError unless these fields lie in [0, 1]."""
    for name in names:
        if not 0.0 <= getattr(owner, name) <= 1.0:
            raise InputError(f"{name} must lie in 0 to 1, not {getattr(owner, name)}")


def require_distinct(owner: object, *names: str) -> None:
    """Raise InputError unless these fields have one or more values, each of them once."""
    for name in names:
        values = getattr(owner, name)
        if len(set(values)) < max(1, len(values)):
            raise InputError(f"{name} must be one or more, each of them once, not {list(values)}")


@dataclass(frozen=True)
class VehicleShape:
    length_m: float = 5.0  # code
    width_m: float = 2.0  # code


@dataclass(frozen=True)
class DriverProfile:
    """One driver trait."""

    name: str
    desired_speed_mps: tuple[float, float]  # uniform in this range (paper IV-A, where it is one speed)
    min_gap_m: tuple[float, float]  # uniform in this range (paper IV-A)
    entry_gap_m: tuple[float, float]  # bumper gap behind the leader at placement and entry, uniform (code)
    yields: bool  # whether the driver reacts to an ego that claims its lane (paper IV-A)
    colour: str  # colour of the vehicle in figures and in sumo-gui, "r,g,b"
    weight: float = 1.0  # share among the profiles that yield as this one does, to the accuracy of whole vTypes

    def __post_init__(self) -> None:
        if not re.fullmatch(r"[A-Za-z]\w*", self.name):
            raise InputError(f"name must be of letters, digits and underscores, a letter first, not {self.name!r}")
        for name in ("desired_speed_mps", "min_gap_m", "entry_gap_m"):
            low, high = getattr(self, name)
            if not 0.0 <= low <= high:
                raise InputError(f"{name} must be two numbers from low to high, 0 or more, not {low:g} and {high:g}")
        if self.desired_speed_mps[0] == 0.0:
            raise InputError("desired_speed_mps must be above 0: nobody would come")
        if not re.fullmatch(r"\d+,\d+,\d+", self.colour) or max(map(int, self.colour.split(","))) > 255:
            raise InputError(f'colour must be "red,green,blue", each 0 to 255, not {self.colour!r}')
        require_positive(self, "weight")

    @property
    def rgb(self) -> tuple[float, float, float]:
        """The colour's parts, each in [0, 1]."""
        red, green, blue = (int(part) / 255 for part in self.colour.split(","))
        return red, green, blue


CONSERVATIVE = DriverProfile("conservative", (2.4, 2.4), (0.5, 0.7), (4.0, 6.0), True, "40,90,200")
AGGRESSIVE = DriverProfile("aggressive", (3.0, 3.0), (0.3, 0.5), (3.0, 5.0), False, "200,40,40")
DRIVER_PROFILES = (CONSERVATIVE, AGGRESSIVE)
CONSERVATIVE_LABEL = DRIVER_PROFILES.index(CONSERVATIVE)  # labels are numbers of profiles in their population
CONTINUOUS = DriverProfile("continuous", (2.0, 3.4), (0.2, 0.8), (3.0, 6.0), True, "90,90,90")  # no classes at all


@dataclass(frozen=True)
class Idm:
    """Intelligent Driver Model parameters shared by all drivers (SUMO's carFollowModel="IDM")."""

    accel_mps2: float = 3.0  # code
    decel_mps2: float = 2.0  # code
    emergency_decel_mps2: float = 9.0  # code
    tau_s: float = 1.0  # SUMO; the paper gives none, the code has 1.5
    delta: float = 4.0  # code

    def __post_init__(self) -> None:
        require_positive(self, "accel_mps2", "decel_mps2", "emergency_decel_mps2", "delta")
        if self.emergency_decel_mps2 < self.decel_mps2:
            raise InputError(
                f"emergency_decel_mps2 must be at least decel_mps2 ({self.decel_mps2:g}), "
                f"not {self.emergency_decel_mps2:g}"
            )


@dataclass(frozen=True)
class Population:
    """The vTypes drivers are drawn from."""

    profiles: Many[DriverProfile] = DRIVER_PROFILES
    members: int = 32  # vTypes of a profile of weight 1, each with its own draws
    seed: int = 2022  # seed of the draws
    idm: Idm = Idm()

    def __post_init__(self) -> None:
        names = [profile.name for profile in self.profiles]
        if not 1 <= len(names) <= MOST_PROFILES:
            raise InputError(f"profiles must be 1 to {MOST_PROFILES}, not {len(names)}")
        if len(set(names)) < len(names):
            raise InputError(f"profiles must have names of their own, not {', '.join(names)}")
        require_at_least(self, 1, "members")
        require_at_least(self, 0, "seed")


POPULATIONS = {"traits": Population(), "continuous": Population((CONTINUOUS,), members=512)}


def read_population(value: Any, where: Where = ()) -> Population:
    """What a file means by a population: a name, a list of profiles, or what differs from its ``base``.

    Raises:
        FieldError: there is no such population, or a value does not fit.
    """
    if not isinstance(value, list):
        chosen = choose(value, POPULATIONS, "traits", where)
        return POPULATIONS[chosen] if isinstance(chosen, str) else chosen
    profiles = build(tuple[DriverProfile, ...], value, where)
    try:
        return Population(profiles)
    except InputError as error:
        raise FieldError(where, str(error)) from None


PopulationSetting = Annotated[Population, ReadBy(read_population)]


def find_population(name: str) -> Population:
    """The population called ``name``.

    Raises:
        InputError: there is none.
    """
    return find_named("population", name, POPULATIONS)


def population_name(population: Population) -> str | None:
    """What a population is called, if it is one that has a name."""
    return next((name for name, known in POPULATIONS.items() if known == population), None)


def ends(share: Share) -> tuple[float, float]:
    """Both ends of a range; twice the same for a number."""
    low, high = share if isinstance(share, Sequence) else (share, share)
    return float(low), float(high)


def share_words(share: Share) -> str:
    """A share for people to read."""
    low, high = ends(share)
    return f"{low:g}" + (f" to {high:g}" if high > low else "")


def is_share(value: object) -> bool:
    """Whether a value is a probability or a range of probabilities."""
    try:
        low, high = ends(value)  # type: ignore[arg-type]
    except (TypeError, ValueError):
        return False
    return 0.0 <= low <= high <= 1.0


def require_share(share: Share) -> None:
    """Raise InputError unless this is a probability or a range of probabilities."""
    if not is_share(share):
        raise InputError(
            f"p_conservative must be a probability in [0, 1], or two of them from low to high, not {share}"
        )


@dataclass(frozen=True)
class Traffic:
    """How drivers appear on the street."""

    p_conservative: Share = 0.4  # probability that a driver is conservative; a range: drawn uniformly per episode
    arrivals_per_s: float | None = None  # Poisson rate per lane; None: saturated, enter as soon as there is room

    @property
    def p_conservative_range(self) -> tuple[float, float]:
        """Lowest and highest probability."""
        return ends(self.p_conservative)

    @property
    def mean_p_conservative(self) -> float:
        return sum(self.p_conservative_range) / 2

    def __post_init__(self) -> None:
        require_share(self.p_conservative)
        if self.arrivals_per_s is not None and not self.arrivals_per_s > 0.0:
            raise InputError(
                f"arrivals_per_s must be positive, or None for saturated traffic, not {self.arrivals_per_s}"
            )


@dataclass(frozen=True)
class EgoController:
    """The ego's low-level control (code): a PD law on speed, and a safety check that overrides it."""

    desired_speeds_mps: Many[float] = (0.0, 0.5, 3.0)  # the actions (paper III-C)
    gain_per_s: float = 2.0
    accel_limit_mps2: float = 3.0
    unsafe_distance_m: float = 0.8  # distance between vehicle boxes
    closing_distance_m: float = 1.0  # unsafe if also closing faster than closing_speed_mps
    closing_speed_mps: float = 1.0
    watches_behind: bool = True  # whether vehicles behind the ego count, too (code)
    braking_gain_per_s: float = 5.0
    braking_limit_mps2: float = 6.0

    def __post_init__(self) -> None:
        if len(self.desired_speeds_mps) < 2:
            raise InputError("desired_speeds_mps must be at least two speeds, the first one slow enough to wait")
        require_at_least(self, 0, "desired_speeds_mps", "unsafe_distance_m", "closing_distance_m", "closing_speed_mps")
        require_positive(self, "gain_per_s", "accel_limit_mps2", "braking_gain_per_s", "braking_limit_mps2")


@dataclass(frozen=True)
class Claim:
    """When the ego claims a lane, and which of its yielding drivers react to that.

    The conditions of a claim are those of the code. A yielding driver reacts only if it can still stop where the ego
    passes it at the distance that its safety check asks for; one that is too close drives on, as drivers do who are
    too close to a traffic light that changes (Gazis, Herman and Maradudin 1960, Operations Research 8, 112-132). If it
    braked all the same, it would stand so close to the ego's way that the safety check holds the ego, and both would
    wait for ever.
    """

    by: Literal["front", "box"] = "front"  # the part of the ego that enters the lane; the code takes the front
    approach_speed_mps: float = 0.5  # speed towards the lane that counts as moving in
    path_margin_m: float = 1.0  # an ego that is this far past a lane's border stands in the vehicles' path
    courtesy_gap_m: float = 1.5  # yielding drivers add this to their minGap while their lane is claimed
    reaction_time_s: float = 0.1  # time before a driver brakes: one step
    braking_mps2: float = 6.0  # a driver is ready to brake so hard; an emergency has 9 m/s2

    def __post_init__(self) -> None:
        require_at_least(self, 0, "approach_speed_mps", "path_margin_m", "courtesy_gap_m", "reaction_time_s")
        require_positive(self, "braking_mps2")

    def stopping_distance_m(self, speed_mps: float) -> float:
        """Distance in which a driver at this speed is ready to stop."""
        return speed_mps * self.reaction_time_s + speed_mps**2 / (2.0 * self.braking_mps2)


@dataclass(frozen=True)
class RewardPreset:
    goal: float
    collision: float
    speed_weight_per_mps: float  # times the ego's speed, each other step
    step: float  # each other step


REWARD_PRESETS = {
    "paper": RewardPreset(2.5, -2.0, 0.05, -0.0013),  # paper IV-A
    "authors": RewardPreset(2.5, -2.0, 0.05 / 3.0, -0.013),  # code
}


@dataclass(frozen=True)
class TraitSettings:
    """The paper's trait network and its training; every trait method takes what it needs of it."""

    embedding_sizes: Many[int] = (32, 64)  # code; () feeds the features to the GRU as they are
    hidden_size: int = 256  # code
    encoder_output_size: int = 256  # code
    decoder_output_size: int = 128  # code
    kl_weight: float = 5e-8  # paper IV-B; the code has 5e-7
    reconstruction_weight: float = 10.0  # code
    learning_rate: float = 5e-4  # decays linearly to zero (paper IV-B)
    weight_decay: float = 1e-6  # code
    batch_size: int = 1024  # code
    epochs: int = 1000  # paper IV-B
    noise_m: float = 0.0  # standard deviation of the noise on every position in training, drawn anew in each epoch

    def __post_init__(self) -> None:
        sizes = ("embedding_sizes", "hidden_size", "encoder_output_size", "decoder_output_size")
        require_at_least(self, 1, *sizes, "batch_size", "epochs")
        require_at_least(self, 0, "kl_weight", "reconstruction_weight", "weight_decay", "noise_m")
        require_positive(self, "learning_rate")


@dataclass(frozen=True)
class PolicySettings:
    """The paper's policy network."""

    embedding_sizes: Many[int] = (150, 100)  # code
    score_sizes: Many[int] = (100, 100)  # code
    context_size: int = 50  # code
    joint_sizes: Many[int] = (150, 100, 64)  # code
    hidden_size: int = 256  # code
    head_sizes: Many[int] = (256, 256)  # code
    attention: bool = True  # without it, all vehicles count the same (the paper's ablation, IV-D)
    position_gain: float = 1.0  # positions are multiplied by this; observed in units of 20 m, they differ by little

    def __post_init__(self) -> None:
        sizes = ("embedding_sizes", "score_sizes", "context_size", "joint_sizes", "hidden_size", "head_sizes")
        require_at_least(self, 1, *sizes)
        require_positive(self, "position_gain")


@dataclass(frozen=True)
class PpoSettings:
    """PPO as in the paper (IV-C) and its code; ``n_steps`` and ``n_envs`` set the batch.

    With ``action_repeat`` above 1 the policy decides only every so many simulation steps; ``n_steps``, ``gamma`` and
    ``total_steps`` then count decisions.
    """

    n_envs: int = 12  # paper
    n_steps: int = 30  # paper
    n_epochs: int = 5
    n_minibatches: int = 2
    learning_rate: float = 1e-4  # decays linearly to zero (paper)
    gamma: float = 0.99
    gae_lambda: float = 0.95
    clip_range: float = 0.2
    ent_coef: float = 0.01  # entropy weight at the beginning
    final_ent_coef: float = 0.01  # entropy weight at the end; in between it changes linearly
    vf_coef: float = 0.5
    max_grad_norm: float = 0.5
    total_steps: int = 10_000_000  # paper
    policy: PolicySettings = field(default_factory=PolicySettings)
    action_repeat: int = 1  # paper: a decision every step
    time_limit_s: float = 50.0  # limit of training episodes if the scene's is not shorter; evaluation has the scene's

    def __post_init__(self) -> None:
        counts = ("n_envs", "n_steps", "n_epochs", "n_minibatches", "total_steps", "action_repeat")
        require_at_least(self, 1, *counts)
        require_at_least(self, 0, "ent_coef", "final_ent_coef", "vf_coef")
        require_positive(self, "learning_rate", "clip_range", "max_grad_norm", "time_limit_s")
        require_fraction(self, "gamma", "gae_lambda")
        if self.n_minibatches > self.n_envs:
            raise InputError(
                f"n_minibatches must be at most n_envs ({self.n_envs}), whose sequences stay whole, "
                f"not {self.n_minibatches}"
            )
