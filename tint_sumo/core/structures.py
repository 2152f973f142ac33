"""Dataclasses from the content of files, and back. Pydantic checks types; its errors become one clear line each."""

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
Where = tuple[str | int, ...]  # path to a value: names of fields, and numbers of list items from 0

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
    """A value that does not fit: its path ``where``, the ``problem``, and the paths of ``others``."""

    def __init__(self, where: Where, problem: str, others: Sequence[Where] = ()) -> None:
        also = f"; also wrong: {', '.join(map(dotted, others[:_MOST_OTHERS]))}" if others else ""
        super().__init__((f"{dotted(where)}: {problem}" if where else problem) + also)
        self.where = where
        self.problem = problem
        self.others = others


def dotted(where: Where) -> str:
    """Return the path to a value for people, such as ``budget.seeds[0]``."""
    return "".join(f"[{part}]" if isinstance(part, int) else f".{_printed(part)}" for part in where).removeprefix(".")


def _printed(name: str) -> str:
    """Return a name as it is, or as Python writes it where a line cannot show it."""
    return name if name.isprintable() and len(name) <= _LONGEST_NAME else shown(name)


@dataclass(frozen=True)
class ReadBy:
    """Reader of a type with a special form in files; beside the type, as ``Annotated[Scene, ReadBy(find)]``."""

    read: Callable[[Any], Any]  # makes the value from the file's; raises FieldError

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
    """Mark of a tuple of any length whose only item a file may give without a list."""

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
    """Return a file's content as a value of a type: a dataclass, a tuple, a union, a literal, or a plain type.

    Args:
        kind: the type.
        value: as JSON and YAML have it: null, true, numbers, text, lists and mappings.
        where: the path to the value in its file, for messages.

    Raises:
        FieldError: the value does not fit the type.
    """
    return build_json(kind, json.dumps(plain(value)).encode(), where)


def build_json(kind: Any, text: bytes, where: Where = ()) -> Any:
    """Return a text in JSON as a value of a type.

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
    """Return the values of a file for a dataclass, and those of the dataclass that the file does not give."""
    if not isinstance(value, Mapping):
        return value
    hints = get_type_hints(type(base), include_extras=True)
    present = {field.name: getattr(base, field.name) for field in fields(base) if field.init}
    parts = [name for name in value if is_dataclass(present.get(name)) and get_origin(hints[name]) is not Annotated]
    return {**present, **value, **{name: _merged(present[name], value[name]) for name in parts}}


def choose(value: Any, named: Mapping[str, T], default: str, where: Where = ()) -> str | T:
    """Return the known value that a file names, or a new one: a mapping of its ``base`` and the numbers that differ.

    Returns:
        A name among the known, or a value that differs from all of them.

    Raises:
        FieldError: there is no such name, or a value does not fit.
    """
    if not is_mapping(value, named, where):
        return require_known(value, named, where)
    name = require_base(value, named, default, where)
    changed = overlay(named[name], {key: changes for key, changes in value.items() if key != "base"}, where)
    return next((known for known, settings in named.items() if settings == changed), changed)


def is_mapping(value: Any, named: Mapping[str, Any], where: Where) -> bool:
    """Return whether a file gives a mapping in place of a name.

    Raises:
        FieldError: it gives neither.
    """
    if not isinstance(value, str | Mapping):
        raise FieldError(where, f"must be a name ({', '.join(named)}) or a mapping of settings, not {shown(value)}")
    return isinstance(value, Mapping)


def require_base(value: Mapping[str, Any], named: Mapping[str, Any], default: str, where: Where) -> str:
    """Return the name that a mapping gives as its ``base``.

    Raises:
        FieldError: it is unknown.
    """
    return require_known(value.get("base", default), named, (*where, "base"))


def require_known(name: Any, known: Mapping[str, Any] | Sequence[str], where: Where) -> str:
    """Return ``name`` if it is among the known names.

    Raises:
        FieldError: it is unknown.
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
        return {str(key): plain(item) for key, item in value.items()}
    if isinstance(value, tuple | list):
        return [plain(item) for item in value]
    return str(value) if isinstance(value, Path) else value


