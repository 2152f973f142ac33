"""Every number of the study once, with its unit and its source.

Sources: "paper" is Liu et al., Learning to Navigate Intersections with Unsupervised Driver Trait Inference, ICRA 2022;
"code" is the authors' published code, used where the paper gives no value; "SUMO" is Eclipse SUMO's default.
"""

import math
import re
import statistics
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from itertools import pairwise
from numbers import Real
from typing import Annotated, Any, Literal, Self

from tint_sumo.core.errors import InputError, shown
from tint_sumo.core.ranges import Length, Range, require_ranges, set_floats
from tint_sumo.core.structures import FileForm, Many

NO_LEADER_GAP_M = 20.0  # stands for the gap of every driver without a leader, whatever its trait, and caps all gaps
MIN_WINDOW_STEPS = 2  # shortest window; a single step has no motion
STEP_S = 0.1  # step of simulations, and time between the states of a window (code)
WINDOW_STEPS = 20  # steps from which a trait is inferred, and between two inferences (paper III-C, code)
LATENT_SIZE = 2  # numbers that represent a trait (paper III-B)
P_CONSERVATIVE = (0.25, 0.4, 0.6)  # driver mixes of the paper's experiments (paper Fig. 4)

SNAPSHOTS_PERCENT = (25, 50)  # parts of a training after which the policy is kept, too

MOST_LABELS = 2**15 - 1  # labels are numbers of two bytes
MOST_ACTIONS = 100  # actions are numbers of one byte
MOST_VTYPES = 10_000  # in a simulation
MOST_DECISIONS = 2**22  # of a batch of PPO

POSITION_SCALE_M = 20.0  # positions are observed divided by this (code)
SPEED_SCALE_MPS = 3.0  # velocities are observed divided by this: the ego's top desired speed
OBSERVATION_BOUND = 2.0  # of normalised observations: 40 m, 6 m/s

Backend = Literal["auto", "libsumo", "traci"]
EgoControl = Literal["speed", "sumo"]
CarFollowing = Literal["IDM", "EIDM", "Krauss", "ACC", "CACC"]
RedLight = Literal["ignore", "cost", "end"]
Perceivable = Literal["traffic_light", "right_of_way", "speed_limit", "lane", "pedestrians"]

# Numbers that several settings have, with what is sensible; larger ones would fill the memory, or are mistakes.
Fraction = Annotated[float, Range(0.0, 1.0)]
SEEDS = Range(0, 1000)
Seed = Annotated[int, SEEDS]  # of a training
EpisodesSeed = Annotated[int, Range(0, 999)]  # of recorded episodes of a policy; a million each, below all test cases
TrafficSeed = Annotated[int, Range(0, 2**32 - 1)]
SpeedMps = Annotated[float, Range(0.0, 60.0)]
DistanceM = Annotated[float, Range(0.0, 1000.0)]
RouteM = Annotated[float, Range(0.0, 1e6)]  # position along a route
CoordinateM = Annotated[float, Range(-1e6, 1e6)]
NOISES = Range(0.0, 1000.0)
NoiseM = Annotated[float, NOISES]
TauS = Annotated[float, Range(0.01, 20.0)]  # with less, drivers cannot keep it; with more, nobody moves
AccelMps2 = Annotated[float, Range(0.01, 100.0)]
GainPerS = Annotated[float, Range(0.001, 1000.0)]
TimeS = Annotated[float, Range(0.01, 86_400.0)]
WarmUpS = Annotated[float, Range(0.0, 86_400.0)]
WarmStarts = Annotated[int, Range(0, 1000)]
StepS = Annotated[float, Range(0.01, 1.0)]
Slots = Annotated[int, Range(1, 200)]  # vehicles in an observation
WindowCount = Annotated[int, Range(1, 100_000_000)]
LatentCount = Annotated[int, Range(1, 64)]  # of a trait model
NoLeaderGapM = Annotated[float, Range(1.0, 1000.0)]  # of a trait model
Gain = Annotated[float, Range(0.001, 1000.0)]
Weight = Annotated[float, Range(0.0, 1e6)]  # of a term of a loss
Penalty = Annotated[float, Range(0.0, 1000.0)]  # taken from a reward
LearningRate = Annotated[float, Range(1e-12, 1e6)]
Layer = Annotated[int, Range(1, 2048)]
Layers = Annotated[Many[Layer], Length(0, 8)]
SomeLayers = Annotated[Many[Layer], Length(1, 8)]
Decisions = Annotated[int, Range(1, 10**12)]
SignedM = Annotated[float, Range(-1000.0, 1000.0)]
TimeShiftS = Annotated[float, Range(0.0, 20.0)]
DriverSpeedMps = Annotated[float, Range(0.01, 60.0)]  # SUMO writes 0 for less than 0.01
ArrivalsPerS = Annotated[float, Range(1e-6, 100.0)]


