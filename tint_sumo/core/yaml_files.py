"""YAML files: read with the lines of their values, written with a comment above each setting."""

import ast
import inspect
import math
import re
import textwrap
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, fields, is_dataclass
from itertools import islice, pairwise
from pathlib import Path
from typing import Any

import yaml

from tint_sumo.core.errors import InputError
from tint_sumo.core.reading import SETTINGS_BYTES, read_file
from tint_sumo.core.structures import FieldError, Where, dotted, plain

_MOST_VALUES = 20_000  # in a file
_MOST_DIGITS = 60
_NUMBERS = ("tag:yaml.org,2002:int", "tag:yaml.org,2002:float")
# Exceptions of PyYAML for text that is no YAML, for aliases within what they stand for, and for tags that do not fit.
_DAMAGE = (yaml.YAMLError, RecursionError, ValueError, LookupError, TypeError, AttributeError, OverflowError)
_END = "\n"
_WIDTH = 116  # width of comments and lists


class _Loader(yaml.SafeLoader):
    """YAML 1.1 with the types of JSON alone: a date is text. 1e-3 is a number, as everybody expects."""


class _Dumper(yaml.SafeDumper):
    """Puts text in quotes that the loader would take for a number."""


for _kind in (_Loader, _Dumper):
    _kind.add_implicit_resolver(
        "tag:yaml.org,2002:float", re.compile(r"[-+]?\d+(\.\d*)?[eE][-+]?\d+$"), list("-+0123456789")
    )


_OTHERS = tuple(f"tag:yaml.org,2002:{name}" for name in ("timestamp", "binary", "set", "omap", "pairs"))
_Loader.yaml_constructors = {tag: make for tag, make in _Loader.yaml_constructors.items() if tag not in _OTHERS}
_Loader.yaml_implicit_resolvers = {
    first: [resolver for resolver in resolvers if resolver[0] not in _OTHERS]
    for first, resolvers in _Loader.yaml_implicit_resolvers.items()
}


@dataclass(frozen=True)
class YamlFile:
    """The mapping that a file holds, and the line of each of its values."""

    file: Path
    content: Mapping[str, Any]
    lines: Mapping[Where, int]

    def located(self, error: FieldError) -> InputError:
        """Return the error with the file and the line that it is about."""
        known = (error.where[:length] for length in range(len(error.where), -1, -1))
        line = next((self.lines[where] for where in known if where in self.lines), 1)
        return InputError(f"{self.file}, line {line}: {error}")


def read_yaml(file: Path) -> YamlFile:
    """Read a file that holds a mapping, or nothing.

    Raises:
        InputError: there is no such file, it is too large, damaged, says something twice, or holds something else.
    """
    try:
        text = read_file(file, "configuration", SETTINGS_BYTES).decode("utf-8")
    except UnicodeDecodeError as error:
        raise InputError(f"{file} is not a text file ({error}); give a YAML file") from None
    try:
        content, lines = _parse(text)
    except FieldError as error:
        raise InputError(f"{file}, {error}") from None
    except _DAMAGE as error:
        raise InputError(f"{file}{_syntax(error)}") from None
    if content is None:
        content = {}
    if not isinstance(content, dict):
        raise InputError(f"{file} must hold a mapping, lines such as 'seed: 1', not {type(content).__name__}")
    return YamlFile(file, content, lines)


def _parse(text: str) -> tuple[Any, dict[Where, int]]:
    """Return the content of a text, and the lines of its values."""
    loader = _Loader(text)
    try:
        root = loader.get_single_node()
        if root is None:
            return None, {}
        lines = dict(islice(_lines(root, ()), _MOST_VALUES + 1))
        if len(lines) > _MOST_VALUES:  # aliases of aliases become any number of values
            raise FieldError((), f"line 1: more than {_MOST_VALUES:,} values; leave out what is there by aliases")
        return loader.construct_document(root), lines
    finally:
        loader.dispose()


