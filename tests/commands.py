"""All commands of the command line."""

from collections.abc import Iterator

from tint_sumo.cli.command_line import TintSumo
from tint_sumo.cli.configuration import subcommands


def commands(kind: type = TintSumo, name: str = "") -> Iterator[tuple[str, type]]:
    """Name and class of every command."""
    below = subcommands(kind)
    if not below:
        yield name, kind
    for word, one in below.items():
        yield from commands(one, f"{name} {word}".strip())
