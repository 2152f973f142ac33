"""Populations of drivers, and their vTypes: several IDM members per trait, and the distribution plain SUMO draws from.

Source: https://sumo.dlr.de/docs/Definition_of_Vehicles,_Vehicle_Types,_and_Routes.html
"""

from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Annotated, Any

import numpy as np

from tint_sumo.config import (
    KINDS,
    POPULATIONS,
    TOWN_LEVELS,
    TOWN_SHIFTS,
    DriverProfile,
    Idm,
    Population,
    Towns,
    VehicleShape,
)
from tint_sumo.core.errors import InputError, find_named
from tint_sumo.core.structures import FieldError, ReadBy, Where, build, choose

DISTRIBUTION_ID = "drivers"
EGO_TYPE = "ego"
NO_TOWN = -1  # number of the town of drivers and episodes in a population without towns


def read_population(value: Any, where: Where = ()) -> Population:
    """Return the population that a file gives: a name, a list of profiles, or what differs from its ``base``.

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
    """Return the population called ``name``.

    Raises:
        InputError: there is none.
    """
    return find_named("population", name, POPULATIONS)


def population_name(population: Population) -> str | None:
    """Return the name of a population, if it has one."""
    return next((name for name, known in POPULATIONS.items() if known == population), None)


def require_two_kinds(kinds: int, work: str, drivers: str) -> None:
    """Raise InputError unless there are exactly two kinds of drivers, as labels, films and studies need.

    Args:
        kinds: number of kinds.
        work: beginning of the message, such as ``"a film"``.
        drivers: whose drivers they are, for the message.
    """
    if kinds != KINDS:
        raise InputError(f"{work} needs exactly two kinds of drivers, and {drivers} has {kinds}; choose other drivers")


@dataclass(frozen=True)
class DriverMember:
    """A driver as SUMO has it: a vType of its own profile."""

    type_id: str
    profile: DriverProfile
    desired_speed_mps: float
    min_gap_m: float
    idm: Idm
    entry_gap_m: tuple[float, float]
    town: int = NO_TOWN


@dataclass(frozen=True)
class Town:
    """The levels that the drivers of a town keep in the mean, and the shifts between its profiles; see ``Towns``."""

    number: int
    tau_s: float
    desired_speed_mps: float
    accel_mps2: float
    decel_mps2: float
    min_gap_factor: float
    entry_gap_m: float
    tau_shift_s: float
    speed_shift_mps: float
    gap_share: float


def draw_town(towns: Towns, number: int) -> Town:
    """Return a town, which follows from its number and the seed of the towns alone."""
    rng = np.random.default_rng((towns.seed, number))
    levels = {name: round(float(rng.uniform(*getattr(towns, name))), 4) for name in TOWN_LEVELS}
    shifts = {name: round(float(rng.uniform(*getattr(towns, name))), 4) for name in TOWN_SHIFTS}
    differ = rng.random(len(TOWN_SHIFTS)) >= towns.alike
    shifts = {name: shift if differs else 0.0 for (name, shift), differs in zip(shifts.items(), differ, strict=True)}
    return Town(number, **levels, **shifts)


def members(population: Population) -> tuple[DriverMember, ...]:
    """Return all vTypes of a population, profile by profile, as many of each as its weight says; town by town."""
    towns = population.towns
    if towns is None:
        return _members(population)
    return tuple(
        member for number in towns.numbers for member in _members_of(draw_town(towns, number), towns.seed, population)
    )


def _members_of(town: Town, seed: int, population: Population) -> Iterator[DriverMember]:
    """Yield the drivers of a town: those of the population, moved to the town's levels and shifted by its shifts."""
    rng = np.random.default_rng((population.seed, seed, town.number))
    mean_gap_m = float(np.mean([profile.min_gap_m for profile in population.profiles]))
    mean_entry_m = float(np.mean([profile.entry_gap_m for profile in population.profiles]))
    for profile in population.profiles:
        side = 0.5 if profile.yields else -0.5  # a driver who does not yield is the aggressive one
        tau_s = round(town.tau_s + side * town.tau_shift_s, 4)
        idm = replace(population.idm, tau_s=tau_s, accel_mps2=town.accel_mps2, decel_mps2=town.decel_mps2)
        gaps_m = _nearer(profile.min_gap_m, mean_gap_m, town.gap_share)
        entry_m = _nearer(profile.entry_gap_m, mean_entry_m, town.gap_share)
        for index in range(_count(population, profile)):
            low_m, high_m = (max(gap_m + town.entry_gap_m, 0.0) for gap_m in entry_m)
            yield DriverMember(
                type_id=f"{profile.name}.{town.number}.{index}",
                profile=profile,
                desired_speed_mps=round(town.desired_speed_mps - side * town.speed_shift_mps, 4),
                min_gap_m=round(town.min_gap_factor * float(rng.uniform(*gaps_m)), 4),
                idm=idm,
                entry_gap_m=(low_m, high_m),
                town=town.number,
            )


