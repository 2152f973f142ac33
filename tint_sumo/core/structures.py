"""Dataclasses from what a file says, and back. Pydantic checks the types; its errors become one clear line each."""

import json
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import MISSING, dataclass, fields, is_dataclass
from difflib import get_close_matches
from functools import cache
from pathlib import Path
from types import NoneType, UnionType
from typing import (
    TYPE_CHECKING,
    Annotated,
    Any,
    ClassVar,
    Literal,
    Self,
    TypeVar,
    Union,
    get_args,
    get_origin,
    get_type_hints,
)

from tint_sumo.core.errors import InputError, shown
from tint_sumo.core.ranges import Range

if TYPE_CHECKING:
    from pydantic import TypeAdapter

# Pydantic is imported when a file is read: --help shall not wait for it.
# ruff: noqa: PLC0415

T = TypeVar("T")
Where = tuple[str | int, ...]  # leads to a value: names of fields, and numbers of list items from 0

_WORDS = {
    int: "a whole number",
    float: "a number",
    bool: "true or false",
    str: "text",
    Path: "a path",
    NoneType: "null",
    dict: "a mapping",
    Mapping: "a mapping",
    Any: "anything",
}
_MOST_OTHERS = 5  # further errors that a message names
_LONGEST_NAME = 80  # characters


class FieldError(InputError):
    """A value that does not fit: ``where`` it is, what is wrong with it, and where ``others`` are."""

    def __init__(self, where: Where, problem: str, others: Sequence[Where] = ()) -> None:
        also = f"; also wrong: {', '.join(map(dotted, others[:_MOST_OTHERS]))}" if others else ""
        super().__init__((f"{dotted(where)}: {problem}" if where else problem) + also)
        self.where = where
        self.problem = problem
        self.others = others


def dotted(where: Where) -> str:
    """The way to a value for people, such as ``budget.seeds[0]``."""
    return "".join(f"[{part}]" if isinstance(part, int) else f".{_printed(part)}" for part in where).removeprefix(".")


def _printed(name: str) -> str:
    """Return a name as it is, or as Python writes it where a line cannot show it."""
    return name if name.isprintable() and len(name) <= _LONGEST_NAME else shown(name)


@dataclass(frozen=True)
class ReadBy:
    """Of a type that a file can give in a form of its own; beside the type, as ``Annotated[Scene, ReadBy(find)]``."""

    read: Callable[[Any], Any]  # makes the value of what the file gives; raises FieldError

    def __get_pydantic_core_schema__(self, source: Any, handler: Any) -> Any:
        from pydantic_core import core_schema

        return core_schema.no_info_plain_validator_function(self.read)


class FileForm(ABC):
    """Base of types that files write in another form than a mapping of their fields."""

    form: ClassVar[str]  # the form in words, which messages put behind "must be"

    @classmethod
    @abstractmethod
    def parse(cls, value: Any) -> Self:
        """Return the value that a file gives in this form.

        Raises:
            InputError: it is not of this form.
        """

    @abstractmethod
    def plain(self) -> Any:
        """Return the value as YAML and JSON can hold it."""

    @classmethod
    def __get_pydantic_core_schema__(cls, source: Any, handler: Any) -> Any:
        return ReadBy(cls.parse).__get_pydantic_core_schema__(source, handler)


class OneOrMany:
    """Of a tuple of any length: a file may give its only item without a list."""

    def __get_pydantic_core_schema__(self, source: Any, handler: Any) -> Any:
        def read(value: Any) -> Any:
            if isinstance(value, list):
                return build(source, value)
            try:
                return build(source, [value])
            except FieldError:
                raise FieldError((), f"must be {_words(source)}, not {shown(value)}") from None

        return ReadBy(read).__get_pydantic_core_schema__(source, handler)


Many = Annotated[tuple[T, ...], OneOrMany()]