@dataclass(frozen=True)
class VehicleShape:
    length_m: Annotated[float, Range(0.5, 30.0)] = 5.0  # code
    width_m: Annotated[float, Range(0.3, 5.0)] = 2.0  # code

    def __post_init__(self) -> None:
        require_ranges(self)


@dataclass(frozen=True)
class DriverProfile:
    """One driver trait."""

    name: str
    desired_speed_mps: tuple[DriverSpeedMps, DriverSpeedMps]  # uniform in this range (paper IV-A: one speed)
    min_gap_m: tuple[DistanceM, DistanceM]  # uniform in this range (paper IV-A)
    entry_gap_m: tuple[DistanceM, DistanceM]  # bumper gap behind the leader at placement and entry, uniform (code)
    yields: bool  # whether the driver reacts to an ego that claims its lane (paper IV-A)
    colour: str  # colour of the vehicle in figures and in sumo-gui, "r,g,b"
    weight: Gain = 1.0  # share among the profiles that yield as this one does, to the accuracy of whole vTypes

    def __post_init__(self) -> None:
        if not re.fullmatch(r"[A-Za-z]\w{0,63}", self.name):
            raise InputError(f"name must be of letters, digits and underscores, a letter first, not {shown(self.name)}")
        require_ranges(self)
        for name in ("desired_speed_mps", "min_gap_m", "entry_gap_m"):
            low, high = getattr(self, name)
            if low > high:
                raise InputError(f"{name} must be two numbers from low to high, not {low:g} and {high:g}")
        if not re.fullmatch(r"\d{1,3},\d{1,3},\d{1,3}", self.colour) or max(map(int, self.colour.split(","))) > 255:
            raise InputError(f'colour must be "red,green,blue", each 0 to 255, not {shown(self.colour)}')

    @property
    def rgb(self) -> tuple[float, float, float]:
        """The colour's parts, each in [0, 1]."""
        red, green, blue = (int(part) / 255 for part in self.colour.split(","))
        return red, green, blue


CONSERVATIVE = DriverProfile("conservative", (2.4, 2.4), (0.5, 0.7), (4.0, 6.0), True, "40,90,200")
AGGRESSIVE = DriverProfile("aggressive", (3.0, 3.0), (0.3, 0.5), (3.0, 5.0), False, "200,40,40")
DRIVER_PROFILES = (CONSERVATIVE, AGGRESSIVE)
KINDS = len(DRIVER_PROFILES)  # of drivers that labels can tell apart: conservative and aggressive
CONSERVATIVE_LABEL = DRIVER_PROFILES.index(CONSERVATIVE)  # labels are numbers of profiles in their population
CONTINUOUS = DriverProfile("continuous", (2.0, 3.4), (0.2, 0.8), (3.0, 6.0), True, "90,90,90")  # no classes at all


@dataclass(frozen=True)
class Idm:
    """Intelligent Driver Model parameters shared by all drivers (SUMO's carFollowModel="IDM")."""

    accel_mps2: AccelMps2 = 3.0  # code
    decel_mps2: AccelMps2 = 2.0  # code
    emergency_decel_mps2: AccelMps2 = 9.0  # code
    tau_s: TauS = 1.0  # SUMO; the paper gives none, the code has 1.5
    delta: Annotated[float, Range(0.1, 100.0)] = 4.0  # code

    def __post_init__(self) -> None:
        require_ranges(self)
        if self.emergency_decel_mps2 < self.decel_mps2:
            raise InputError(
                f"emergency_decel_mps2 must be at least decel_mps2 ({self.decel_mps2:g}), "
                f"not {self.emergency_decel_mps2:g}"
            )


@dataclass(frozen=True)
class FittedDriver:
    """Parameters of a car-following model that were fitted together to the recording of a driver."""

    tau_s: TauS
    min_gap_m: DistanceM
    accel_mps2: AccelMps2
    decel_mps2: AccelMps2

    def __post_init__(self) -> None:
        require_ranges(self)


