"""Text for a terminal: paragraphs without what a terminal would obey."""

from __future__ import annotations

from collections.abc import Iterable
from textwrap import fill

from sealscope.errors import printable

#: Width of a line in columns.
WIDTH = 80


def paragraph(text: str, head: str = "", indent: int | None = None, width: int = WIDTH) -> str:
    """Wrap a text beside `head` in lines as wide as whole words allow.

    The second line and those below are indented by `indent` columns, by default those of the head.
    """
    further = " " * (len(head) if indent is None else indent)
    return fill(
        printable(text, "\n\t"),
        width,
        initial_indent=head,
        subsequent_indent=further,
        break_long_words=False,
        break_on_hyphens=False,
    )


def paragraphs(rows: Iterable[tuple[str, str | None]], columns: int, width: int = WIDTH) -> list[str]:
    """Format rows (label, text) as paragraphs beside their labels, which take `columns`; empty texts are left out."""
    return [paragraph(text, f"  {label}".ljust(columns), columns, width) for label, text in rows if text]
