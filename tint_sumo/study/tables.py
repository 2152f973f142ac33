"""Tables for readers."""

from collections.abc import Sequence
from dataclasses import dataclass

Lines = Sequence[Sequence[str]]  # cells; the first line is the header


@dataclass(frozen=True)
class Table:
    """A table with all that belongs to it."""

    heading: str
    lines: Lines
    note: str

    @property
    def markdown(self) -> tuple[str, str, str]:
        return f"## {self.heading}", markdown_table(self.lines), self.note


def markdown_table(lines: Lines) -> str:
    """Return a Markdown table, whose columns also align as plain text."""
    widths = [max(len(line[column]) for line in lines) for column in range(len(lines[0]))]
    rows = [
        "| " + " | ".join(cell.ljust(width) for cell, width in zip(line, widths, strict=True)) + " |" for line in lines
    ]
    return "\n".join([rows[0], "| " + " | ".join("-" * width for width in widths) + " |", *rows[1:]])