def build(kind: Any, value: Any, where: Where = ()) -> Any:
    """Return what a file says as a value of a type: a dataclass, a tuple, a union, a literal, or a plain type.

    Args:
        kind: the type.
        value: of what JSON and YAML know: null, true, numbers, text, lists and mappings.
        where: the way to the value in its file, for messages.

    Raises:
        FieldError: the value does not fit the type.
    """
    return build_json(kind, json.dumps(plain(value)).encode(), where)


def build_json(kind: Any, text: bytes, where: Where = ()) -> Any:
    """Return what a text in JSON says as a value of a type.

    Raises:
        FieldError: the text is not JSON, or the value does not fit the type.
    """
    from pydantic import ValidationError

    if b"\\u0000" in text:
        raise FieldError(where, "has a null character, which is no text; leave it out")
    try:
        return _adapter(kind).validate_json(b"[" + text + b"]")[0]
    except ValidationError as error:
        raise _field_error(kind, error.errors(include_url=False), where) from None


@cache
def _adapter(kind: Any) -> "TypeAdapter[Any]":
    from pydantic import ConfigDict, TypeAdapter

    config = ConfigDict(extra="forbid", strict=True, allow_inf_nan=False)
    return TypeAdapter(tuple[kind], config=config)  # a dataclass itself takes no settings, but inherits a tuple's


def overlay(base: T, value: Any, where: Where = ()) -> T:
    """Return a dataclass with the values that a file gives in place of its present ones, at any depth.

    Raises:
        FieldError: there is no such field, or a value does not fit its type.
    """
    built: T = build(type(base), _merged(base, value), where)
    return built


def _merged(base: Any, value: Any) -> Any:
    """What a file says of a dataclass, and what the dataclass says where the file is silent."""
    if not isinstance(value, Mapping):
        return value
    hints = get_type_hints(type(base), include_extras=True)
    present = {field.name: getattr(base, field.name) for field in fields(base) if field.init}
    parts = [name for name in value if is_dataclass(present.get(name)) and get_origin(hints[name]) is not Annotated]
    return {**present, **value, **{name: _merged(present[name], value[name]) for name in parts}}


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
        raise FieldError(where, f"must be a name ({', '.join(named)}) or a mapping of settings, not {shown(value)}")
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
        nearest, known_names = _nearest(str(name)[:80], known), ", ".join(known)
        raise FieldError(where, f"is not known: {shown(name)}{nearest}; choose one of: {known_names}")
    return name


def require_fields(value: Mapping[Any, Any], known: Mapping[str, Any], where: Where = ()) -> None:
    """Raise FieldError if a mapping has other keys than the known ones."""
    for key in value:
        if key not in known:
            raise FieldError((*where, str(key)), _unknown(str(key), list(known)))


def plain(value: Any) -> Any:
    """Return a value as YAML and JSON can hold it; ``build`` makes the same value of it again."""
    if isinstance(value, FileForm):
        return value.plain()
    if is_dataclass(value) and not isinstance(value, type):
        return {field.name: plain(getattr(value, field.name)) for field in fields(value) if field.init}
    if isinstance(value, Mapping):
        return {str(key): plain(one) for key, one in value.items()}
    if isinstance(value, tuple | list):
        return [plain(one) for one in value]
    return str(value) if isinstance(value, Path) else value


def is_required(field: Any) -> bool:
    """Whether a dataclass's field has no default."""
    return field.default is MISSING and field.default_factory is MISSING


# Pydantic's errors as one line