@dataclass(frozen=True)
class Towns:
    """Towns that drivers are drawn from: each episode is in one of them.

    The drivers of a town are alike in the mean, and towns differ in it: each draws its levels uniformly from ``tau_s``,
    ``desired_speed_mps``, ``accel_mps2``, ``decel_mps2``, ``min_gap_factor`` and ``entry_gap_m``. Its profiles differ
    from these levels by shifts that it draws, too: drivers who yield keep longer headways and gaps than those who do
    not, and are slower. So a driver is conservative relative to its neighbours. In a town, each of the three shifts is
    nothing with the probability ``alike``, independently of the others.
    """

    count: Annotated[int, Range(1, MOST_VTYPES)] = 128
    seed: TrafficSeed = 2022  # seed of the draws; another one gives other towns
    only: Annotated[int, Range(0, MOST_VTYPES - 1)] | None = None  # all episodes are in the town of this number, from 0
    episodes: Annotated[int, Range(1, 1_000_000)] = 1  # so many episodes of an environment in a row are in one town
    tau_s: tuple[TauS, TauS] = (0.6, 1.8)
    desired_speed_mps: tuple[DriverSpeedMps, DriverSpeedMps] = (2.3, 3.1)
    accel_mps2: tuple[AccelMps2, AccelMps2] = (2.0, 4.0)
    decel_mps2: tuple[AccelMps2, AccelMps2] = (1.5, 2.5)  # comfortable braking
    min_gap_factor: tuple[Gain, Gain] = (0.7, 2.0)  # times the minimum gaps of the profiles
    entry_gap_m: tuple[SignedM, SignedM] = (-1.0, 1.5)  # added to the entry gaps of the profiles
    tau_shift_s: tuple[TimeShiftS, TimeShiftS] = (0.0, 0.5)  # headway of those who yield less that of the others
    speed_shift_mps: tuple[SpeedMps, SpeedMps] = (0.0, 0.7)  # speed of those who do not yield less that of the others
    gap_share: tuple[Fraction, Fraction] = (0.0, 1.0)  # share that is left of the profiles' difference in gaps
    alike: Fraction = 0.5

    def __post_init__(self) -> None:
        require_ranges(self)
        for name in (*TOWN_LEVELS, *TOWN_SHIFTS):
            low, high = getattr(self, name)
            if low > high:
                raise InputError(f"{name} must be two numbers from low to high, not {low:g} and {high:g}")
        if self.only is not None and self.only >= self.count:
            raise InputError(f"only must be the number of a town, 0 to {self.count - 1}, not {self.only}")
        if self.least_tau_s <= 0.0:
            raise InputError(f"tau_s must exceed half of tau_shift_s, {self.tau_shift_s[1] / 2:g} s, in every town")
        if self.desired_speed_mps[0] <= self.speed_shift_mps[1] / 2:
            raise InputError(
                f"desired_speed_mps must exceed half of speed_shift_mps, {self.speed_shift_mps[1] / 2:g} m/s, "
                "in every town"
            )

    @property
    def least_tau_s(self) -> float:
        """Shortest headway that a driver can have."""
        return self.tau_s[0] - self.tau_shift_s[1] / 2

    @property
    def top_speed_mps(self) -> float:
        """Highest desired speed that a driver can have."""
        return self.desired_speed_mps[1] + self.speed_shift_mps[1] / 2

    @property
    def numbers(self) -> range:
        """Numbers of the towns that episodes are in."""
        return range(self.count) if self.only is None else range(self.only, self.only + 1)


TOWN_LEVELS = ("tau_s", "desired_speed_mps", "accel_mps2", "decel_mps2", "min_gap_factor", "entry_gap_m")
TOWN_SHIFTS = ("tau_shift_s", "speed_shift_mps", "gap_share")


@dataclass(frozen=True)
class Willingness:
    """States of drivers whose trait is to yield, on which it depends whether they would do so now; default: always.

    A driver that passes the ego is willing to yield to it with ``probability``, which grows towards 1 with the time for
    which the ego has waited in the episode, in the time constant ``patience_s``. With ``braking_mps2``, a driver yields
    only if braking so hard, which it draws uniformly from this range, stops it clear of the ego's way: an ego has to
    leave it a gap. With ``attentive_s``, periods of attention and lapses follow one another, both of exponential
    lengths, and in a lapse nobody notices that the ego claims the lane. Whoever has begun to yield does so until the
    claim ends.
    """

    probability: Fraction = 1.0
    patience_s: TimeS | None = None  # null: the probability does not depend on the ego's waiting
    waiting_speed_mps: SpeedMps = 1.0  # an ego that is not faster waits
    braking_mps2: tuple[AccelMps2, AccelMps2] | None = None  # null: as the claim has it
    attentive_s: TimeS | None = None  # mean length of a period of attention; null: there are no lapses
    lapse_s: TimeS = 2.0  # mean length of a lapse

    def __post_init__(self) -> None:
        require_ranges(self)
        low, high = self.braking_mps2 or (0.0, 0.0)
        if low > high:
            raise InputError(f"braking_mps2 must be two numbers from low to high, not {low:g} and {high:g}")


