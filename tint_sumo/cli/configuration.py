"""Commands from configuration files, and back. A command is a dataclass; its fields are its flags and settings."""

import argparse
from collections.abc import Callable, Sequence
from dataclasses import dataclass, fields
from importlib import import_module
from pathlib import Path
from typing import Any, TypeVar, get_args, get_type_hints

import tyro
from tyro.constructors import PrimitiveConstructorSpec

from tint_sumo.core.files import at_home
from tint_sumo.core.redaction import redact
from tint_sumo.core.structures import FieldError, Where, build, choose, is_required, require_fields
from tint_sumo.core.yaml_files import YamlFile, field_notes, read_yaml, to_yaml

T = TypeVar("T")

CONFIG_FLAG = "--config"
NO_SETTINGS = ("config", "print_config")  # fields that are flags alone


@dataclass(frozen=True)
class FromFile:
    """Mark of a field whose flag takes a name, and that can be defined in a file."""

    read: Callable[[Any, Where], Any]  # makes a value of a file's
    full: Callable[[Any], Any]  # returns the settings that a name stands for, and other values as they are


def one_of(module: str, known: str, default: str) -> FromFile:
    """Return the mark of a field with values in the dictionary ``known`` of a module, which is imported when needed."""

    def names() -> Any:
        return getattr(import_module(module), known)

    return FromFile(
        lambda value, where: choose(value, names(), default, where),
        lambda value: names()[value] if isinstance(value, str) else value,
    )


def name_flag(*names: str) -> PrimitiveConstructorSpec[Any]:
    """Return the form of such a field's flag; any name is allowed if no ``names`` are given."""
    return PrimitiveConstructorSpec(
        nargs=1,
        metavar="{" + ",".join(names) + "}" if names else "NAME",
        instance_from_str=lambda words: words[0],
        is_instance=lambda _: True,
        str_from_instance=lambda value: [value if isinstance(value, str | None) else "as in the file"],
        choices=names or None,
    )


def config_of(words: Sequence[str]) -> Path | None:
    """Return the configuration file that the words of a command line name."""
    parser = argparse.ArgumentParser(prog="tint-sumo", add_help=False, allow_abbrev=False)
    parser.add_argument(CONFIG_FLAG, type=Path, nargs="?")  # tyro says that its value is missing
    found: Path | None = parser.parse_known_args(words)[0].config
    return None if found is None else Path(at_home(str(found)))


def commands_named(root: type, words: Sequence[str]) -> list[type]:
    """Return the command that the first words name, behind the groups of commands that it is in."""
    named = [root]
    for word in words:
        below = subcommands(named[-1])
        if word not in below:
            break
        named.append(below[word])
    return named


def subcommands(kind: type) -> dict[str, type]:
    """Return the commands of a group by their names."""
    choices = get_args(get_type_hints(kind, include_extras=True).get("command"))
    return {mark.name: kind.__origin__ for kind in choices for mark in kind.__metadata__ if hasattr(mark, "name")}


def read_command(kind: type[T], file: Path) -> T:
    """Return a command with the values of a file; those that are missing must be given as flags.

    Raises:
        InputError: there is no such file, or a value does not fit.
    """
    found = read_yaml(file)
    try:
        return _command(kind, found)
    except FieldError as error:
        raise found.located(error) from None


def _command(kind: type[T], found: YamlFile) -> T:
    hints = get_type_hints(kind, include_extras=True)
    known = {field.name: field for field in fields(kind) if field.name not in NO_SETTINGS}  # type: ignore[arg-type]
    require_fields(found.content, known)
    given = {name: _value(hints[name], value, (name,)) for name, value in found.content.items()}
    missing = {name: tyro.MISSING for name, field in known.items() if name not in given and is_required(field)}
    return kind(**given, **missing)


def _value(hint: Any, value: Any, where: Where) -> Any:
    named = _from_file(hint)
    return build(hint, value, where) if named is None else named.read(value, where)


def _from_file(hint: Any) -> FromFile | None:
    return next((mark for mark in _marks(hint) if isinstance(mark, FromFile)), None)


def _marks(hint: Any) -> tuple[Any, ...]:
    """Return the marks beside a field's type."""
    return getattr(hint, "__metadata__", ())


def write_command(command: Any) -> str:
    """Return a configuration file with all values of a command, from which ``read_command`` makes the same command.

    Credentials in URLs are left out.
    """
    hints = get_type_hints(type(command), include_extras=True)
    values = {field.name: getattr(command, field.name) for field in fields(command) if field.name not in NO_SETTINGS}
    for name, value in values.items():
        named = _from_file(hints[name])
        values[name] = value if named is None else named.full(value)
    helped = {name: mark.help for name, hint in hints.items() for mark in _marks(hint) if getattr(mark, "help", None)}
    return redact(to_yaml(values, {**field_notes(type(command)), **helped}))
