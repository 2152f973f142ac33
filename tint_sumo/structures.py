"""Dataclasses from what a file says, and back. The types, defaults and checks are those of the dataclasses."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import MISSING, fields, is_dataclass, replace
from difflib import get_close_matches
from pathlib import Path
from types import NoneType, UnionType
from typing import Annotated, Any, Literal, TypeVar, Union, get_args, get_origin, get_type_hints

from tint_sumo.errors import InputError

T = TypeVar("T")
Where = tuple[str | int, ...]  # leads to a value: names of fields, and numbers of list items from 0

_WORDS = {
    int: "a whole number",
    float: "a number",
    bool: "true or false",
    str: "text",
    Path: "a path",
    NoneType: "null",
}


class FieldError(InputError):
    """A value that does not fit; ``where`` it is and what is wrong with it."""

    def __init__(self, where: Where, problem: str) -> None:
        super().__init__(f"{dotted(where)}: {problem}" if where else problem)
        self.where = where


def dotted(where: Where) -> str:
    """The way to a value for people, such as ``budget.seeds[0]``."""
    return "".join(f"[{part}]" if isinstance(part, int) else f".{part}" for part in where).removeprefix(".")


def build(kind: Any, value: Any, where: Where = ()) -> Any:
    """What a file says, as a value of a type: a dataclass, a tuple, a union, a literal, or a plain type.

    A dataclass may have a class method ``from_file(value, where)`` that makes it of what a file says instead.

    Raises:
        FieldError: the value does not fit the type.
    """
    if get_origin(kind) is Annotated:
        kind = get_args(kind)[0]
    if hasattr(kind, "from_file"):
        return kind.from_file(value, where)
    if is_dataclass(kind):
        return _build_dataclass(kind, None, value, where)
    if get_origin(kind) in (Union, UnionType):
        fitting = [one for one in get_args(kind) if _has_shape(one, value)]
        return build(fitting[0], value, where) if fitting else _refuse(kind, value, where)
    if not _has_shape(kind, value):
        _refuse(kind, value, where)
    if get_origin(kind) is tuple:
        return tuple(build(one, part, (*where, at)) for at, (one, part) in enumerate(_items(kind, value, where)))
    return value if kind is NoneType or get_origin(kind) is Literal else kind(value)


def overlay(base: T, value: Any, where: Where = ()) -> T:
    """A dataclass with the values that a file gives in place of its own, at any depth.

    Raises:
        FieldError: there is no such field, or a value does not fit its type.
    """
    built: T = _build_dataclass(type(base), base, value, where)
    return built


def choose(value: Any, named: Mapping[str, T], default: str, where: Where = ()) -> str | T:
    """What a file means by a name, or by a mapping of what differs from the one that it calls its ``base``.

    Returns:
        The name of a known one, or a new one that differs from all of them.

    Raises:
        FieldError: there is no such name, or a value does not fit.
    """
    if not is_mapping(value, named, where):
        return require_known(value, named, where)
    name = require_base(value, named, default, where)
    changed = overlay(named[name], {key: one for key, one in value.items() if key != "base"}, where)
    return next((known for known, one in named.items() if one == changed), changed)


def is_mapping(value: Any, named: Mapping[str, Any], where: Where) -> bool:
    """Whether a file gives a mapping in place of a name.

    Raises:
        FieldError: it gives neither.
    """
    if not isinstance(value, str | Mapping):
        raise FieldError(where, f"must be a name ({', '.join(named)}) or a mapping of settings, not {value!r}")
    return isinstance(value, Mapping)


def require_base(value: Mapping[str, Any], named: Mapping[str, Any], default: str, where: Where) -> str:
    """The name that a mapping calls its ``base``, if it is a known one.

    Raises:
        FieldError: it is not.
    """
    return require_known(value.get("base", default), named, (*where, "base"))


def require_known(name: Any, known: Mapping[str, Any] | Sequence[str], where: Where) -> str:
    """``name``, if it is one of the known ones.

    Raises:
        FieldError: it is not.
    """
    if not isinstance(name, str) or name not in known:
        known_names = ", ".join(known)
        raise FieldError(where, f"is not known: {name!r}{_nearest(str(name), known)}; choose one of: {known_names}")
    return name


def require_fields(value: Mapping[Any, Any], known: Mapping[str, Any], where: Where = ()) -> None:
    """Raise FieldError if a mapping has other keys than the known ones."""
    for key in value:
        if key not in known:
            nearest = _nearest(str(key), known)
            raise FieldError((*where, str(key)), f"there is no such setting{nearest}; known are {', '.join(known)}")


def plain(value: Any) -> Any:
    """A value as YAML and JSON can hold it; ``build`` makes the same value of it again."""
    if is_dataclass(value) and not isinstance(value, type):
        return {field.name: plain(getattr(value, field.name)) for field in fields(value) if field.init}
    if isinstance(value, Mapping):
        return {str(key): plain(one) for key, one in value.items()}
    if isinstance(value, tuple | list):
        return [plain(one) for one in value]
    return str(value) if isinstance(value, Path) else value


def _build_dataclass(kind: Any, base: Any, value: Any, where: Where) -> Any:
    if not isinstance(value, Mapping):
        _refuse(kind, value, where)
    hints = get_type_hints(kind, include_extras=True)
    known = {field.name: field for field in fields(kind) if field.init}
    require_fields(value, known, where)
    given = {key: _build_field(hints[key], getattr(base, key, None), one, (*where, key)) for key, one in value.items()}
    missing = [name for name, field in known.items() if name not in given and is_required(field)]
    if base is None and missing:
        raise FieldError(where, f"{', '.join(missing)} must be given")
    try:
        return kind(**given) if base is None else replace(base, **given)
    except InputError as error:
        raise FieldError(where, str(error)) from None


def _build_field(kind: Any, present: Any, value: Any, where: Where) -> Any:
    """A field's new value; a mapping changes the dataclass that is there."""
    if isinstance(value, Mapping) and is_dataclass(present) and not hasattr(kind, "from_file"):
        return overlay(present, value, where)
    return build(kind, value, where)


