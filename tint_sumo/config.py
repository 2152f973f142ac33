"""Every number of the study once, with its unit and its source.

Sources: "paper" is Liu et al., Learning to Navigate Intersections with Unsupervised Driver Trait Inference, ICRA 2022;
"code" is the authors' published code, used where the paper gives no value; "SUMO" is Eclipse SUMO's default.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Literal

from tint_sumo.errors import InputError

NO_LEADER_GAP_M = 20.0  # stands for the gap of every driver without a leader, whatever its trait, and caps all gaps
MIN_WINDOW_STEPS = 2  # of a window; a single step has no motion
STEP_S = 0.1  # of simulations, and between the states of a window (code)
WINDOW_STEPS = 20  # steps from which a trait is inferred, and between two inferences (paper III-C, code)
LATENT_SIZE = 2  # numbers that represent a trait (paper III-B)
P_CONSERVATIVE = (0.25, 0.4, 0.6)  # driver mixes of the paper's experiments (paper Fig. 4)

POSITION_SCALE_M = 20.0  # positions are observed divided by this (code)
SPEED_SCALE_MPS = 3.0  # velocities are observed divided by this: the ego's top desired speed

Backend = Literal["auto", "libsumo", "traci"]
Share = float | tuple[float, float]  # a probability, or the range it is drawn from


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
    colour: str  # of the vehicle in figures and in sumo-gui, "r,g,b"
    weight: float = 1.0  # share among the profiles that yield as this one does, to the accuracy of whole vTypes

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


@dataclass(frozen=True)
class Population:
    """The vTypes drivers are drawn from."""

    profiles: tuple[DriverProfile, ...] = DRIVER_PROFILES
    members: int = 32  # vTypes of a profile of weight 1, each with its own draws
    seed: int = 2022  # of the draws
    idm: Idm = Idm()


POPULATIONS = {"traits": Population(), "continuous": Population((CONTINUOUS,), members=512)}


def ends(share: Share) -> tuple[float, float]:
    """Both ends of a range; twice the same for a number."""
    low, high = share if isinstance(share, Sequence) else (share, share)
    return float(low), float(high)


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

    desired_speeds_mps: tuple[float, ...] = (0.0, 0.5, 3.0)  # the actions (paper III-C)
    gain_per_s: float = 2.0
    accel_limit_mps2: float = 3.0
    unsafe_distance_m: float = 0.8  # between vehicle boxes
    closing_distance_m: float = 1.0  # unsafe if also closing faster than closing_speed_mps
    closing_speed_mps: float = 1.0
    watches_behind: bool = True  # whether vehicles behind the ego count, too (code)
    braking_gain_per_s: float = 5.0
    braking_limit_mps2: float = 6.0


@dataclass(frozen=True)
class Claim:
    """When the ego claims a lane, and which of its yielding drivers react to that.

    The conditions of a claim are those of the code. A yielding driver reacts only if it can still stop where the ego
    passes it at the distance that its safety check asks for; one that is too close drives on, as drivers do who are
    too close to a traffic light that changes (Gazis, Herman and Maradudin 1960, Operations Research 8, 112-132). If it
    braked all the same, it would stand so close to the ego's way that the safety check holds the ego, and both would
    wait for ever.
    """

    by: Literal["front", "box"] = "front"  # of the ego, that enters the lane; the front's middle is the code's
    approach_speed_mps: float = 0.5  # speed towards the lane that counts as moving in
    path_margin_m: float = 1.0  # this far past a lane's border it stands in the vehicles' path
    courtesy_gap_m: float = 1.5  # that yielding drivers add to their minGap while their lane is claimed
    reaction_time_s: float = 0.1  # before a driver brakes: a step
    braking_mps2: float = 6.0  # that a driver is ready for: hard, but below the 9 m/s2 of an emergency

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

    embedding_sizes: tuple[int, ...] = (32, 64)  # code; () feeds the features to the GRU as they are
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


@dataclass(frozen=True)
class PolicySettings:
    """The paper's policy network."""

    embedding_sizes: tuple[int, ...] = (150, 100)  # code
    score_sizes: tuple[int, ...] = (100, 100)  # code
    context_size: int = 50  # code
    joint_sizes: tuple[int, ...] = (150, 100, 64)  # code
    hidden_size: int = 256  # code
    head_sizes: tuple[int, ...] = (256, 256)  # code
    attention: bool = True  # without, all vehicles count the same (the paper's ablation, IV-D)
    position_gain: float = 1.0  # positions are multiplied by this; observed in units of 20 m, they differ by little


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
    ent_coef: float = 0.01  # at the beginning,
    final_ent_coef: float = 0.01  # and at the end; in between it changes linearly
    vf_coef: float = 0.5
    max_grad_norm: float = 0.5
    total_steps: int = 10_000_000  # paper
    policy: PolicySettings = field(default_factory=PolicySettings)
    action_repeat: int = 1  # paper: a decision every step
    time_limit_s: float = 50.0  # of training episodes; evaluation always has the paper's 50 s