@dataclass(frozen=True)
class Population:
    """The vTypes drivers are drawn from."""

    profiles: Many[DriverProfile] = DRIVER_PROFILES
    members: Annotated[int, Range(1, MOST_VTYPES)] = 32  # vTypes of a profile of weight 1, each with its own draws
    seed: TrafficSeed = 2022  # seed of the draws
    idm: Idm = Idm()
    towns: Towns | None = None  # the members are those of each town then
    car_following: CarFollowing = "IDM"  # SUMO's model, with the values of ``idm``
    fitted: Many[
        FittedDriver
    ] = ()  # the members of each profile follow as these, in turn; () as ``idm`` and profiles say
    willingness: Willingness | None = None  # states of drivers who yield; None: they always would

    def __post_init__(self) -> None:
        names = [profile.name for profile in self.profiles]
        if not 1 <= len(names) <= MOST_LABELS:
            raise InputError(f"profiles must be 1 to {MOST_LABELS:,}, not {len(names)}")
        if len(set(names)) < len(names):
            raise InputError(f"profiles must have names of their own, not {', '.join(names)}")
        require_ranges(self)
        if self.willingness is not None and len({profile.yields for profile in self.profiles}) < 2:
            raise InputError("willingness needs a profile that yields and one that does not, which are its labels")
        if self.towns is not None and self.towns.decel_mps2[1] > self.idm.emergency_decel_mps2:
            raise InputError(
                f"decel_mps2 of towns must not exceed emergency_decel_mps2 ({self.idm.emergency_decel_mps2:g}), "
                f"{self.towns.decel_mps2[1]:g} does"
            )
        if self.fitted and self.towns is not None:
            raise InputError("fitted drivers are in no towns; leave out fitted, or towns")
        for driver in self.fitted:
            if driver.decel_mps2 > self.idm.emergency_decel_mps2:
                raise InputError(
                    f"decel_mps2 of fitted drivers must not exceed emergency_decel_mps2 "
                    f"({self.idm.emergency_decel_mps2:g}), {driver.decel_mps2:g} does"
                )
        towns = 1 if self.towns is None else len(self.towns.numbers)
        vtypes = towns * sum(max(1, round(self.members * profile.weight)) for profile in self.profiles)
        if vtypes > MOST_VTYPES:
            times = "members times the weights of profiles" + ("" if self.towns is None else " times towns")
            raise InputError(f"{times} must be {MOST_VTYPES:,} at most, not {vtypes:,}")

    @property
    def episodes_per_town(self) -> int:
        """Number of episodes in a row that are in one town."""
        return 1 if self.towns is None else self.towns.episodes

    @property
    def least_tau_s(self) -> float:
        """Shortest time headway that a driver can have."""
        if self.fitted:
            return min(driver.tau_s for driver in self.fitted)
        return self.idm.tau_s if self.towns is None else self.towns.least_tau_s

    @property
    def middle_tau_s(self) -> float:
        """Time headway in the middle: the median of fitted drivers; with towns, the middle of their range."""
        if self.fitted:
            return statistics.median(driver.tau_s for driver in self.fitted)
        return self.idm.tau_s if self.towns is None else sum(self.towns.tau_s) / 2

    def with_tau(self, tau_s: float) -> "Population":
        """Return the population with this time headway for everybody, in every town."""
        towns = self.towns and replace(self.towns, tau_s=(tau_s, tau_s), tau_shift_s=(0.0, 0.0))
        fitted = tuple(replace(driver, tau_s=tau_s) for driver in self.fitted)
        return replace(self, idm=replace(self.idm, tau_s=tau_s), towns=towns, fitted=fitted)


_STREET = Population(  # of a town, at 30 to 50 km/h
    (
        replace(CONSERVATIVE, desired_speed_mps=(30 / 3.6, 40 / 3.6), min_gap_m=(2.0, 3.0), entry_gap_m=(15.0, 25.0)),
        replace(AGGRESSIVE, desired_speed_mps=(40 / 3.6, 50 / 3.6), min_gap_m=(1.0, 2.0), entry_gap_m=(10.0, 18.0)),
    ),
    idm=Idm(accel_mps2=2.0, decel_mps2=3.0, tau_s=1.2),
)
_TOWNS = Population(members=8, towns=Towns())
POPULATIONS = {
    "traits": Population(),
    "continuous": Population((CONTINUOUS,), members=512),
    "same_speed": Population(tuple(replace(profile, desired_speed_mps=(2.7, 2.7)) for profile in DRIVER_PROFILES)),
    "same_gap": Population(
        tuple(replace(profile, min_gap_m=(0.3, 0.7), entry_gap_m=(3.0, 6.0)) for profile in DRIVER_PROFILES)
    ),
    "towns": _TOWNS,
    "held_out_towns": replace(_TOWNS, towns=Towns(count=64, seed=2023)),
    "willing": Population(willingness=Willingness(probability=0.6)),
    "gentle": Population(willingness=Willingness(braking_mps2=(1.0, 4.0))),
    "inattentive": Population(willingness=Willingness(attentive_s=4.0, lapse_s=2.0)),
    "polite": Population(willingness=Willingness(probability=0.2, patience_s=10.0)),
    "street": _STREET,
}


