"""Messages of the package name arguments; those of the command line name flags."""

import ast
import re
from collections.abc import Iterator
from dataclasses import fields
from pathlib import Path

from tests.commands import commands
from tint_sumo.cli.command import Command, flag_of

PACKAGE = Path(__file__).parents[2] / "tint_sumo"
ARGUMENTS = {field.name for _, kind in commands() for field in fields(kind)}


def messages() -> Iterator[str]:
    """The text of all that is raised below the command line."""
    for file in PACKAGE.rglob("*.py"):
        if "cli" not in file.relative_to(PACKAGE).parts:
            for node in ast.walk(ast.parse(file.read_text())):
                if isinstance(node, ast.Raise):
                    yield "".join(
                        part.value
                        for part in ast.walk(node)
                        if isinstance(part, ast.Constant) and isinstance(part.value, str)
                    )


def test_no_message_below_the_command_line_names_a_flag() -> None:
    flags = {flag_of(name) for name in ARGUMENTS}
    assert not [text for text in messages() if flags & set(re.findall(r"--[a-z-]+", text))]


def test_arguments_in_messages_are_those_of_commands() -> None:
    named = {name for text in messages() for name in re.findall(r"`(\w+)`", text)}
    assert {"out", "scene", "allow_pickle", "other_scene"} <= named <= ARGUMENTS


def test_commands_show_their_flags_alone() -> None:
    assert Command().with_flags("give `print_config` of `out`") == "give --print-config of `out`"