def _nearer(low_high: tuple[float, float], mean: float, share: float) -> tuple[float, float]:
    """Return a profile's range moved towards the mean of all, so that this share of the distance is left."""
    low, high = low_high
    move = (1.0 - share) * (mean - (low + high) / 2)
    return low + move, high + move


def _count(population: Population, profile: DriverProfile) -> int:
    return max(1, round(population.members * profile.weight))


def _members(population: Population) -> tuple[DriverMember, ...]:
    gaps, speeds = (np.random.default_rng(seed) for seed in (population.seed, (population.seed, 1)))
    return tuple(
        _as_fitted(
            population,
            index,
            DriverMember(
                type_id=f"{profile.name}.{index}",
                profile=profile,
                desired_speed_mps=round(float(speeds.uniform(*profile.desired_speed_mps)), 4),
                min_gap_m=round(float(gaps.uniform(*profile.min_gap_m)), 4),
                idm=population.idm,
                entry_gap_m=profile.entry_gap_m,
            ),
        )
        for profile in population.profiles
        for index in range(_count(population, profile))
    )


def _as_fitted(population: Population, index: int, member: DriverMember) -> DriverMember:
    """Return a member that follows as the fitted driver whose turn it is, if there are any."""
    if not population.fitted:
        return member
    found = population.fitted[index % len(population.fitted)]
    idm = replace(member.idm, tau_s=found.tau_s, accel_mps2=found.accel_mps2, decel_mps2=found.decel_mps2)
    return replace(member, idm=idm, min_gap_m=found.min_gap_m)


def vtypes_xml(population: Population, p_conservative: float, vehicle: VehicleShape) -> str:
    """Return the SUMO additional file with every vType, the distribution with P(conservative) and the ego's type.

    With towns there is a distribution for each of them, ``drivers.NUMBER``, and ``drivers`` is the first one's.
    """
    drivers = members(population)
    # SUMO cuts the corners off a passenger car's shape before it looks for collisions; a van keeps its full box.
    shape = f'guiShape="delivery" length="{vehicle.length_m:g}" width="{vehicle.width_m:g}"'
    first = [member for member in drivers if member.town == drivers[0].town]
    towns = population.towns
    named = {} if towns is None else {f"{DISTRIBUTION_ID}.{number}": number for number in towns.numbers}
    lines = [
        "<additional>",
        *(f"    {_vtype(member, shape, population.car_following)}" for member in drivers),
        *_distribution(DISTRIBUTION_ID, first, p_conservative),
        *(
            line
            for name, town in named.items()
            for line in _distribution(name, [member for member in drivers if member.town == town], p_conservative)
        ),
        f'    <vType id="{EGO_TYPE}" {shape} minGap="0" maxSpeed="10" speedDev="0" color="230,180,0"/>',
        "</additional>",
        "",
    ]
    return "\n".join(lines)


def _distribution(name: str, drivers: Sequence[DriverMember], p_conservative: float) -> list[str]:
    count = Counter(member.profile.yields for member in drivers)
    share = {True: p_conservative, False: 1.0 - p_conservative} if len(count) == 2 else {True: 1.0, False: 1.0}
    probabilities = [share[member.profile.yields] / count[member.profile.yields] for member in drivers]
    return [
        f'    <vTypeDistribution id="{name}" vTypes="{" ".join(member.type_id for member in drivers)}"',
        f'        probabilities="{" ".join(f"{p:g}" for p in probabilities)}"/>',
    ]


def _vtype(member: DriverMember, shape: str, car_following: str) -> str:
    idm = member.idm
    # A driver that does not yield ignores every vehicle on the junction; the rest of the trait, ignoring the ego as a
    # leader, has no effect as a vType parameter and is set per vehicle.
    delta = f' delta="{idm.delta:g}"' if car_following in ("IDM", "EIDM") else ""
    sigma = ' sigma="0"' if car_following == "Krauss" else ""  # as IDM, it has no randomness then
    ignore = "" if member.profile.yields else ' jmIgnoreJunctionFoeProb="1"'
    return (
        f'<vType id="{member.type_id}" carFollowModel="{car_following}" {shape} '
        f'maxSpeed="{member.desired_speed_mps:g}" minGap="{member.min_gap_m:g}" '
        f'accel="{idm.accel_mps2:g}" decel="{idm.decel_mps2:g}" emergencyDecel="{idm.emergency_decel_mps2:g}" '
        f'tau="{idm.tau_s:g}"{delta} speedFactor="1" speedDev="0" color="{member.profile.colour}"{sigma}{ignore}/>'
    )
