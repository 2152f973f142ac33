"""Dataclasses from what a file says."""

from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any, Literal

import pytest

from tint_sumo.core.errors import InputError
from tint_sumo.core.ranges import Range
from tint_sumo.core.structures import FieldError, Many, build, build_json, overlay, plain

Share = Annotated[float, Range(0, 1)]


@dataclass(frozen=True)
class Part:
    seeds: Many[int] = (0,)
    mix: Share | tuple[Share, Share] = 0.5
    kind: Literal["a", "b"] = "a"
    file: Path | None = None

    def __post_init__(self) -> None:
        if len(self.seeds) > 3:
            raise InputError("seeds must be three at most")


@dataclass(frozen=True)
class Whole:
    name: str
    parts: tuple[Part, ...] = ()
    part: Part = field(default_factory=Part)
    sizes: dict[str, int] = field(default_factory=dict)
    on: bool = False


def test_a_value_survives_the_way_to_a_file_and_back() -> None:
    whole = Whole("x", (Part((1, 2), (0.1, 0.9)), Part(file=Path("there"))), Part(kind="b"), {"a": 1}, on=True)
    assert build(Whole, plain(whole)) == whole


@pytest.mark.parametrize(
    ("value", "message"),
    [
        ([], "must be a mapping of name, parts, part, sizes, on, not []"),
        ({}, "name must be given"),
        ({"name": "x", "prats": 1}, "prats: there is no such setting; did you mean parts?; known are name, parts"),
        ({"name": "x", "part": {"sed": 1}}, "part.sed: there is no such setting; did you mean seeds?; known are seeds"),
        ({"name": "x", "parts": [{}, {"seeds": [1, "2"]}]}, "parts[1].seeds[1]: must be a whole number, not '2'"),
        ({"name": "x", "part": {"seeds": True}}, "part.seeds: must be a list, each item a whole number, not True"),
        ({"name": "x", "part": {"seeds": [1, 2, 3, 4]}}, "part: seeds must be three at most"),
        (
            {"name": "x", "part": {"mix": "x"}},
            "part.mix: must be a number from 0 to 1 or a list of 2, each item a number from 0 to 1, not 'x'",
        ),
        ({"name": "x", "part": {"mix": [0.1]}}, "part.mix: must be a number from 0 to 1 or a list of 2, each item"),
        ({"name": "x", "part": {"mix": 2}}, "part.mix: must lie in 0 to 1, not 2.0"),
        ({"name": "x", "part": {"mix": [0.1, 7]}}, "part.mix[1]: must lie in 0 to 1, not 7.0"),
        ({"name": "x", "part": {"mix": float("nan")}}, "part.mix: must be a number from 0 to 1 or a list of 2"),
        ({"name": "x", "part": {"file": 3}}, "part.file: must be a path or null, not 3"),
        ({"name": "x", "sizes": {"a": 1.5}}, "sizes.a: must be a whole number, not 1.5"),
        ({"name": 1, "on": 1, "part": {"kind": "c"}}, "name: must be text, not 1; also wrong: part.kind, on"),
        (
            {"name": "x", "part": {"seeds": [1, "2", "3"]}, "on": 1},
            "part.seeds[1]: must be a whole number, not '2'; also wrong: part.seeds[2], on",
        ),
        ({"name": "x", "part": {"\n": 1}}, "part.'\\n': there is no such setting"),
        ({"name": "x", "sizes": {"a\tb": 1.5}}, "sizes.'a\\tb': must be a whole number, not 1.5"),
        ({"name": "x", "k" * 1000: 1}, "'kkkk"),
        ({"name": ["long" * 1000]}, "name: must be text, not ['longlong"),
    ],
)
def test_values_that_do_not_fit_are_refused_in_a_line(value: Any, message: str) -> None:
    with pytest.raises(FieldError) as refused:
        build(Whole, value)
    error = str(refused.value)
    assert error.startswith(message)
    assert "\n" not in error
    assert len(error) < 300


@pytest.mark.parametrize("text", [b"", b"{", b"[" * 100_000, b'{"name": "\xff"}', b'{"name": ' + b"9" * 5000 + b"}"])
def test_damaged_json_is_refused(text: bytes) -> None:
    with pytest.raises(FieldError):
        build_json(Whole, text)


def test_what_a_file_does_not_say_stays_as_it_is() -> None:
    base = Whole("x", part=Part((1, 2), 0.3))
    assert overlay(base, {"part": {"mix": 0.4}}) == Whole("x", part=Part((1, 2), 0.4))
    with pytest.raises(FieldError, match=r"scene\.part\.mix: must lie in 0 to 1, not 3"):
        overlay(base, {"part": {"mix": 3}}, ("scene",))


def test_one_value_stands_for_a_list_of_it() -> None:
    assert build(Part, {"seeds": 3}).seeds == (3,)