@dataclass(frozen=True, order=True, init=False)
class Mix(FileForm):
    """P(conservative): each episode draws its probability uniformly from ``low`` to ``high``.

    Files, flags and users write one number where both are the same, and two numbers otherwise.
    """

    form = "a probability in [0, 1], or two of them from low to high"

    low: float
    high: float

    def __init__(self, low: float, high: float | None = None) -> None:
        """Make a mix of one probability, or of the range of two.

        Raises:
            InputError: they are no probabilities, or ``high`` is less than ``low``.
        """
        last = low if high is None else high
        if not 0.0 <= low <= last <= 1.0:
            raise InputError(f"P(conservative) must be {self.form}, not {shown(low if high is None else (low, high))}")
        object.__setattr__(self, "low", float(low))
        object.__setattr__(self, "high", float(last))

    @classmethod
    def parse(cls, value: Any) -> Self:
        """Return the mix that a number or two numbers stand for; a mix itself is returned as it is.

        Raises:
            InputError: they are no probabilities.
        """
        if isinstance(value, cls):
            return value
        numbers = value if isinstance(value, list | tuple) else [value]
        are_numbers = all(isinstance(number, Real) and not isinstance(number, bool) for number in numbers)
        if not are_numbers or len(numbers) not in (1, 2):
            raise InputError(f"P(conservative) must be {cls.form}, not {shown(value)}")
        return cls(*numbers)

    def plain(self) -> float | list[float]:
        return self.low if self.is_single else [self.low, self.high]

    @property
    def is_single(self) -> bool:
        """Whether all episodes have the same probability."""
        return self.low == self.high

    @property
    def mean(self) -> float:
        return (self.low + self.high) / 2

    @property
    def text(self) -> str:
        """The mix for people to read, such as ``"0.1 to 0.9"``."""
        return f"{self.low:g}" + ("" if self.is_single else f" to {self.high:g}")

    @classmethod
    def from_text(cls, text: str) -> Self:
        """Return the mix that ``text`` has written."""
        return cls(*map(float, text.split(" to ")))

    def contains(self, other: "Mix") -> bool:
        """Whether all probabilities of another mix are among these."""
        return self.low <= other.low and other.high <= self.high


ALL_MIXES = Mix(0.1, 0.9)
AnyMix = Mix | float | Sequence[float]  # what users write for a mix; parsed where it comes in


@dataclass(frozen=True)
class Traffic:
    """Arrivals of drivers on the street, and their mix."""

    p_conservative: Mix = Mix(0.4)
    arrivals_per_s: ArrivalsPerS | None = None  # Poisson rate per lane; None: saturated, enter as soon as there is room

    def __post_init__(self) -> None:
        require_ranges(self)


@dataclass(frozen=True)
class EgoController:
    """The ego's low-level control (code): a PD law on speed, and a safety check that overrides it."""

    desired_speeds_mps: Annotated[Many[SpeedMps], Length(2, MOST_ACTIONS)] = (
        0.0,
        0.5,
        3.0,
    )  # the actions (paper III-C)
    gain_per_s: GainPerS = 2.0
    accel_limit_mps2: AccelMps2 = 3.0
    unsafe_distance_m: DistanceM = 0.8  # distance between vehicle boxes
    closing_distance_m: DistanceM = 1.0  # unsafe if also closing faster than closing_speed_mps
    closing_speed_mps: SpeedMps = 1.0
    watches_behind: bool = True  # whether vehicles behind the ego count, too (code)
    braking_gain_per_s: GainPerS = 5.0
    braking_limit_mps2: AccelMps2 = 6.0

    def __post_init__(self) -> None:
        require_ranges(self)
        if any(after <= before for before, after in pairwise(self.desired_speeds_mps)):
            speeds = list(self.desired_speeds_mps)
            raise InputError(
                f"desired_speeds_mps must rise from the slowest, which waits, to the fastest, not {speeds}"
            )


