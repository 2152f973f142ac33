"""Ranges of settings: hostile values are refused in one line, or they work."""

from dataclasses import fields, is_dataclass, replace
from typing import Annotated, Any, get_args, get_origin, get_type_hints

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tint_sumo.cli.command_line import TintSumo
from tint_sumo.cli.configuration import subcommands
from tint_sumo.comparisons.scenes import SceneStudy
from tint_sumo.comparisons.traits import TraitStudy
from tint_sumo.config import (
    CONSERVATIVE,
    Claim,
    DriverProfile,
    EgoController,
    Idm,
    Mix,
    PolicySettings,
    Population,
    PpoSettings,
    Traffic,
    TraitSettings,
    VehicleShape,
)
from tint_sumo.core.errors import InputError
from tint_sumo.core.ranges import Length, Range, require_ranges
from tint_sumo.core.structures import FieldError, build, plain
from tint_sumo.scenes import SCENES, find_scene, read_scene
from tint_sumo.scenes.drivers import members
from tint_sumo.scenes.scene import Scene
from tint_sumo.scenes.settings import SceneSettings, SumocfgSettings
from tint_sumo.study.budgets import BUDGETS, Budget, Conditions, Trials

SETTINGS: tuple[Any, ...] = (
    CONSERVATIVE,
    Claim(),
    EgoController(),
    Idm(),
    PolicySettings(),
    Population(),
    PpoSettings(),
    SceneSettings.of(find_scene("four_way")),
    TraitSettings(),
    Traffic(),
    VehicleShape(),
    BUDGETS["quick"],
    Conditions(Mix(0.4)),
    Trials((Conditions(Mix(0.4)),), 100),
    TraitStudy(),
    SceneStudy(),
)
FIELDS = [(base, field.name) for base in SETTINGS for field in fields(base) if field.init]
NUMBERS = st.one_of(
    st.floats(),
    st.integers(),
    st.sampled_from([0, -1, 1e-300, 1e-4, 1e9, 1e300, 10**30, -(10**400), 2**63, float("nan"), float("inf"), True]),
)
HOSTILE = st.one_of(
    NUMBERS,
    st.lists(NUMBERS, max_size=4),
    st.text(max_size=10),
    st.none(),
    st.lists(st.lists(NUMBERS, max_size=3), max_size=3),
    st.dictionaries(st.text(max_size=5), NUMBERS, max_size=2),
    st.sampled_from(["../../x", "a\0b", "x" * 5000, "\ud800", [[]] * 1000]),
)


def numbers_of(kind: Any) -> list[tuple[Any, tuple[Any, ...]]]:
    """The types of numbers within a type, each with what they are annotated with."""
    if get_origin(kind) is Annotated:
        inner, *marks = get_args(kind)
        return [(inner, tuple(marks))] if inner in (int, float) else numbers_of(inner)
    if kind in (int, float):
        return [(kind, ())]
    return [found for one in get_args(kind) for found in numbers_of(one)]


def commands(kind: type) -> list[type]:
    below = subcommands(kind)
    return [kind] if not below else [one for group in below.values() for one in commands(group)]


KINDS = [*(type(base) for base in SETTINGS), Scene, SumocfgSettings, DriverProfile, Budget, *commands(TintSumo)]


@pytest.mark.parametrize("kind", dict.fromkeys(KINDS), ids=lambda kind: kind.__name__)
def test_every_number_has_a_range(kind: type) -> None:
    hints = get_type_hints(kind, include_extras=True)
    found = {
        name
        for name in (field.name for field in fields(kind) if is_dataclass(kind))
        for _, marks in numbers_of(hints[name])
        if not any(isinstance(mark, Range) for mark in marks)
    }
    assert found <= {"percent"}  # of a few values


@pytest.mark.parametrize(("base", "name"), FIELDS, ids=lambda one: one if isinstance(one, str) else type(one).__name__)
@settings(max_examples=30, deadline=None)
@given(value=HOSTILE)
def test_a_hostile_value_in_a_file_is_refused_in_a_line_or_kept(base: Any, name: str, value: Any) -> None:
    try:
        found = build(type(base), {**plain(base), name: value})
    except FieldError as error:
        assert "\n" not in str(error)
        assert len(str(error)) < 1000
    else:
        assert build(type(base), plain(found)) == found


@pytest.mark.parametrize(("base", "name"), FIELDS, ids=lambda one: one if isinstance(one, str) else type(one).__name__)
def test_python_gets_the_same_limits_as_files(base: Any, name: str) -> None:
    if not numbers_of(get_type_hints(type(base), include_extras=True)[name]):
        return
    for number in (-1e9, 1e300, float("nan")):
        value = getattr(base, name)
        with pytest.raises(InputError):
            replace(base, **{name: (number,) * len(value) if isinstance(value, tuple) and value else number})


def test_a_length_counts_the_items() -> None:
    with pytest.raises(InputError, match="embedding_sizes must have 1 to 8 values, not 9"):
        PolicySettings(embedding_sizes=(4,) * 9)
    assert Length(0, 2).check((1, 2)) == (1, 2)


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"step_s": 1e-4}, "step_s: must lie in 0.01 to 1, not 0.0001"),
        ({"step_s": 0.0123}, "step_s must be whole milliseconds, not 0.0123"),
        ({"max_vehicles": 10**9}, "max_vehicles: must lie in 1 to 200, not 1000000000"),
        ({"name": "../../x"}, "name must be of up to 64 letters, digits"),
        ({"controller": {"desired_speeds_mps": [0, 0, 0]}}, "desired_speeds_mps must rise from the slowest"),
        ({"controller": {"desired_speeds_mps": [3, 2, 1]}}, "desired_speeds_mps must rise from the slowest"),
        ({"controller": {"desired_speeds_mps": [3]}}, "desired_speeds_mps: must have 2 to 100 values, not 1"),
        ({"population": {"idm": {"tau_s": 1e300}}}, r"tau_s: must lie in 0.01 to 20, not 1e\+300"),
        (
            {"population": [{**plain(CONSERVATIVE), "desired_speed_mps": [14, 14]}]},
            "desired_speed_mps of conservative must not exceed the roads' limit of 10 m/s, 14 m/s does",
        ),
        ({"population": [{**plain(CONSERVATIVE), "desired_speed_mps": [1e-6, 1]}]}, r"must lie in 0.01 to 60"),
        ({"population": {"members": 10_000}}, "must be 10,000 at most, not 20,000"),
    ],
)
def test_scenes_that_sumo_would_not_run_are_refused(settings: dict[str, Any], message: str) -> None:
    with pytest.raises(FieldError, match=message):
        read_scene({"base": "t_intersection", **settings}, ("scene",))


def test_scenes_at_their_limits_have_drivers() -> None:
    for name in SCENES:
        base = find_scene(name)
        for speed_mps in (0.01, base.network.speed_limit_mps):
            profile = replace(CONSERVATIVE, desired_speed_mps=(speed_mps, speed_mps))
            assert members(replace(base, population=Population((profile,))).population)[0].desired_speed_mps > 0


def test_flags_have_limits() -> None:
    for kind in commands(TintSumo):
        if "workers" in get_type_hints(kind):
            command = object.__new__(kind)
            for name in get_type_hints(kind):
                object.__setattr__(command, name, 100_000 if name == "workers" else getattr(kind, name, None))
            with pytest.raises(InputError, match="workers must lie in 1 to 1,024, not 100000"):
                require_ranges(command)