def _field_error(kind: Any, errors: Iterable[Mapping[str, Any]], where: Where) -> FieldError:
    """The first error in full, and where others are."""
    found: dict[Where, str] = {}
    of_unions: dict[Where, str] = {}  # pydantic tries each member of a union; the value may have the shape of none
    missing: dict[Where, list[str]] = {}
    for error in errors:
        place, expected, union = _find(kind, error["loc"][1:])
        problem = error.get("ctx", {}).get("error")
        if error["type"] == "missing" and place and isinstance(place[-1], str):
            missing.setdefault(place[:-1], []).append(place[-1])
        elif error["type"] == "unexpected_keyword_argument":
            found.setdefault(place, _unknown(str(place[-1]), _names(_find(kind, error["loc"][1:-1])[1])))
        elif isinstance(problem, FieldError):
            found.setdefault((*place, *problem.where), problem.problem)
            for other in problem.others:
                found.setdefault((*place, *other), "")
        elif error["type"] in ("value_error", "json_invalid"):
            found.setdefault(place, str(problem))
        else:
            if error["type"] == "missing":  # a tuple is too short
                place, expected, union = _find(kind, error["loc"][1:-1])
            text = f"must be {_words(expected)}, not {shown(error['input'])}"
            (of_unions if place == union else found).setdefault(place, text)
    found |= {place: f"{', '.join(names)} must be given" for place, names in missing.items()}
    found |= {at: text for at, text in of_unions.items() if not any(one[: len(at)] == at for one in found)}
    (first, problem), *others = found.items()
    return FieldError((*where, *first), problem, [(*where, *place) for place, _ in others])


def _find(kind: Any, location: Sequence[str | int]) -> tuple[Where, Any, Where | None]:
    """Where pydantic's location is, which type the value there should have, and where the last union on the way is."""
    where: Where = ()
    union = None
    parts = list(location)
    while parts:
        members = _members(kind)
        if len(members) > 1:  # this part is the name of the member that was tried
            union = where
            parts.pop(0)
            if parts:
                kind = next((one for one in members if _has_parts(one, parts[0])), None)
            continue
        where = (*where, parts[0])
        kind = _part(members[0], parts.pop(0))
    return where, kind, union


def _members(kind: Any) -> list[Any]:
    """The types of a union, without what they are annotated with and without null; a type itself is its only one."""
    kind = get_args(kind)[0] if get_origin(kind) is Annotated else kind
    if get_origin(kind) not in (Union, UnionType):
        return [kind]
    return [member for one in get_args(kind) if one is not NoneType for member in _members(one)]


def _has_parts(kind: Any, part: str | int) -> bool:
    """Whether values of a type have items with numbers, or with names."""
    return (get_origin(kind) is tuple) is isinstance(part, int)


def _part(kind: Any, part: str | int) -> Any:
    """The type of a part of a value of this type; None if it has no such part."""
    if is_dataclass(kind):
        return get_type_hints(kind, include_extras=True).get(str(part))
    kinds = get_args(kind)
    if get_origin(kind) is not tuple:
        return kinds[-1] if kinds else None
    return kinds[0] if _is_variadic(kind) else next(iter(kinds[int(part) :]), None)


def _is_variadic(kind: Any) -> bool:
    """Whether a tuple's type is that of any number of items."""
    return get_args(kind)[-1] is ...


def _names(kind: Any) -> list[str]:
    """The fields of a dataclass that a file can give, also of one among other types."""
    return [field.name for one in _members(kind) if is_dataclass(one) for field in fields(one) if field.init]


def _words(kind: Any) -> str:
    """What a type allows."""
    arguments = get_args(kind)
    if get_origin(kind) is Annotated:
        limits = [str(one) for one in arguments[1:] if isinstance(one, Range)]
        return " ".join([_words(arguments[0]), *limits])
    if isinstance(kind, type) and is_dataclass(kind):
        return kind.form if issubclass(kind, FileForm) else f"a mapping of {', '.join(_names(kind))}"
    if get_origin(kind) is Literal:
        return f"one of {', '.join(map(str, arguments))}"
    if get_origin(kind) is tuple:
        count = "" if _is_variadic(kind) else f" of {len(arguments)}"
        return f"a list{count}, each item {_words(arguments[0])}"
    if get_origin(kind) in (Union, UnionType):
        return " or ".join(map(_words, arguments))
    return _WORDS[get_origin(kind) or kind]


def _unknown(name: str, known: Sequence[str]) -> str:
    return f"there is no such setting{_nearest(name, known)}; known are {', '.join(known)}"


def _nearest(name: str, known: Mapping[str, Any] | Sequence[str]) -> str:
    found = get_close_matches(name.replace("-", "_"), list(known), n=1)
    return f"; did you mean {found[0]}?" if found else ""