@dataclass(frozen=True)
class Sensor:
    """Settings of the ego's perception of other vehicles; the default is perfect, and sees all of them as they are.

    A vehicle is seen if its centre is within the range and the field of view, if nothing hides it, and while the sensor
    has not lost it. The eye is above the ego's centre. ``occlusion``: a vehicle is hidden where buildings or boxes of
    other vehicles cut the straight lines from the eye to its centre and to its four corners, all five of them.
    A vehicle that is seen again has a new track number.
    """

    noise_m: NoiseM = 0.0
    """Standard deviation of the noise on the x and y of each vehicle."""
    noise_time_s: Annotated[float, Range(0.0, 3600.0)] = 0.0
    """Time constant in which this noise changes; 0: it is independent from step to step."""
    dropouts_per_s: Annotated[float, Range(0.0, 100.0)] = 0.0
    """Rate at which the sensor loses a vehicle that it has."""
    dropout_s: TimeS = 0.5
    """Mean time for which a vehicle is lost, exponentially distributed."""
    range_m: DistanceM | None = None
    """Distance from centre to centre up to which vehicles are seen; null: unlimited."""
    field_of_view_deg: Annotated[float, Range(1.0, 360.0)] = 360.0
    """Angle in which vehicles are seen, half of it to each side of the ego's heading."""
    occlusion: bool = False
    """Whether other vehicles and buildings hide vehicles."""
    corners_m: DistanceM | None = None
    """Buildings are at all corners of the roads, so far from them, beside those of the scene; null: there are none."""
    delay_s: Annotated[float, Range(0.0, 1.0)] = 0.0
    """Vehicles are seen where they were so long ago, a multiple of the simulation's step."""

    def __post_init__(self) -> None:
        require_ranges(self)
        if not isinstance(self.occlusion, bool):
            raise InputError(f"occlusion must be True or False, not {shown(self.occlusion)}")
        set_floats(self, "noise_m", "noise_time_s", "dropouts_per_s", "dropout_s", "range_m")
        set_floats(self, "field_of_view_deg", "corners_m", "delay_s")

    @property
    def hides(self) -> bool:
        """Whether there can be vehicles that it does not see."""
        is_limited = self.range_m is not None or self.field_of_view_deg < 360.0
        return is_limited or self.occlusion or self.dropouts_per_s > 0.0


PERFECT = Sensor()
SENSORS = {
    "perfect": PERFECT,
    "noisy_0.1": Sensor(noise_m=0.1),
    "noisy_0.2": Sensor(noise_m=0.2),
    "correlated": Sensor(noise_m=0.2, noise_time_s=1.0),
    "dropouts": Sensor(dropouts_per_s=0.5, dropout_s=0.5),
    "range_15": Sensor(range_m=15.0),
    "occlusion": Sensor(occlusion=True),
    "corners": Sensor(occlusion=True, corners_m=1.5),
    "delay_0.2": Sensor(delay_s=0.2),
}
TRAINING_SENSORS = (  # of policies that shall cope with any sensor; those of tests in held-out worlds are others
    PERFECT,
    Sensor(noise_m=0.05),
    Sensor(noise_m=0.15),
    Sensor(noise_m=0.1, noise_time_s=0.5),
    Sensor(dropouts_per_s=0.25, dropout_s=0.8),
    Sensor(range_m=20.0),
    Sensor(noise_m=0.05, occlusion=True),
    Sensor(delay_s=0.1),
    Sensor(delay_s=0.3),
)


@dataclass(frozen=True)
class World:
    """Drivers and sensors among which policies are trained, or tested unseen."""

    title: str
    population: str = "traits"  # a name in POPULATIONS
    car_following: CarFollowing = "IDM"
    tau_s: TauS | None = None  # time headway of all drivers; None: the population's
    sensors: tuple[Sensor, ...] = (PERFECT,)  # of several, each has an equal share of the environments


def _with_sensor(title: str, sensor: str) -> World:
    return World(title, sensors=(SENSORS[sensor],))


HELD_OUT_WORLDS = {  # never trained or tuned on
    "held_out_towns": World("64 unseen towns", "held_out_towns"),
    "headway_0.7": World("headway 0.7 s", tau_s=0.7),
    "headway_1.5": World("headway 1.5 s", tau_s=1.5),
    "headway_2.0": World("headway 2.0 s", tau_s=2.0),
    "same_speed": World("no difference in speed", "same_speed"),
    "same_gap": World("no difference in gap", "same_gap"),
    "eidm": World("EIDM", car_following="EIDM"),
    "krauss": World("Krauss", car_following="Krauss"),
    "acc": World("ACC", car_following="ACC"),
    "noise_0.1": _with_sensor("noise 0.1 m", "noisy_0.1"),
    "noise_0.2": _with_sensor("noise 0.2 m", "noisy_0.2"),
    "correlated_noise": _with_sensor("correlated noise", "correlated"),
    "dropouts": _with_sensor("dropouts", "dropouts"),
    "range_15": _with_sensor("range 15 m", "range_15"),
    "occlusion": _with_sensor("occlusion", "occlusion"),
    "delay_0.2": _with_sensor("delay 0.2 s", "delay_0.2"),
}
WORLDS = {
    "old": World("the old world"),
    "strangers": World("128 towns and nine sensors", "towns", sensors=TRAINING_SENSORS),
    "towns": World("128 towns", "towns"),
    **HELD_OUT_WORLDS,
}


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
    approach_speed_mps: SpeedMps = 0.5  # speed towards the lane that counts as moving in
    path_margin_m: DistanceM = 1.0  # an ego that is this far past a lane's border stands in the vehicles' path
    courtesy_gap_m: DistanceM = 1.5  # yielding drivers add this to their minGap while their lane is claimed
    reaction_time_s: Annotated[float, Range(0.0, 60.0)] = 0.1  # time before a driver brakes: one step
    braking_mps2: AccelMps2 = 6.0  # a driver is ready to brake so hard; an emergency has 9 m/s2

    def __post_init__(self) -> None:
        require_ranges(self)

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
    "careful": RewardPreset(2.5, -10.0, 0.05, -0.0013),  # the paper's, but that it is worth waiting in doubt
}
RewardName = Literal["paper", "authors", "careful"]