def is_required(field: Any) -> bool:
    """Return whether a dataclass's field has no default."""
    return field.default is MISSING and field.default_factory is MISSING


# Pydantic's errors as one line


def _field_error(kind: Any, errors: Iterable[Mapping[str, Any]], where: Where) -> FieldError:
    """Return the first error in full, with the paths of the others."""
    found: dict[Where, str] = {}
    of_unions: dict[Where, str] = {}  # pydantic tries each member of a union; the value may fit the form of none
    missing: dict[Where, list[str]] = {}
    for error in errors:
        path, expected, union = _find(kind, error["loc"][1:])
        cause = error.get("ctx", {}).get("error")
        if error["type"] == "missing" and path and isinstance(path[-1], str):
            missing.setdefault(path[:-1], []).append(path[-1])
        elif error["type"] == "unexpected_keyword_argument":
            found.setdefault(path, _unknown(str(path[-1]), _names(_find(kind, error["loc"][1:-1])[1])))
        elif isinstance(cause, FieldError):
            found.setdefault((*path, *cause.where), cause.problem)
            for other in cause.others:
                found.setdefault((*path, *other), "")
        elif error["type"] in ("value_error", "json_invalid"):
            found.setdefault(path, str(cause))
        else:
            if error["type"] == "missing":  # a tuple is too short
                path, expected, union = _find(kind, error["loc"][1:-1])
            text = f"must be {_words(expected)}, not {shown(error['input'])}"
            (of_unions if path == union else found).setdefault(path, text)
    found |= {path: f"{', '.join(names)} must be given" for path, names in missing.items()}
    found |= {at: text for at, text in of_unions.items() if not any(path[: len(at)] == at for path in found)}
    (first, problem), *others = found.items()
    return FieldError((*where, *first), problem, [(*where, *path) for path, _ in others])


def _find(kind: Any, location: Sequence[str | int]) -> tuple[Where, Any, Where | None]:
    """Return the path of pydantic's location, the type of the value there, and the path of the last union on it."""
    where: Where = ()
    union = None
    parts = list(location)
    while parts:
        members = _members(kind)
        if len(members) > 1:  # this part is the name of the member that was tried
            union = where
            parts.pop(0)
            if parts:
                kind = next((member for member in members if _has_parts(member, parts[0])), None)
            continue
        where = (*where, parts[0])
        kind = _part(members[0], parts.pop(0))
    return where, kind, union


def _members(kind: Any) -> list[Any]:
    """Return the types of a union without annotations and without null, or a list of a type that is no union."""
    kind = get_args(kind)[0] if get_origin(kind) is Annotated else kind
    if get_origin(kind) not in (Union, UnionType):
        return [kind]
    return [member for part in get_args(kind) if part is not NoneType for member in _members(part)]


def _has_parts(kind: Any, part: str | int) -> bool:
    """Return whether values of a type have this part, which is a number or a name."""
    return (get_origin(kind) is tuple) is isinstance(part, int) and _part(kind, part) is not None


def _part(kind: Any, part: str | int) -> Any:
    """Return the type of a part of a value of this type; None if it has no such part."""
    if is_dataclass(kind):
        return get_type_hints(kind, include_extras=True).get(str(part))
    kinds = get_args(kind)
    if get_origin(kind) is not tuple:
        return kinds[-1] if kinds else None
    return kinds[0] if _is_variadic(kind) else next(iter(kinds[int(part) :]), None)


def _is_variadic(kind: Any) -> bool:
    """Return whether tuples of this type may have any number of items."""
    return get_args(kind)[-1] is ...


def _names(kind: Any) -> list[str]:
    """Return the fields that a file can give of the dataclasses in a type."""
    return [field.name for part in _members(kind) if is_dataclass(part) for field in fields(part) if field.init]


def _words(kind: Any) -> str:
    """Return the values that a type allows, in words."""
    arguments = get_args(kind)
    if get_origin(kind) is Annotated:
        limits = [str(mark) for mark in arguments[1:] if isinstance(mark, Range)]
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
