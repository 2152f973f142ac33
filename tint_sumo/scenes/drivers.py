"""Populations of drivers, and their vTypes: several IDM members per trait, and the distribution plain SUMO draws from.

Source: https://sumo.dlr.de/docs/Definition_of_Vehicles,_Vehicle_Types,_and_Routes.html
"""

from collections import Counter
from dataclasses import dataclass
from typing import Annotated, Any

import numpy as np

from tint_sumo.config import KINDS, POPULATIONS, DriverProfile, Idm, Population, VehicleShape
from tint_sumo.core.errors import InputError, find_named
from tint_sumo.core.structures import FieldError, ReadBy, Where, build, choose

DISTRIBUTION_ID = "drivers"
EGO_TYPE = "ego"


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


def members(population: Population) -> tuple[DriverMember, ...]:
    """Return all vTypes of a population, profile by profile, as many of each as its weight says."""
    gaps, speeds = (np.random.default_rng(seed) for seed in (population.seed, (population.seed, 1)))
    return tuple(
        DriverMember(
            type_id=f"{profile.name}.{index}",
            profile=profile,
            desired_speed_mps=round(float(speeds.uniform(*profile.desired_speed_mps)), 4),
            min_gap_m=round(float(gaps.uniform(*profile.min_gap_m)), 4),
            idm=population.idm,
        )
        for profile in population.profiles
        for index in range(max(1, round(population.members * profile.weight)))
    )


def vtypes_xml(population: Population, p_conservative: float, vehicle: VehicleShape) -> str:
    """Return the SUMO additional file with every vType, the distribution with P(conservative) and the ego's type."""
    drivers = members(population)
    count = Counter(member.profile.yields for member in drivers)
    share = {True: p_conservative, False: 1.0 - p_conservative} if len(count) == 2 else {True: 1.0, False: 1.0}
    probabilities = [share[member.profile.yields] / count[member.profile.yields] for member in drivers]
    # SUMO cuts the corners off a passenger car's shape before it looks for collisions; a van keeps its full box.
    shape = f'guiShape="delivery" length="{vehicle.length_m:g}" width="{vehicle.width_m:g}"'
    lines = [
        "<additional>",
        *(f"    {_vtype(member, shape)}" for member in drivers),
        f'    <vTypeDistribution id="{DISTRIBUTION_ID}" vTypes="{" ".join(member.type_id for member in drivers)}"',
        f'        probabilities="{" ".join(f"{p:g}" for p in probabilities)}"/>',
        f'    <vType id="{EGO_TYPE}" {shape} minGap="0" maxSpeed="10" speedDev="0" color="230,180,0"/>',
        "</additional>",
        "",
    ]
    return "\n".join(lines)


def _vtype(member: DriverMember, shape: str) -> str:
    idm = member.idm
    # A driver that does not yield ignores every vehicle on the junction; the rest of the trait, ignoring the ego as a
    # leader, has no effect as a vType parameter and is set per vehicle.
    ignore = "" if member.profile.yields else ' jmIgnoreJunctionFoeProb="1"'
    return (
        f'<vType id="{member.type_id}" carFollowModel="IDM" {shape} maxSpeed="{member.desired_speed_mps:g}" '
        f'minGap="{member.min_gap_m:g}" accel="{idm.accel_mps2:g}" decel="{idm.decel_mps2:g}" '
        f'emergencyDecel="{idm.emergency_decel_mps2:g}" tau="{idm.tau_s:g}" delta="{idm.delta:g}" '
        f'speedFactor="1" speedDev="0" color="{member.profile.colour}"{ignore}/>'
    )
