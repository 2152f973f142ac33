"""Pieces of HTML."""

import base64
import gzip
import hashlib
import json
from collections.abc import Sequence
from html import escape
from typing import Any

from tint_sumo.study.tables import Lines


def table(lines: Lines, caption: str) -> str:
    """Return a table in a box that scrolls; the first line is its header, the first column the headers of the rows.

    Every cell knows the name of its column, which stands beside it on a phone, where each row is a block.
    """
    header, *rows = lines
    head = "".join(f'<th scope="col">{escape(cell)}</th>' for cell in header)
    body = "".join(
        "<tr>"
        + f'<th scope="row">{escape(row[0])}</th>'
        + "".join(
            f'<td data-column="{escape(name)}">{escape(cell)}</td>'
            for name, cell in zip(header[1:], row[1:], strict=True)
        )
        + "</tr>"
        for row in rows
    )
    return (
        f'<div class="scrolls" tabindex="0" role="region" aria-label="{escape(caption)}"><table>'
        f"<caption>{escape(caption)}</caption><thead><tr>{head}</tr></thead><tbody>{body}</tbody></table></div>"
    )


def folded(summary: str, *content: str) -> str:
    """Return an element that opens on a click, and in print."""
    return f"<details><summary>{escape(summary)}</summary>{''.join(content)}</details>"


def paragraph(text: str) -> str:
    return f"<p>{escape(text)}</p>"


def section(name: str, title: str, *content: str) -> str:
    return f'<section id="{name}" aria-labelledby="{name}-title"><h2 id="{name}-title">{escape(title)}</h2>' + (
        "".join(content) + "</section>"
    )


def chart(name: str, description: str, lines: Lines) -> str:
    """Return the element of a chart, and its numbers as a table."""
    return f'<div class="chart" data-chart="{name}" role="img" aria-label="{escape(description)}"></div>' + folded(
        f"The numbers: {description}", table(lines, description)
    )


def json_data(name: str, value: Any) -> str:
    """Return data that scripts read by their name."""
    text = json.dumps(value, separators=(",", ":"), allow_nan=False).replace("<", "\\u003c")  # no tag ends it early
    return f'<script type="application/json" id="{name}">{text}</script>'


def packed(name: str, text: str) -> str:
    """Return the same element for long text: compressed, in Base64."""
    content = base64.b64encode(gzip.compress(text.encode(), mtime=0)).decode("ascii")
    return f'<script type="text/plain" id="{name}">{content}</script>'


def content_policy(scripts: Sequence[str], styles: Sequence[str]) -> str:
    """Return the content security policy of a page with these inline scripts and styles, which fetches nothing.

    Attributes called style are allowed, since Plotly sets them; they cannot run code.
    """
    rules = {
        "default-src": "'none'",
        "script-src": " ".join(map(_source, scripts)),
        "style-src-elem": " ".join(map(_source, styles)),
        "style-src-attr": "'unsafe-inline'",
        "img-src": "data:",
        "base-uri": "'none'",
        "form-action": "'none'",
    }
    return "; ".join(f"{name} {sources}" for name, sources in rules.items())


def _source(text: str) -> str:
    """Return what a policy calls an inline script or style: the digest of its text."""
    return f"'sha256-{base64.b64encode(hashlib.sha256(text.encode()).digest()).decode('ascii')}'"


def bullets(lines: Sequence[str]) -> str:
    """Return a list of pieces of HTML."""
    return f"<ul>{''.join(f'<li>{line}</li>' for line in lines)}</ul>"