def read_list(text: str) -> list[Any]:
    """Return the values of a list without its brackets, such as ``1e-3, [64, 64], true``.

    Raises:
        InputError: it is not YAML.
    """
    try:
        values: list[Any] = _parse(f"[{text}]")[0]
    except (FieldError, *_DAMAGE):
        raise InputError(f"{text!r} must be values with commas between them, such as 0.001,0.003") from None
    return values


def _lines(node: yaml.Node, where: Where) -> Iterator[tuple[Where, int]]:
    """Yield the path to each value below a node, and the line it begins in."""
    if isinstance(node, yaml.ScalarNode):
        _require_text(node)
    elif isinstance(node, yaml.MappingNode):
        seen = set()
        for key, value in node.value:
            line, path = key.start_mark.line + 1, (*where, str(key.value))
            if isinstance(key, yaml.ScalarNode):
                _require_text(key)
            if path in seen:
                raise FieldError((), f"line {line}: {dotted(path)} is said twice; leave one of them")
            seen.add(path)
            yield path, line
            yield from _lines(value, path)
    elif isinstance(node, yaml.SequenceNode):
        for number, item in enumerate(node.value):
            yield (*where, number), item.start_mark.line + 1
            yield from _lines(item, (*where, number))


def _require_text(node: yaml.ScalarNode) -> None:
    """Raise FieldError if a value has characters that no name of a file has, or is too long to be a number."""
    line = node.start_mark.line + 1
    if "\0" in node.value or any("\ud800" <= letter <= "\udfff" for letter in node.value):
        raise FieldError((), f"line {line}: {node.value!r} has a character that is no text; leave it out")
    if len(node.value) > _MOST_DIGITS and node.tag in _NUMBERS:
        raise FieldError((), f"line {line}: a number has more than {_MOST_DIGITS} digits; give fewer")


def _syntax(error: Exception) -> str:
    mark = getattr(error, "problem_mark", None)
    line = "" if mark is None else f", line {mark.line + 1}"
    problem = " ".join(str(getattr(error, "problem", None) or error).split())
    return f"{line}: not YAML that can be read ({problem}); correct the file"


def to_yaml(values: Mapping[str, Any], notes: Mapping[str, str]) -> str:
    """Return settings as YAML, each below its note; fields of dataclasses have their docstrings as notes."""
    return "\n".join(_block(values, notes)) + "\n"


def _block(values: Mapping[str, Any], notes: Mapping[str, str]) -> Iterator[str]:
    for key, value in values.items():
        yield from (f"# {line}" for line in textwrap.wrap(notes.get(key, ""), _WIDTH))
        if is_dataclass(value) and not isinstance(value, type):
            yield f"{key}:"
            inner = {field.name: getattr(value, field.name) for field in fields(value) if field.init}
            yield from (f"  {line}" for line in _block(inner, field_notes(type(value))))
        else:
            yield from _entry(key, plain(value))


def _entry(key: str, value: Any) -> list[str]:
    """Return the lines of a value; lists of plain values are in one line each."""
    if isinstance(value, list | dict):
        block: str = yaml.dump({key: value}, Dumper=_Dumper, sort_keys=False, default_flow_style=None, width=_WIDTH)
        return block.rstrip("\n").split("\n")
    style = '"' if "\n" in str(value) else None
    line: str = yaml.dump(value, Dumper=_Dumper, default_style=style, width=math.inf, allow_unicode=True)
    return [f"{key}: {line.partition(_END)[0]}"]


def field_notes(kind: type) -> dict[str, str]:
    """Return the docstrings below the fields of a dataclass and of its parents."""
    notes: dict[str, str] = {}
    for parent in reversed(kind.__mro__):
        if is_dataclass(parent):
            notes |= _notes_in(parent)
    return notes


def _notes_in(kind: type) -> dict[str, str]:
    parsed = ast.parse(textwrap.dedent(inspect.getsource(kind))).body[0]
    assert isinstance(parsed, ast.ClassDef)
    notes = {}
    for node, below in pairwise(parsed.body):
        if isinstance(node, ast.AnnAssign) and isinstance(below, ast.Expr) and isinstance(below.value, ast.Constant):
            notes[ast.unparse(node.target)] = " ".join(str(below.value.value).split())
    return notes
