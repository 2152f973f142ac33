"""The ``tint-sumo`` command."""

from tint_sumo.cli.command_line import main

__all__ = ["main"]