def is_required(field: Any) -> bool:
    """Whether a dataclass's field has no default."""
    return field.default is MISSING and field.default_factory is MISSING


def _has_shape(kind: Any, value: Any) -> bool:
    """Whether a value may fit a type, as far as can be seen without looking into it."""
    if is_dataclass(kind):
        return isinstance(value, Mapping)
    if get_origin(kind) is tuple:
        return isinstance(value, list | tuple) or (_is_variadic(kind) and _has_shape(get_args(kind)[0], value))
    if get_origin(kind) is Literal:
        return value in get_args(kind) and not isinstance(value, bool)
    if isinstance(value, bool):
        return kind is bool
    if kind is float:
        return isinstance(value, int | float) and math.isfinite(value)
    return isinstance(value, str | Path if kind is Path else kind)


def _is_variadic(kind: Any) -> bool:
    """Whether a tuple's type is that of any number of items."""
    return get_args(kind)[-1] is ...


def _items(kind: Any, value: Any, where: Where) -> list[tuple[Any, Any]]:
    """The items of a tuple, each with its type; where there may be any number of them, one needs no list."""
    kinds = get_args(kind)
    if _is_variadic(kind):
        return [(kinds[0], one) for one in (value if isinstance(value, list | tuple) else [value])]
    if len(value) != len(kinds):
        _refuse(kind, value, where)
    return list(zip(kinds, value, strict=True))


def _refuse(kind: Any, value: Any, where: Where) -> Any:
    raise FieldError(where, f"must be {_words(kind)}, not {value!r}")


def _words(kind: Any) -> str:
    """What a type allows."""
    arguments = get_args(kind)
    if is_dataclass(kind):
        return f"a mapping of {', '.join(field.name for field in fields(kind))}"
    if get_origin(kind) is Literal:
        return f"one of {', '.join(map(str, arguments))}"
    if get_origin(kind) is tuple:
        count = "" if _is_variadic(kind) else f" of {len(arguments)}"
        return f"a list{count}, each item {_words(arguments[0])}"
    if arguments:
        return " or ".join(map(_words, arguments))
    return _WORDS[kind]


def _nearest(name: str, known: Mapping[str, Any] | Sequence[str]) -> str:
    found = get_close_matches(name.replace("-", "_"), list(known), n=1)
    return f"; did you mean {found[0]}?" if found else ""