@dataclass(frozen=True)
class TraitSettings:
    """The paper's trait network and its training; every trait method takes what it needs of it."""

    embedding_sizes: Layers = (32, 64)  # code; () feeds the features to the GRU as they are
    hidden_size: Layer = 256  # code
    encoder_output_size: Layer = 256  # code
    decoder_output_size: Layer = 128  # code
    kl_weight: Weight = 5e-8  # paper IV-B; the code has 5e-7
    reconstruction_weight: Weight = 10.0  # code
    learning_rate: LearningRate = 5e-4  # decays linearly to zero (paper IV-B)
    weight_decay: Weight = 1e-6  # code
    batch_size: Annotated[int, Range(1, 1_000_000)] = 1024  # code
    epochs: Annotated[int, Range(1, 1_000_000)] = 1000  # paper IV-B
    noise_m: NoiseM = 0.0  # standard deviation of the noise on every position in training, drawn anew in each epoch

    def __post_init__(self) -> None:
        require_ranges(self)


@dataclass(frozen=True)
class Steady:
    """Limits within which a driver's motion counts as steady, so that it shows what the driver wants."""

    least_speed_mps: SpeedMps = 1.5
    greatest_accel_mps2: AccelMps2 = 0.8
    farthest_leader_m: DistanceM = 9.0  # farther ones are not followed
    greatest_closing_mps: SpeedMps = 0.8  # of the gap to the leader

    def __post_init__(self) -> None:
        require_ranges(self)


@dataclass(frozen=True)
class RelativeLatent:
    """A weighted sum of time gap and gap, and its distribution in towns; see ``tint_sumo.traits.relative``."""

    time_gap_weight: Annotated[float, Range(-1e6, 1e6)] = 7.0626  # per s
    gap_weight: Annotated[float, Range(-1e6, 1e6)] = -1.8459  # per m
    town_mean: Annotated[float, Range(-1e6, 1e6)] = 6.5201  # over all towns
    town_std: Annotated[float, Range(1e-3, 1e6)] = 1.6795  # of the towns' means; the drivers of a town have 1
    group_std: Annotated[float, Range(1e-3, 1e6)] = 0.2  # of the drivers of a group in a town
    steps: Annotated[float, Range(1e-3, 1e6)] = 80.0  # whose mean varies as much as the drivers of a group
    differences: Annotated[tuple[Fraction, ...], Length(1, 20)] = (
        0.2872,
        0.1065,
        0.2085,
        0.0988,
        0.1207,
        0.0849,
        0.0933,
    )
    """Probabilities that the groups of a town differ by 0, 0.6, 1.2, ..."""

    def __post_init__(self) -> None:
        require_ranges(self)
        if not sum(self.differences) > 0.0:
            raise InputError("differences must have a probability above 0")


@dataclass(frozen=True)
class RelativeSettings:
    """Relative traits; the default was fitted to the world ``strangers`` by ``tint-sumo traits relative``."""

    latent: RelativeLatent = RelativeLatent()
    steady: Steady = Steady()


@dataclass(frozen=True)
class PolicySettings:
    """The paper's policy network."""

    embedding_sizes: SomeLayers = (150, 100)  # code
    score_sizes: Layers = (100, 100)  # code
    context_size: Layer = 50  # code
    joint_sizes: SomeLayers = (150, 100, 64)  # code
    hidden_size: Layer = 256  # code
    head_sizes: Layers = (256, 256)  # code
    attention: bool = True  # without it, all vehicles count the same (the paper's ablation, IV-D)
    position_gain: Gain = 1.0  # positions are multiplied by this; observed in units of 20 m, they differ by little

    def __post_init__(self) -> None:
        require_ranges(self)
        if self.attention and not self.score_sizes:
            raise InputError("score_sizes must have 1 to 8 values with attention, not 0")


