"""Ranges of numbers, given once beside the type of a setting: for files, flags and Python alike."""

from dataclasses import dataclass
from functools import cache
from numbers import Real
from types import UnionType
from typing import Annotated, Any, Union, get_args, get_origin, get_type_hints

from tint_sumo.core.errors import InputError, shown


@dataclass(frozen=True)
class Range:
    """The range in which a number must lie, ends included. Beside a type, as ``Annotated[int, Range(1, 64)]``."""

    low: float
    high: float

    def __str__(self) -> str:
        return f"from {_digits(self.low)} to {_digits(self.high)}"

    def check(self, value: Any) -> Any:
        """Return the value.

        Raises:
            InputError: it is no number in this range.
        """
        if isinstance(value, bool) or not isinstance(value, Real) or not self.low <= value <= self.high:  # type: ignore[operator]
            raise InputError(f"must lie in {_digits(self.low)} to {_digits(self.high)}, not {shown(value)}")
        return value

    def require(self, name: str, value: Any) -> None:
        """Raise InputError, which begins with ``name``, unless the value is a number in this range."""
        try:
            self.check(value)
        except InputError as error:
            raise InputError(f"{name} {error}") from None

    def __get_pydantic_core_schema__(self, source: Any, handler: Any) -> Any:
        from pydantic_core import core_schema  # noqa: PLC0415 - where files are read, and nowhere else

        return core_schema.no_info_after_validator_function(self.check, handler(source))


@dataclass(frozen=True)
class Length(Range):
    """The range in which the number of items of a tuple must lie."""

    def __str__(self) -> str:
        return f"({_digits(self.low)} to {_digits(self.high)} of them)"

    def check(self, value: Any) -> Any:
        """Return the value.

        Raises:
            InputError: it has fewer or more items.
        """
        if not self.low <= len(value) <= self.high:
            raise InputError(f"must have {_digits(self.low)} to {_digits(self.high)} values, not {len(value)}")
        return value


Processes = Annotated[int, Range(1, 1024)]  # of this machine, at a time


def require_ranges(owner: Any) -> None:
    """Check the fields of a dataclass against the ranges beside their types.

    Raises:
        InputError: a field, or an item of a field that is a tuple, is outside of its range.
    """
    kind: Any = type(owner)
    for name, hint in _hints(kind).items():
        try:
            _require(hint, getattr(owner, name))
        except InputError as error:
            raise InputError(f"{name} {error}") from None


def require_distinct(owner: object, *names: str) -> None:
    """Raise InputError unless these fields of a dataclass have one or more values, each of them once."""
    for name in names:
        values = getattr(owner, name)
        if len(set(values)) < max(1, len(values)):
            raise InputError(f"{name} must be one or more, each of them once, not {shown(list(values))}")


def set_floats(owner: object, *names: str) -> None:
    """Make floats of the numbers in these fields of a frozen dataclass, so that 1 and 1.0 are one value; None stays."""
    for name in names:
        value = getattr(owner, name)
        if value is not None:
            object.__setattr__(owner, name, float(value))


@cache
def _hints(kind: Any) -> dict[str, Any]:
    return {name: hint for name, hint in get_type_hints(kind, include_extras=True).items() if _has_range(hint)}


def _has_range(kind: Any) -> bool:
    return isinstance(kind, Range) or any(map(_has_range, get_args(kind)))


def _require(kind: Any, value: Any) -> None:
    """Raise InputError if a number is outside of the range that its type has."""
    arguments = get_args(kind)
    if get_origin(kind) is Annotated:
        _require(arguments[0], value)
        for mark in arguments[1:]:
            if isinstance(mark, Range):
                mark.check(value)
    elif get_origin(kind) in (Union, UnionType) and value is not None:
        for member in arguments:
            if _is_tuple(member) is isinstance(value, tuple | list):
                _require(member, value)
    elif get_origin(kind) is tuple:
        kinds = arguments[:1] * len(value) if arguments[-1] is ... else arguments
        for item_kind, item in zip(kinds, value, strict=False):
            _require(item_kind, item)


def _is_tuple(kind: Any) -> bool:
    return get_origin(get_args(kind)[0] if get_origin(kind) is Annotated else kind) is tuple


def _digits(number: float) -> str:
    return f"{number:,}" if isinstance(number, int) else f"{number:g}"