@dataclass(frozen=True)
class PpoSettings:
    """PPO as in the paper (IV-C) and its code; ``n_steps`` and ``n_envs`` set the batch.

    With ``action_repeat`` above 1 the policy decides only every so many simulation steps; ``n_steps``, ``gamma`` and
    ``total_steps`` then count decisions.
    """

    n_envs: Annotated[int, Range(1, 4096)] = 12  # paper
    n_steps: Annotated[int, Range(1, 65_536)] = 30  # paper
    n_epochs: Annotated[int, Range(1, 1000)] = 5
    n_minibatches: Annotated[int, Range(1, 4096)] = 2
    learning_rate: LearningRate = 1e-4  # decays linearly to zero (paper)
    gamma: Fraction = 0.99
    gae_lambda: Fraction = 0.95
    clip_range: Annotated[float, Range(1e-6, 1e6)] = 0.2
    ent_coef: Weight = 0.01  # entropy weight at the beginning
    final_ent_coef: Weight = 0.01  # entropy weight at the end; in between it changes linearly
    vf_coef: Weight = 0.5
    max_grad_norm: Annotated[float, Range(1e-6, 1e9)] = 0.5
    total_steps: Decisions = 10_000_000  # paper
    policy: PolicySettings = field(default_factory=PolicySettings)
    action_repeat: Annotated[int, Range(1, 1000)] = 1  # paper: a decision every step
    reward: RewardName = "paper"  # of the training; tests count outcomes
    motion: bool = False  # whether the policy observes each vehicle's speed, too, as its track shows it
    relative: RelativeSettings = field(default_factory=RelativeSettings)  # of the method "relative"
    time_limit_s: TimeS = 50.0  # limit of training episodes if the scene's is not shorter; evaluation has the scene's
    calibration_episodes: Annotated[int, Range(0, 1_000_000)] = 0  # to find how readily the trained policy should move

    def __post_init__(self) -> None:
        require_ranges(self)
        if self.rollout > MOST_DECISIONS:
            raise InputError(
                f"n_envs times n_steps must be {MOST_DECISIONS:,} decisions at most, which are in memory at a time, "
                f"not {self.rollout:,}"
            )
        if self.n_minibatches > self.n_envs:
            raise InputError(
                f"n_minibatches must be at most n_envs ({self.n_envs}), whose sequences stay whole, "
                f"not {self.n_minibatches}"
            )

    @property
    def rollout(self) -> int:
        """Decisions of a rollout, in all environments together."""
        return self.n_envs * self.n_steps

    def whole_rollouts(self, decisions: int) -> int:
        """Return the decisions of as few whole rollouts as have at least so many ``decisions``."""
        return self.rollout * math.ceil(decisions / self.rollout)


# A small network is as accurate here as the paper's, trains in minutes and encodes 768 windows in less than 2 ms.
_FULL = TraitSettings(
    embedding_sizes=(),
    hidden_size=20,
    encoder_output_size=32,
    decoder_output_size=32,
    learning_rate=3e-3,
    batch_size=512,
    epochs=3,
)

TRAIT_BUDGETS = {
    "quick": replace(_FULL, batch_size=256, epochs=20),  # meant for some 30,000 windows
    "full": _FULL,  # meant for the paper's 696,000
    "paper": TraitSettings(),
}

# Chosen with one or two seeds on cases that are reported nowhere (set 1000); see docs/explanation/training.md.
_FULL_PPO = PpoSettings(
    n_envs=128,
    n_steps=64,
    n_epochs=4,
    n_minibatches=8,
    learning_rate=3e-3,
    gamma=0.999,  # per decision of 0.4 s; with less, a small risk pays more than waiting for the next gap
    ent_coef=0.01,
    final_ent_coef=0.0,  # tests take the likeliest actions: what succeeds by chance must become likely
    vf_coef=0.02,  # returns are near 8: with more, their errors drown the actor's gradient in the shared layers
    total_steps=1_600_000,
    action_repeat=4,
    policy=PolicySettings(
        position_gain=6.0,
        embedding_sizes=(64, 64),
        score_sizes=(64,),
        context_size=64,
        joint_sizes=(64, 64),
        hidden_size=64,
        head_sizes=(64,),
    ),
)

PPO_BUDGETS = {
    "quick": replace(_FULL_PPO, n_envs=64, total_steps=200_000),
    "full": _FULL_PPO,
    "strangers": replace(_FULL_PPO, reward="careful", motion=True, n_epochs=8, calibration_episodes=512),
    "paper": PpoSettings(),
}


def network_ppo(step_s: float) -> PpoSettings:
    """Return the settings of a training in a SUMO configuration with this step: a decision about every 0.4 s.

    Each environment is a process there, hence few of them.
    """
    every = max(round(_FULL_PPO.action_repeat * STEP_S / step_s), 1)
    batch = replace(_FULL_PPO, n_envs=8, n_steps=128, n_minibatches=4)
    return replace(batch, learning_rate=1e-3, gamma=0.99, total_steps=200_000, action_repeat=every)
